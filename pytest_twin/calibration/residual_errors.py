"""Errors of predicted observations: size, and location in the workspace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.parameters import State, Variables
from pytest_twin.calibration.problem import CalibrationProblem, predicted_poses
from pytest_twin.calibration.residual_patterns import Residuals, pattern_of
from pytest_twin.calibration.terms import PointTerm, PoseTerm, Term

_REGIONS = ("near", "middle", "far")
_LEAST_IN_REGION = 3
"""Smallest number of observations in a region whose errors are stated."""

LONGEST_STEP_S = 0.1
"""Largest time between observations that are samples of one motion."""


@dataclass(frozen=True)
class Errors:
    """Errors of one state on some observations.

    Attributes:
        ids: id of each measurement.
        rows: (m,) row of the observations.
        translation: (m, 3) position errors, m.
        rotation: (m, 3) rotation vectors, rad; NaN for measured points.
        reach: (m,) distance of the flange from the base, m.
        in_base: (m, 3) ``translation`` in the axes of the base, m.
        rate: (m, 3) rate of the prediction in the axes of ``translation``, m/s; NaN where the
            observations are not samples of a motion.
    """

    ids: tuple[str, ...]
    rows: np.ndarray
    translation: FloatArray
    rotation: FloatArray
    reach: FloatArray
    in_base: FloatArray
    rate: FloatArray

    def only(self, kept: np.ndarray) -> Errors:
        """Return the errors of the measurements where the (m,) mask is True."""
        ids = tuple(name for name, there in zip(self.ids, kept, strict=True) if there)
        return Errors(
            ids,
            self.rows[kept],
            self.translation[kept],
            self.rotation[kept],
            self.reach[kept],
            self.in_base[kept],
            self.rate[kept],
        )

    @property
    def distance(self) -> FloatArray:
        """(m,) distances, m."""
        return np.asarray(np.linalg.norm(self.translation, axis=1))

    def summary(self) -> dict[str, Any]:
        """Return root mean squares over all coordinates, and of distances and angles."""
        if len(self.ids) == 0:
            return {"count": 0}
        found: dict[str, Any] = {
            "translation_rms": _rms(self.translation),
            "distance_rms": float(np.sqrt(np.mean(self.distance**2))),
            "distance_max": float(self.distance.max()),
        }
        if np.isfinite(self.rotation).any():
            angles = np.linalg.norm(self.rotation, axis=1)
            found["rotation_rms"] = _rms(self.rotation)
            found["angle_rms"] = float(np.sqrt(np.nanmean(angles**2)))
        found["count"] = len(set(self.rows.tolist()))
        return found

    def worst(self) -> dict[str, Any]:
        """Return the observation with the largest error."""
        at = int(np.argmax(self.distance))
        found: dict[str, Any] = {"id": self.ids[at], "translation": float(self.distance[at])}
        angle = float(np.linalg.norm(self.rotation[at]))
        if np.isfinite(angle):
            found["rotation"] = angle
        return found

    def regions(self) -> list[dict[str, Any]]:
        """Return the root mean squares for thirds of the workspace by reach."""
        return regions_of(self.reach, self.translation, self.rotation)


def regions_of(
    reach: FloatArray, translation: FloatArray, rotation: FloatArray
) -> list[dict[str, Any]]:
    """RMS of coordinates for thirds of the workspace; empty if the reach does not vary.

    Args:
        reach: (m,) distance of the flange from the base, m.
        translation: (m, k) coordinates of the errors, m.
        rotation: (m, k) coordinates of the rotation errors, rad; NaN for measured points.
    """
    if len(reach) < _LEAST_IN_REGION * len(_REGIONS):
        return []
    bounds = np.quantile(reach, [0.0, 1 / 3, 2 / 3, 1.0])
    if bounds[-1] - bounds[0] < 1e-6:
        return []
    which = np.clip(np.searchsorted(bounds[1:-1], reach, side="right"), 0, 2)
    found = []
    for number, name in enumerate(_REGIONS):
        inside = which == number
        if inside.sum() < _LEAST_IN_REGION:
            continue
        one = {
            "region": name,
            "reach": [float(bounds[number]), float(bounds[number + 1])],
            "count": int(inside.sum()),
            "translation_rms": _rms(translation[inside]),
        }
        if np.isfinite(rotation[inside]).any():
            one["rotation_rms"] = _rms(rotation[inside])
        found.append(one)
    return found


def errors_of(
    problem: CalibrationProblem, state: State, kept: Sequence[np.ndarray] | None = None
) -> Errors:
    """Return errors of all measurements, or of those that ``kept`` selects for each term."""
    found = problem.residuals(state, np.zeros(problem.layout.count))
    flange = predicted_poses(problem, state)
    ids: list[str] = []
    # The empty arrays are for a problem without terms.
    rows = [np.zeros(0, dtype=int)]
    translations, rotations, in_base, rates = ([np.zeros((0, 3))] for _ in range(4))
    for at, (term, (residual, _)) in enumerate(zip(problem.terms, found, strict=True)):
        chosen = np.ones(len(term.rows), dtype=bool) if kept is None else kept[at]
        mine = term.rows[chosen]
        rows.append(mine)
        ids += [problem.observations.ids[row] for row in mine]
        translations.append(residual[chosen, :3])
        turned = residual[chosen, 3:] if isinstance(term, PoseTerm) else None
        rotations.append(np.full((len(mine), 3), np.nan) if turned is None else turned)
        to_base = _axes_in_base(term, state, flange)[chosen]
        in_base.append(np.einsum("nij,nj->ni", to_base, residual[chosen, :3]))
        rates.append(_rates(term, problem, state)[chosen])
    all_rows = np.concatenate(rows)
    return Errors(
        tuple(ids),
        all_rows,
        np.concatenate(translations),
        np.concatenate(rotations),
        np.linalg.norm(flange[all_rows, :3, 3], axis=1),
        np.concatenate(in_base),
        np.concatenate(rates),
    )


def pattern(errors: Errors, payloads: Sequence[str] | None) -> dict[str, Any] | None:
    """Return the pattern of the errors (:func:`pattern_of`), from one vector for each observation.

    Args:
        errors: errors of observations; markers of one observation share the error of the arm.
        payloads: name of each row's payload, or None.
    """
    rows, first, place = np.unique(errors.rows, return_index=True, return_inverse=True)
    count = np.bincount(place, minlength=len(rows))[:, None]

    def mean(values: FloatArray) -> FloatArray:
        sums = np.zeros((len(rows), 3))
        np.add.at(sums, place, values)
        return np.asarray(sums / count)

    return pattern_of(
        Residuals(
            mean(errors.translation),
            mean(errors.in_base),
            errors.reach[first],
            mean(errors.rate),
            [payloads[row] for row in rows] if payloads else [""] * len(rows),
        )
    )


def _axes_in_base(term: Term, state: State, flange: FloatArray) -> FloatArray:
    """(m, 3, 3) rotations from the axes of a term's errors to those of the base."""
    if isinstance(term, PoseTerm):
        if term.mount == "hand":
            return np.asarray(flange[term.rows, :3, :3] @ state.poses[term.mounted][:3, :3])
        return np.tile(state.poses[term.world][:3, :3], (len(term.rows), 1, 1))
    if isinstance(term, PointTerm):
        return np.tile(state.poses[term.world][:3, :3], (len(term.rows), 1, 1))
    return np.tile(np.eye(3), (len(term.rows), 1, 1))


