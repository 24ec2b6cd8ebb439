"""Coverage of the intervals of friction and offset that pushes identify.

The first interval holds for the simulation of the fit (timestep 4 ms), the second one also contains
what half the timestep and another integrator change. The box is simulated at 0.25 ms.

    python benchmarks/contact/pushes.py [--boxes 10] [--first SEED]

Each box has drawn mass, friction and surface offset, and a nominal model of friction 0.8 without an
offset. It is simulated at 0.25 ms and pushed along the table by four drawn forces; poses at 100 Hz
and forces at 500 Hz have noise. `pytest-twin identify` fits three pushes and tests the fourth.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np

from pytest_twin import cli

sys.path.append(str(Path(__file__).parents[2] / "tests" / "formats"))
import sensor_bags

HALF, START = 0.05, 1_700_000_000_000_000_000
POSITION_NOISE, TURN_NOISE, FORCE_NOISE = 5e-5, 1e-4, 0.02
"""m, part of a unit quaternion, N."""
LEVELS = [0.05, 0.15, 0.25, 0.3, 0.5, 0.52]
"""s; the force grows, starts the box, keeps it sliding, and lets it go."""


def box(mass: float, friction: float, half: float, timestep: float) -> str:
    inertia = mass * (2.0 * HALF) ** 2 / 6.0
    return f"""<mujoco><option timestep="{timestep}" cone="elliptic"/><worldbody>
      <geom name="table" type="plane" size="5 5 0.1"/>
      <body name="box" pos="0 0 {HALF}"><freejoint/>
        <inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>
        <geom name="faces" type="box" size="{half} {half} {half}" friction="{friction}"
          priority="1"/></body></worldbody></mujoco>"""


def record(
    path: Path, mass: float, friction: float, offset: float, random: np.random.Generator
) -> None:
    """Poses and forces of one push over 0.7 s."""
    model = mujoco.MjModel.from_xml_string(box(mass, friction, HALF + offset, 0.00025))
    data = mujoco.MjData(model)
    data.qpos[2] = HALF + offset
    mujoco.mj_step(model, data, nstep=4000)
    angle, start = random.uniform(0.0, 2.0 * np.pi), data.time
    most, sliding = random.uniform(1.4, 1.8), random.uniform(0.9, 1.1)
    poses, wrenches = [], []
    for tick in range(2800):
        time = data.time - start
        stamp = START + round(1e9 * time)
        share = np.interp(time, LEVELS, [0.0, most, most, sliding, sliding, 0.0])
        force = friction * mass * 9.81 * share * np.array([np.cos(angle), np.sin(angle), 0.0])
        data.xfrc_applied[1, :3] = force
        if tick % 8 == 0:
            wrenches.append([stamp, *(force + FORCE_NOISE * random.normal(size=3)), 0.0, 0.0, 0.0])
        if tick % 40 == 0:
            turn = data.qpos[[4, 5, 6, 3]] + TURN_NOISE * random.normal(size=4)
            place = data.qpos[:3] + POSITION_NOISE * random.normal(size=3)
            poses.append([stamp, *place, *(turn / np.linalg.norm(turn))])
        mujoco.mj_step(model, data)
    tables = {"/object": (sensor_bags.POSE, poses), "/push": (sensor_bags.WRENCH, wrenches)}
    sensor_bags.write(
        path,
        {
            topic: (kind, [row[0] for row in rows], np.array([row[1:] for row in rows]))
            for topic, (kind, rows) in tables.items()
        },
        frame="world",
    )


def identified(folder: Path, seed: int) -> dict[str, tuple[float, dict | None]]:
    """Parameter -> true value and what was found, None where it is not observable."""
    random = np.random.default_rng(seed)
    mass, friction = random.uniform(0.2, 1.0), random.uniform(0.15, 0.6)
    offset = random.uniform(-0.002, 0.002)
    (folder / "box.xml").write_text(box(mass, 0.8, HALF, 0.004))
    files = [folder / f"{push}.mcap" for push in range(4)]
    for path in files:
        record(path, mass, friction, offset, random)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        cli.main([
            "identify", str(folder / "box.xml"), *map(str, files[:3]), "--held-out", str(files[3]),
            "--pose-topic", "/object", "--wrench-topic", "/push", "--out", str(folder / "out"),
        ])  # fmt: skip
    found = json.loads((folder / "out/identification.json").read_text())["parameters"]
    true = {"contact_friction": friction, "contact_offset": offset}
    return {name: (value, found.get(f"box.{name}")) for name, value in true.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--boxes", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    args = parser.parse_args()
    covered: dict[tuple[str, str], list[bool]] = {}
    for seed in range(args.first, args.first + args.boxes):
        with tempfile.TemporaryDirectory() as scratch:
            for name, (true, found) in identified(Path(scratch), seed).items():
                if found is None:
                    print(f"box {seed}: {name} not observable")
                    continue
                words = []
                for key in ("ci95", "ci95_over_simulations"):
                    low, high = found[key]
                    covered.setdefault((name, key), []).append(low <= true <= high)
                    words.append(f"{low:.4g} to {high:.4g}")
                print(f"box {seed}: {name} {found['value']:.4g} ({'; '.join(words)}), "
                      f"true {true:.4g}", flush=True)  # fmt: skip
    for (name, key), inside in covered.items():
        print(f"{name}, {key}: {sum(inside)} of {len(inside)} intervals hold the true value")


if __name__ == "__main__":
    main()
