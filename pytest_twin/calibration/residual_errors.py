"""Errors of a state on observations: how large, where in the workspace, and of what pattern."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.parameters import State
from pytest_twin.calibration.problem import Problem, predicted_poses
from pytest_twin.calibration.terms import PoseTerm

_REGIONS = ("near", "middle", "far")
_LEAST_IN_REGION = 3

CONSTANT_SHARE = 0.5
"""Part of the squared error that one constant vector must explain to be called a bias."""

REACH_CORRELATION = 0.5
"""Rank correlation between error and reach from which a report says that errors grow with reach."""


@dataclass(frozen=True)
class Errors:
    """Errors of one state on some observations.

    Attributes:
        ids: of each measurement.
        rows: (m,) row of the observations.
        translation: (m, 3) vectors, m.
        rotation: (m, 3) rotation vectors, rad; NaN where points are measured.
        reach: (m,) distance of the flange from the base, m.
    """

    ids: tuple[str, ...]
    rows: np.ndarray
    translation: FloatArray
    rotation: FloatArray
    reach: FloatArray

    def only(self, kept: np.ndarray) -> Errors:
        """Those of some measurements, (m,) truth values."""
        ids = tuple(name for name, there in zip(self.ids, kept, strict=True) if there)
        return Errors(
            ids, self.rows[kept], self.translation[kept], self.rotation[kept], self.reach[kept]
        )

    @property
    def distance(self) -> FloatArray:
        """(m,) m."""
        return np.asarray(np.linalg.norm(self.translation, axis=1))

    def summary(self) -> dict[str, Any]:
        """Root mean squares over all coordinates, and of distances and angles."""
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
        """The observation that is furthest off."""
        at = int(np.argmax(self.distance))
        found: dict[str, Any] = {"id": self.ids[at], "translation": float(self.distance[at])}
        angle = float(np.linalg.norm(self.rotation[at]))
        if np.isfinite(angle):
            found["rotation"] = angle
        return found

    def regions(self) -> list[dict[str, Any]]:
        """The same root mean squares for thirds of the workspace by reach."""
        if len(self.ids) < _LEAST_IN_REGION * len(_REGIONS):
            return []
        bounds = np.quantile(self.reach, [0.0, 1 / 3, 2 / 3, 1.0])
        if bounds[-1] - bounds[0] < 1e-6:
            return []
        which = np.clip(np.searchsorted(bounds[1:-1], self.reach, side="right"), 0, 2)
        found = []
        for number, name in enumerate(_REGIONS):
            inside = which == number
            if inside.sum() < _LEAST_IN_REGION:
                continue
            one = {
                "region": name,
                "reach": [float(bounds[number]), float(bounds[number + 1])],
                "count": int(inside.sum()),
                "translation_rms": _rms(self.translation[inside]),
            }
            if np.isfinite(self.rotation[inside]).any():
                one["rotation_rms"] = _rms(self.rotation[inside])
            found.append(one)
        return found

    def pattern(self) -> dict[str, Any] | None:
        """What the errors look like: a constant bias, or growth with reach; None for neither."""
        if len(self.ids) < 2 * _LEAST_IN_REGION:
            return None
        mean = self.translation.mean(axis=0)
        share = float(mean @ mean / max(np.mean(self.distance**2), 1e-300))
        if share > CONSTANT_SHARE:
            return {
                "kind": "constant",
                "bias": mean.tolist(),
                "words": f"a constant bias of {1e3 * np.linalg.norm(mean):.2f} mm makes "
                f"{100 * share:.0f} % of the squared error: a frame is off, not the arm",
            }
        if np.ptp(self.reach) > 1e-6:
            correlation = _rank_correlation(self.reach, self.distance)
            if correlation > REACH_CORRELATION:
                return {
                    "kind": "grows_with_reach",
                    "correlation": correlation,
                    "words": "the error grows with reach (rank correlation "
                    f"{correlation:.2f}): a joint's zero or a link's geometry is off",
                }
        return None


def errors_of(problem: Problem, state: State, kept: Sequence[np.ndarray] | None = None) -> Errors:
    """Errors of all measurements, or of those that ``kept`` has for each term."""
    found = problem.residuals(state, np.zeros(problem.layout.count))
    flange = predicted_poses(problem, state)[:, :3, 3]
    ids: list[str] = []
    rows, translations, rotations = [], [], []
    for at, (term, (residual, _)) in enumerate(zip(problem.terms, found, strict=True)):
        chosen = np.ones(len(term.rows), dtype=bool) if kept is None else kept[at]
        mine = term.rows[chosen]
        rows.append(mine)
        ids += [problem.observations.ids[row] for row in mine]
        translations.append(residual[chosen, :3])
        turned = residual[chosen, 3:] if isinstance(term, PoseTerm) else None
        rotations.append(np.full((len(mine), 3), np.nan) if turned is None else turned)
    all_rows = np.concatenate(rows) if rows else np.zeros(0, dtype=int)
    reach = np.linalg.norm(flange[all_rows], axis=1)
    return Errors(
        tuple(ids),
        all_rows,
        np.concatenate(translations) if translations else np.zeros((0, 3)),
        np.concatenate(rotations) if rotations else np.zeros((0, 3)),
        reach,
    )


def accepted(summary: Mapping[str, Any], bounds: Mapping[str, float | None]) -> list[str]:
    """What is beyond its bound, in words; empty where all is accepted."""
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


def _rank_correlation(first: FloatArray, second: FloatArray) -> float:
    ranks = [np.argsort(np.argsort(values)).astype(float) for values in (first, second)]
    return float(np.corrcoef(ranks[0], ranks[1])[0, 1])
