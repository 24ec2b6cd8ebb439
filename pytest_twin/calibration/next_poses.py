"""Measure the diversity of calibration poses, and propose further poses."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.observability import UNDETERMINED_RAD, natural_sizes
from pytest_twin.calibration.problem import CalibrationProblem, predicted_poses
from pytest_twin.calibration.records import CalibrationEstimate
from pytest_twin.calibration.solve import whitened_jacobian
from pytest_twin.calibration.terms import PoseTerm
from pytest_twin.calibration.workspace import (
    draw_flanges,
    draw_joints,
    predict_rows,
    spread,
)
from pytest_twin.metrics.pose import pose_vector

WANTED = 5
"""Number of proposed poses. An engineer typically adds this many before calibrating again."""

_DRAWN = 3000
"""Number of random poses in the whole workspace, and half as many around observed ones."""
_KEPT = 300
"""Largest number of visible poses that are compared as candidates."""
_AROUND_RAD, _AROUND_M = 0.5, 0.1
"""Standard deviations of random poses around observed ones."""
_WIDER = 1.2
"""A target is assumed visible if its distance, direction and tilt are within the observed range,
widened by this factor."""


def pose_diversity(problem: CalibrationProblem, estimate: CalibrationEstimate) -> dict[str, Any]:
    """Return the RMS rotation about each principal axis (rad), and the box of positions (m)."""
    flange = predicted_poses(problem, estimate.fit.state)
    flange = flange[np.isfinite(flange).all(axis=(1, 2))]
    rotations = Rotation.from_matrix(flange[:, :3, :3])
    turns = (rotations.mean().inv() * rotations).as_rotvec()
    # Poses that rotate about one axis only have an eigenvalue of zero, which rounding may make
    # negative.
    squares = np.linalg.eigvalsh(turns.T @ turns / max(len(turns), 1))[::-1]
    size = np.sqrt(np.maximum(squares, 0.0))
    box = np.ptp(flange[:, :3, 3], axis=0)
    return {"turns": size.tolist(), "turns_unit": "rad", "box": box.tolist(), "box_unit": "m"}


def next_poses(found: CalibrationEstimate) -> dict[str, Any]:
    """Return the poses that add most information about the unknowns (D-optimal, greedy).

    Each pose is selected from a few hundred random candidates. Given the poses before it, its
    observation reduces the volume of the uncertainty ellipsoid most (Daney, Papegay, Madeline:
    Choosing measurement poses for robot calibration, 2005). Candidates are within the joint limits,
    and their view of the target is within the observed range.

    Returns:
        ``poses`` with ``joints`` or ``flange`` and ``information`` (how often the observation
        halves the volume of the uncertainty), and the standard deviation of predictions in the
        workspace without and with these poses.
    """
    fit = found.fit
    problem, state = fit.problem, fit.state
    at = _draw_poses(problem)
    candidates = predict_rows(problem, state, at)
    visible = _visible(problem, candidates)
    if visible.sum() < WANTED:
        return {"poses": []}
    chosen = np.flatnonzero(visible)[:_KEPT]
    candidates = candidates.on_rows(chosen)
    rows = whitened_jacobian(candidates, state, fit.noise)
    priors = sum(parameter.prior is not None for parameter in problem.layout.parameters)
    rows = rows[: len(rows) - priors]
    blocks = _by_row(candidates, rows)
    weak = np.diag((UNDETERMINED_RAD / natural_sizes(problem.layout)) ** 2)
    information = fit.jacobian.T @ fit.jacobian + weak
    poses = []
    for _ in range(WANTED):
        covariance = np.linalg.inv(information)
        middle = np.eye(blocks.shape[1]) + blocks @ covariance @ np.swapaxes(blocks, 1, 2)
        gain = np.linalg.slogdet(middle)[1] / 2.0
        best = int(np.argmax(gain))
        information = information + blocks[best].T @ blocks[best]
        poses.append(_pose_entry(problem, at[chosen[best]], float(gain[best]) / np.log(2.0)))
    seen = draw_flanges if problem.chain is None else None
    where = (
        seen(problem.observations.flange, 60, seed=1)  # type: ignore[arg-type]
        if seen is not None
        else draw_joints(problem.chain, 60, seed=1)  # type: ignore[arg-type]
    )
    before = np.asarray(np.linalg.inv(fit.jacobian.T @ fit.jacobian + weak), dtype=np.float64)
    then = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return {
        "poses": poses,
        "predictions_now": spread(problem, state, before, where).sizes,
        "predictions_then": spread(problem, state, then, where).sizes,
    }


def _draw_poses(problem: CalibrationProblem) -> FloatArray:
    """Random joint readings or flange poses, in the whole workspace and around observed ones."""
    draw = np.random.default_rng(3)
    some = draw.integers(len(problem.observations), size=_DRAWN)
    if problem.chain is None:
        flange = problem.observations.flange
        assert flange is not None
        near = flange[some[: _DRAWN // 2]].copy()
        turn = Rotation.from_rotvec(draw.normal(0.0, _AROUND_RAD, (len(near), 3)))
        near[:, :3, :3] = near[:, :3, :3] @ turn.as_matrix()
        near[:, :3, 3] += draw.normal(0.0, _AROUND_M, (len(near), 3))
        near = near[np.isfinite(near).all(axis=(1, 2))]
        return np.concatenate([near, draw_flanges(flange, _DRAWN // 2, seed=4)])
    chain = problem.chain
    wide = draw_joints(chain, _DRAWN, seed=4)
    step = draw.normal(0.0, 1.0, (_DRAWN // 2, len(chain.joints)))
    near = problem.readings[some[: _DRAWN // 2]] + step * np.where(
        chain.revolute, _AROUND_RAD, _AROUND_M
    )
    if chain.limits is not None:
        low, high = (chain.limits.T - chain.offsets) / chain.signs
        near = np.clip(near, np.minimum(low, high), np.maximum(low, high))
    # Both kinds alternate, so that the first visible candidates are of both kinds.
    return np.stack([near, wide[: len(near)]], axis=1).reshape(-1, len(chain.joints))


def _visible(problem: CalibrationProblem, candidates: CalibrationProblem) -> np.ndarray:
    """(rows,) True where distance, direction and tilt of the target are in the observed range."""
    pairs = [
        (one, drawn)
        for one, drawn in zip(problem.terms, candidates.terms, strict=False)
        if isinstance(one, PoseTerm) and isinstance(drawn, PoseTerm)
    ]
    fine = np.ones(len(candidates.observations), dtype=bool)
    for one, drawn in pairs:
        for before, now in zip(_view(one.measured), _view(drawn.measured), strict=True):
            middle = (before.max() + before.min()) / 2.0
            fine &= np.abs(now - middle) <= _WIDER * (before.max() - middle) + 1e-9
    return fine


def _view(poses: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distance (m), angle from the optical axis (rad) and tilt (rad) of each target."""
    distance = np.linalg.norm(poses[:, :3, 3], axis=1)
    towards = np.arccos(np.clip(poses[:, 2, 3] / np.maximum(distance, 1e-9), -1.0, 1.0))
    return distance, towards, np.arccos(np.clip(poses[:, 2, 2], -1.0, 1.0))


def _by_row(problem: CalibrationProblem, rows: FloatArray) -> FloatArray:
    """(observations, width, count) whitened derivatives of each observation, padded with zeros."""
    count = len(problem.observations)
    width = sum(len(term.noise) for term in problem.terms)
    found = np.zeros((count, width, rows.shape[1]))
    at = place = 0
    for term in problem.terms:
        size = len(term.noise)
        part = rows[at : at + size * len(term.rows)].reshape(len(term.rows), size, -1)
        found[term.rows, place : place + size] = part
        at, place = at + size * len(term.rows), place + size
    return found


def _pose_entry(problem: CalibrationProblem, at: FloatArray, information: float) -> dict[str, Any]:
    if problem.chain is None:
        return {"flange": pose_vector(at).tolist(), "information": information}
    joints = {n: float(v) for n, v in zip(problem.chain.joints, at, strict=True)}
    return {"joints": joints, "information": information}
