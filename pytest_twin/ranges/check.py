"""Check that final recordings lie in the predictive envelope, and that it is not too wide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.metrics.envelope import (
    Envelope,
    coverage_interval,
    deviation_from_uniform,
    envelope,
    histogram,
    integral_transform,
    is_inside,
    smallest_half_width,
)
from pytest_twin.ranges.simulate import Traces

TOO_WIDE = 3.0
"""Ratio of the envelope's width to that of the narrowest envelope with the required coverage, above
which ranges are too wide if it is also significant. A robot that happens to be near the mean needs
a narrower envelope than the fleet. Ranges are too narrow if the ratio is below the inverse, even if
the coverage could be by chance: a 95 % envelope ends at 2 standard deviations, so that measurements
at 3 times this distance are 6 standard deviations away."""
ONE_TOO_WIDE = 2.0 * TOO_WIDE
"""The same ratio for one joint. It is more likely that one of several joints is near its mean than
that all are."""
USELESS_WIDTH = 0.5
"""Ratio of the envelope's width to the range of the motion above which a joint's prediction is of
no use."""
_MOVES = {"rad": 0.2, "m": 0.05}
"""Smallest range of a motion for which this ratio is tested."""
LEVEL = 0.05
"""Significance level of the tests; divided by the number of joints if each is tested."""
_WIDE_LEVEL = 0.02
"""Significance level of the tests for too wide ranges, which cost less than too narrow ones."""
FEWEST_ROBOTS = round(1.0 / _WIDE_LEVEL)
"""Number of robots with which a p-value can be below this level."""
_REFERENCE = 512
"""Number of simulated robots that replace the real one in the tests. A p-value of 5 % then has a
standard error of 1 %."""
_PLOTTED = 400
"""Largest number of samples of an envelope in the report, for each joint."""


@dataclass(frozen=True)
class PredictedRecording:
    """One recording with its simulated robots and envelope.

    Attributes:
        robots: (robots, n, j) simulated encoder readings with noise.
    """

    traces: Traces
    robots: FloatArray
    envelope: Envelope


def predict_envelopes(
    traces: Sequence[Traces], noise: Mapping[str, float], share: float, seed: int
) -> list[PredictedRecording]:
    """Return the envelopes of recordings, including encoder noise.

    Args:
        noise: joint -> standard deviation of a reading, rad or m.
        share: fraction of the samples that should lie in the envelope.
    """
    random = np.random.default_rng(seed)
    found = []
    for one in traces:
        robots = one.robots[np.isfinite(one.robots).all(axis=(1, 2))]
        std = np.array([noise.get(joint, 0.0) for joint in one.joints], dtype=np.float32)
        read = robots + std * random.standard_normal(robots.shape, dtype=np.float32)
        found.append(PredictedRecording(one, read, envelope(read, share)))
    return found


def assess(found: Sequence[PredictedRecording], share: float) -> dict[str, Any]:
    """Return ``check`` of ``ranges.json``: each joint, all joints together, and the verdict.

    Neighbouring samples of a trace, and traces of one robot, are not independent. Therefore each
    simulated robot replaces the real one in turn (posterior predictive check; Gelman, Meng, Stern,
    Statistica Sinica 6, 1996). The scatter of their coverages gives the effective sample size of a
    coverage. Sharpness and uniformity are compared with theirs.
    """
    joints = list(dict.fromkeys(j for one in found for j in one.traces.joints))
    level = LEVEL / len(joints)
    each = {joint: _joint(found, joint, share, level) for joint in joints}
    every = _coverage(found, joints, 1.0 - LEVEL)
    ratio, chance = _sharpness(found, share)
    narrow = [
        j
        for j, one in each.items()
        if one["coverage_interval"][1] < share or one["width_over_tightest"] < 1.0 / ONE_TOO_WIDE
    ]
    wide = [j for j, one in each.items() if one["too_wide"]]
    verdict = "useful"
    if every.interval[1] < share or ratio < 1.0 / TOO_WIDE or narrow:
        verdict = "too_narrow"
    elif (ratio > TOO_WIDE and chance < _WIDE_LEVEL) or wide:
        verdict = "too_wide"
    return {
        "verdict": verdict,
        "share": share,
        "recordings": [one.traces.trial.name for one in found],
        "robots": min(len(one.robots) for one in found),
        "diverged": max(len(one.traces.robots) - len(one.robots) for one in found),
        **every.to_json(),
        "width_over_tightest": ratio,
        "width_chance": chance,
        "joints": each,
        "outside": narrow,
        "too_wide": wide,
    }


def _joint(
    found: Sequence[PredictedRecording], joint: str, share: float, level: float
) -> dict[str, Any]:
    """Check one joint over all recordings that have it."""
    own = [(one, one.traces.joints.index(joint)) for one in found if joint in one.traces.joints]
    transforms, of_robots, lengths = [], [], []
    widths: list[FloatArray] = []
    for one, column in own:
        measured = one.traces.measured[:, [column]]
        robots = one.robots[:, :, [column]]
        others = robots[:_REFERENCE]
        transforms.append(integral_transform(measured, robots))
        ranks = (np.argsort(np.argsort(others, axis=0), axis=0) + 0.5) / len(others)
        of_robots.append(histogram(ranks)[:, 0])
        widths.append(one.envelope.half_width[:, column])
        lengths.append(len(measured))
    coverage = _coverage(found, [joint], 1.0 - level)
    shares = np.average([histogram(t)[0] for t in transforms], axis=0, weights=lengths)
    robots_shares = np.average(_cut_to_common(of_robots), axis=0, weights=lengths)
    unevenness = float(deviation_from_uniform(shares))
    # Each simulated robot is treated as the measured one, to get the distribution of the statistic.
    chance = _share_at_least(deviation_from_uniform(robots_shares), unevenness)
    ratio, ratio_chance = _sharpness(found, share, joint)
    motion = float(np.ptp(np.concatenate([o.traces.measured[:, c] for o, c in own])))
    unit = "m" if joint in _slides(found) else "rad"
    width = 2.0 * float(np.mean(np.concatenate(widths)))
    return {
        **coverage.to_json(),
        "width": width,
        "motion": motion,
        "width_over_tightest": ratio,
        "width_chance": ratio_chance,
        "too_wide": bool(ratio > ONE_TOO_WIDE and ratio_chance < _WIDE_LEVEL)
        or (motion > _MOVES[unit] and width > USELESS_WIDTH * motion),
        "histogram": shares.tolist(),
        "unevenness": unevenness,
        "uneven_chance": chance,
        "unit": unit,
    }


@dataclass(frozen=True)
class Coverage:
    """Fraction of the samples in the envelope.

    Attributes:
        share: the fraction.
        samples: number of measured samples.
        effective: effective number of independent samples.
        interval: confidence interval of the fraction.
    """

    share: float
    samples: int
    effective: float
    interval: tuple[float, float]

    def to_json(self) -> dict[str, Any]:
        """JSON-able fields."""
        return {
            "coverage": self.share,
            "coverage_interval": list(self.interval),
            "samples": self.samples,
            "effective_samples": self.effective,
        }


def _coverage(found: Sequence[PredictedRecording], joints: Sequence[str], level: float) -> Coverage:
    """Return the coverage of joints over all recordings, with its confidence interval.

    The coverage ``c`` of ``n`` independent samples has the variance ``c (1 - c) / n``. The
    effective sample size is the ``n`` for which it equals the variance among simulated robots.
    """
    hits: list[float] = []
    robots: list[FloatArray] = []
    samples = 0
    for one in found:
        columns = [one.traces.joints.index(j) for j in joints if j in one.traces.joints]
        bounds = one.envelope
        own = is_inside(one.traces.measured, bounds)[:, columns]
        hits.append(float(own.sum()))
        others = is_inside(one.robots[:_REFERENCE], bounds)[:, :, columns]
        robots.append(others.sum(axis=(1, 2)))
        samples += own.size
    each = np.sum(_cut_to_common(robots), axis=0) / samples
    mean, variance = float(each.mean()), float(each.var())
    bound = mean * (1.0 - mean)
    effective = float(np.clip(bound / max(variance, 1e-300), 1.0, samples))
    covered = sum(hits) / samples
    return Coverage(covered, samples, effective, coverage_interval(covered, effective, level))


def _slides(found: Sequence[PredictedRecording]) -> frozenset[str]:
    return frozenset().union(*(one.traces.slides for one in found))


def _column(found: Envelope, column: int) -> Envelope:
    return Envelope(*(part[:, [column]] for part in (found.lower, found.middle, found.upper)))


def _cut_to_common(parts: Sequence[FloatArray]) -> list[FloatArray]:
    """Cut all parts to the smallest number of robots."""
    least = min(len(part) for part in parts)
    return [part[:least] for part in parts]


def _sharpness(
    found: Sequence[PredictedRecording], share: float, joint: str | None = None
) -> tuple[float, float]:
    """Return the relative width of the envelope, and its p-value among simulated robots.

    The relative width is the ratio to the narrowest envelope with the required coverage. It is the
    geometric mean over joints and recordings, so it does not depend on units.
    """
    measured: list[float] = []
    robots: list[FloatArray] = []
    for one in found:
        for column, name in enumerate(one.traces.joints):
            if joint not in (None, name):
                continue
            bounds = _column(one.envelope, column)
            width = float(bounds.half_width.mean())
            need = smallest_half_width(one.traces.measured[:, [column]], bounds, share)[0]
            each = smallest_half_width(one.robots[:_REFERENCE, :, [column]], bounds, share)[:, 0]
            measured.append(float(np.log(width / need)))
            robots.append(np.log(width / each))
    mine = float(np.mean(measured))
    return float(np.exp(mine)), _share_at_least(np.mean(_cut_to_common(robots), axis=0), mine)


def _share_at_least(values: FloatArray, value: float) -> float:
    return float((np.sum(values >= value) + 1.0) / (len(values) + 1.0))


def plot_data(found: Sequence[PredictedRecording]) -> list[dict[str, Any]]:
    """Return envelopes and traces, reduced to the number of samples of a report."""
    out = []
    for one in found:
        traces = one.traces
        at = np.unique(np.linspace(0, len(traces.time) - 1, _PLOTTED).astype(int))
        for column, joint in enumerate(traces.joints):
            bounds = one.envelope
            out.append(
                {
                    "recording": traces.trial.name,
                    "joint": joint,
                    "unit": "m" if joint in traces.slides else "rad",
                    "time": traces.time[at].tolist(),
                    "measured": traces.measured[at, column].tolist(),
                    "lower": bounds.lower[at, column].tolist(),
                    "middle": bounds.middle[at, column].tolist(),
                    "upper": bounds.upper[at, column].tolist(),
                }
            )
    return out
