"""Baxter: is a law that is added to real efforts named as what changed?

    TWIN_RECORDINGS=FOLDER python benchmarks/changes/baxter.py [--choices N] [--by-law]

Eight recordings of one session of Baxter's left arm are divided into three new and five earlier
ones. One law at one joint is added to the new ones. Its size is r times the RMS residual of this
joint after an identification of rigid bodies, armature, friction and bias. Every law of the
catalogue at every joint is added once for each choice of the three, with a random shape and sign.

The laws are added to the linear rows; the scatter between recordings is estimated once for each
choice, because a law that is the same in the three new recordings is no scatter. The same through
files and the command: ``baxter_command.py``.
"""

from __future__ import annotations

import argparse
import gzip
import itertools
import os
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from injected import (
    NEW,
    Outcome,
    Robot,
    answer,
    drawn_amplitudes,
    in_process,
    interval,
    robot_of,
    show,
)

from pytest_twin.changes.motor_types import TypeLaw, type_laws
from pytest_twin.changes.prepared import prepare
from pytest_twin.changes.recordings import read_compared
from pytest_twin.loaded_model import load_model
from pytest_twin.recording_options import RecordingOptions

MOTORS = {
    "large": ("left_s0", "left_s1", "left_e0", "left_e1"),
    "small": ("left_w0", "left_w1", "left_w2"),
}
"""Motor types of the arm: two sizes of series elastic actuators."""


def folder() -> Path:
    """Folder of the recordings."""
    beside = Path(__file__).resolve().parents[3] / "shared" / "recordings"
    found = Path(os.environ.get("TWIN_RECORDINGS") or beside) / "baxter"
    if not found.is_dir():
        raise SystemExit("no recordings of Baxter: the variable TWIN_RECORDINGS says where")
    return found


def urdf() -> Path:
    """Baxter's URDF of example-robot-data."""
    import pinocchio

    for parent in Path(pinocchio.__file__).parents:
        robots = parent / "share" / "example-robot-data" / "robots"
        if robots.is_dir():
            return robots / "baxter_description" / "urdf" / "baxter.urdf"
    raise SystemExit("example-robot-data is not installed: pip install pytest-twin[test]")


def write_recordings(out: Path) -> list[Path]:
    """Write the recordings as CSV files."""
    paths = []
    for source in sorted(folder().glob("*.csv.gz")):
        paths.append(out / source.name.removesuffix(".gz"))
        paths[-1].write_bytes(gzip.decompress(source.read_bytes()))
    return paths


def read(paths: Sequence[Path]) -> Robot:
    """Read recordings and evaluate every law along them."""
    loaded = load_model(urdf())
    compared = read_compared(
        loaded.realization, paths[:-1], paths[-1:], [], loaded.topics,
        RecordingOptions().over(loaded.options),
    )  # fmt: skip
    return robot_of(loaded.realization, compared.every)


def with_motor_types(
    robot: Robot, choices: Sequence[tuple[int, ...]], seed: int
) -> dict[str, list[Outcome]]:
    """Cases of a law of a whole type at r = 0.5 and 1, and of one joint with and without types."""
    shapes, joints = robot.shapes, robot.laws.joints
    motors = {name: [joints.index(j) for j in names] for name, names in MOTORS.items()}
    types = type_laws(shapes, robot.rows.scale, motors)
    outcomes: dict[str, list[Outcome]] = {}
    for new in choices:
        random = np.random.default_rng([seed, *new])
        earlier = [[i] for i in range(robot.count) if i not in new]
        prepared = prepare(robot.rows, earlier, [[i] for i in new], shapes)
        for law in types:
            sample = types_sample(robot, law, new, random)
            kind = law.term.joint
            for r in (0.5, 1.0):
                outcomes.setdefault(f"type, r = {r:g}", []).append(
                    answer(robot, prepared, types, (law.term.effect, kind), r * sample, new)
                )
            member = shapes[law.members[random.integers(len(law.members))]]
            single = np.zeros(len(robot.rows.scale))
            single[member.indices] = sample[member.indices]
            for with_types in (False, True):
                name = f"one joint, {'with' if with_types else 'no'} types"
                outcomes.setdefault(name, []).append(
                    answer(
                        robot,
                        prepared,
                        types if with_types else (),
                        (law.term.effect, member.term.joint),
                        single,
                        new,
                    )
                )
    return outcomes


def types_sample(
    robot: Robot, law: TypeLaw, new: Sequence[int], random: np.random.Generator
) -> np.ndarray:
    """(columns,) amplitudes of a law in all joints of a type, each at the residual of its joint.

    The sign is that of the type; the size of each joint deviates by 20 % from it.
    """
    amplitudes = np.zeros(len(robot.rows.scale))
    direction = None
    for member in law.members:
        shape = robot.shapes[member]
        sums = robot.rows.sums_of(new)[shape.term.joint]
        at = np.searchsorted(sums.columns, shape.indices)
        square = sums.matrix[np.ix_(at, at)] / sums.samples
        if direction is None:
            drawn = drawn_amplitudes(robot, [shape], shape.term.joint, new, random)
            direction = drawn[shape.indices] * np.sqrt(np.diag(square))
        values = direction / np.sqrt(np.diag(square))
        size = robot.residual[shape.term.joint] * (1.0 + 0.2 * random.normal())
        amplitudes[shape.indices] = values * size / np.sqrt(values @ square @ values)
    return amplitudes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--choices", type=int, default=8, help="choices of the new recordings")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--by-law", action="store_true", help="the laws at r = 1, one by one")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        paths = write_recordings(Path(scratch))
        robot = read(paths)
        every = list(itertools.combinations(range(robot.count), NEW))
        order = np.random.default_rng(args.seed).permutation(len(every))
        some = [every[k] for k in order[: args.choices]]
        outcomes = in_process(robot, some, args.seed)
        unchanged = outcomes.pop(0.0)
        alarms = sum(o.score > o.threshold for o in unchanged)
        print(
            f"nothing changed: {alarms} alarms of {len(unchanged)} choices "
            f"({interval(alarms, len(unchanged))}; the choices share recordings), "
            f"{sum(o.score > o.threshold and o.confidence >= 0.9 for o in unchanged)} names at 0.9"
        )
        print(
            f"  scores {[round(o.score, 1) for o in unchanged]}, "
            f"thresholds {[round(o.threshold, 1) for o in unchanged]}"
        )
        for r, of_size in outcomes.items():
            show(f"r = {r:g}", of_size)
        if args.by_law:
            for effect in sorted({o.effect for o in outcomes[1.0]}):
                of_law = [o for o in outcomes[1.0] if o.effect == effect]
                wrong = Counter(o.named for o in of_law if not o.is_right).most_common(3)
                print(f"  {effect:<30} {sum(o.is_right for o in of_law)} of {len(of_law)}; {wrong}")
        for name, of_kind in with_motor_types(robot, some[:3], args.seed).items():
            show(name, of_kind)


if __name__ == "__main__":
    main()
