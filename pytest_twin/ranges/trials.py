"""Variation of parameters between groups of trials: loads, temperatures, days."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats

from pytest_twin.arrays import FloatArray
from pytest_twin.formats.record_fields import Z95
from pytest_twin.ranges.distribution import Coordinate, Source
from pytest_twin.ranges.identified_coordinates import RecordCoordinates
from pytest_twin.ranges_spec import TrialGroup
from pytest_twin.twin import Twin

_UNITS = {"temperature": "deg C", "load": "kg"}
NAME = "ranges: trials: of twin.yaml"


def spread_over_trials(found: RecordCoordinates, twin: Twin, notes: list[str]) -> RecordCoordinates:
    """Return the collected coordinates with the variance between groups of trials added.

    The covariance between groups is the covariance of their estimates minus the mean of their own
    covariances (method of moments; DerSimonian, Laird, Controlled Clinical Trials 7, 1986), without
    negative eigenvalues. Conditions of the trials are included, so that friction keeps its
    correlation with temperature. With few groups the variance is itself uncertain and is widened to
    Student's prediction interval (Cox, Snell, Applied Statistics, 1981, ch. 4).

    Args:
        found: uncertain coordinates of the records.
        twin: twin with ``ranges: trials:``.
        notes: list to which messages on assumptions are added.
    """
    groups = twin.ranges.trials
    if not groups:
        return found
    names = [one.name for one in found.coordinates]
    shared = [
        k for k, one in enumerate(found.coordinates)
        if one.body is None and all(one.name in group.record.values for group in groups)
    ]  # fmt: skip
    lacking = [one.name for k, one in enumerate(found.coordinates) if k not in shared
               and one.body is None]  # fmt: skip
    if lacking:
        notes.append(
            "the spread over trials is unknown for parameters that some groups did not estimate: "
            + ", ".join(lacking)
        )
    conditions = [
        name for name in _UNITS
        if all(name in group.conditions for group in groups)
        and len({group.conditions[name] for group in groups}) > 1
    ]  # fmt: skip
    own = [names[k] for k in shared]
    estimates = np.array([[group.record.values[name] for name in own] for group in groups])
    stated = np.array([[group.conditions[name] for name in conditions] for group in groups])
    table = np.hstack([estimates, stated.reshape(len(groups), len(conditions))])
    between = _between_covariance(
        table, np.mean([_covariance(group, own) for group in groups], axis=0)
    )
    factor = _prediction_factor(len(groups))
    notes.append(
        f"spread over {len(groups)} groups of trials: standard deviations times {factor:.2f}, "
        f"because {len(groups)} groups determine a spread with {len(groups) - 1} degrees of freedom"
    )
    return _add_between_covariance(found, shared, conditions, table, between * factor**2)


def _covariance(group: TrialGroup, names: list[str]) -> FloatArray:
    """(k, k) covariance of a group's estimates; only variances if it has no covariance."""
    record = group.record
    at = [record.covariance_names.index(n) if n in record.covariance_names else -1 for n in names]
    whole = np.reshape(record.covariance, (len(record.covariance_names),) * 2)
    found = np.zeros((len(names), len(names)))
    for i, row in enumerate(at):
        for k, column in enumerate(at):
            if row >= 0 and column >= 0:
                found[i, k] = whole[row, column]
        if row < 0:
            found[i, i] = record.deviations.get(names[i], 0.0) ** 2
    return found


def _between_covariance(table: FloatArray, within: FloatArray) -> FloatArray:
    """(k, k) covariance of estimates and conditions between groups; conditions have no error."""
    scale = table.std(axis=0, ddof=1)
    scale = np.where(scale > 0.0, scale, 1.0)
    between = np.atleast_2d(np.cov(table / scale, rowvar=False))
    known = len(within)
    between[:known, :known] -= within / np.outer(scale[:known], scale[:known])
    # Nothing is subtracted for conditions, so the correlation with them remains.
    values, vectors = np.linalg.eigh(between)
    positive = (vectors * values.clip(0.0)) @ vectors.T
    return np.asarray(positive * np.outer(scale, scale))


def _prediction_factor(groups: int) -> float:
    """Return the ratio of a 95 % prediction interval to that for a known standard deviation.

    Two groups have one degree of freedom, for which Student's t of 12.7 would make the interval
    useless. For two groups, t of two degrees of freedom is used.
    """
    freedom = max(groups - 1, 2)
    return float(stats.t.ppf(0.975, freedom) / Z95 * np.sqrt(1.0 + 1.0 / groups))


def _add_between_covariance(
    found: RecordCoordinates,
    shared: list[int],
    conditions: list[str],
    table: FloatArray,
    between: FloatArray,
) -> RecordCoordinates:
    before = len(found.coordinates)
    covariance = np.zeros((before + len(conditions),) * 2)
    covariance[:before, :before] = found.covariance
    places = [*shared, *range(before, before + len(conditions))]
    covariance[np.ix_(places, places)] += between
    std = np.sqrt(np.diag(between).clip(0.0))
    coordinates = list(found.coordinates)
    for column, place in enumerate(shared):
        one = coordinates[place]
        source = Source("trials", NAME, float(std[column]))
        # The mean is that of the trials.
        mean = float(table[:, column].mean()) + one.is_relative
        coordinates[place] = replace(one, mean=mean, sources=(*one.sources, source))
    for k, name in enumerate(conditions):
        column = len(shared) + k
        coordinates.append(
            Coordinate(
                f"trials.{name}", _UNITS[name], float(table[:, column].mean()), 0.0,
                is_condition=True, sources=(Source("trials", NAME, float(std[column])),),
            )
        )  # fmt: skip
    return replace(found, coordinates=coordinates, covariance=covariance)
