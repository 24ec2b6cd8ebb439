"""Initial values from algebraic solvers.

Solvers of ``flange @ mounted = world @ seen`` are registered by name. All available solvers are
tried. The least squares starts from the one with the smallest residuals, and each is reported with
its error on held-out observations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration import closed_form
from pytest_twin.calibration.boards.opencv import opencv
from pytest_twin.calibration.parameters import State
from pytest_twin.calibration.problem import CalibrationProblem, predicted_poses
from pytest_twin.calibration.solve import LEAST_INLIERS
from pytest_twin.calibration.solvers.algebraic import HAND_EYE, ROBOT_WORLD, solver_of_poses
from pytest_twin.calibration.terms import PivotTerm, PointTerm, PoseTerm
from pytest_twin.errors import SpecError
from pytest_twin.metrics.pose import inverse, rigid
from pytest_twin.time_limit import is_over

HandEyeSolver = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""Function from (n, 4, 4) ``flange`` and ``seen`` to (4, 4) ``mounted`` and ``world``, m."""

HAND_EYE_SOLVERS: dict[str, HandEyeSolver] = {
    "park": closed_form.park,
    "shah": closed_form.shah,
}

SUBSETS = 60
"""Number of random subsets of observations that give further starts. If half of the poses are
wrong, one subset of 3 in eight has no wrong pose, so all 60 fail once in 3000 calibrations."""

_POSES_IN_SUBSET = 3
"""Number of poses in a subset, the smallest number that determines a hand-eye transform."""
_POINTS_IN_SUBSET = 6
"""Number of point observations in a subset."""
_POSES_FOR_UNIT = 6
"""Number of poses for the estimate of the unit of length."""


def starts(problem: CalibrationProblem, subsets: int = SUBSETS) -> Mapping[str, State]:
    """Return initial states by the name of their solver.

    Args:
        subsets: number of random subsets of observations that give further starts.
    """
    has_poses = any(isinstance(term, PoseTerm) for term in problem.terms)
    solvers = _hand_eye_solvers() if has_poses else {"closed_form": closed_form.park}
    found = {}
    for name, solver in solvers.items():
        state = _start(problem, solver)
        if state is not None:
            found[name] = state
    rows = np.unique(np.concatenate([term.rows for term in problem.terms]))
    size = _POSES_IN_SUBSET if has_poses else _POINTS_IN_SUBSET
    draw = np.random.default_rng(0)
    for number in range(subsets if len(rows) > 2 * size else 0):
        if found and is_over():
            break
        chosen = np.sort(draw.choice(rows, size, replace=False))
        state = _start(problem.on_rows(chosen), closed_form.park)
        if state is not None:
            found[f"{_SUBSET}{number}"] = state
    return found


def camera_unit(problem: CalibrationProblem) -> float | None:
    """Length of one unit of the camera's positions, m, from the robot's motion; None if none fits.

    All poses and random subsets of them are tried; the best third of the residual distances
    decides.
    """
    flange = predicted_poses(problem, problem.fixed)
    for term in problem.terms:
        if not isinstance(term, PoseTerm) or len(term.rows) < _POSES_IN_SUBSET + 1:
            continue
        mine, seen = flange[term.rows], seen_poses(term)
        draw = np.random.default_rng(0)
        size = min(_POSES_FOR_UNIT, len(mine))
        tried = [np.arange(len(mine))]
        tried += [draw.choice(len(mine), size, replace=False) for _ in range(SUBSETS)]
        best, unit = np.inf, None
        for chosen in tried:
            factor, mounted, world = closed_form.scale_of_seen(mine[chosen], seen[chosen])
            if not factor > 0.0:
                continue
            places = seen.copy()
            places[:, :3, 3] *= factor
            gaps = (mine @ mounted)[:, :3, 3] - (world @ places)[:, :3, 3]
            error = float(np.quantile(np.linalg.norm(gaps, axis=1), LEAST_INLIERS))
            if error < best:
                best, unit = error, factor
        return unit
    return None


_SUBSET = "subset"


def _hand_eye_solvers() -> dict[str, HandEyeSolver]:
    """Return our own solvers, and those of OpenCV if it is installed."""
    try:
        opencv()
    except SpecError:
        return HAND_EYE_SOLVERS
    theirs = {name: solver_of_poses(name) for name in (*HAND_EYE, *ROBOT_WORLD)}
    return {**theirs, **HAND_EYE_SOLVERS}


def is_subset(name: str) -> bool:
    """Whether a start comes from a subset of the poses."""
    return name.startswith(_SUBSET)


def seen_poses(term: PoseTerm) -> FloatArray:
    """(m, 4, 4) ``seen`` with ``flange @ mounted = world @ seen``."""
    return inverse(term.measured) if term.mount == "hand" else term.measured


