"""Find the row after which the target, the camera or the tracker had moved.

A fit that excludes outliers takes the longer part of the rows and leaves out the others one by one.
This test adds one step of a pose at each possible row instead, to first order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import f as fisher

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.input_mistake import InputMistake
from pytest_twin.calibration.parameters import State
from pytest_twin.calibration.problem import CalibrationProblem, describe_pose
from pytest_twin.calibration.solve import Fit, prior_rows, prior_values

LEAST_ROWS = 4
"""Fewest rows before and after a step. Fewer wrong rows are outliers."""

LEAST_M, LEAST_RAD = 5e-4, 2e-3
"""Smallest step of a body, m and rad. Errors of lens and arm that neighbouring rows share are as
large as 0.1 mm and 1 mrad."""

_CHANCE = 1e-6
"""Significance level of a step (Bonferroni over the rows). Errors of an arm that follow the order
of the poses are no steps, but reach a level of 0.001."""

_SHARE = 0.5
"""Fraction of the squared residuals of positions or of angles that a step must remove. Joint zeros
and links that are wrong remain in the residuals on both sides of a step."""

_OUTLIER_RATIO = 6.0
"""A row is left out as an outlier if its residual with the step exceeds the median by this
factor."""

_NORMAL = 1.4826
"""Standard deviation of normal noise, relative to its median magnitude."""

_ROUNDS, _SETTLED = 4, 0.05
"""Largest number of rounds between which the noise is estimated and outliers are left out, and
relative change of the noise below which they end."""


def moved_body(problem: CalibrationProblem, fit: Fit) -> InputMistake | None:
    """Return the pose that changed between two rows, or None.

    Args:
        problem: the problem on all observations, in the order in which they were taken.
        fit: a fit on some of them.
    """
    layout = fit.problem.layout
    names = [name for name in layout.poses if name.rpartition(".")[2] in ("world", "mounted")]
    if not names:
        return None
    rows = _whitened(problem, fit.state, fit)
    best: tuple[float, str, int, FloatArray] | None = None
    for name in names:
        steps = _step(rows, layout.blocks[f"pose:{name}"])
        if steps is not None and (best is None or steps[0] > best[0]):
            best = (steps[0], name, steps[1], steps[2])
    if best is None:
        return None
    _, name, row, step = best
    if np.linalg.norm(step[:3]) < LEAST_M and np.linalg.norm(step[3:]) < LEAST_RAD:
        return None
    what = describe_pose(name, problem.plan.mount)
    ids = problem.observations.ids
    here, before = ids[row], ids[row - 1]
    return InputMistake(
        f"from observation {here} on, {what} is elsewhere: it moved by about "
        f"{1e3 * np.linalg.norm(step[:3]):.2g} mm and {1e3 * np.linalg.norm(step[3:]):.2g} mrad "
        f"after observation {before}",
        f"fasten it, and calibrate the observations up to {before} and those from {here} on apart",
        float("nan"),
        float("nan"),
    )


@dataclass(frozen=True)
class _Rows:
    """Residuals and derivatives, divided by their noise; priors come last.

    Attributes:
        residuals: (m,).
        slopes: (m, count).
        row: (m,) row of the observations, -1 for priors.
        kind: (m,) kind of noise, ``""`` for priors.
    """

    residuals: FloatArray
    slopes: FloatArray
    row: np.ndarray
    kind: np.ndarray

    def only(self, used: np.ndarray) -> _Rows:
        """Return the residuals where the (m,) mask is True."""
        return _Rows(self.residuals[used], self.slopes[used], self.row[used], self.kind[used])

    def divided(self, size: FloatArray) -> _Rows:
        """Return the residuals and slopes divided by (m,) sizes."""
        return replace(self, residuals=self.residuals / size, slopes=self.slopes / size[:, None])


def _whitened(problem: CalibrationProblem, state: State, fit: Fit) -> _Rows:
    residuals, slopes, rows, kinds = [], [], [], []
    of_terms = problem.residuals(state, np.zeros(fit.problem.layout.count))
    for term, (residual, slope) in zip(problem.terms, of_terms, strict=True):
        size = np.array([fit.noise[name] for name in term.noise])
        residuals.append((residual / size).ravel())
        slopes.append((slope / size[:, None]).reshape(-1, slope.shape[2]))
        rows.append(np.repeat(term.rows, len(term.noise)))
        kinds.append(np.tile(term.noise, len(term.rows)))
    priors = prior_rows(fit.problem)
    return _Rows(
        np.concatenate([*residuals, prior_values(fit.problem, state)]),
        np.concatenate([*slopes, priors]),
        np.concatenate([*rows, np.full(len(priors), -1)]),
        np.concatenate([*kinds, np.full(len(priors), "")]),
    )


def _step(rows: _Rows, pose: slice) -> tuple[float, int, FloatArray] | None:
    """Return the share that the best step removes, its first row, and the step; None without one.

    Args:
        rows: all residuals.
        pose: columns of the pose that may have moved.
    """
    for _ in range(_ROUNDS):
        there = np.unique(rows.row[rows.row >= 0])
        if len(there) < 2 * LEAST_ROWS:
            return None
        basis, _ = np.linalg.qr(rows.slopes)
        left = rows.residuals - basis @ (basis.T @ rows.residuals)
        best: tuple[float, int, FloatArray, FloatArray] | None = None
        for row in there[LEAST_ROWS : len(there) - LEAST_ROWS + 1].tolist():
            later = np.where((rows.row >= row)[:, None], rows.slopes[:, pose], 0.0)
            unexplained = later - basis @ (basis.T @ later)
            step = -np.linalg.lstsq(unexplained, left, rcond=1e-9)[0]
            rest = left + unexplained @ step
            if best is None or rest @ rest < best[0]:
                best = (float(rest @ rest), row, step, rest)
        assert best is not None
        squares, row, step, rest = best
        shares = {}
        size = np.ones(len(rest))
        for kind in set(rows.kind.tolist()) - {""}:
            of_kind = rows.kind == kind
            before, after = (float(np.mean(one[of_kind] ** 2)) for one in (left, rest))
            shares[kind] = 1.0 - after / max(before, 1e-300)
            size[of_kind] = max(_NORMAL * float(np.median(np.abs(rest[of_kind]))), 1e-12)
        whole = np.array([np.linalg.norm((rest / size)[rows.row == one]) for one in there])
        wrong = there[whole > _OUTLIER_RATIO * np.median(whole)]
        if len(wrong) == 0 and np.abs(size - 1.0).max() < _SETTLED:
            break
        # With the step the noise is smaller, and outliers stand out.
        rows = rows.divided(size).only(~np.isin(rows.row, wrong))
    free = len(rest) - rows.slopes.shape[1] - 6
    if max(shares.values()) < _SHARE or free < 1:
        return None
    if _drift_criterion(rows, pose, basis, left) < _criterion(squares, len(rest), 7):
        return None
    ratio = (float(left @ left) / max(squares, 1e-300) - 1.0) * free / 6.0
    chance = float(fisher.sf(ratio, 6, free)) * len(there)
    return (max(shares.values()), row, step) if chance < _CHANCE else None


def _drift_criterion(rows: _Rows, pose: slice, basis: FloatArray, left: FloatArray) -> float:
    """Criterion of a pose that changes smoothly with the order of the rows (cubic).

    Errors of an arm change smoothly if the poses follow a path.
    """
    _, place = np.unique(rows.row, return_inverse=True)
    time = 2.0 * place / max(int(place.max()), 1) - 1.0
    slopes = np.where((rows.row >= 0)[:, None], rows.slopes[:, pose], 0.0)
    drift = np.concatenate([slopes * (time**power)[:, None] for power in (1, 2, 3)], axis=1)
    drift -= basis @ (basis.T @ drift)
    rest = left - drift @ np.linalg.lstsq(drift, left, rcond=1e-9)[0]
    return _criterion(float(rest @ rest), len(rest), drift.shape[1])


def _criterion(squares: float, count: int, unknowns: int) -> float:
    """Bayesian information criterion."""
    return count * float(np.log(max(squares, 1e-300))) + unknowns * float(np.log(count))
