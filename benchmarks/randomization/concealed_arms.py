"""Coverage of the predictive envelope for final recordings of arms with unknown parameters.

    python benchmarks/randomization/concealed_arms.py [--arms N] [--first SEED] [--draws N]

Each arm has random true parameters, which differ by up to 40 % from its nominal model. It moves
under random smooth commands with position servos. Positions and efforts are recorded with noise;
the effort noise is correlated over 20 ms, like that of a current loop. `pytest-twin identify` fits
two recordings and tests two others. `pytest-twin randomize` computes ranges from the record and
checks them on two final recordings.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
from collections import Counter
from pathlib import Path

import mujoco
import numpy as np
from scipy import signal

from pytest_twin import cli
from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import JointSeries

sys.path.append(str(Path(__file__).parents[1]))
from drawn_arms import JOINTS, LINKS, nominal_parameters, true_parameters
from fourier_motion import fourier

MODEL = f"""<mujoco model="arm">
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>{LINKS}
  </worldbody>
  <actuator>
    <position name="m0" joint="shoulder" kp="300" kv="25"/>
    <position name="m1" joint="elbow" kp="150" kv="12"/>
    <position name="m2" joint="wrist" kp="60" kv="4"/>
  </actuator>
</mujoco>"""
RATE, SECONDS = 200, 10.0
POSITION_NOISE, EFFORT_NOISE = 2e-5, 0.03
"""Position noise, rad, and effort noise, as a fraction of the effort's standard deviation."""
ROLES = ("fit", "fit", "held_out", "held_out", "final", "final")


def arm(folder: Path, random: np.random.Generator) -> mujoco.MjModel:
    """Write the nominal model; return the true one, with parameters that differ by up to 40 %."""
    (folder / "arm.xml").write_text(MODEL.format(**nominal_parameters()))
    return mujoco.MjModel.from_xml_string(MODEL.format(**true_parameters(random)))


def record(path: Path, model: mujoco.MjModel, random: np.random.Generator, role: str) -> None:
    """Simulate a motion from rest under a random Fourier series of commands."""
    steps = round(SECONDS / model.opt.timestep)
    every = round(1.0 / RATE / model.opt.timestep)
    time = model.opt.timestep * np.arange(steps)
    command, _, _ = fourier(random, time, 3, 5, 0.15, (0.1, 0.5))
    command -= command[0]
    command *= np.minimum(1.0, time / 0.5)[:, None]
    data = mujoco.MjData(model)
    position, effort = [], []
    for step in range(steps):
        data.ctrl[:] = command[step]
        if step % every == 0:
            position.append(data.qpos.copy())
        mujoco.mj_step(model, data)
        if step % every == 0:
            effort.append(data.qfrc_actuator.copy())
    read, torque = np.array(position), np.array(effort)
    low = signal.butter(1, 8.0, fs=RATE, output="sos")
    noise = signal.sosfilt(low, random.standard_normal(torque.shape), axis=0)
    torque += EFFORT_NOISE * torque.std(axis=0) * noise / noise.std(axis=0)
    read += POSITION_NOISE * random.standard_normal(read.shape)
    stamps = (1e9 / RATE * np.arange(len(read))).astype(np.int64) + 10**18
    series = [
        JointSeries("/joint_states", JOINTS, stamps, stamps, read, None, torque),
        JointSeries("/joint_commands", JOINTS, stamps, stamps, command[::every], None, None),
    ]
    write_recording(path, series, {"command_between": "interpolated", "role": role})


def checked(seed: int, folder: Path, draws: int) -> dict | None:
    """Return ``ranges.json`` of one arm; None if its identification is not accepted."""
    random = np.random.default_rng(seed)
    true = arm(folder, random)
    (folder / "recordings").mkdir()
    paths = [folder / f"recordings/{k}_{role}.mcap" for k, role in enumerate(ROLES)]
    for path, role in zip(paths, ROLES, strict=True):
        record(path, true, random, role)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        fit = folder / "fit"
        given = [str(path) for path in paths[:4]]
        if cli.main(["identify", str(folder / "arm.xml"), *given, "--out", str(fit)]) != 0:
            return None
        (folder / "twin.yaml").write_text(
            "model: arm.xml\nfit:\n  - {file: fit/identification.json}\n"
        )
        words = [str(folder), "--out", str(folder / "ranges"), "--draws", str(draws)]
        if cli.main(["randomize", *words]) == 2:
            return None
    found: dict = json.loads((folder / "ranges/ranges.json").read_text())
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="seed of the first arm")
    parser.add_argument("--draws", type=int, default=256)
    args = parser.parse_args()
    coverages, verdicts, ratios, factors = [], Counter(), [], []
    for seed in range(args.first, args.first + args.arms):
        with tempfile.TemporaryDirectory() as scratch:
            found = checked(seed, Path(scratch), args.draws)
        if found is None:
            verdicts["identification not accepted"] += 1
            continue
        verdicts[found["verdict"]] += 1
        coverages.append(found["check"]["coverage"])
        ratios.append(found["check"]["width_over_tightest"])
        factors.append(found["widening"]["factors"])
        print(f"arm {seed}: coverage {100 * coverages[-1]:.1f} %, {ratios[-1]:.2f} times the "
              f"tightest, {found['verdict']}, widened {found['widening']['factors']}",
              flush=True)  # fmt: skip
    print(f"{len(coverages)} arms: coverage {100 * np.mean(coverages):.1f} % (goal: 90 to 99 %), "
          f"median {100 * np.median(coverages):.1f} %")  # fmt: skip
    print(f"width over the tightest that covers: median {np.median(ratios):.2f}")
    print(f"verdicts: {dict(verdicts)}")
    print(f"arms with a widened joint: {sum(bool(one) for one in factors)}")


if __name__ == "__main__":
    main()