def _start(problem: CalibrationProblem, solver: HandEyeSolver) -> State | None:
    """Return the state that a solver finds, or None if it fails."""
    state = _points(problem, problem.fixed)
    flange = predicted_poses(problem, state)
    poses = dict(state.poses)
    for term in problem.terms:
        if not isinstance(term, PoseTerm):
            continue
        mine, seen = flange[term.rows], seen_poses(term)
        free = [name in problem.layout.poses for name in (term.mounted, term.world)]
        if not all(free):
            poses |= _one_side(term, state, mine, seen, free)
            continue
        if len(term.rows) < 3:
            return None
        try:
            poses[term.mounted], poses[term.world] = solver(mine, seen)
        except (np.linalg.LinAlgError, ValueError):
            return None
        if not all(np.isfinite(poses[name]).all() for name in (term.mounted, term.world)):
            return None
    return replace(state, poses=poses)


def _one_side(
    term: PoseTerm, state: State, flange: FloatArray, seen: FloatArray, free: list[bool]
) -> dict[str, FloatArray]:
    """If one of both poses is given, return the mean over observations of the other."""
    if free[0]:
        each = inverse(flange) @ state.poses[term.world] @ seen
        return {term.mounted: _middle(each)}
    if free[1]:
        each = flange @ state.poses[term.mounted] @ inverse(seen)
        return {term.world: _middle(each)}
    return {}


def _middle(poses: FloatArray) -> FloatArray:
    """Return a robust mean pose: median position, and the rotation nearest to all others."""
    rotations = poses[:, :3, :3]
    traces = np.einsum("aij,bij->ab", rotations, rotations)
    best = int(np.argmax(np.median(traces, axis=1)))
    return rigid(rotations[best], np.median(poses[:, :3, 3], axis=0))


def _points(problem: CalibrationProblem, state: State) -> State:
    flange = predicted_poses(problem, state)
    poses, points = dict(state.poses), dict(state.points)
    terms = [term for term in problem.terms if isinstance(term, PointTerm)]
    free = [term for term in terms if term.point in problem.layout.points]
    if free:
        mine = [flange[term.rows] for term in free]
        world = free[0].world
        if world in problem.layout.poses:
            poses[world], places = closed_form.markers(mine, [term.measured for term in free])
        else:
            seen = [_transform_points(poses[world], term.measured) for term in free]
            places = [
                np.median(_transform_points(inverse(a), b), axis=0)
                for a, b in zip(mine, seen, strict=True)
            ]
        points |= {term.point: place for term, place in zip(free, places, strict=True)}
    elif terms:
        poses |= _known_points(problem, state, terms, flange)
    for term in problem.terms:
        if isinstance(term, PivotTerm):
            points[term.tip], points[term.pivot] = closed_form.pivot(flange[term.rows])
    return replace(state, poses=poses, points=points)


def _known_points(
    problem: CalibrationProblem, state: State, terms: list[PointTerm], flange: FloatArray
) -> dict[str, FloatArray]:
    """Start from markers with known positions in the tool, via the tool's pose in each row."""
    world, mounted = terms[0].world, terms[0].mounted
    if mounted is None:
        if world not in problem.layout.poses:
            return {}
        mine = [_transform_points(flange[t.rows], state.points[t.point][None]) for t in terms]
        theirs = [t.measured for t in terms]
        return {world: closed_form.kabsch(np.concatenate(theirs), np.concatenate(mine))}
    rows, seen = [], []
    for row in range(len(problem.observations)):
        here = [
            (state.points[t.point], t.measured[np.flatnonzero(t.rows == row)[0]])
            for t in terms
            if row in t.rows
        ]
        if len(here) >= 3:
            rows.append(row)
            seen.append(closed_form.kabsch(*(np.array(side) for side in zip(*here, strict=True))))
    free = [name in problem.layout.poses for name in (mounted, world)]
    if all(free):
        if len(rows) < 3:
            return {}
        both = closed_form.park(flange[rows], np.array(seen))
        return dict(zip((mounted, world), both, strict=True))
    if free[0] and rows:
        each = inverse(flange[rows]) @ state.poses[world] @ np.array(seen)
        return {mounted: _middle(each)}
    if free[1]:
        tool = flange @ state.poses[mounted]
        mine = [_transform_points(tool[t.rows], state.points[t.point][None]) for t in terms]
        theirs = [t.measured for t in terms]
        return {world: closed_form.kabsch(np.concatenate(theirs), np.concatenate(mine))}
    return {}


def _transform_points(transform: FloatArray, points: FloatArray) -> FloatArray:
    rotation, position = transform[..., :3, :3], transform[..., :3, 3]
    return np.asarray(np.einsum("...ij,...j->...i", rotation, points) + position)
