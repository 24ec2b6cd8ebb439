"""Other machines than Baxter: are names at 0.9 right where no constant was chosen?

    TWIN_RECORDINGS=FOLDER python benchmarks/changes/machines.py [--choices N] [MACHINE ...]

EMPS (two runs), Panda, TX40 and TIAGo (one run each) are cut into eight parts. The parts are
compared like recordings: a law is added to three of them at r = 0.3 to 3 times
the residual of parts that are left out, and the other five are the earlier ones.
"""

from __future__ import annotations

import argparse
import gzip
import itertools
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from baxter import urdf
from injected import NEW, Outcome, Robot, in_process, interval, robot_of, show, show_reliability

from pytest_twin.changes.prepared import prepare
from pytest_twin.changes.recordings import part_of, read_compared
from pytest_twin.formats.recording import TOPICS
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.realization import load
from pytest_twin.recording_options import NO_OPTIONS
from pytest_twin.twin import load_twin

sys.path.append(str(Path(__file__).resolve().parents[1] / "identification"))
import tiago_files
import tx40_files

PARTS = 8
SIZES = (0.3, 0.5, 1.0, 2.0, 3.0)


def folder() -> Path:
    """Folder of all recordings."""
    beside = Path(__file__).resolve().parents[3] / "shared" / "recordings"
    found = Path(os.environ.get("TWIN_RECORDINGS") or beside)
    if not found.is_dir():
        raise SystemExit("no recordings: the variable TWIN_RECORDINGS says where")
    return found


def files_of(machine: str, out: Path) -> tuple[Path, list[Path]]:
    """Model and recordings of a machine; converted files are written to a folder."""
    if machine == "emps":
        source = folder() / machine
        return source / "model.xml", sorted((source / "recordings").glob("*.mcap"))
    if machine == "panda":
        path = out / "exciting.csv"
        path.write_bytes(gzip.decompress((folder() / "panda_gaz/exciting.csv.gz").read_bytes()))
        robots = urdf().parents[2]
        return robots / "panda_description" / "urdf" / "panda.urdf", [path]
    if machine == "tx40":
        paths = tx40_files.write(folder() / machine, out)
        return paths["twin"], [paths["whole"]]
    paths = tiago_files.write(folder() / machine, out)
    # Its currents have no known torque constant: values are in amperes, names do not depend on it.
    text = paths["twin"].read_text()
    paths["twin"].write_text(text.replace("quantity: current", "quantity: current, constant: 1"))
    return paths["twin"], [paths["fit"], paths["held_out"]]


def read(machine: str) -> Robot:
    """Rows of the parts of a machine's recordings."""
    with tempfile.TemporaryDirectory() as scratch:
        model, paths = files_of(machine, Path(scratch))
        twin = load_twin(model) if model.suffix == ".yaml" else None
        file = model if twin is None else twin.first_realization.file
        realization = load(file, twin=twin, accept_invalid_inertia=True, shapes=False)
        compared = read_compared(
            realization, paths, [], [], TOPICS if twin is None else twin.topics,
            NO_OPTIONS if twin is None else twin.recordings,
        )  # fmt: skip
        robot = robot_of(realization, cut(compared.before))
    # An identification explains short recordings too well: the size is that of parts left out.
    parts = [[i] for i in range(robot.count)]
    usual = prepare(robot.rows, parts[:-1], parts[-1:], robot.shapes).usual
    return replace(robot, residual=np.where(robot.residual > 0.0, usual, 0.0))


def cut(recordings: Sequence[MeasuredRecording]) -> list[MeasuredRecording]:
    """Eight parts, as equal as whole recordings allow."""
    total = sum(len(one.time) for one in recordings)
    parts = []
    for one in recordings:
        count = max(round(PARTS * len(one.time) / total), 1)
        for rows in np.array_split(np.arange(len(one.time)), count):
            parts.append(part_of(one, rows))
    return parts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("machines", nargs="*", default=["emps", "panda", "tx40", "tiago"])
    parser.add_argument("--choices", type=int, default=4, help="choices of the new parts")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    every: list[Outcome] = []
    for machine in args.machines:
        robot = read(machine)
        choices = list(itertools.combinations(range(robot.count), NEW))
        order = np.random.default_rng(args.seed).permutation(len(choices))[: args.choices]
        outcomes = in_process(robot, [choices[k] for k in order], args.seed, SIZES)
        unchanged = outcomes.pop(0.0)
        alarms = sum(o.score > o.threshold for o in unchanged)
        print(
            f"{machine}: {robot.count} parts, nothing changed: {alarms} alarms of {len(unchanged)}"
        )
        for r, of_size in outcomes.items():
            show(f"r = {r:g}", of_size)
            every += of_size
        show_reliability([o for of_size in outcomes.values() for o in of_size])
    sure = [o for o in every if o.score > o.threshold and o.confidence >= 0.9]
    if sure:
        right = sum(o.is_right for o in sure)
        print(
            f"names at 0.9: {right} of {len(sure)} right ({interval(right, len(sure))}; cases of "
            "one choice share recordings)"
        )


if __name__ == "__main__":
    main()
