"""First values of drives and friction, without a simulation: the equation error.

Along the measured motion, the model's drive law gives the effort of the drive up to its gain. The
model's inverse dynamics gives the effort that the motion needs. Gain, friction and armature at a
joint follow by linear least squares, as in an identification from efforts in an unknown unit. The
simulation error has many minima; these values are near the right one.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.smoothing import derivatives
from pytest_twin.effects.segment import Segment

_SMOOTH = 0.05
"""Time over which positions are smoothed before they are differentiated, s."""
_LEAST_SPEED = 0.02
"""Fraction of a joint's RMS speed below which a sample is left out, because the direction of dry
friction is unknown."""
_UNSATURATED = 0.98
"""Fraction of the drive's limit above which the effort is saturated and does not depend on the
gain."""
_FEWEST_ROWS = 50
"""Smallest number of unsaturated samples; there are five unknowns."""
_LARGEST_GAIN = 5.0
"""Largest ratio to the model's gain, as in the catalogue; above it the motion does not determine
the gain."""


def first_values(problem: Problem) -> FloatArray:
    """(joints, 5) ratio to the model's gain, viscous and dry friction, armature, offset.

    The last four are added to the model's values, in N*m*s/rad, N*m, kg*m^2 and N*m, or N*s/m, N,
    kg and N for slides. NaN if a joint has no position or velocity servo, or too little motion.
    """
    rows: list[list[_Rows]] = [[] for _ in problem.joints]
    for at in problem.fit:
        for joint, part in _of_segment(problem, problem.simulator.segments[at]).items():
            rows[joint].append(part)
    found = np.full((len(problem.joints), 5), np.nan)
    for joint, parts in enumerate(rows):
        if parts:
            found[joint] = _solve_robustly(
                *(np.concatenate(each) for each in zip(*parts, strict=True))
            )
    return found


_Rows = tuple[FloatArray, FloatArray, FloatArray]


def _of_segment(problem: Problem, segment: Segment) -> dict[int, _Rows]:
    """Joint -> rows (n, 5), the effort of the model's own drive law without its limits (n,), and
    these limits (n, 2).
    """
    layout = problem.simulator.layout
    model = segment.model
    if len(segment.time) < 20 or np.any(np.diff(segment.time) <= 0):
        return {}
    q, v, a = _motion(segment)
    needed = _inverse_dynamics(segment, layout.qpos_index, layout.dof_index, q, v, a)
    setpoint = segment.setpoint.at(segment.time)
    found = {}
    for joint in range(q.shape[1]):
        act = int(layout.actuator[joint])
        if act < 0 or segment.mode_of(joint) == "effort":
            continue
        gear = float(layout.gear[joint])
        gain = float(model.actuator_gainprm[act, 0]) * float(layout.scale[joint])
        bias = model.actuator_biasprm[act]
        force = (
            gain * setpoint[:, joint]
            + bias[0]
            + gear * (bias[1] * q[:, joint] + bias[2] * v[:, joint])
        )
        low, high = (
            model.actuator_forcerange[act]
            if model.actuator_forcelimited[act]
            else (-np.inf, np.inf)
        )
        speed = np.sqrt(np.mean(v[:, joint] ** 2))
        use = np.isfinite(force) & (np.abs(v[:, joint]) > _LEAST_SPEED * speed)
        limits = np.sort(gear * _UNSATURATED * np.array([low, high]))
        columns = np.column_stack([
            needed[:, joint], v[:, joint], np.sign(v[:, joint]), a[:, joint], np.ones(len(q)),
        ])  # fmt: skip
        found[joint] = columns[use], gear * force[use], np.tile(limits, (int(use.sum()), 1))
    return found


def _motion(segment: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
    smooth, velocity, acceleration = derivatives(segment.time, segment.position, _SMOOTH)
    return smooth, velocity, acceleration


def _inverse_dynamics(
    segment: Segment,
    qpos: Sequence[int] | np.ndarray,
    dof: Sequence[int] | np.ndarray,
    q: FloatArray,
    v: FloatArray,
    a: FloatArray,
) -> FloatArray:
    """(n, joints) effort that the motion takes in the model, without contacts and dry friction."""
    model = segment.model
    data = mujoco.MjData(model)
    before = model.opt.disableflags
    model.opt.disableflags = before | int(
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_ACTUATION
    )
    found = np.empty_like(q)
    try:
        for at in range(len(q)):
            if segment.base is not None:
                segment.base.place(data, float(segment.time[at]))
            data.qpos[qpos], data.qvel[dof], data.qacc[dof] = q[at], v[at], a[at]
            mujoco.mj_inverse(model, data)
            found[at] = data.qfrc_inverse[dof]
    finally:
        model.opt.disableflags = before
    return found


def _solve_robustly(rows: FloatArray, effort: FloatArray, limits: FloatArray) -> FloatArray:
    """Return the five values of a joint, by iteratively reweighted least squares (Huber).

    A saturated drive does not show its gain, so its rows are left out. Which rows are saturated
    depends on the gain: in a model that is too stiff, nearly all of them. So they are determined
    again for each estimate of the gain. The first iteration uses the model's gain, or all rows if
    less than half are unsaturated with it.

    Args:
        rows: (n, 5) inverse dynamics, velocity, direction of motion, acceleration and 1.
        effort: (n,) effort of the model's drive law without limits, N*m or N.
        limits: (n, 2) effort above and below which the drive is saturated, N*m or N.

    Returns:
        (5,) as :func:`first_values`; NaN if too few rows are unsaturated, or the gain is larger
        than ``_LARGEST_GAIN``.
    """
    none = np.full(5, np.nan)
    use = _is_unsaturated(effort, limits)
    if use.mean() < 0.5:
        use[:] = True
    weight = np.ones(len(rows))
    values: FloatArray = np.zeros(5)
    for _ in range(10):
        if use.sum() < _FEWEST_ROWS:
            return none
        weighted = rows[use] * weight[use, None]
        sizes = np.linalg.norm(weighted, axis=0)
        unit = weighted / np.maximum(sizes, 1e-300)
        found = np.linalg.lstsq(unit, effort[use] * weight[use], rcond=1e-6)[0]
        values = np.asarray(found / np.maximum(sizes, 1e-300), dtype=np.float64)
        if not values[0] > 1.0 / _LARGEST_GAIN:
            return none
        off = np.abs(effort - rows @ values)
        scale = 1.4826 * float(np.median(off[use])) + 1e-12
        weight = np.sqrt(np.minimum(1.0, 1.345 * scale / np.maximum(off, 1e-12)))
        use = _is_unsaturated(effort / values[0], limits)
    return np.array([1.0 / values[0], *(values[1:] / values[0])])


def _is_unsaturated(effort: FloatArray, limits: FloatArray) -> NDArray[np.bool_]:
    return np.asarray((effort > limits[:, 0]) & (effort < limits[:, 1]))
