"""Fit the drive values of SO-101's joints that ``real_models.py`` holds.

    python benchmarks/concealed/real_fit.py [so101_pan so101_flex so101_roll]

Least squares (soft L1 at 3 mrad) of positions in windows started from the measured state, by MuJoCo
alone: servo stiffness, damping, dry friction, zero of the encoder and bus delay of each joint. The
rotor's inertia is the file's, so a drive without gravity is known up to that scale. Prints the
values and the root mean square that is left.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from injections import Recorded
from real_cases import RECORDINGS, excerpts
from real_models import MACHINES, Machine, compiled, push
from real_replay import Floats, replay
from scipy.optimize import least_squares

START = (np.log(13.0), np.log(0.8), 0.1, 0.0, 0.02)
"""Of log(kp), log(damping), friction, zero and delay."""
SCALE = (0.1, 0.1, 0.05, 0.05, 0.01)


def taken(machine: Machine, x: Floats) -> tuple[Machine, float]:
    """The machine with the values of a point, and the delay, s."""
    kp, damping, friction, zero, delay = (float(v) for v in x)
    joint = machine.joints[0]
    drive = replace(
        machine.drives[joint], kp=float(np.exp(kp)), damping=float(np.exp(damping)),
        friction=abs(friction), armature=0.028, zero=zero,
    )  # fmt: skip
    return replace(machine, drives={joint: drive}), max(delay, 0.0)


def residual(machine: Machine, x: Floats, stretches: list[Recorded]) -> Floats:
    """Predictions less readings of all stretches, rad."""
    tried, delay = taken(machine, x)
    model = compiled(tried, RECORDINGS)
    out = []
    for stretch in stretches:
        assert stretch.state.position is not None
        predicted = replay(model, stretch, push(tried), delay=delay)
        out.append((predicted - stretch.state.position).ravel())
    return np.concatenate(out)


def main() -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    single = [name for name, m in MACHINES.items() if m.folder == "so101" and len(m.joints) == 1]
    parser.add_argument("machines", nargs="*", default=single, choices=single)
    args = parser.parse_args()
    for name in args.machines:
        machine = MACHINES[name]
        stretches = [r for _, r in excerpts(machine, np.random.default_rng(1))]
        fitted = least_squares(
            lambda x, m=machine, s=stretches: residual(m, x, s), START, diff_step=1e-2,
            x_scale=SCALE, loss="soft_l1", f_scale=0.003, max_nfev=12,
        )  # fmt: skip
        found, delay = taken(machine, fitted.x)
        left = 1e3 * np.sqrt(np.mean(residual(machine, fitted.x, stretches) ** 2))
        print(f"{name}: {found.drives}, delay {delay:.4f} s, {left:.2f} mrad left", flush=True)


if __name__ == "__main__":
    main()
