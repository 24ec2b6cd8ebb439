"""Verify the plant of blind cases against a finer time step and against MuJoCo.

    python benchmarks/concealed/agreement.py [--seconds 12] [--robots 6]

The robots have no hidden effects; they move in the air or touch a surface. RMS and largest position
differences are printed for three comparisons: the plant against itself with every term at 80 kHz,
extrapolated rigid-body terms against evaluation at every step, and the nominal MJCF in MuJoCo at
0.25 ms (stiff dry friction, restarted every second) against the plant.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import mujoco
import numpy as np
from cases import excitations, touching
from plant import RECORD, RESTART, STEP, TICK, Hidden, Motion, simulate
from robots import Robot, draw, mjcf

WINDOW = 1.0
"""Time between restarts in MuJoCo, s."""


def in_mujoco(robot: Robot, motion: Motion, timestep: float) -> np.ndarray:
    """(steps, recordings, joints) positions of the nominal MJCF under the same commands."""
    spec = mujoco.MjSpec.from_string(mjcf(robot))
    spec.option.timestep = timestep
    model = spec.compile()
    # MuJoCo's default dry friction creeps under load.
    model.dof_solref[:] = [2.0 * timestep, 1.0]
    model.dof_solimp[:, :3] = [0.9999, 0.9999, 0.001]
    data = mujoco.MjData(model)
    ticks, rows, _ = motion.setpoint.shape
    per_tick = round(TICK / timestep)
    every, step = round(WINDOW / timestep), round(WINDOW / RESTART)
    out = np.empty((ticks * per_tick, rows, model.nq))
    for r in range(rows):
        for k in range(len(out)):
            if k % every == 0:
                state = motion.kept[k // every * step, r]
                data.qpos[:], data.qvel[:] = state["q"], state["v"]
            out[k, r] = data.qpos
            data.ctrl[:] = motion.setpoint[k // per_tick, r]
            mujoco.mj_step(model, data)
    return out


def told(one: np.ndarray, other: np.ndarray) -> str:
    """RMS and largest difference."""
    error = one - other
    return f"{np.sqrt(np.mean(error**2)):.1e} {np.abs(error).max():.1e}"


def main() -> None:
    """Print a line per robot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--robots", type=int, default=6)
    args = parser.parse_args()
    ticks = round(args.seconds / TICK)
    print("robot: rms and greatest difference, rad | 80 kHz | extrapolation | MuJoCo")
    for seed in range(args.robots):
        rng = np.random.default_rng([77, seed])
        mode = ("position", "position", "effort")[seed % 3]
        robot = draw(rng, (1, 3, 2, 2, 6, 3)[seed % 6], mode, hinges=True)
        chosen: list[tuple[Robot, np.ndarray]] = [(robot, excitations(robot, rng))]
        if len(robot.joints) <= 3:
            touched, references = touching(robot, rng)
            chosen = [(replace(touched, contact=None), references), (touched, references)]
        for robot, references in chosen:
            references = references[:ticks]
            own = simulate(robot, Hidden(), references, references[0])
            every = simulate(robot, Hidden(), references, references[0], record=STEP)
            fine = simulate(robot, Hidden(), references, references[0], step=STEP / 2, record=STEP)
            stride = round(RECORD / STEP)
            engine = in_mujoco(robot, own, 2.5e-4)
            print(
                f"{len(robot.joints)} joints, {mode}, {'contact' if robot.contact else 'air'}",
                told(every.position, fine.position),
                told(own.position, every.position[::stride]),
                told(engine, own.position[:: round(2.5e-4 / RECORD)][: len(engine)]),
                sep=" | ", flush=True,
            )  # fmt: skip


if __name__ == "__main__":
    main()
