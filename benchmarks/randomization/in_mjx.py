"""Compare robots of ``mjx_randomize.py`` in MJX with the same robots in MuJoCo.

    python benchmarks/randomization/in_mjx.py RANGES MODEL.xml

RANGES is the folder that ``pytest-twin randomize`` wrote, MODEL.xml the model of the twin. Needs
``mujoco-mjx`` and jax, on the CPU too. Each robot starts at the model's reference with 1 rad/s
(1 m/s) on every joint and moves for 100 steps.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path

import jax
import jax.numpy as jp
import mujoco
import numpy as np
from mujoco import mjx

STEPS, ROBOTS = 100, 8


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("ranges", type=Path)
    parser.add_argument("model", type=Path)
    args = parser.parse_args()
    sys.path.insert(0, str(args.ranges.absolute()))
    written = importlib.import_module("mjx_randomize")
    model = mujoco.MjModel.from_xml_path(str(args.model))
    one = mjx.put_model(model)
    keys = jax.random.split(jax.random.PRNGKey(0), ROBOTS)
    many, axes = written.domain_randomize(one, keys)

    def moved(robot):
        start = mjx.make_data(one).replace(qvel=jp.ones(model.nv))
        end, _ = jax.lax.scan(
            lambda data, _: (mjx.step(robot, data), None), start, None, length=STEPS
        )
        return end.qpos

    found = np.asarray(jax.jit(jax.vmap(moved, in_axes=(axes,)))(many))
    fields = written.RANGES.mujoco_fields(written.robots_of(keys))
    apart = 0.0
    for robot in range(ROBOTS):
        same = mujoco.MjModel.from_xml_path(str(args.model))
        for name, places in fields.items():
            for index, values in places.items():
                getattr(same, name)[index] = values[robot]
        data = mujoco.MjData(same)
        data.qvel[:] = 1.0
        mujoco.mj_step(same, data, nstep=STEPS)
        apart = max(apart, float(np.abs(data.qpos - found[robot]).max()))
    print(f"{ROBOTS} robots, {', '.join(fields)}")
    print(f"largest difference to MuJoCo {apart:.2g}, largest deviation between the robots "
          f"{found.std(axis=0).max():.2g} (rad, m)")  # fmt: skip


if __name__ == "__main__":
    main()