def _rates(term: Term, problem: CalibrationProblem, state: State) -> FloatArray:
    """(m, 3) rate of a term's prediction by central differences between neighbours, m/s."""
    rates = np.full((len(term.rows), 3), np.nan)
    time = problem.observations.time
    if time is None or len(term.rows) < 3 or not isinstance(term, PoseTerm | PointTerm):
        return rates
    variables = Variables(problem.layout, state, np.zeros(problem.layout.count))
    place = term.predicted(problem.flange(variables), variables)
    place = place[:, :3, 3] if isinstance(term, PoseTerm) else place
    stamp = time[term.rows]
    step = np.diff(stamp)
    near = (step > 0.0) & (step <= LONGEST_STEP_S)
    both = np.flatnonzero(near[:-1] & near[1:]) + 1
    rates[both] = (place[both + 1] - place[both - 1]) / (stamp[both + 1] - stamp[both - 1])[:, None]
    return rates


def acceptance_failures(
    summary: Mapping[str, Any], bounds: Mapping[str, float | None]
) -> list[str]:
    """Return a sentence for each error beyond its bound; empty if all are accepted."""
    units = {"translation": ("mm", 1e3), "rotation": ("mrad", 1e3), "reprojection": ("px", 1.0)}
    found = []
    for name, bound in bounds.items():
        value = summary.get(f"{name}_rms")
        if bound is None or value is None:
            continue
        if not value <= bound:
            unit, factor = units[name]
            found.append(
                f"held-out {name} {factor * value:.3g} {unit} (root mean square), "
                f"accepted up to {factor * bound:.3g} {unit}"
            )
    return found


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
