"""Draw cases of family ``sampled cells``. One seed, one case.

    python benchmarks/concealed/cell_cases.py --out DIR --truth DIR --seeds 100000:100060

Of any 20 consecutive seeds, 4 have no hidden effect, so only the background differs; 11 have one
effect, 2 have two, 1 has three, and 2 have a force that is not in the catalogue.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from case_parts import (
    HELD_OUT,
    STANDS_OUT,
    acted_windows,
    hide,
    made_to_stand_out,
    seen,
    write_case,
    write_truth,
)
from cases import EFFECTS, EFFORT_EFFECTS, OUTSIDE_NAMES, SEEDS, drawn, joints_for, seeds
from cell import Background, Cell, draw_background, draw_cell, ideal
from cell_plant import STEP, Run, simulate
from kernel import OUTSIDE, OUTSIDE_KINDS
from logger import Logger, draw_logger
from plant import Hidden
from robots import Robot, draw
from setpoints import FINE, setpoints

FAMILY = "cell"
BLOCK = 20
ORDER = np.random.default_rng(20_261_128).permutation(BLOCK)
PLAN = ["none"] * 4 + ["one"] * 11 + ["two"] * 2 + ["three"] + ["outside"] * 2
NUMBER = {"none": 0, "one": 1, "two": 2, "three": 3, "outside": 0}
COUNTS = {1: 0.45, 2: 0.25, 3: 0.2, 6: 0.1}
MODES = {"position": 0.75, "velocity": 0.1, "effort": 0.15}
SECONDS = (6.0, 8.0, 10.0, 12.0)
NAMED = tuple(e for e in EFFECTS if not e.startswith("contact_"))
"""Effects of this family, which has no contact."""
INDISTINCT = ("command_delay", "sensor_delay", "base_tilt", "encoder_bias")
"""Effects that may be hidden although another effect is equivalent (:mod:`equivalents`)."""


def kind_of(seed: int) -> str:
    """Return the kind of a seed: none, one, two, three or outside."""
    return PLAN[int(ORDER[seed % BLOCK])]


def places(effect: str, robot: Robot) -> list[int]:
    """Return the joints at which an effect or an equivalent one can act and be observed."""
    if effect in INDISTINCT and len(robot.joints) == 1:
        turned = effect not in ("base_tilt", "encoder_bias") or not robot.joints[0].slide
        fits = effect != "encoder_bias" or robot.mode == "position"
        return [-1 if effect in ("sensor_delay", "base_tilt") else 0] if turned and fits else []
    return joints_for(effect, robot)


def force_outside(
    kind: str, joint: int, robot: Robot, reference: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """(1,) record of a force that is not in the catalogue, in the joint's range of motion."""
    path = reference[..., joint]
    if robot.mode == "velocity":
        path = np.cumsum(path, axis=0) * FINE
    force = np.zeros(1, OUTSIDE)
    force["kind"], force["joint"] = OUTSIDE_KINDS.index(kind), joint
    force["at"] = np.quantile(path, rng.uniform(0.35, 0.65))
    force["width"] = rng.uniform(0.03, 0.06)
    force["size"] = rng.uniform(0.8, 1.5) * robot.joints[joint].effort / 6.0
    return force


class CellScene:
    """A robot in a cell, simulated with selected effects."""

    def __init__(self, robot: Robot, cell: Cell, reference: np.ndarray, logger: Logger) -> None:
        self.robot, self.cell, self.logger = robot, cell, logger
        self.reference = reference

    def held_out(
        self, hidden: Hidden, background: Background, force: np.ndarray | None, again: Run | None,
        *, nominal: bool = False,
    ) -> Run:  # fmt: skip
        """Simulate the held-out recordings; if ``nominal``, with nominal servos and friction."""
        cell = ideal(self.cell, STEP) if nominal else self.cell
        return simulate(self.robot, cell, hidden, background, self.reference[:, HELD_OUT],
                        outside=force, again=again)  # fmt: skip


def make(
    seed: int, out: Path, truth: Path, joints: int | None = None, *, has_before: bool = False
) -> str:
    """Write one case; returns its name.

    Args:
        has_before: whether a session of the robot without the hidden effects, with other motions,
            is in the folder ``before`` of the case.
    """
    rng = np.random.default_rng([20_261_128, seed])
    kind = kind_of(seed)
    count = drawn(COUNTS, rng)
    robot = draw(rng, count if joints is None else joints, drawn(MODES, rng))
    cell = draw_cell(robot, rng)
    seconds = float(rng.choice(SECONDS))
    reference = setpoints(robot, seconds, rng)
    hidden = hide(NAMED, places, NUMBER[kind], robot, rng)
    background = draw_background(robot, rng)
    force, outside = None, None
    if kind == "outside":
        outside = {"kind": str(rng.choice(OUTSIDE_NAMES))}
        where = int(rng.integers(len(robot.joints)))
        force = force_outside(outside["kind"], where, robot, reference, rng)
    logger = draw_logger(rng, effort_sensor=bool(set(hidden.effects) & set(EFFORT_EFFECTS)))
    scene = CellScene(robot, cell, reference, logger)
    stands = None
    if kind != "none":
        wanted = float(np.exp(rng.uniform(*np.log(STANDS_OUT))))
        hidden, background, force, stands = made_to_stand_out(
            scene, hidden, background, force, wanted
        )
    background = background.without(hidden.effects)
    visibility = seen(scene, hidden, background, force)
    whole = simulate(robot, cell, hidden, background, reference, outside=force)
    name = f"{FAMILY}{seed}"
    write_case(out / name, robot, cell, logger, hidden, whole, whole.sent, rng)
    if has_before:
        other = np.random.default_rng([20_261_128, seed, 1])
        unaltered = simulate(robot, cell, Hidden(), background, setpoints(robot, seconds, other))
        write_case(
            out / name / "before", robot, cell, logger, Hidden(), unaltered, unaltered.sent, other
        )
    if force is not None and outside is not None:
        size = float(force["size"][0])
        outside |= {
            "joint": robot.joints[int(force["joint"][0])].name, "size": size,
            "at": float(force["at"][0]), "width": float(force["width"][0]),
            "windows": acted_windows(whole.acted, size, whole.period),
        }  # fmt: skip
    head = {"case": name, "family": FAMILY, "kind": kind, "seconds": seconds}
    tail = {"outside": outside, "stands_out": stands}
    write_truth(truth / f"{name}.json", head, robot, cell, logger, hidden, background, visibility,
                tail)  # fmt: skip
    return name


def main() -> None:
    """Write the cases of some seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--seeds", type=seeds, default="0:8", help=SEEDS)
    parser.add_argument("--joints", type=int, help="of every robot, in place of a drawn number")
    parser.add_argument("--before", action="store_true", help="with an earlier unaltered session")
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    with ProcessPoolExecutor(args.jobs) as pool:
        jobs = [
            pool.submit(make, s, args.out, args.truth, args.joints, has_before=args.before)
            for s in args.seeds
        ]
        for job in jobs:
            print(job.result(), flush=True)


if __name__ == "__main__":
    main()
