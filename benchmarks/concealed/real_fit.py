"""Fit the drive values of SO-101's joints that ``real_models.py`` holds.

    python benchmarks/concealed/real_fit.py [so101_pan so101_flex so101_roll]

Least squares (soft L1 at 3 mrad) of positions in windows of a second started from the measured
state, simulated by MuJoCo: servo stiffness, damping, dry friction, encoder zero and bus delay of
one joint. The rotor's inertia is that of the file. Prints the values and the RMS residual.

Without gravity load (pan, roll) the zero has no influence and is 0 in the table. For roll, whose
link is light, only ratios are identifiable; the table has them for a stiffness of 14.1 N*m/rad,
from a diagnosis of all joints (benchmarks/real/record.md).
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
import real_replay
from injections import Recorded, cut, of_joints
from real_cases import RECORDINGS
from real_forms import compiled, push
from real_models import MACHINES, Machine
from real_replay import Floats, replay
from scipy.optimize import least_squares

from pytest_twin.formats.mcap import read_recording

# Recording and start (s) of segments of ten seconds.
STRETCHES = {
    "so101_pan": (
        ("single_joint_rotation", 22.0), ("ramp_motion", 25.0), ("sinusoidal_sweep", 30.0),
        ("staircase_motion", 22.0),
    ),
    "so101_flex": (
        ("single_joint_wrist_pitch", 5.0), ("single_joint_wrist_pitch", 20.0),
        ("single_joint_wrist_pitch", 40.0),
    ),
    "so101_roll": (("triangle_wave", 20.0), ("triangle_wave", 50.0), ("wave_motion", 20.0)),
}  # fmt: skip
SECONDS, WINDOW, ARMATURE = 10.0, 1.0, 0.028
START = (np.log(13.0), np.log(0.8), 0.1, 0.0, 0.02)
"""Order of the parameters: log(kp), log(damping), friction, zero and delay."""
SCALE = (0.1, 0.1, 0.05, 0.05, 0.01)


def taken(machine: Machine, x: Floats) -> tuple[Machine, float]:
    """Return the machine with the values of a point, and the delay, s."""
    kp, damping, friction, zero, delay = (float(v) for v in x)
    joint = machine.joints[0]
    values: dict[str, Any] = {"kp": np.exp(kp), "damping": np.exp(damping)}
    values |= {"friction": abs(friction), "zero": zero, "armature": ARMATURE}
    drive = replace(machine.drives[joint], **{k: float(v) for k, v in values.items()})
    return replace(machine, drives={joint: drive}), max(delay, 0.0)


def residual(machine: Machine, x: Floats, stretches: list[Recorded]) -> Floats:
    """Predictions minus readings of all segments, rad."""
    tried, delay = taken(machine, x)
    model = compiled(tried, RECORDINGS)
    out = []
    for stretch in stretches:
        assert stretch.state.position is not None
        predicted = replay(model, stretch, push(tried), delay=delay)
        out.append((predicted - stretch.state.position).ravel())
    return np.concatenate(out)


def stretches_of(machine: Machine) -> list[Recorded]:
    """Return the recordings to fit."""
    out = []
    for name, start in STRETCHES[machine.name]:
        read = read_recording(RECORDINGS / machine.folder / "recordings" / f"{name}.mcap")
        whole = Recorded(read.series["state"], read.series["command"], {})
        out.append(of_joints(cut(whole, start, SECONDS), machine.joints))
    return out


def main() -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("machines", nargs="*", default=list(STRETCHES), choices=list(STRETCHES))
    args = parser.parse_args()
    real_replay.WINDOW = WINDOW
    for name in args.machines:
        machine, stretches = MACHINES[name], stretches_of(MACHINES[name])
        fitted = least_squares(
            lambda x, m=machine, s=stretches: residual(m, x, s), START, diff_step=1e-2,
            x_scale=SCALE, loss="soft_l1", f_scale=0.003, max_nfev=12,
        )  # fmt: skip
        found, delay = taken(machine, fitted.x)
        left = 1e3 * np.sqrt(np.mean(residual(machine, fitted.x, stretches) ** 2))
        print(f"{name}: {found.drives}, delay {delay:.4f} s, {left:.2f} mrad left", flush=True)


if __name__ == "__main__":
    main()
