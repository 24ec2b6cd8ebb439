"""Coverage of intervals over the whole chain: excite, simulate an independent plant, identify.

    python benchmarks/identification/closed_circle.py [--cells 8] [--joints 3] [--out FILE.json]

Each cell is a random serial robot with a nominal model, limits and noise. The true robot has other
masses, inertias, armature and friction. ``pytest-twin excite`` designs the motion with the nominal
model. The plant of benchmarks/concealed (Pinocchio's rigid bodies, bristle friction, 40 kHz; it
shares no code with the package) follows the designed commands. ``pytest-twin identify`` gets
positions and efforts with noise. The share of base parameters whose 95 % interval contains the true
value is printed.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).parents[1] / "concealed"))
import plant
import robots

from pytest_twin import cli
from pytest_twin.formats.mcap import JointSeries, read_recording, write_recording
from pytest_twin.identification.regressor.base_parameters import structural_base
from pytest_twin.identification.regressor.regressor import Regressor
from pytest_twin.realization.loading import load

POSITION_NOISE = 2e-5
EFFORT_NOISE = 0.003
"""Effort noise, as a fraction of each drive's effort limit."""
EVERY = 100
"""Number of plant samples per recorded state (200 Hz)."""
plant.TICK = 1e-3
"""Command period of the plant, s. The drive interpolates between commands, as the files state."""
COMMAND_RATE = 100.0
MECHANISMS = ("friction", "gravity", "inertia")


def nominal_of(real: robots.Robot, random: np.random.Generator) -> robots.Robot:
    """Return the nominal robot: masses differ by up to 15 %, drive parameters by up to 40 %."""
    joints = []
    for joint in real.joints:
        body = random.uniform(0.85, 1.15)
        drive = random.uniform(0.6, 1.4, 3)
        joints.append(
            replace(
                joint,
                mass=joint.mass * body,
                inertia=tuple(body * value for value in joint.inertia),
                damping=joint.damping * drive[0],
                friction=joint.friction * drive[1],
                armature=joint.armature * drive[2],
            )
        )
    return replace(real, joints=tuple(joints))


def approved(robot: robots.Robot) -> dict[str, Any]:
    """Return the limits of a random robot."""
    return {
        "approved_by": "a benchmark",
        "mechanisms": list(MECHANISMS),
        "duration": 20.0,
        "rate": COMMAND_RATE,
        "task_band": [0.1, 1.0],
        "joints": {
            joint.name: {
                "position": [-1.5, 1.5],
                "velocity": 2.0,
                "acceleration": 8.0,
                "effort": float(joint.effort),
                "start": 0.0,
                "effort_noise": float(EFFORT_NOISE * joint.effort),
                "position_noise": POSITION_NOISE,
            }
            for joint in robot.joints
        },
        "workspace": [],
        "clearance": "none",
        "supply": {"voltage": 1e3, "current": 1e3},
        "stop": {"category": 1, "reaction": 0.1, "plan": "a benchmark"},
    }


def drive(
    real: robots.Robot, commands: list[Path], out: Path, random: np.random.Generator
) -> list[Path]:
    """Simulate the plant under each command file, and write the sensor readings."""
    written = []
    for file in commands:
        asked = read_recording(file)
        command = asked.series["command"]
        sent = command.stamp * 1e-9
        fine = np.arange(0.0, sent[-1], plant.TICK)
        reference = np.stack([np.interp(fine, sent, one) for one in command.position.T], axis=1)
        motion = plant.simulate(real, plant.Hidden(), reference[:, None], reference[:1])
        position, effort = motion.position[::EVERY, 0], _filtered(motion.effort[:, 0])[::EVERY]
        noise = EFFORT_NOISE * np.array([joint.effort for joint in real.joints])
        stamp = np.arange(len(position)) * round(EVERY * plant.RECORD * 1e9)
        names = tuple(joint.name for joint in real.joints)
        states = JointSeries(
            "/joint_states", names, stamp, stamp,
            position + POSITION_NOISE * random.standard_normal(position.shape), None,
            effort + noise * random.standard_normal(effort.shape),
        )  # fmt: skip
        path = out / file.name
        write_recording(path, [states, asked.series["command"]], asked.metadata)
        written.append(path)
    return written


