"""Coverage of drive gains: currents of unknown torque constants, and a known payload.

    python benchmarks/identification/coverage_of_gains.py [--arms N]

Each arm has random true parameters, a nominal model with errors, and a random drive gain (recorded
current per torque) of each joint. One recording has a known payload on the hand, one has none, and
one without it is held out. Noise is that of ``coverage_of_intervals.py``.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from coverage_of_intervals import JOINTS, MODEL, EncoderErrors, covered, record
from drawn_arms import nominal_parameters, true_parameters

from pytest_twin.identification.effort.identify_effort import EffortResult, identify_effort
from pytest_twin.identification.measured_recordings import MeasuredRecordings
from pytest_twin.identification.regressor import Regressor
from pytest_twin.realization import load
from pytest_twin.signals import NO_SIGNALS
from pytest_twin.twin import load_twin

PAYLOAD = "kg2"
TWIN = (
    f"model: nominal.xml\npayloads: {{{PAYLOAD}: {{hand: {{mass: 2.0, com: [0.15, 0.02, 0]}}}}}}\n"
)


def identified(seed: int, folder: Path) -> tuple[EffortResult, np.ndarray, np.ndarray]:
    """The identification of one arm, its true base parameters, and its true gains."""
    random = np.random.default_rng([seed, 7])
    (folder / "nominal.xml").write_text(MODEL.format(**nominal_parameters()))
    (folder / "real.xml").write_text(MODEL.format(**true_parameters(random)))
    (folder / "twin.yaml").write_text(TWIN)
    twin = load_twin(folder / "twin.yaml")
    real = load(folder / "real.xml", twin=twin)
    gains = np.exp(random.uniform(np.log(0.05), np.log(5.0), len(JOINTS)))
    runs = []
    for name, payload in (("one", PAYLOAD), ("two", None), ("check", None)):
        robot = real.variant(payload=payload)
        one = record(robot, folder / f"{name}.csv", random, EncoderErrors())
        runs.append(
            replace(
                one,
                effort=one.effort * gains,
                unscaled=np.ones(len(JOINTS), dtype=bool),
                metadata={} if payload is None else {"payload": payload},
            )
        )
    nominal = load(folder / "nominal.xml", twin=twin)
    result = identify_effort(nominal, MeasuredRecordings(tuple(runs[:2]), (runs[2],)), NO_SIGNALS)
    return result, result.base.values(Regressor(real, JOINTS).prior), gains


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", type=int, default=20)
    args = parser.parse_args()
    of_gains: list[bool] = []
    widths: list[float] = []
    inside: list[bool] = []
    held, nominal, unknown, consistent = [], [], 0, 0
    for seed in range(args.arms):
        with tempfile.TemporaryDirectory() as scratch:
            result, true, gains = identified(seed, Path(scratch))
        for joint, gain in zip(JOINTS, gains, strict=True):
            if joint not in result.gains:
                unknown += 1
                continue
            found = result.gains[joint]
            of_gains.append(abs(found.value - gain) <= found.half_width)
            widths.append(found.half_width / found.value)
        if len(result.gains) == len(JOINTS):
            inside += covered(result, true).tolist()
        consistent += result.physical.is_consistent
        held += [error.relative for error in result.errors.values()]
        nominal += [error.relative for error in result.nominal.values()]
        print(seed, sorted(result.gains), flush=True)
    print(f"{args.arms} arms")
    print(f"coverage of gains: {100 * np.mean(of_gains):.1f} % of {len(of_gains)} (goal: 90 to "
          f"99 %), median half width {100 * np.median(widths):.2f} %")  # fmt: skip
    print(f"gains that the payload does not determine: {unknown}")
    print(f"coverage of parameters, all gains known: {100 * np.mean(inside):.1f} % of "
          f"{len(inside)} (goal: 90 to 99 %)")  # fmt: skip
    print(f"physically consistent: {consistent} of {args.arms} (goal: all)")
    print(f"held-out effort error: median {100 * np.median(held):.2f} %, nominal model "
          f"{100 * np.median(nominal):.1f} %")  # fmt: skip


if __name__ == "__main__":
    main()
