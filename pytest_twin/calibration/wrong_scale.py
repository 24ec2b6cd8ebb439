"""Detect positions with a wrong scale: another unit, a wrong target size, or no metric scale."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration import closed_form
from pytest_twin.calibration.input_mistake import FAR_BETTER, InputMistake
from pytest_twin.calibration.jackknife import jackknife
from pytest_twin.calibration.observability import hold_gauges
from pytest_twin.calibration.parameters import State
from pytest_twin.calibration.problem import CalibrationProblem, arms, predicted_poses
from pytest_twin.calibration.solve import Fit, robust_cost, solve
from pytest_twin.calibration.starts import camera_unit, seen_poses, starts
from pytest_twin.calibration.terms import PointTerm, PoseTerm

_SCALES = {0.001: "mm", 1000.0: "mm", 0.01: "cm", 100.0: "cm", 0.0254: "inches"}

_ANOTHER_UNIT = 0.05
"""Deviation of a scale from 1 beyond which the fit with the stated scale is no start for another
one."""

_CHANCE = 1e-3
"""Significance level of a scale and of its smaller errors."""

_OF_ARM = "give robot: with columns joint.NAME and estimate joint_zeros"

_MOST_SIZES = 4.0
"""Residuals beyond this many standard deviations are outliers."""

_SUBSETS = 6
"""Number of random subsets for starts when a scale is only tested."""


def scale_of(problem: CalibrationProblem, now: tuple[float, float]) -> InputMistake | None:
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


@dataclass(frozen=True)
class FreeScale:
    """Scale of the camera's positions, estimated without a prior.

    Attributes:
        value: stated size of the target divided by its real one.
        degrees: degrees of freedom of ``std``.
    """

    value: float
    std: float
    degrees: float

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval."""
        half = float(student.ppf(0.975, max(self.degrees, 1.0))) * self.std
        return self.value - half, self.value + half

    def excludes_stated(self, tolerance: float) -> bool:
        """Whether it differs from 1 beyond its error and the tolerance of the target together.

        Args:
            tolerance: standard deviation of the target's size, relative to the stated one.
        """
        quantile = float(student.ppf(1.0 - _CHANCE / 2.0, max(self.degrees, 1.0)))
        return abs(self.value - 1.0) > quantile * float(np.hypot(self.std, tolerance))


def wrong_scale(fit: Fit, of_corners: FreeScale | None = None) -> InputMistake | None:
    """Return the scale of the camera's positions if the data exclude the stated one.

    The scale is estimated with all other unknowns and without its prior. It is wrong if it differs
    from 1 beyond its own error and the tolerance of the target together, and if no error of the
    arm explains the data better.

    Args:
        fit: a fit on poses of the target.
        of_corners: scale from the corners in images, which know the focal length better than poses.
    """
    problem = fit.problem
    if problem.plan.has_free_scale or not any(isinstance(t, PoseTerm) for t in problem.terms):
        return None
    unit = camera_unit(problem) or 1.0
    if abs(np.log(unit)) < np.log1p(_ANOTHER_UNIT):
        unit = 1.0
    layout = replace(problem.layout, scale=True, scale_prior=None)
    scaled = replace(problem, layout=layout).in_unit(unit)
    # Starts of the stated unit are no starts of another one.
    candidates = {"fit": fit.state} if unit == 1.0 else starts(scaled, _SUBSETS)
    if not candidates:
        return None
    free = solve(scaled, min(candidates.values(), key=lambda state: robust_cost(scaled, state)))
    of_poses = FreeScale(free.state.scale / unit, _spread_of_scale(free) / unit, free.degrees)
    scale = of_corners or of_poses
    if not scale.excludes_stated(problem.plan.target_tolerance):
        return None
    if _explained_by_arm(free, problem, fit.state):
        return None
    distances = np.linalg.norm(np.concatenate([r[:, :3] for r in free.residuals]), axis=1)
    mistake = _of_target(
        problem,
        1.0 / scale.value,
        "camera_from_target",
        float(np.median(distances)),
        free.noise["rotation"],
    )
    low, high = scale.interval
    return replace(
        mistake,
        what=f"{mistake.what} (95 %: {low:.4f} to {high:.4f})",
        mend=f"{mistake.mend}; if it measures as stated, the arm is wrong by this factor: "
        f"{_OF_ARM if problem.chain is None else 'calibrate its geometry'}, or state a larger "
        "target: {tolerance: ...}",
    )


def _spread_of_scale(fit: Fit) -> float:
    """Return the standard deviation of the scale, by the larger of two estimates.

    One assumes independent noise, the other leaves out whole observations.
    """
    _, singular, right = np.linalg.svd(fit.jacobian, full_matrices=False)
    at = fit.problem.layout.blocks["scale"].start
    independent = float(np.linalg.norm(right[:, at] / np.maximum(singular, 1e-300)))
    return max(independent, float(np.sqrt(jackknife(fit).covariance[at, at])))


def _explained_by_arm(free: Fit, problem: CalibrationProblem, state: State) -> bool:
    """Whether joint zeros or links that were not estimated explain the errors better than a scale.

    Joint zeros that are wrong by 20 mrad change the size of an arm's motions by up to 2 %. The
    smaller Bayesian information criterion decides.
    """
    chain = problem.chain
    if chain is None:
        return False
    limit = _criterion(free)
    for arm in arms(problem):
        wider, _ = hold_gauges(arm, state)
        links = np.zeros(len(wider.layout.links))
        start = state if len(state.links) == len(links) else replace(state, links=links)
        if wider.layout.count > problem.layout.count and _criterion(solve(wider, start)) < limit:
            return True
    return False


def _criterion(fit: Fit) -> float:
    """Bayesian information criterion of a fit with independent noise of each kind."""
    total = 0.0
    count = 0
    for term, residual in zip(fit.problem.terms, fit.residuals, strict=True):
        for name in set(term.noise):
            values = residual[:, [kind == name for kind in term.noise]]
            # Outliers of one of two fits must not decide the comparison.
            size = np.minimum(np.abs(values), _MOST_SIZES * fit.noise[name])
            total += values.size * float(np.log(np.mean(size**2)))
            count += values.size
    return total + fit.problem.layout.count * float(np.log(count))


def _of_target(
    problem: CalibrationProblem, factor: float, column: str, translation: float, rotation: float
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
