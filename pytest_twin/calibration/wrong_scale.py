"""Detect positions with a wrong scale: another unit, a wrong target size, or no metric scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import binomtest
from scipy.stats import t as student

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration import closed_form
from pytest_twin.calibration.input_mistake import FAR_BETTER, InputMistake
from pytest_twin.calibration.jackknife import jackknife
from pytest_twin.calibration.problem import Problem, predicted_poses
from pytest_twin.calibration.solve import Fit, robust_cost, solve
from pytest_twin.calibration.starts import camera_unit, seen_poses, starts
from pytest_twin.calibration.terms import PointTerm, PoseTerm

_SCALES = {0.001: "mm", 1000.0: "mm", 0.01: "cm", 100.0: "cm", 0.0254: "inches"}

_LEAST_SCALE = 0.05
"""Smallest deviation of a scale from 1 that significance alone can prove. Joint zeros that are
wrong by 20 mrad change the size of an arm's motions by up to 2 %."""

_CHANCE = 1e-3
"""Significance level of a scale and of its smaller errors."""

_SUBSETS = 6
"""Number of random subsets for starts when a scale is only tested."""


def scale_of(problem: Problem, now: tuple[float, float]) -> InputMistake | None:
    """Return a scale factor of all measured positions: a unit, or the size of the target."""
    flange = predicted_poses(problem, problem.fixed)
    for term in problem.terms:
        if isinstance(term, PoseTerm) and len(term.rows) >= 4:
            mine, seen = flange[term.rows], seen_poses(term)
            # Both errors must be of the same kind; those of the fit are at the target.
            before = _median_gap(mine, seen, *closed_form.park(mine, seen))
            factor, mounted, world = closed_form.scale_of_seen(mine, seen)
            seen = seen.copy()
            seen[:, :3, 3] *= factor
            error = _median_gap(mine, seen, mounted, world)
            column = "camera_from_target"
        elif isinstance(term, PointTerm) and len(term.rows) >= 8:
            before = now[0]
            factor, error = closed_form.scale_of_marker(flange[term.rows], term.measured)
            column = "point.*" if len(problem.observations.points) > 1 else term.name
        else:
            continue
        if factor <= 0.0 or error > FAR_BETTER * before or abs(factor - 1.0) < 1e-3:
            return None
        for known, unit in _SCALES.items():
            if abs(factor / known - 1.0) < 0.1:
                who = f"the positions of {column}" if factor < 1.0 else "the robot's positions"
                return InputMistake(
                    f"{who} seem to be in {unit} (a factor of {factor:.4g} fits)",
                    f"convert {who} to m",
                    error,
                    now[1],
                )
        return _of_target(problem, factor, column, error, now[1])
    return None


def _median_gap(
    flange: FloatArray, seen: FloatArray, mounted: FloatArray, world: FloatArray
) -> float:
    """Median distance between both predictions of the carried body's position, m."""
    gaps = (flange @ mounted)[:, :3, 3] - (world @ seen)[:, :3, 3]
    return float(np.median(np.linalg.norm(gaps, axis=1)))


def scale_of_fit(fit: Fit) -> InputMistake | None:
    """Return a scale factor of the target's positions, estimated to first order with all else."""
    at = 0
    column = np.zeros(len(fit.jacobian))
    residuals = np.zeros(len(fit.jacobian))
    positions = np.zeros(len(fit.jacobian), dtype=bool)
    for term, kept, residual in zip(fit.problem.terms, fit.kept, fit.residuals, strict=True):
        size = np.array([fit.noise[name] for name in term.noise])
        count = residual.size
        residuals[at : at + count] = (residual * kept[:, None] / size).reshape(-1)
        if isinstance(term, PoseTerm):
            slope = np.zeros_like(residual)
            slope[:, :3] = -term.measured[:, :3, 3] * kept[:, None] / size[:3]
            column[at : at + count] = slope.reshape(-1)
            positions[at : at + count] = np.tile([True] * 3 + [False] * 3, len(residual))
        at += count
    if not positions.any():
        return None
    matrix = np.column_stack([fit.jacobian, column])
    change = np.linalg.lstsq(matrix, -residuals, rcond=1e-10)[0]
    left = residuals + matrix @ change
    factor = 1.0 + float(change[-1])
    part = float(np.linalg.norm(left[positions]) / np.linalg.norm(residuals[positions]))
    if part > FAR_BETTER or factor <= 0.0:
        return None
    usual = fit.noise["translation"] * part
    return _of_target(fit.problem, factor, "camera_from_target", usual, float("nan"))


