"""Draw cases of family ``other engines``: Drake and Bullet as plants. One seed, one case.

    python benchmarks/concealed/engine_cases.py --out DIR --truth DIR --seeds 201000:201040

Even seeds use Drake, odd ones Bullet. Of any 20 consecutive seeds, 4 have no hidden effect, so only
the background differs; 12 have one effect, 3 have two, and 1 has three. About one robot in three
touches a surface.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from case_parts import HELD_OUT, STANDS_OUT, hide, made_to_stand_out, seen, write_case, write_truth
from cases import CONTACT_EFFECTS, SEEDS, drawn, seeds, touching
from cell import Background, Cell, draw_background, draw_cell, ideal
from cell_cases import places
from engine_plant import ENGINES, Run, named, simulate
from logger import Logger, draw_logger
from plant import TICK, Hidden
from robots import Robot, draw
from setpoints import FINE, setpoints

FAMILY = "engine"
BLOCK = 20
ORDER = np.random.default_rng(20_261_129).permutation(BLOCK)
PLAN = ["none"] * 4 + ["one"] * 12 + ["two"] * 3 + ["three"]
NUMBER = {"none": 0, "one": 1, "two": 2, "three": 3}
COUNTS = {1: 0.5, 2: 0.3, 3: 0.15, 6: 0.05}
SECONDS = (6.0, 7.0, 8.0)
SERVO_PERIODS = (1e-3, 2e-3, 4e-3)
"""Time between samples, s, a multiple of the time steps of both engines."""
TOUCHING = 0.35
"""Fraction of the cases in which the robot touches a surface."""


def kind_of(seed: int) -> str:
    """Return the kind of a seed: none, one, two or three."""
    return PLAN[int(ORDER[seed % BLOCK])]


def engine_of(seed: int) -> str:
    """Return the engine that simulates the plant of a seed."""
    return ENGINES[seed % len(ENGINES)]


class EngineScene:
    """A robot in another engine, simulated with selected effects."""

    def __init__(
        self, engine: str, robot: Robot, cell: Cell, reference: np.ndarray, logger: Logger
    ) -> None:
        self.engine, self.robot, self.cell, self.logger = engine, robot, cell, logger
        self.reference = reference
        self.known: dict[str, Run] = {}

    def held_out(
        self, hidden: Hidden, background: Background, force: np.ndarray | None, again: Run | None,
        *, nominal: bool = False,
    ) -> Run:  # fmt: skip
        """Simulate held-out recordings, both with contact; with nominal servos if ``nominal``."""
        assert force is None
        assert again is None
        cell = ideal(self.cell, SERVO_PERIODS[0]) if nominal else self.cell
        key = repr((cell, hidden, background))
        if key not in self.known:
            some = HELD_OUT if self.robot.contact is not None else slice(-1, None)
            some_of = np.ascontiguousarray(self.reference[:, some])
            self.known[key] = simulate(self.engine, self.robot, cell, hidden, background, some_of)
        return self.known[key]


def draw_robot(
    engine: str, seconds: float, touches: bool, joints: int | None, rng: np.random.Generator
) -> tuple[Robot, np.ndarray]:
    """A robot and its setpoints (milliseconds, recordings, joints).

    With contact, the duration is the time needed to reach the surface, independent of ``seconds``.
    """
    count = drawn(COUNTS, rng) if joints is None else joints
    touches = touches and count <= 3
    mode = "position" if touches or rng.random() < 0.85 else "velocity"
    robot = draw(rng, count, mode, hinges=touches)
    if engine == "bullet":  # this engine has no reflected inertia of motors
        robot = replace(robot, joints=tuple(replace(j, armature=0.0) for j in robot.joints))
    if not touches:
        return robot, setpoints(robot, seconds, rng)
    robot, coarse = touching(robot, rng)
    long = len(coarse) * TICK
    fine, ticks = np.arange(0.0, long - TICK, FINE), np.arange(len(coarse)) * TICK
    flat = coarse.reshape(len(coarse), -1)
    moved = np.stack([np.interp(fine, ticks, column) for column in flat.T], axis=1)
    return robot, moved.reshape(len(fine), *coarse.shape[1:])


def make(seed: int, out: Path, truth: Path, joints: int | None = None) -> str:
    """Write one case; returns its name."""
    rng = np.random.default_rng([20_261_129, seed])
    engine, kind = engine_of(seed), kind_of(seed)
    seconds = float(rng.choice(SECONDS))
    touches = bool(rng.random() < TOUCHING)
    robot, reference = draw_robot(engine, seconds, touches, joints, rng)
    cell = draw_cell(robot, rng)
    period = float(rng.choice(SERVO_PERIODS))
    # The engine has its own friction law, and no current loop is modelled.
    cell = replace(cell, servo_period=period, servo_phase=0.0, current_bandwidth=0.0,
                   electrical=0.0, friction="set_valued", yield_at=0.0)  # fmt: skip
    possible = named(engine) + (CONTACT_EFFECTS if robot.contact is not None else ())
    hidden = hide(possible, places, NUMBER[kind], robot, rng)
    if robot.contact is not None and kind == "one" and rng.random() < 0.5:
        hidden = hide(CONTACT_EFFECTS, places, 1, robot, rng)
    background = draw_background(robot, rng)
    unknown = {"armature", "stribeck_friction"} - set(named(engine))
    for effect in unknown:
        background.effects.pop(effect, None)
    logger = draw_logger(rng)
    scene = EngineScene(engine, robot, cell, reference, logger)
    stands = None
    if kind != "none":
        wanted = float(np.exp(rng.uniform(*np.log(STANDS_OUT))))
        hidden, background, _, stands = made_to_stand_out(scene, hidden, background, None, wanted)
    background = background.without(hidden.effects)
    visibility = seen(scene, hidden, background, None)
    whole = simulate(engine, robot, cell, hidden, background, reference)
    seconds = len(reference) * FINE
    name = f"{FAMILY}{seed}"
    write_case(out / name, robot, cell, logger, hidden, whole, reference, rng)
    head = {"case": name, "family": FAMILY, "engine": engine, "kind": kind, "seconds": seconds}
    tail = {"outside": None, "stands_out": stands}
    laws = CONTACT_EFFECTS[1:] if robot.contact is not None else ()
    write_truth(truth / f"{name}.json", head, robot, cell, logger, hidden, background, visibility,
                tail, laws)  # fmt: skip
    return name


def main() -> None:
    """Write the cases of some seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--seeds", type=seeds, default="0:8", help=SEEDS)
    parser.add_argument("--joints", type=int, help="of every robot, in place of a drawn number")
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    with ProcessPoolExecutor(args.jobs) as pool:
        jobs = [pool.submit(make, s, args.out, args.truth, args.joints) for s in args.seeds]
        for job in jobs:
            print(job.result(), flush=True)


if __name__ == "__main__":
    main()
