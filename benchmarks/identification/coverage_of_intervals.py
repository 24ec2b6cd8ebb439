"""Coverage of the intervals on simulated arms: how often the true parameters lie in them.

    python benchmarks/identification/coverage_of_intervals.py [--arms N] [--encoders]

Each arm has random true parameters, a nominal model with errors, and three recordings along random
Fourier series with noise on positions and efforts. One recording is held out. The effort noise is
correlated over 20 ms, like that of a current loop. Efforts come from MuJoCo's inverse dynamics.
With --encoders one encoder's zero is off by up to 0.1 rad (not that of the last joint, which no
effort tells) and one encoder's scale by up to 5 %.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy import signal

from pytest_twin.identification.effort.encoders import BIAS
from pytest_twin.identification.effort.identify_effort import EffortResult, identify_effort
from pytest_twin.identification.measured_recordings import MeasuredRecording, MeasuredRecordings
from pytest_twin.identification.regressor import Regressor
from pytest_twin.realization import Realization, load
from pytest_twin.signals import NO_SIGNALS

sys.path.append(str(Path(__file__).parents[1]))
from drawn_arms import JOINTS, LINKS, nominal_parameters, true_parameters
from fourier_motion import fourier, needed_effort

MODEL = f"""<mujoco model="arm"><worldbody>{LINKS}
</worldbody></mujoco>"""
RATE, SECONDS = 200.0, 16.0


@dataclass(frozen=True)
class EncoderErrors:
    """Errors of the encoders of an arm.

    Attributes:
        bias: (joints,) zero errors, rad.
        scale: (joints,) relative scale errors.
    """

    bias: np.ndarray = field(default_factory=lambda: np.zeros(len(JOINTS)))
    scale: np.ndarray = field(default_factory=lambda: np.zeros(len(JOINTS)))

    @staticmethod
    def drawn(random: np.random.Generator) -> EncoderErrors:
        """A random error of one zero and of one scale."""
        errors = EncoderErrors()
        errors.bias[random.integers(len(JOINTS) - 1)] = random.uniform(-0.1, 0.1)
        errors.scale[random.integers(len(JOINTS))] = random.uniform(-0.05, 0.05)
        return errors

    def readings(self, q: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """(n, joints) readings of the true positions, with noise, rad."""
        noisy = q + 2e-5 * random.standard_normal(q.shape)
        return noisy * (1.0 + self.scale) + self.bias

    def true_of(self, joint: str, kind: str) -> float:
        """True value of an encoder error that the identification estimates."""
        return float((self.bias if kind == BIAS else self.scale)[JOINTS.index(joint)])


def effort_noise(shape: tuple[int, ...], rate: float, random: np.random.Generator) -> np.ndarray:
    """(n, joints) noise of standard deviation 1 that is correlated over 20 ms.

    Args:
        shape: n and the number of joints.
        rate: sampling rate, Hz.
        random: random generator.
    """
    low = signal.butter(1, 8.0, fs=rate, output="sos")
    noise = signal.sosfilt(low, random.standard_normal(shape), axis=0)
    return np.asarray(noise / noise.std(axis=0))


def record(
    robot: Realization, path: Path, random: np.random.Generator, encoders: EncoderErrors
) -> MeasuredRecording:
    """One random Fourier series with noise."""
    time = np.arange(round(SECONDS * RATE)) / RATE
    q, v, a = fourier(random, time, 3, 6, 0.125, (0.1, 0.5))
    effort = needed_effort(robot.model, q, v, a)
    effort += 0.03 * effort.std(axis=0) * effort_noise(effort.shape, RATE, random)
    q = encoders.readings(q, random)
    return MeasuredRecording(path, 0.0, JOINTS, time, q, None, effort, np.zeros(3, dtype=bool),
                    np.full(3, np.inf), {})  # fmt: skip


def identified(seed: int, folder: Path, encoders: EncoderErrors) -> tuple[EffortResult, np.ndarray]:
    """The identification of one arm, and its true base parameters."""
    random = np.random.default_rng(seed)
    (folder / "nominal.xml").write_text(MODEL.format(**nominal_parameters()))
    (folder / "real.xml").write_text(MODEL.format(**true_parameters(random)))
    real = load(folder / "real.xml")
    runs = [
        record(real, folder / f"{name}.csv", random, encoders) for name in ("one", "two", "check")
    ]
    result = identify_effort(
        load(folder / "nominal.xml"), MeasuredRecordings(tuple(runs[:2]), (runs[2],)), NO_SIGNALS
    )
    return result, result.base.values(Regressor(real, JOINTS).prior)


def covered(result: EffortResult, true: np.ndarray) -> np.ndarray:
    """(k,) whether the true value of each essential parameter lies in its 95 % interval."""
    off = np.abs(result.fitted.solution.values - true[result.fitted.kept])
    return np.asarray(off <= result.fitted.solution.half_width)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", type=int, default=100)
    parser.add_argument("--encoders", action="store_true", help="encoders have errors")
    args = parser.parse_args()
    inside: list[bool] = []
    of_encoders: defaultdict[tuple[str, str], list[bool]] = defaultdict(list)
    missed: Counter[str] = Counter()
    held, nominal, consistent, rejected = [], [], 0, Counter()
    for seed in range(args.arms):
        encoders = EncoderErrors()
        if args.encoders:
            encoders = EncoderErrors.drawn(np.random.default_rng([seed, 1]))
        with tempfile.TemporaryDirectory() as scratch:
            result, true = identified(seed, Path(scratch), encoders)
        for one in result.encoders.readings:
            value = encoders.true_of(one.joint, one.kind)
            case = "off" if value else "sound"
            of_encoders[one.kind, case].append(abs(one.value - value) <= one.half_width)
        hit = covered(result, true)
        inside += hit.tolist()
        for k in np.flatnonzero(~hit):
            missed[result.base.expressions[result.fitted.kept[k]]] += 1
        consistent += result.physical.is_consistent
        held += [error.relative for error in result.errors.values()]
        nominal += [error.relative for error in result.nominal.values()]
        rejected.update(stage.name for stage in result.stages if stage.state == "rejected")
    print(f"{args.arms} arms, {len(inside)} intervals")
    print(f"coverage: {100 * np.mean(inside):.1f} % (goal: 90 to 99 %)")
    for (kind, case), holds in sorted(of_encoders.items()):
        print(f"{kind}, {case}: {100 * np.mean(holds):.1f} % of {len(holds)} intervals")
    print(f"physically consistent: {consistent} of {args.arms} (goal: all)")
    print(f"held-out effort error: median {100 * np.median(held):.2f} %, nominal model "
          f"{100 * np.median(nominal):.1f} %")  # fmt: skip
    print(f"stages rejected: {dict(rejected) or 'none'}")
    print(f"most often outside: {missed.most_common(5)}")


if __name__ == "__main__":
    main()