def _filtered(effort: np.ndarray) -> np.ndarray:
    """Return means over one sample period around each instant, like an anti-aliasing filter."""
    window = np.ones(EVERY + 1) / (EVERY + 1)
    return np.stack([np.convolve(one, window, mode="same") for one in effort.T], axis=1)


def cell(seed: int, joints: int, folder: Path) -> dict[str, Any]:
    """Run one robot from its nominal model to its identified parameters."""
    random = np.random.default_rng(seed)
    real = robots.draw(random, joints, "position", hinges=True)
    nominal = nominal_of(real, random)
    (folder / "model.xml").write_text(robots.mjcf(nominal))
    (folder / "twin.yaml").write_text(
        yaml.safe_dump({"model": "model.xml", "excitation": approved(nominal)}, sort_keys=False)
    )
    (folder / "real.xml").write_text(robots.mjcf(real))
    since = time.process_time()
    twin, out = str(folder / "twin.yaml"), folder / "excitation"
    status = cli.main(["excite", twin, "--out", str(out), "--seed", str(seed)])
    document = json.loads((out / "excitation.json").read_text())
    by_role = {
        role: [
            out / name
            for one in document["trajectories"]
            if one["role"] == role
            for name in one["files"]
            if name.endswith(".mcap")
        ]
        for role in ("fit", "held_out")
    }
    (folder / "recordings").mkdir()
    recorded = {
        role: drive(real, files, folder / "recordings", random) for role, files in by_role.items()
    }
    words = ["identify", twin, *map(str, recorded["fit"]), "--held-out"]
    words += [*map(str, recorded["held_out"]), "--out", str(folder / "identified")]
    identified = cli.main(words)
    found = json.loads((folder / "identified" / "identification.json").read_text())
    return {
        "seed": seed,
        "excite": status,
        "identify": identified,
        "verdict": found["verdict"],
        "consistent": found["physical"]["consistent"],
        "held_out": {
            name: [one["effort_relative"], one["effort_relative_nominal"]]
            for name, one in found["held_out"].items()
        },
        "parameters": covered(folder / "real.xml", found),
        "seconds": time.process_time() - since,
    }


def covered(real: Path, found: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the true value of each fitted base parameter, and whether its interval contains it."""
    regressor = Regressor(load(real), [f"joint{i + 1}" for i in range(len(found["held_out"]))])
    base = structural_base(regressor)
    true = dict(zip(base.expressions, base.values(regressor.prior), strict=True))
    rows = []
    for one in found["base_parameters"]:
        if one["value"] is None or one["relative_std"] is None or one["expression"] not in true:
            continue
        half = 1.96 * abs(one["value"]) * one["relative_std"]
        off = abs(one["value"] - true[one["expression"]])
        rows.append(
            {
                "expression": one["expression"],
                "true": float(true[one["expression"]]),
                "value": one["value"],
                "half": half,
                "covered": bool(off <= half),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=8)
    parser.add_argument("--joints", type=int, default=3)
    parser.add_argument("--first", type=int, default=1, help="seed of the first cell")
    parser.add_argument("--out", type=Path, help="write all figures as JSON")
    args = parser.parse_args()
    cells = []
    for seed in range(args.first, args.first + args.cells):
        with tempfile.TemporaryDirectory() as scratch:
            cells.append(cell(seed, args.joints, Path(scratch)))
        if args.out is not None:
            args.out.write_text(json.dumps(cells, indent=2) + "\n")
    print(
        "| cell | verdict | consistent | covered | held-out effort error, nominal [%] | CPU [s] |"
    )
    print("|---|---|---|---|---|---|")
    for one in cells:
        held = ", ".join(f"{100 * a:.1f} ({100 * b:.1f})" for a, b in one["held_out"].values())
        inside = sum(row["covered"] for row in one["parameters"])
        print(
            f"| {one['seed']} | {one['verdict']} | {one['consistent']} | "
            f"{inside} of {len(one['parameters'])} | {held} | {one['seconds']:.0f} |"
        )
    rows = [row for one in cells for row in one["parameters"]]
    share = sum(row["covered"] for row in rows) / len(rows)
    print(f"coverage of 95 % intervals: {100 * share:.1f} % of {len(rows)} parameters")


if __name__ == "__main__":
    main()
