"""Leave-one-out residuals of a fit, and the covariance that follows from them (jackknife).

Markers of one observation share the error of the robot's pose. Therefore whole observations are
left out, never single markers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.solve import Fit


@dataclass(frozen=True)
class Jackknife:
    """Result of leaving out each observation in turn, to first order.

    Attributes:
        residuals: for each term, (m, columns) residuals of observations left out, m, rad or px; NaN
            where a measurement was not fitted.
        covariance: (count, count) covariance of the unknowns.
        count: number of fitted observations.
    """

    residuals: tuple[FloatArray, ...]
    covariance: FloatArray
    count: int

    def summary(self, fit: Fit) -> dict[str, float]:
        """Root mean square of all coordinates, by kind of noise."""
        found = {}
        for name in fit.noise:
            parts = [
                residual[:, [i for i, one in enumerate(term.noise) if one == name]].reshape(-1)
                for term, residual in zip(fit.problem.terms, self.residuals, strict=True)
            ]
            values = np.concatenate(parts)
            values = values[np.isfinite(values)]
            if len(values):
                kind = "translation" if name == "point" else name
                found[f"{kind}_rms"] = float(np.sqrt(np.mean(values**2)))
        return found


def jackknife(fit: Fit) -> Jackknife:
    """Compute leave-one-out residuals from the leverages: ``e = (I - H)^-1 r``.

    The result is exact for linear problems. The covariance is the cluster-robust estimate CR3
    (Cameron and Miller: A practitioner's guide to cluster-robust inference, 2015, section VI.B). It
    requires independent observations and makes no assumption on errors within one.
    """
    terms = fit.problem.terms
    starts = np.cumsum([0, *(len(term.rows) * len(term.noise) for term in terms)])
    left, singular, right = np.linalg.svd(fit.jacobian, full_matrices=False)
    sure = singular > 1e-12 * max(singular.max(initial=0.0), 1e-300)
    left, inner = left[:, sure], right[sure].T / singular[sure]
    found = [np.full(residual.shape, np.nan) for residual in fit.residuals]
    covariance = np.zeros((fit.jacobian.shape[1],) * 2)
    rows = sorted({int(r) for t, k in zip(terms, fit.kept, strict=True) for r in t.rows[k]})
    for row in rows:
        at: list[FloatArray] = []
        values: list[FloatArray] = []
        places: list[tuple[int, int, FloatArray]] = []
        for number, (term, kept) in enumerate(zip(terms, fit.kept, strict=True)):
            width = len(term.noise)
            size = np.array([fit.noise[name] for name in term.noise])
            for measurement in np.flatnonzero((term.rows == row) & kept).tolist():
                at.append(starts[number] + width * measurement + np.arange(width))
                values.append(fit.residuals[number][measurement] / size)
                places.append((number, measurement, size))
        block = left[np.concatenate(at)]
        free = np.eye(len(block)) - block @ block.T
        error = np.linalg.pinv(free, rcond=1e-10) @ np.concatenate(values)
        score = inner @ (block.T @ error)
        covariance += np.outer(score, score)
        offset = 0
        for number, measurement, size in places:
            found[number][measurement] = error[offset : offset + len(size)] * size
            offset += len(size)
    count = len(rows)
    covariance *= (count - 1) / max(count, 1)
    prior = inner @ left[starts[-1] :].T
    return Jackknife(tuple(found), covariance + prior @ prior.T, count)
