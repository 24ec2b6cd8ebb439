"""Find rows in which the target, the camera or the tracker was elsewhere, or of another size.

A fit that excludes outliers takes the larger part of the rows and leaves out the others one by one.
This test adds a change of one pose, or of the target's size, to some of the rows instead, to first
order. It tries a step after each row, a set of outliers that agree with each other, and a change
that grows with the order of the rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import f as fisher

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.closed_form import least_squares
from pytest_twin.calibration.input_mistake import FAR_BETTER, InputMistake
from pytest_twin.calibration.input_mistakes import has_large_errors, lengths_in_mm
from pytest_twin.calibration.parameters import State
from pytest_twin.calibration.problem import CalibrationProblem, describe_pose, predicted_poses
from pytest_twin.calibration.residual_errors import errors_of
from pytest_twin.calibration.solve import LEAST_INLIERS, Fit, prior_rows, prior_values

LEAST_ROWS = 4
"""Fewest rows before and after a step, and that agree with each other. Fewer are outliers."""

MOST_SCALE = 0.3
"""Largest change of a size. To first order a larger one is not correct."""

LEAST_M, LEAST_RAD, LEAST_SCALE = 5e-4, 2e-3, 2e-3
"""Smallest change of a body, m and rad, and of a size. Errors of lens and arm that neighbouring
rows share are as large as 0.1 mm and 1 mrad."""

_CHANCE = 1e-6
"""Significance level of a change (Bonferroni over the rows). Errors of an arm that follow the order
of the poses are no steps, but reach a level of 0.001."""

_SHARE = 0.5
"""Fraction of the squared residuals of positions or of angles that a change must remove. Joint
zeros and links that are wrong remain in the residuals on both sides of a step."""

_SHARE_OF_LARGE = 1.0 - FAR_BETTER**2
"""The same where the errors are so large that other mistakes of the input may cause them."""

_AGREEING = 0.9
"""Fraction of the squared residuals of outliers that a change common to them must remove. Of four
outliers that do not agree, it removes a quarter."""

_OUTLIER_RATIO = 6.0
"""A row is left out as an outlier if its residual with the change exceeds the median by this
factor."""

_NORMAL = 1.4826
"""Standard deviation of normal noise, relative to its median magnitude."""

_ROUNDS, _SETTLED = 4, 0.05
"""Largest number of rounds between which the noise is estimated and outliers are left out, and
relative change of the noise below which they end."""

_PATH = 0.7
"""Distance of successive flange positions, relative to that of random pairs, below which the poses
follow a path. Errors of the arm then change smoothly with the order of the rows too."""

_MOST_NAMED = 8
"""Largest number of rows that a message lists."""


@dataclass(frozen=True)
class Change:
    """A change of the cell between the observations.

    Attributes:
        mistake: the change and what to do, as text.
        may_be_arm: whether errors of the arm would look the same.
    """

    mistake: InputMistake
    may_be_arm: bool

    @property
    def note(self) -> str:
        """The change and its other explanation, as text."""
        return (
            f"{self.mistake.what}, or the arm's errors change along the path of the poses: take "
            "the poses in a random order to distinguish them"
        )


def changed_cell(problem: CalibrationProblem, fit: Fit) -> Change | None:
    """Return what changed between the observations, or None.

    Args:
        problem: the problem on all observations, in the order in which they were taken.
        fit: a fit on some of them.
    """
    quantities = _quantities(fit)
    # Odometry drifts, which its intervals contain.
    if not quantities or problem.plan.has_free_scale or lengths_in_mm(problem):
        return None
    rows = _whitened(problem, fit.state, fit)
    fitted = errors_of(fit.problem, fit.state, fit.kept).summary()
    share = _SHARE_OF_LARGE if has_large_errors(fitted, problem) else _SHARE
    tried = (_ordered(rows, *each, share) for each in quantities)
    candidates = [one for one in tried if one is not None]
    if not candidates:
        candidates = _agreeing(rows, quantities)
    possible = [one for one in candidates if one.is_possible()]
    if not possible:
        return None
    best = min(possible, key=lambda one: one.criterion)
    what, mend = _in_words(problem, best)
    may_be_arm = best.is_gradual and _follows_path(problem, fit.state)
    return Change(InputMistake(what, mend, float("nan"), float("nan")), may_be_arm)


def _quantities(fit: Fit) -> list[tuple[str, slice]]:
    """Poses that may have changed, and the scale of the measured positions, with their columns."""
    layout = fit.problem.layout
    names = [name for name in layout.poses if name.rpartition(".")[2] in ("world", "mounted")]
    poses = [(name, layout.blocks[f"pose:{name}"]) for name in names]
    # A change of the whole set's scale is in the size of the target; here it is that of some rows.
    return [*poses, ("scale", layout.blocks["scale"])] if layout.scale and poses else poses


@dataclass(frozen=True)
class _Candidate:
    """A change of one quantity.

    Attributes:
        name: pose, or ``scale``.
        step: (6,) change of the pose, m and rad, or (1,) change of the scale.
        rows: rows with the change; of a gradual one, all.
        is_step: whether the rows are all those from the first one on.
        is_gradual: whether the change grows with the order of the rows.
        criterion: Bayesian information criterion with the change, to compare quantities.
    """

    name: str
    step: FloatArray
    rows: np.ndarray
    is_step: bool
    is_gradual: bool
    criterion: float

    def is_possible(self) -> bool:
        """Whether the change is larger than errors of lens and arm, and correct to first order."""
        if self.name == "scale":
            return bool(LEAST_SCALE <= abs(self.step[0]) <= MOST_SCALE)
        return bool(
            np.linalg.norm(self.step[:3]) >= LEAST_M or np.linalg.norm(self.step[3:]) >= LEAST_RAD
        )


def _in_words(problem: CalibrationProblem, change: _Candidate) -> tuple[str, str]:
    """What changed, and what to do."""
    ids = problem.observations.ids
    if change.name == "scale":
        size = f"{1.0 + change.step[0]:.4f} times as far from the camera"
        is_elsewhere, moves = (
            f"the target is {size} as in the others",
            f"the target gradually gets {size}",
        )
        cause = "the target has another size, or the camera's focus or zoom changed"
        way_out = "use one target, hold the camera's focus and zoom"
    else:
        body = describe_pose(change.name, problem.plan.mount)
        size = (
            f"by about {1e3 * np.linalg.norm(change.step[:3]):.2g} mm and "
            f"{1e3 * np.linalg.norm(change.step[3:]):.2g} mrad"
        )
        is_elsewhere, moves = f"{body} is elsewhere, {size}", f"{body} gradually moves {size}"
        is_camera = body.startswith("the camera")
        focus = ", or its focus or zoom changed" if is_camera else ""
        cause, way_out = f"it moved{focus}", "fasten it"
        if not (change.is_step or change.is_gradual):
            cause += ", or there are two of them"
    if change.is_gradual:
        return (
            f"from observation {ids[0]} to {ids[-1]}, {moves}: {cause}",
            f"{way_out}, and take the observations again, in another order",
        )
    if change.is_step:
        before, here = ids[change.rows[0] - 1], ids[change.rows[0]]
        return (
            f"from observation {here} on, {is_elsewhere}: {cause} after observation {before}",
            f"{way_out}, and calibrate the observations up to {before} and those from {here} on "
            "apart",
        )
    named = [ids[row] for row in change.rows[:_MOST_NAMED]]
    listed = ", ".join(named) + (", ..." if len(change.rows) > len(named) else "")
    return (
        f"{len(change.rows)} of {len(ids)} observations agree with each other and not with the "
        f"others ({listed}): in them {is_elsewhere}: {cause}",
        f"{way_out}, and calibrate them apart",
    )


def _follows_path(problem: CalibrationProblem, state: State) -> bool:
    """Whether successive poses of the flange are near each other."""
    positions = predicted_poses(problem, state)[:, :3, 3]
    positions = positions[np.isfinite(positions).all(axis=1)]
    count = len(positions)
    if count < LEAST_ROWS:
        return True
    successive = np.linalg.norm(np.diff(positions, axis=0), axis=1).mean()
    sum_over_pairs = np.linalg.norm(positions[:, None] - positions[None], axis=2).sum()
    return bool(successive < _PATH * sum_over_pairs / (count * (count - 1)))


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


def _ordered(rows: _Rows, name: str, columns: slice, least_share: float) -> _Candidate | None:
    """Return the step or the gradual change that explains the residuals best, if it is no chance.

    Args:
        rows: all residuals.
        columns: its columns.
        least_share: fraction of the squared residuals that the change must remove.
    """
    if name == "scale":
        # A prior holds the size of the target near its nominal one, so a wrong size of all rows
        # remains in the residuals, and a step after the first few rows is nearly that.
        free_size = np.where((rows.row >= 0)[:, None], rows.slopes[:, columns], 0.0)
        rows = replace(rows, slopes=np.concatenate([rows.slopes, free_size], axis=1))
    everything = remaining = rows
    for _ in range(_ROUNDS):
        rows = remaining
        there = np.unique(rows.row[rows.row >= 0])
        if len(there) < 2 * LEAST_ROWS:
            return None
        basis, _ = np.linalg.qr(rows.slopes)
        left = rows.residuals - basis @ (basis.T @ rows.residuals)
        best: tuple[float, int | None, FloatArray, FloatArray] | None = None
        for row, profile in _profiles(rows):
            change = profile[:, None] * rows.slopes[:, columns]
            unexplained = change - basis @ (basis.T @ change)
            step = -least_squares(unexplained, left)
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
        # With the change the noise is smaller, and outliers stand out.
        remaining = rows.divided(size).only(~np.isin(rows.row, wrong))
    unknowns = len(step)
    free = len(rest) - rows.slopes.shape[1] - unknowns
    if max(shares.values()) < least_share or free < 1:
        return None
    is_gradual = row is None
    criterion = _criterion(squares, len(rest), unknowns + (not is_gradual))
    if _smooth_criterion(rows, columns, basis, left) < criterion:
        return None
    ratio = (float(left @ left) / max(squares, 1e-300) - 1.0) * free / unknowns
    chance = float(fisher.sf(ratio, unknowns, free)) * len(there)
    if chance >= _CHANCE:
        return None
    profile = next(size for first, size in _profiles(everything) if first == row)
    change = profile[:, None] * everything.slopes[:, columns]
    changed = there if row is None else there[there >= row]
    return _Candidate(
        name,
        # From -1 to 1 a gradual change is twice its slope.
        2.0 * step if is_gradual else step,
        changed,
        not is_gradual,
        is_gradual,
        _robust_criterion(everything, change, np.isin(everything.row, [-1, *there])),
    )


def _profiles(rows: _Rows) -> Iterator[tuple[int | None, FloatArray]]:
    """First row and (m,) size of each change that is tried; the gradual one has no first row."""
    there = np.unique(rows.row[rows.row >= 0])
    measured = rows.row >= 0
    time = 2.0 * (rows.row - there[0]) / max(int(there[-1] - there[0]), 1) - 1.0
    yield None, np.where(measured, time, 0.0)
    for row in there[LEAST_ROWS : len(there) - LEAST_ROWS + 1].tolist():
        yield row, (measured & (rows.row >= row)).astype(np.float64)


def _robust_criterion(rows: _Rows, change: FloatArray, used: np.ndarray) -> float:
    """Bayesian information criterion with a change, from medians, which outliers do not affect.

    Args:
        rows: all residuals.
        change: (m, k) derivatives by the change.
        used: (m,) True for residuals to which unknowns and change are fitted.
    """
    slopes = np.concatenate([rows.slopes, change], axis=1)
    rest = rows.residuals - slopes @ least_squares(slopes[used], rows.residuals[used])
    total = float(change.shape[1] * np.log(len(rest)))
    for kind in set(rows.kind.tolist()) - {""}:
        of_kind = np.abs(rest[rows.kind == kind])
        total += 2.0 * len(of_kind) * float(np.log(max(float(np.median(of_kind)), 1e-12)))
    return float(total)


def _agreeing(rows: _Rows, quantities: list[tuple[str, slice]]) -> list[_Candidate]:
    """Return the changes that the outliers of a fit may have in common."""
    there = np.unique(rows.row[rows.row >= 0])
    whole = np.array([np.linalg.norm(rows.residuals[rows.row == one]) for one in there])
    outliers = there[whole > _OUTLIER_RATIO * np.quantile(whole, LEAST_INLIERS)]
    if len(outliers) < LEAST_ROWS:
        return []
    is_theirs = np.isin(rows.row, outliers)
    theirs = rows.only(is_theirs)
    total = float(theirs.residuals @ theirs.residuals)
    candidates = []
    for name, columns in quantities:
        slopes = theirs.slopes[:, columns]
        step = -least_squares(slopes, theirs.residuals)
        rest = theirs.residuals + slopes @ step
        if float(rest @ rest) > (1.0 - _AGREEING) * total:
            continue
        change = is_theirs[:, None] * rows.slopes[:, columns]
        criterion = _robust_criterion(rows, change, np.ones(len(is_theirs), dtype=bool))
        candidates.append(_Candidate(name, step, outliers, False, False, criterion))
    return candidates


def _smooth_criterion(rows: _Rows, columns: slice, basis: FloatArray, left: FloatArray) -> float:
    """Criterion of a quantity that changes smoothly with the order of the rows (cubic).

    Errors of an arm change smoothly if the poses follow a path.
    """
    _, place = np.unique(rows.row, return_inverse=True)
    time = 2.0 * place / max(int(place.max()), 1) - 1.0
    slopes = np.where((rows.row >= 0)[:, None], rows.slopes[:, columns], 0.0)
    drift = np.concatenate([slopes * (time**power)[:, None] for power in (1, 2, 3)], axis=1)
    drift -= basis @ (basis.T @ drift)
    rest = left - drift @ least_squares(drift, left)
    return _criterion(float(rest @ rest), len(rest), drift.shape[1])


def _criterion(squares: float, count: int, unknowns: int) -> float:
    """Bayesian information criterion."""
    return count * float(np.log(max(squares, 1e-300))) + unknowns * float(np.log(count))
