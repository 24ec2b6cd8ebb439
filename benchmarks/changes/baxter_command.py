"""Baxter through ``pytest-twin diagnose --before``: cases from files, a few at a time.

    TWIN_RECORDINGS=FOLDER python benchmarks/changes/baxter_command.py [--seconds N] [--cases N]

Three of eight recordings of one session are the new ones. A law is added to their efforts: at one
joint, or in all joints of a motor type (with ``motors:`` in ``twin.yaml``), at r = 0.5 and 1 times
the residual that an identification leaves. Every case draws law, joint, shape, sign and recordings
from its number alone. Answers are appended to a file, so that a run goes on where the last one
ended; the figures are those of all answers.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from baxter import MOTORS, read, types_sample, urdf, write_recordings
from injected import NEW, Robot, drawn_amplitudes, interval

from pytest_twin import cli
from pytest_twin.changes.motor_types import type_laws
from pytest_twin.commands import child_result

sys.path.append(str(Path(__file__).resolve().parents[2] / "tests"))
from in_process import InProcess

ANSWERS = Path(__file__).with_name("answers") / "baxter_command.jsonl"
GOALS = {"joint 0.5": 85, "joint 1": 92, "type 0.5": 93, "type 1": 97}
KINDS = (*GOALS, "unchanged")


def cases(count: int) -> Iterator[tuple[str, int]]:
    """Kind and number of every case; unchanged cases are as many as there are in 20 others."""
    for number in range(count):
        for kind in GOALS:
            yield kind, number
        if number % 5 == 0:
            yield "unchanged", number


def drawn(robot: Robot, kind: str, number: int) -> tuple[list[int], str, str | None, np.ndarray]:
    """New recordings, effect, joint or motor type, and amplitudes of a case."""
    random = np.random.default_rng([7, KINDS.index(kind), number])
    new = sorted(random.permutation(robot.count)[:NEW].tolist())
    if kind == "unchanged":
        return new, "", None, np.zeros(len(robot.rows.scale))
    family, size = kind.split()
    if family == "type":
        joints = robot.laws.joints
        motors = {name: [joints.index(j) for j in names] for name, names in MOTORS.items()}
        laws = type_laws(robot.shapes, robot.rows.scale, motors)
        law = laws[random.integers(len(laws))]
        amplitudes = types_sample(robot, law, new, random)
        return new, law.term.effect, law.motor, float(size) * amplitudes
    terms = sorted({s.term for s in robot.shapes if s.term.joint >= 0})
    term = terms[random.integers(len(terms))]
    shapes = [
        s for s in robot.shapes
        if s.term == term and (term.effect != "inertial_parameters" or len(s.columns) == 1)
    ]  # fmt: skip
    amplitudes = drawn_amplitudes(robot, shapes, term.joint, new, random)
    return new, term.effect, robot.laws.joints[term.joint], float(size) * amplitudes


def answer(robot: Robot, paths: Sequence[Path], model: Path, kind: str, number: int) -> dict:
    """Run one case through the command; what was hidden and what was answered."""
    new, effect, at, amplitudes = drawn(robot, kind, number)
    with tempfile.TemporaryDirectory() as scratch:
        changed = []
        for i in new:
            changed.append(Path(scratch) / f"new_{paths[i].name}")
            write_with(robot, i, amplitudes, paths[i], changed[-1])
        earlier = [str(p) for i, p in enumerate(paths) if i not in new]
        silent = io.StringIO()
        with contextlib.redirect_stdout(silent), contextlib.redirect_stderr(silent):
            status = cli.main([
                "diagnose", str(model), *map(str, changed), "--before", *earlier,
                "--package", f"example-robot-data={urdf().parents[3]}", "--out", f"{scratch}/out",
            ])  # fmt: skip
        if status == 2:
            raise SystemExit(silent.getvalue())
        document = json.loads((Path(scratch) / "out" / "diagnosis.json").read_text())
    named = [[f["effect"], f["motor"] or f["joint"], f["confidence"]] for f in document["findings"]]
    return {
        "kind": kind, "case": number, "effect": effect, "at": at, "verdict": document["verdict"],
        "score": document["alarm"]["score"], "threshold": document["alarm"]["threshold"],
        "named": named,
        "candidates": [
            [one["effect"], one["motor"] or one["joint"], one["confidence"]]
            for one in document["candidates"]
        ],
        "explained": document["explained"],
        "places": [
            [one["motor"] or one["joint"], one["confidence"]] for one in document["places"]
        ],
    }  # fmt: skip


def write_with(robot: Robot, i: int, amplitudes: np.ndarray, source: Path, out: Path) -> None:
    """Write a recording with the efforts of a law added."""
    header = source.read_text().split("\n", 1)[0].split(",")
    table = np.loadtxt(source, delimiter=",", skiprows=1)
    stamps, added = robot.recorded_effort_of(i, amplitudes)
    for j, joint in enumerate(robot.laws.joints):
        column = header.index(f"{joint}.effort")
        table[:, column] += np.interp(table[:, 0] - table[0, 0], stamps, added[:, j])
    np.savetxt(out, table, fmt="%.9g", delimiter=",", header=",".join(header), comments="")


def show(answers: Sequence[dict]) -> None:
    """Print the figures of all answers."""
    sure = right_and_sure = 0
    for kind in KINDS:
        own = [one for one in answers if one["kind"] == kind]
        alarms = [one for one in own if one["verdict"] != "no_change"]
        if kind == "unchanged":
            count = len(alarms), len(own)
            if own:
                print(f"unchanged: {count[0]} alarms of {count[1]} ({interval(*count)})")
            continue
        right = [bool(o["named"]) and o["named"][0][:2] == [o["effect"], o["at"]] for o in own]
        for one in own:
            # A change of a motor type has a finding for each of its joints.
            for effect, at in {(e, at) for e, at, confidence in one["named"] if confidence >= 0.9}:
                sure += 1
                right_and_sure += (effect, at) == (one["effect"], one["at"])
        if own:
            print(
                f"{kind}: {len(own)} cases, alarm {len(alarms)}, named first and right "
                f"{sum(right)} ({interval(sum(right), len(own))}; goal {GOALS[kind]} %)"
            )
    undecided = [one for one in answers if one.get("candidates")]
    for kind in GOALS:
        own = [one for one in undecided if one["kind"] == kind]
        law = sum(
            [one["effect"], one["at"]] in [c[:2] for c in one["candidates"][:1]] for one in own
        )
        listed = sum(
            [one["effect"], one["at"]] in [c[:2] for c in one["candidates"]] for one in own
        )
        place = sum(one["places"][0][0] == one["at"] for one in own)
        if own:
            print(
                f"{kind}, no name: {len(own)} cases, first candidate right {law}, law among the "
                f"candidates {listed}, place right {place}"
            )
    if sure:
        print(f"names at 0.9: {right_and_sure} of {sure} right (goal 90 %)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=100, help="cases of each kind")
    parser.add_argument("--seconds", type=float, default=0.0, help="stop after; 0 for no limit")
    parser.add_argument("--answers", type=Path, default=ANSWERS, help="file of the answers")
    args = parser.parse_args()
    began = time.monotonic()
    # The start of a child process for every case would take half of the time.
    child_result.Sandbox = InProcess
    args.answers.parent.mkdir(exist_ok=True)
    lines = args.answers.read_text().splitlines() if args.answers.exists() else []
    answers = [json.loads(line) for line in lines]
    done = {(one["kind"], one["case"]) for one in answers}
    with tempfile.TemporaryDirectory() as scratch:
        paths = write_recordings(Path(scratch))
        robot = read(paths)
        twin = Path(scratch) / "twin.yaml"
        types = "".join(f"  {name}: [{', '.join(joints)}]\n" for name, joints in MOTORS.items())
        twin.write_text(f"model: {urdf()}\nroots: [{urdf().parents[1]}]\nmotors:\n{types}")
        for kind, number in cases(args.cases):
            if (kind, number) in done:
                continue
            if args.seconds and time.monotonic() - began > args.seconds:
                break
            model = twin if kind.startswith("type") else urdf()
            answers.append(answer(robot, paths, model, kind, number))
            with args.answers.open("a") as file:
                file.write(json.dumps(answers[-1]) + "\n")
    show(answers)


if __name__ == "__main__":
    main()
