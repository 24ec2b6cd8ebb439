"""Repeatability, hysteresis and home position of encoders, from repeated returns to poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.document import new_document
from pytest_twin.calibration.observations import SIDES, Observations
from pytest_twin.calibration.plan import Plan
from pytest_twin.calibration.records import estimate_entry
from pytest_twin.realization.serial_chain import SerialChain

ENCODERS = "encoder_repeatability"
_LEVEL = 0.95
"""Confidence level of intervals."""


@dataclass(frozen=True)
class _Group:
    """Readings of one joint in one pose that was approached from one direction, rad or m."""

    pose: str
    side: str
    readings: FloatArray


@dataclass(frozen=True)
class _PooledSpread:
    """Pooled standard deviation of readings about their group means, with degrees of freedom."""

    std: float
    degrees: int

    def scalar(self, value: float, variances: float, unit: str) -> dict[str, Any]:
        """Return the record of a mean with its interval from Student's distribution.

        Args:
            value: mean, rad or m.
            variances: variance of the mean, as a multiple of that of one reading.
            unit: unit of the value.
        """
        std = self.std * np.sqrt(variances)
        quantile = float(stats.t.ppf(0.5 + _LEVEL / 2.0, self.degrees))
        return estimate_entry(value, unit, float(std), quantile)

    def repeatability(self, unit: str) -> dict[str, Any]:
        """Return the record of the standard deviation with its chi-squared interval."""
        tails = stats.chi2.ppf([0.5 + _LEVEL / 2.0, 0.5 - _LEVEL / 2.0], self.degrees)
        low, high = self.std * np.sqrt(self.degrees / tails)
        return {
            "value": self.std,
            "unit": unit,
            "degrees_of_freedom": self.degrees,
            "ci95": [float(low), float(high)],
        }


def calibrate_encoders(
    plan: Plan, observations: Observations, chain: SerialChain | None
) -> dict[str, Any]:
    """Return the content of ``calibration.json`` for a plan that estimates encoder repeatability.

    Raises:
        SpecError: the plan has other estimates too, or a reference names an unknown pose or joint.
    """
    _check(plan, observations)
    poses = observations.poses or ("",) * len(observations)
    sides = observations.approaches or ("",) * len(observations)
    repeated: dict[str, Any] = {}
    hysteresis: dict[str, Any] = {}
    home: dict[str, Any] = {}
    unobservable: list[str] = []
    notes: list[str] = []
    for joint, readings in observations.joints.items():
        unit, sign = "rad", 1.0
        if chain is not None and joint in chain.joints:
            at = chain.joints.index(joint)
            unit, sign = "rad" if chain.revolute[at] else "m", float(chain.signs[at])
        groups = _groups(readings, poses, sides)
        pooled = _pool(groups)
        if isinstance(pooled, str):
            unobservable.append(f"the repeatability of {joint}: {pooled}")
            continue
        repeated[joint] = pooled.repeatability(unit)
        apart = _hysteresis(groups, pooled, unit)
        if apart is None:
            notes.append(
                f"{joint}: no pose was approached from both sides (column approach, + and -), "
                "so that its hysteresis is not measured"
            )
        else:
            hysteresis[joint] = apart
        reference = {
            pose: sign * stated[joint]
            for pose, stated in plan.references.items()
            if joint in stated
        }
        if reference:
            home[joint] = _home(groups, pooled, reference, unit, sign)
            if any(len(_sides_of(groups, pose)) < 2 for pose in reference):
                notes.append(
                    f"{joint}: its reference position was approached from one side, so that half "
                    "of the hysteresis is in its home"
                )
    notes.append("the plan has no bound for encoders: their figures are stated, not judged")
    records = {
        ENCODERS: (repeated, "standard deviation of the readings in one pose, from one side"),
        "encoder_hysteresis": (hysteresis, "reading after approach from + minus that from -"),
        "encoder_home": (home, "model position = sign * encoder reading + value"),
    }
    return {
        **new_document(plan),
        "verdict": "degenerate" if unobservable else "accepted",
        "records": {
            name: {"values": values, "meaning": meaning}
            for name, (values, meaning) in records.items()
            if values
        },
        "fitted": {"count": len(observations)},
        "unobservable": unobservable,
        "reasons": list(unobservable),
        "notes": [*observations.notes, *notes],
    }


def _check(plan: Plan, observations: Observations) -> None:
    if len(plan.estimate) > 1:
        raise plan.error(
            "estimate",
            f"{ENCODERS} cannot be combined with other estimates",
            value=", ".join(plan.estimate),
            expected=f"a separate plan for {ENCODERS}: it compares readings of the same pose",
        )
    poses = set(observations.poses or ())
    for pose, stated in plan.references.items():
        if pose not in poses:
            raise plan.error(
                f"references.{pose}",
                "a reference for a pose that no observation has",
                value=pose,
                expected="a name in the column pose of the observations",
            )
        for joint in stated:
            if joint not in observations.joints:
                raise plan.error(
                    f"references.{pose}.{joint}",
                    "a reference for a joint without a column",
                    value=joint,
                    expected=", ".join(observations.joints) or "a column joint.NAME",
                )
            there = np.isfinite(observations.joints[joint])
            if not any(
                name == pose and there[i] for i, name in enumerate(observations.poses or ())
            ):
                raise plan.error(
                    f"references.{pose}.{joint}",
                    "a reference for a joint without a reading in this pose",
                    value=joint,
                    expected=f"a number in joint.{joint} of a row of pose {pose}",
                )


def _groups(
    readings: FloatArray, poses: tuple[str, ...], sides: tuple[str, ...]
) -> tuple[_Group, ...]:
    places: dict[tuple[str, str], list[int]] = {}
    for row, key in enumerate(zip(poses, sides, strict=True)):
        if key[0] and np.isfinite(readings[row]):
            places.setdefault(key, []).append(row)
    return tuple(_Group(pose, side, readings[rows]) for (pose, side), rows in places.items())


def _pool(groups: tuple[_Group, ...]) -> _PooledSpread | str:
    """Return the pooled standard deviation within groups, or the reason why there is none."""
    degrees = sum(len(group.readings) - 1 for group in groups)
    if degrees < 1:
        return (
            "no pose repeats. Return to the same pose at least twice from the same side, and name "
            "it in the column pose"
        )
    squares = sum(float(np.sum((g.readings - g.readings.mean()) ** 2)) for g in groups)
    largest = max(float(np.abs(group.readings).max()) for group in groups)
    std = float(np.sqrt(squares / degrees))
    # Rounding can make the deviations of equal readings differ from zero in the last digits.
    if std <= 1e-14 * largest or std == 0.0:
        return (
            "its readings are equal in each pose, so that their resolution hides it. Record more "
            "digits, or use an external measurement"
        )
    return _PooledSpread(std, degrees)


def _sides_of(groups: tuple[_Group, ...], pose: str) -> Mapping[str, _Group]:
    found = {group.side: group for group in groups if group.pose == pose}
    return {side: found[side] for side in SIDES if side in found}


def _hysteresis(
    groups: tuple[_Group, ...], pooled: _PooledSpread, unit: str
) -> dict[str, Any] | None:
    """Return the difference of both approach directions, a weighted mean over the poses."""
    differences, variances = [], []
    for pose in dict.fromkeys(group.pose for group in groups):
        sides = _sides_of(groups, pose)
        if len(sides) == 2:
            first, second = (sides[side].readings for side in SIDES)
            differences.append(float(first.mean() - second.mean()))
            variances.append(1.0 / len(first) + 1.0 / len(second))
    if not differences:
        return None
    weights = 1.0 / np.array(variances)
    mean = float(weights @ np.array(differences) / weights.sum())
    return pooled.scalar(mean, float(1.0 / weights.sum()), unit)


def _home(
    groups: tuple[_Group, ...],
    pooled: _PooledSpread,
    reference: Mapping[str, float],
    unit: str,
    sign: float,
) -> dict[str, Any]:
    """Return the offset to add to the reading, from the mean of both directions in reference poses.

    Args:
        groups: groups of readings of the joint.
        pooled: pooled standard deviation of its readings.
        reference: pose -> known position in the encoder's direction of counting, rad or m.
        unit: unit of the positions.
        sign: direction of the encoder against the model, 1 or -1.
    """
    offsets, variances = [], []
    for pose, position in reference.items():
        both = _sides_of(groups, pose)
        mine = list(both.values()) if len(both) == 2 else [g for g in groups if g.pose == pose]
        offsets.append(position - float(np.mean([g.readings.mean() for g in mine])))
        variances.append(sum(1.0 / len(g.readings) for g in mine) / len(mine) ** 2)
    count = len(offsets)
    mean, variance = sign * float(np.mean(offsets)), float(sum(variances)) / count**2
    return {**pooled.scalar(mean, variance, unit), "sign": sign}
