"""Uncertainty of a calibration's predictions in other poses of the workspace."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.parameters import State, Variables
from pytest_twin.calibration.problem import CalibrationProblem, marker_of, terms_of
from pytest_twin.calibration.terms import PointTerm, PoseTerm
from pytest_twin.metrics.pose import rigid
from pytest_twin.realization.serial_chain import SerialChain

WIDEST_RAD, WIDEST_M = 2.0, 0.3
"""Half range of random joint positions, within the joint limits. It is wide enough to excite every
parameter of an arm."""

_KINDS = {"translation": "translation", "point": "translation", "rotation": "rotation"}


def draw_joints(chain: SerialChain, count: int, seed: int) -> FloatArray:
    """(count, joints) random encoder readings within the joint limits, rad or m."""
    draw = np.random.default_rng(seed)
    widest = np.where(chain.revolute, WIDEST_RAD, WIDEST_M)
    low, high = -widest, widest
    if chain.limits is not None:
        # If the limits exclude the middle of the range, positions are drawn around the limits'
        # middle.
        lowest, highest = chain.limits.T
        low = np.clip(low, lowest, np.maximum(highest - 2.0 * widest, lowest))
        high = np.clip(high, np.minimum(lowest + 2.0 * widest, highest), highest)
    positions = draw.uniform(low, high, (count, len(chain.joints)))
    return np.asarray((positions - chain.offsets) / chain.signs)


def draw_flanges(observed: FloatArray, count: int, seed: int) -> FloatArray:
    """(count, 4, 4) random flange poses within the box of the observed positions, m."""
    draw = np.random.default_rng(seed)
    places = observed[np.isfinite(observed).all(axis=(1, 2)), :3, 3]
    return rigid(
        Rotation.random(count, random_state=seed).as_matrix(),
        draw.uniform(places.min(axis=0), places.max(axis=0), (count, 3)),
    )


def predict_rows(problem: CalibrationProblem, state: State, at: FloatArray) -> CalibrationProblem:
    """Return the same problem in other poses, with measurements predicted at ``state``.

    Args:
        at: (rows, joints) readings, or (rows, 4, 4) flange poses if there is no chain.
    """
    count = len(at)
    observations = problem.observations.rows(np.arange(count) % len(problem.observations))
    observations = replace(observations, ids=tuple(str(i) for i in range(count)))
    if problem.chain is not None:
        joints = dict(zip(problem.chain.joints, at.T, strict=True))
        observations = replace(observations, joints=joints)
    else:
        observations = replace(observations, flange=at)
    if observations.camera_from_target is not None:
        identity = np.tile(np.eye(4), (count, 1, 1))
        observations = replace(observations, camera_from_target=identity)
    measured = [marker_of(term.point) for term in problem.terms if isinstance(term, PointTerm)]
    points = {name: np.zeros((count, 3)) for name in measured}
    observations = replace(observations, points=points)
    drawn = replace(problem, observations=observations)
    terms = terms_of(problem.plan, observations, problem.chain is not None)
    variables = Variables(problem.layout, state, np.zeros(problem.layout.count))
    flange = drawn.flange(variables)
    return replace(
        drawn,
        terms=tuple(
            replace(term, measured=term.predicted(flange, variables))
            if isinstance(term, PoseTerm | PointTerm)
            else term
            for term in terms
        ),
    )


@dataclass(frozen=True)
class Spread:
    """Uncertainty of predicted measurements in other poses.

    Attributes:
        sizes: standard deviation of ``translation`` and, for poses, ``rotation``, root mean square
            over poses and coordinates, m and rad.
        worst: for each of them, (count,) direction of the unknowns that contributes most.
    """

    sizes: dict[str, float]
    worst: dict[str, FloatArray]


def spread(
    problem: CalibrationProblem, state: State, covariance: FloatArray, at: FloatArray
) -> Spread:
    """Return the standard deviation of predictions that follows from the unknowns' covariance.

    Args:
        covariance: (count, count) of the unknowns, m and rad.
        at: poses as for :func:`predict_rows`.
    """
    drawn = predict_rows(problem, state, at)
    found = drawn.residuals(state, np.zeros(problem.layout.count))
    values, axes = np.linalg.eigh(covariance)
    half = axes * np.sqrt(np.maximum(values, 0.0))
    sizes, worst = {}, {}
    for kind in dict.fromkeys(_KINDS.values()):
        slopes = [
            slope[:, [i for i, name in enumerate(term.noise) if _KINDS.get(name) == kind]]
            for term, (_, slope) in zip(drawn.terms, found, strict=True)
        ]
        rows = np.concatenate([one.reshape(-1, problem.layout.count) for one in slopes])
        if len(rows) == 0:
            continue
        _, singular, right = np.linalg.svd(rows @ half, full_matrices=False)
        sizes[kind] = float(np.sqrt(np.sum(singular**2) / len(rows)))
        worst[kind] = half @ right[0]
    return Spread(sizes, worst)
