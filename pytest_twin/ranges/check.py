"""Whether final recordings lie in the predictive envelope, and whether that is too wide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.metrics.envelope import (
    Envelope,
    coverage_interval,
    envelope,
    histogram,
    inside,
    integral_transform,
    tightest,
    uneven,
)
from pytest_twin.ranges.simulate import Traces

TOO_WIDE = 3.0
"""Width of the envelope over the tightest that covers. Beyond it, and beyond what chance explains,
the ranges are too wide: a robot that happens to be near the mean needs less than the fleet does."""
ONE_TOO_WIDE = 2.0 * TOO_WIDE
"""The same of one joint: of several, one is near its mean more often than all of them are."""
SAYS_LITTLE = 0.5
"""Width of the envelope over the range of the motion, from which on a joint's prediction says
hardly more than that it stays where it can move."""
_MOVES = {"rad": 0.2, "m": 0.05}
"""Range of a motion from which on it is asked for more than that."""
LEVEL = 0.05
"""Of the tests; divided by the joints where each is tested."""
_WIDE_LEVEL = 0.02
"""Of the tests for too wide ranges, which cost less than too narrow ones."""
_REFERENCE = 512
"""Simulated robots that take the part of the real one: a chance of 5 % is then known to 1 %."""
_PLOTTED = 400
"""Samples of an envelope that a page shows for each joint."""


@dataclass(frozen=True)
class Predicted:
    """One recording, its envelope, and how each simulated robot lies in it.

    Attributes:
        traces: measured and simulated.
        robots: (robots, n, j) with sensor noise, as encoders would read them.
        envelope: of these.
    """

    traces: Traces
    robots: FloatArray
    envelope: Envelope


def predicted(
    traces: Sequence[Traces], noise: Mapping[str, float], share: float, seed: int
) -> list[Predicted]:
    """Envelopes of recordings, with the noise of the encoders in them.

    Args:
        traces: measured and simulated.
        noise: joint -> standard deviation of a reading, rad or m.
        share: of the samples that should lie in the envelope.
        seed: of the noise.
    """
    random = np.random.default_rng(seed)
    found = []
    for one in traces:
        alive = np.isfinite(one.robots).all(axis=(1, 2))
        robots = one.robots[alive]
        std = np.array([noise.get(joint, 0.0) for joint in one.joints], dtype=np.float32)
        read = robots + std * random.standard_normal(robots.shape, dtype=np.float32)
        found.append(Predicted(one, read, envelope(read, share)))
    return found


def assessed(found: Sequence[Predicted], share: float) -> dict[str, Any]:
    """``check`` of ``ranges.json``: each joint, all joints together, and the verdict.

    Neighbouring samples of a trace, and traces of one robot, are no independent evidence. So each
    simulated robot takes the part of the real one (posterior predictive check; Gelman, Meng, Stern,
    Statistica Sinica 6, 1996): how much their coverages scatter says how many independent samples
    a coverage is worth, and sharpness and evenness are compared with theirs.
    """
    joints = list(dict.fromkeys(j for one in found for j in one.traces.joints))
    level = LEVEL / len(joints)
    each = {joint: _joint(found, joint, share, level) for joint in joints}
    every = _coverage(found, joints, 1.0 - LEVEL)
    ratio, chance = _sharpness(found, share)
    narrow = [j for j, one in each.items() if one["coverage_interval"][1] < share]
    wide = [j for j, one in each.items() if one["too_wide"]]
    verdict = "useful"
    if every.interval[1] < share or narrow:
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


def _joint(found: Sequence[Predicted], joint: str, share: float, level: float) -> dict[str, Any]:
    """One joint over all recordings that have it."""
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
    robots_shares = np.average(_common(of_robots), axis=0, weights=lengths)
    unevenness = float(uneven(shares))
    # Each robot as if it were measured: how uneven is one of the fleet?
    chance = _share_at_least(uneven(robots_shares), unevenness)
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
        or (motion > _MOVES[unit] and width > SAYS_LITTLE * motion),
        "histogram": shares.tolist(),
        "unevenness": unevenness,
        "uneven_chance": chance,
        "unit": unit,
    }


@dataclass(frozen=True)
class Coverage:
    """Share of the samples in the envelope.

    Attributes:
        share: found.
        samples: measured.
        effective: independent ones that they are worth.
        interval: of the share.
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


def _coverage(found: Sequence[Predicted], joints: Sequence[str], level: float) -> Coverage:
    """Of some joints over all recordings, with the interval that it deserves.

    Independent samples of which a share ``c`` is inside scatter by ``c (1 - c) / n``: the effective
    number is the ``n`` of which that is the variance among simulated robots.
    """
    hits: list[float] = []
    robots: list[FloatArray] = []
    samples = 0
    for one in found:
        columns = [one.traces.joints.index(j) for j in joints if j in one.traces.joints]
        bounds = one.envelope
        own = inside(one.traces.measured, bounds)[:, columns]
        hits.append(float(own.sum()))
        others = inside(one.robots[:_REFERENCE], bounds)[:, :, columns]
        robots.append(others.sum(axis=(1, 2)))
        samples += own.size
    each = np.sum(_common(robots), axis=0) / samples
    mean, variance = float(each.mean()), float(each.var())
    bound = mean * (1.0 - mean)
    effective = float(np.clip(bound / max(variance, 1e-300), 1.0, samples))
    covered = sum(hits) / samples
    return Coverage(covered, samples, effective, coverage_interval(covered, effective, level))


def _slides(found: Sequence[Predicted]) -> frozenset[str]:
    return frozenset().union(*(one.traces.slides for one in found))


def _column(found: Envelope, column: int) -> Envelope:
    return Envelope(*(part[:, [column]] for part in (found.lower, found.middle, found.upper)))


def _common(parts: Sequence[FloatArray]) -> list[FloatArray]:
    """Of as many robots each as the recording with the fewest has."""
    least = min(len(part) for part in parts)
    return [part[:least] for part in parts]


def _sharpness(
    found: Sequence[Predicted], share: float, joint: str | None = None
) -> tuple[float, float]:
    """Width of the envelope over the tightest that covers, and the share of simulated robots of
    which that is as large.

    Of several joints and recordings: the geometric mean, so that no unit counts.
    """
    measured: list[float] = []
    robots: list[FloatArray] = []
    for one in found:
        for column, name in enumerate(one.traces.joints):
            if joint not in (None, name):
                continue
            bounds = _column(one.envelope, column)
            width = float(bounds.half_width.mean())
            need = tightest(one.traces.measured[:, [column]], bounds, share)[0]
            each = tightest(one.robots[:_REFERENCE, :, [column]], bounds, share)[:, 0]
            measured.append(float(np.log(width / need)))
            robots.append(np.log(width / each))
    mine = float(np.mean(measured))
    return float(np.exp(mine)), _share_at_least(np.mean(_common(robots), axis=0), mine)


def _share_at_least(values: FloatArray, value: float) -> float:
    return float((np.sum(values >= value) + 1.0) / (len(values) + 1.0))


def plotted(found: Sequence[Predicted]) -> list[dict[str, Any]]:
    """Envelopes and traces with as many samples as a page shows."""
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
