"""Least squares and instrumental variables with encoder noise in the closed loop of servos.

    python benchmarks/identification/encoder_noise.py [--arms N] [--noise MRAD]

Each arm has random true parameters, a nominal model with errors, and position servos that act on
noisy positions. The noise lies below 3 Hz, as the motion does, so that no filter removes it. Both
estimators are compared with the true base parameters.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
from coverage_of_intervals import JOINTS, MODEL

from pytest_twin.identification.effort.identify_effort import EffortResult, identify_effort
from pytest_twin.identification.measured_recordings import MeasuredRecording, MeasuredRecordings
from pytest_twin.identification.regressor import Regressor
from pytest_twin.realization import Realization, load
from pytest_twin.signals import NO_SIGNALS

sys.path.append(str(Path(__file__).parents[1]))
from drawn_arms import nominal_parameters, true_parameters
from fourier_motion import follow_noisy_positions, fourier

TICK = 0.005
"""Period of the servos, s."""
STIFFNESS, DAMPING = np.array([1500.0, 600.0, 150.0]), np.array([120.0, 50.0, 12.0])
"""Gains of the servos, N*m/rad and N*m*s/rad."""
SECONDS = 20.0


def driven(
    robot: Realization, path: Path, random: np.random.Generator, noise: float
) -> MeasuredRecording:
    """One recording of servos that follow a random Fourier series; ``noise`` in rad."""
    time = np.arange(round(SECONDS / TICK)) * TICK
    command, speed, _ = fourier(random, time, len(JOINTS), 5, 0.1, (0.1, 0.5))
    seen, effort = follow_noisy_positions(
        robot.model, random, command, speed, (STIFFNESS, DAMPING), noise, TICK
    )
    count = len(JOINTS)
    return MeasuredRecording(
        path, 0.0, JOINTS, time, seen, None, effort, np.zeros(count, dtype=bool),
        np.full(count, np.inf), {}, command=command,
    )  # fmt: skip


def identified(seed: int, folder: Path, noise: float) -> tuple[EffortResult, np.ndarray]:
    """The identification of one arm, and its true base parameters."""
    random = np.random.default_rng([seed, 3])
    (folder / "nominal.xml").write_text(MODEL.format(**nominal_parameters()))
    (folder / "real.xml").write_text(MODEL.format(**true_parameters(random)))
    real = load(folder / "real.xml")
    true = Regressor(real, JOINTS).prior
    runs = [driven(real, folder / f"{n}.csv", random, noise) for n in ("one", "two", "check")]
    nominal = load(folder / "nominal.xml")
    result = identify_effort(nominal, MeasuredRecordings(tuple(runs[:2]), (runs[2],)), NO_SIGNALS)
    return result, result.base.values(true)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", type=int, default=10)
    parser.add_argument("--noise", type=float, default=4.0, help="mrad (default: 4)")
    args = parser.parse_args()
    chosen: Counter[str] = Counter()
    inside: dict[str, list[bool]] = {"least squares": [], "as chosen": []}
    off: dict[str, list[float]] = {"least squares": [], "as chosen": []}
    for seed in range(args.arms):
        with tempfile.TemporaryDirectory() as scratch:
            result, true = identified(seed, Path(scratch), 1e-3 * args.noise)
        estimate, kept = result.estimate, result.fitted.kept
        chosen[estimate.estimator] += 1
        for name, solution in (
            ("least squares", estimate.squares), ("as chosen", result.fitted.solution),
        ):  # fmt: skip
            error = np.abs(solution.values - true[kept])
            inside[name] += (error <= solution.half_width).tolist()
            off[name] += (error / np.maximum(np.abs(true[kept]), 1e-9)).tolist()
        print(seed, estimate.estimator, flush=True)
    print(f"{args.arms} arms, encoder noise {args.noise:g} mrad, chosen: {dict(chosen)}")
    for name, holds in inside.items():
        print(
            f"{name}: {100 * np.mean(holds):.1f} % of {len(holds)} parameters in their 95 % "
            f"intervals, median error {100 * np.median(off[name]):.2f} %"
        )


if __name__ == "__main__":
    main()
