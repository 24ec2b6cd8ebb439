"""First values of drives and friction, without a simulation: the equation error.

Along the measured motion, the model's drive law gives the effort of the drive up to its gain. The
model's inverse dynamics gives the effort that the motion needs. Gain, friction and armature at a
joint follow by linear least squares, as in an identification from efforts in an unknown unit. The
simulation error has many minima; these values are near the right one.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.build_problem import residuals_everywhere
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.smoothing import derivatives
from pytest_twin.effects.actuation import ControllerGain
from pytest_twin.effects.friction import CoulombFriction
from pytest_twin.effects.segment import Segment
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term

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
_NEAR = 3.0
"""Ratio to the model's gain within which derivatives around the model lead to the right gain."""
_MULTIPLES = (1.0, 2.0, 4.0)
"""Multiples of the gain by the equation error, which a delay of the recording makes too small."""
_LARGEST_GAIN = 5.0
"""Largest ratio to the model's gain, as in the catalogue; above it the motion does not determine
the gain."""


def distant_gains(problem: Problem) -> Hypothesis:
    """Servo gains far from the model's, and dry friction beside them, from the equation error.

    A servo that is too stiff by far follows its command in the model, and no derivative along that
    motion leads to the right gain. Where the motion does not show the gain, the others' is tried:
    a model has the same servo at many joints. Empty where gains are near or no better.
    """
    values = first_values(problem)
    gain, dry = values[:, 0], values[:, 2]
    with np.errstate(invalid="ignore"):
        far = (gain * _NEAR < 1.0) | (gain > _NEAR)
    if not far.any():
        return EMPTY
    usual = np.median(gain[far]), np.median(dry[far])
    tried = [EMPTY]
    for multiple, is_dry in itertools.product(_MULTIPLES, (False, True)):
        terms = dict[Term, FloatArray]()
        for joint in np.flatnonzero(far | np.isnan(gain)).tolist():
            if problem.simulator.layout.servo[joint] != "position":
                continue
            own_gain, own_dry = (gain[joint], dry[joint]) if far[joint] else usual
            gains, friction = Term(ControllerGain.id, joint), Term(CoulombFriction.id, joint)
            # The damping of a mode is proportional to the root of its stiffness.
            ratio = np.array([multiple * own_gain, np.sqrt(multiple * own_gain)])
            terms[gains] = np.clip(ratio - 1.0, *EMPTY.with_term(gains, ratio).bounds)
            level = own_dry / problem.scales.value(friction.parameters[0], joint)
            if is_dry and level > 0.0:
                terms[friction] = np.array([level])
        tried.append(EMPTY.with_terms(terms))
    left = np.array([residuals_everywhere(problem, h)[:, : len(gain)] for h in tried])
    best = np.argmin(np.nan_to_num(np.mean(left**2, axis=1), nan=np.inf), axis=0)
    return EMPTY.with_terms({
        t: h.theta[h.slice_of(t)]
        for at, h in enumerate(tried) for t in h.terms if best[t.joint] == at
    })  # fmt: skip


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
    if len(rows) < _FEWEST_ROWS:
        return none
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