def scale_beyond_chance(fit: Fit) -> InputMistake | None:
    """Return a statistically significant scale factor of the camera's positions.

    The scale is estimated together with all other unknowns. It must differ from 1 beyond its
    interval. It must also reduce the leave-one-out errors of more observations than chance would.
    """
    problem = fit.problem
    terms = problem.terms
    if len(terms) != 1 or not isinstance(terms[0], PoseTerm) or problem.layout.scale:
        return None
    unit = camera_unit(problem)
    if unit is None or abs(np.log(unit)) < np.log1p(_LEAST_SCALE):
        return None
    layout = replace(problem.layout, scale=True)
    scaled = replace(problem, layout=layout).in_unit(unit)
    candidates = starts(scaled, _SUBSETS)
    if not candidates:
        return None
    best = min(candidates.values(), key=lambda state: robust_cost(scaled, state))
    found = solve(scaled, best)
    spread = _spread_of_scale(found)
    quantile = float(student.ppf(1.0 - _CHANCE / 2.0, max(found.degrees, 1.0)))
    scale = found.state.scale / unit
    # If errors of the robot repeat with the pose, the interval is too narrow.
    bound = max(quantile * spread / unit, _LEAST_SCALE)
    errors, others = _leave_one_out_errors(found), _leave_one_out_errors(fit)
    nearer, compared = int(np.sum(errors < others)), len(errors)
    chance = binomtest(nearer, compared, alternative="greater").pvalue
    if abs(scale - 1.0) <= bound or chance > _CHANCE:
        return None
    half = float(student.ppf(0.975, max(found.degrees, 1.0))) * spread / unit
    mistake = _of_target(
        problem,
        1.0 / scale,
        "camera_from_target",
        float(np.median(errors)),
        found.noise["rotation"],
    )
    return replace(
        mistake,
        what=f"{mistake.what} (95 %: {scale - half:.4f} to {scale + half:.4f}; {nearer} of "
        f"{compared} observations, each left out in turn, are nearer with it)",
    )


def _spread_of_scale(fit: Fit) -> float:
    """Return the standard deviation of the scale."""
    _, singular, right = np.linalg.svd(fit.jacobian, full_matrices=False)
    at = fit.problem.layout.blocks["scale"].start
    return float(np.linalg.norm(right[:, at] / np.maximum(singular, 1e-300)))


def _leave_one_out_errors(fit: Fit) -> FloatArray:
    """(m,) leave-one-out position error of each observation, m."""
    left_out, residual = jackknife(fit).residuals[0][:, :3], fit.residuals[0][:, :3]
    return np.asarray(np.linalg.norm(np.where(np.isfinite(left_out), left_out, residual), axis=1))


def _of_target(
    problem: Problem, factor: float, column: str, translation: float, rotation: float
) -> InputMistake:
    what = f"positions of {column} are too large or too small by a factor of {1 / factor:.4f}: "
    mend = f"multiply the target's dimensions by {factor:.4f} after measuring them"
    if problem.plan.target or problem.observations.images is not None or "point" in column:
        what += "the target is probably not of the stated size"
    else:
        what += (
            f"the camera's motion is {1 / factor:.4f} times the robot's. The target is not of the "
            "stated size, or a single camera's odometry has no metric scale"
        )
        mend += "; for a camera without a metric scale, declare camera: {scale: estimate}"
    return InputMistake(what, mend, translation, rotation, factor)
