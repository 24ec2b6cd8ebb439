"""Simulate a realization under a stimulus: initial state, holding controls, recorded signals."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import ModelError, SimulationError
from pytest_twin.realization.engine import new_batch
from pytest_twin.realization.first_state import settle_actuators
from pytest_twin.realization.model import Realization
from pytest_twin.trial import CommandMode

Vector = NDArray[np.float64]

# Armature of a locked degree of freedom, relative to the largest and the smallest inertia of the
# moving ones. With larger values, rounding in the solver softens limits, contacts and couplings of
# the lightest one.
_LOCKED_TO_HEAVIEST, _LOCKED_TO_LIGHTEST = 1e5, 1e6
# Damping of a locked degree of freedom times the timestep, relative to its armature. Under a
# lasting load it then moves slowly and does not accelerate. The second value is the limit of
# stability where the integrator is not implicit in damping.
_LOCKED_DAMPING, _LOCKED_DAMPING_EXPLICIT = 1e4, 0.5
# Integers, because a MuJoCo enum on the left of == does not compare with a NumPy integer.
_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_STATE = (
    "time", "qpos", "qvel", "act", "history", "plastic", "qacc_warmstart", "eq_active",
    "mocap_pos", "mocap_quat",
)  # fmt: skip
_FATAL = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
    mujoco.mjtWarning.mjWARN_BADCTRL,
)


def prepare_model(
    realization: Realization,
    *,
    gravity: bool = True,
    contact: bool = True,
    locked: Collection[str] = (),
    edit: Callable[[mujoco.MjSpec], None] | None = None,
) -> mujoco.MjModel:
    """Copy of a realization's model for a test, with changed options and locked joints.

    Args:
        realization: the model; not changed.
        gravity, contact: False turns it off.
        locked: joints that keep their initial position, by an armature far above the inertia of
            the moving joints.
        edit: changes a copy of the spec before it is compiled, for example adds an object.

    Raises:
        ModelError: the changed spec does not compile.
    """
    if edit is None:
        model = copy.copy(realization.model)
    else:
        spec = realization.spec.copy()
        for key in list(spec.keys):  # the sizes of keyframes do not match the scene
            spec.delete(key)
        edit(spec)
        try:
            model = spec.compile()
        except (ValueError, RuntimeError, mujoco.FatalError) as error:
            raise ModelError(
                f"MuJoCo refuses the scene: {' '.join(str(error).split())}", path=realization.path
            ) from None
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    # An automatic reset would hide a divergence.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if not gravity:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY
    if not contact:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    if locked:
        mean_inertia = float(model.stat.meaninertia)
        moves = np.ones(model.nv, dtype=bool)
        for joint in locked:
            moves[_dofs(model, realization.joint_index(joint))] = False
        inertia = model.dof_M0[moves] if moves.any() else model.dof_M0
        locked_inertia = min(
            _LOCKED_TO_HEAVIEST * float(inertia.max()), _LOCKED_TO_LIGHTEST * float(inertia.min())
        )
        model.dof_armature[~moves] = locked_inertia
        creep = _LOCKED_DAMPING if _damps_implicitly(model) else _LOCKED_DAMPING_EXPLICIT
        model.dof_damping[~moves] = creep * locked_inertia / float(model.opt.timestep)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        model.stat.meaninertia = mean_inertia  # scales the solver's tolerance
    return model


def _damps_implicitly(model: mujoco.MjModel) -> bool:
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        return not model.opt.disableflags & (
            mujoco.mjtDisableBit.mjDSBL_EULERDAMP | mujoco.mjtDisableBit.mjDSBL_DAMPER
        )
    return bool(model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4)


def _dofs(model: mujoco.MjModel, joint: int) -> slice:
    start = int(model.jnt_dofadr[joint])
    width = {mujoco.mjtJoint.mjJNT_FREE: 6, mujoco.mjtJoint.mjJNT_BALL: 3}
    return slice(start, start + width.get(mujoco.mjtJoint(model.jnt_type[joint]), 1))


def coupled_joints(realization: Realization, joint: str) -> frozenset[str]:
    """``joint`` and all joints that are coupled to it by joint equalities or tendons."""
    model = realization.model
    ties: list[set[int]] = []
    for i in range(model.neq):
        if model.eq_type[i] == mujoco.mjtEq.mjEQ_JOINT and model.eq_obj2id[i] >= 0:
            ties.append({int(model.eq_obj1id[i]), int(model.eq_obj2id[i])})
    for i in range(model.ntendon):
        wraps = range(int(model.tendon_adr[i]), int(model.tendon_adr[i] + model.tendon_num[i]))
        ties.append(
            {
                int(model.wrap_objid[k])
                for k in wraps
                if model.wrap_type[k] == mujoco.mjtWrap.mjWRAP_JOINT
            }
        )
    group = {realization.joint_index(joint)}
    grown = True
    while grown:
        grown = False
        for tie in ties:
            if tie & group and not tie <= group:
                group |= tie
                grown = True
    return frozenset(str(model.joint(i).name) for i in group)


# -- controls


def driven_joints(realization: Realization, actuator: str) -> tuple[str, ...]:
    """Joints that an actuator drives, directly or through a tendon."""
    model = realization.model
    return tuple(
        str(model.joint(i).name) for i in _driven(model, realization.actuator_index(actuator))
    )


def _driven(model: mujoco.MjModel, actuator: int) -> list[int]:
    kind = mujoco.mjtTrn(model.actuator_trntype[actuator])
    target = int(model.actuator_trnid[actuator, 0])
    if kind in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT):
        return [target]
    if kind != mujoco.mjtTrn.mjTRN_TENDON:
        return []
    wraps = range(
        int(model.tendon_adr[target]), int(model.tendon_adr[target] + model.tendon_num[target])
    )
    return [
        int(model.wrap_objid[k]) for k in wraps if model.wrap_type[k] == mujoco.mjtWrap.mjWRAP_JOINT
    ]


def command_kind(model: mujoco.MjModel, actuator: int) -> CommandMode:
    """Quantity of an actuator's first control input: ``position``, ``velocity`` or ``effort``.

    It is the declared input; without a declaration it follows from the actuator's bias.
    """
    if model.actuator_ctrlnum[actuator] > 0:
        declared = mujoco.mj_actuatorInputName(model, actuator, 0)
        if declared in ("pos", "vel"):
            return "position" if declared == "pos" else "velocity"
    gain = float(model.actuator_gainprm[actuator, 0])
    if model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE and gain != 0.0:
        integrates = model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_INTEGRATOR
        if model.actuator_biasprm[actuator, 1] != 0.0:
            return "velocity" if integrates else "position"
        if model.actuator_biasprm[actuator, 2] != 0.0 and not integrates:
            return "velocity"
    return "effort"


def hold(model: mujoco.MjModel, data: mujoco.MjData) -> Vector:
    """(nu,) controls for rest at the pose of ``data``; activations are set to the steady state.

    The target of a position servo is its present position, that of a velocity servo is zero, and
    the control of a motor is zero.
    """
    mujoco.mj_fwdPosition(model, data)
    control: Vector = np.zeros(model.nu)
    for actuator in range(model.nactuator):
        if command_kind(model, actuator) == "position":
            control[model.actuator_ctrladr[actuator]] = _setpoint(model, data, actuator)
    data.ctrl[:] = clip_controls(model, control)
    settle_actuators(model, data)
    return np.array(data.ctrl)


def _setpoint(model: mujoco.MjModel, data: mujoco.MjData, actuator: int) -> float:
    length = float(data.actuator_length[model.actuator_outadr[actuator]])
    gain = float(model.actuator_gainprm[actuator, 0])
    if model.actuator_gaintype[actuator] != mujoco.mjtGain.mjGAIN_FIXED or gain == 0.0:
        return length
    bias = model.actuator_biasprm[actuator]
    return -(float(bias[0]) + float(bias[1]) * length) / gain


def clip_controls(model: mujoco.MjModel, control: Vector) -> Vector:
    """(nu,) controls, clipped to the declared ranges as in MuJoCo."""
    limited = np.asarray(model.actuator_ctrllimited, dtype=bool)
    lower = np.where(limited, model.actuator_ctrlrange[:, 0], -np.inf)
    upper = np.where(limited, model.actuator_ctrlrange[:, 1], np.inf)
    return np.clip(control, lower, upper)


# -- initial state


def initial_state(model: mujoco.MjModel, realization: Realization, qpos: Vector) -> mujoco.MjData:
    """State at rest, with the robot at ``qpos`` (nq,) and added bodies at their reference."""
    data = mujoco.MjData(model)
    base = realization.model
    for i in range(base.njnt):
        source = int(base.jnt_qposadr[i])
        width = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}.get(
            mujoco.mjtJoint(base.jnt_type[i]), 1
        )
        # Bodies of the scene come after those of the robot.
        target = int(model.jnt_qposadr[i])
        data.qpos[target : target + width] = qpos[source : source + width]
    return data


def first_pose(realization: Realization) -> str | dict[str, dict[str, float]]:
    """Pose for a first spec: the first named keyframe, or a pose well inside all joint ranges.

    Joints whose reference is within the inner 80 % of their range stay there and are not named;
    the others are set to the middle of their range.
    """
    model = realization.model
    for i in range(model.nkey):
        if model.key(i).name:
            return str(model.key(i).name)
    followers = {
        int(model.eq_obj1id[i])
        for i in range(model.neq)
        if model.eq_type[i] == mujoco.mjtEq.mjEQ_JOINT and model.eq_obj2id[i] >= 0
    }
    pose = {}
    for i in range(model.njnt):
        if model.jnt_type[i] not in _SCALAR or not model.jnt_limited[i] or i in followers:
            continue
        lower, upper = (float(bound) for bound in model.jnt_range[i])
        margin = 0.1 * (upper - lower)
        reference = float(model.qpos0[model.jnt_qposadr[i]])
        if not lower + margin <= reference <= upper - margin and model.joint(i).name:
            pose[str(model.joint(i).name)] = round(0.5 * (lower + upper), 4)
    return {"joints": pose} if pose else "reference"


def overlaps(realization: Realization, qpos: Vector) -> bool:
    """Whether any bodies are in contact at ``qpos`` (nq,)."""
    data = initial_state(realization.model, realization, qpos)
    mujoco.mj_fwdPosition(realization.model, data)
    return bool(data.ncon)


# -- stepping


@dataclass(frozen=True, slots=True)
class SimulatedMotion:
    """Recorded simulation; row k is the state at ``time[k]``.

    Attributes:
        time: (n + 1,) s.
        qpos, qvel: (n + 1, nq), (n + 1, nv).
        energy: (n + 1,) kinetic and potential energy with springs, without contacts, J.
        actuator_work, constraint_work: (n + 1,) work done on the robot since the start, J, by
            actuators and applied forces, and by constraints (contacts, limits, friction,
            equalities): force at the start of a step times the mean velocity in the step.
        penetration: (n + 1,) depth of the deepest contact, m; 0 without penetration.
        deepest: names of the two geoms of the deepest contact of the run, or None.
    """

    time: Vector
    qpos: Vector
    qvel: Vector
    energy: Vector
    actuator_work: Vector
    constraint_work: Vector
    penetration: Vector
    deepest: tuple[str, str] | None


def steps_in(model: mujoco.MjModel, duration: float) -> int:
    """Number of steps that cover ``duration`` (s), at least one."""
    return max(1, math.ceil(duration / float(model.opt.timestep) - 1e-6))


def run(
    realization: Realization,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    steps: int,
    *,
    progress: Callable[[float], None] | None = None,
) -> SimulatedMotion:
    """Step ``data`` with the realization's simulator, under constant controls and forces.

    Args:
        model: :func:`prepare_model` of it.
        steps: number of steps.
        progress: called with the fraction that is done, 0 to 1.

    Raises:
        SpecError: its simulator cannot compute this motion.
        SimulationError: the simulation diverged.
    """
    if realization.simulator == "newton":
        from pytest_twin.realization import newton

        return newton.simulate(realization, model, data, steps, progress)
    return simulate(model, data, steps, progress=progress)


def forward_kinematics(
    realization: Realization,
) -> Callable[[Vector, Iterable[str]], dict[str, Vector]]:
    """Forward kinematics of the realization's simulator.

    Returns:
        Function from ``qpos`` (nq,) and names of bodies or sites to a dictionary: name ->
        ``transform_world_to_frame`` (4, 4), m.
    """
    if realization.simulator == "newton":
        from pytest_twin.realization import newton

        return newton.forward_kinematics(realization)
    data = mujoco.MjData(realization.model)

    def poses(qpos: Vector, frames: Iterable[str]) -> dict[str, Vector]:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(realization.model, data)
        return {frame: realization.frame_pose(data, frame) for frame in frames}

    return poses


def simulate(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    steps: int,
    *,
    before: Callable[[float], None] | None = None,
    after: Callable[[int], None] | None = None,
    progress: Callable[[float], None] | None = None,
) -> SimulatedMotion:
    """Step ``data`` and record its states.

    Args:
        steps: number of steps.
        before: called with the time (s) before each step; may set controls and forces.
        after: called with k when ``data`` contains the contacts and forces of state k; its
            positions and velocities are then already those of the next state.
        progress: called with the fraction that is done, 0 to 1.

    Raises:
        SimulationError: a state that is not finite or exceeds MuJoCo's bounds; the message names
            the time and the joint.
    """
    n = steps
    time, energy = np.empty(n + 1), np.empty(n + 1)
    qpos, qvel = np.empty((n + 1, model.nq)), np.empty((n + 1, model.nv))
    actuator_work, constraint_work = np.zeros(n + 1), np.zeros(n + 1)
    penetration = np.zeros(n + 1)
    deepest: tuple[str, str] | None = None
    timestep = float(model.opt.timestep)
    for k in range(n + 1):
        if before is not None:
            before(float(data.time))
        time[k], qpos[k], qvel[k] = data.time, data.qpos, data.qvel
        if k < n:
            mujoco.mj_step(model, data)
            check_finite(model, data)
            motion = 0.5 * timestep * (qvel[k] + data.qvel)
            applied = data.qfrc_actuator + data.qfrc_applied
            actuator_work[k + 1] = actuator_work[k] + applied @ motion
            constraint_work[k + 1] = constraint_work[k] + data.qfrc_constraint @ motion
        else:
            mujoco.mj_forward(model, data)
        # Derived fields are those of the state before the step.
        energy[k] = data.energy[0] + data.energy[1]
        if data.ncon:
            distance = data.contact.dist
            worst = int(np.argmin(distance))
            penetration[k] = max(0.0, -float(distance[worst]))
            if penetration[k] > 0.0 and penetration[k] >= penetration[: k + 1].max():
                deepest = _geom_names(model, data.contact.geom[worst])
        if after is not None:
            after(k)
        if progress is not None and k % 256 == 0:
            progress(k / n)
    return SimulatedMotion(
        time, qpos, qvel, energy, actuator_work, constraint_work, penetration, deepest
    )


def geom_name(model: mujoco.MjModel, geom: int) -> str:
    """Name of a geom, or ``geom of BODY`` where it has none."""
    name = str(model.geom(geom).name)
    return name or f"geom of {model.body(int(model.geom_bodyid[geom])).name}"


def _geom_names(model: mujoco.MjModel, geoms: NDArray[np.int32]) -> tuple[str, str]:
    first, second = (geom_name(model, int(geom)) for geom in geoms)
    return first, second


def check_finite(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Check that a state has not diverged.

    Raises:
        SimulationError: the state diverged; the message names the time and the joint.
    """
    if not any(data.warning[kind].number for kind in _FATAL) and np.isfinite(data.qvel).all():
        return
    velocity = np.where(np.isfinite(data.qvel), np.abs(data.qvel), np.inf)
    raise divergence_error(model, int(np.argmax(velocity)), float(data.time))


def divergence_error(model: mujoco.MjModel, dof: int, time: float) -> SimulationError:
    """Error for a simulation that diverged at degree of freedom ``dof`` at ``time`` (s)."""
    joint = str(model.joint(int(model.dof_jntid[dof])).name)
    return SimulationError(
        f"the simulation diverged at {time:.6g} s",
        where=f"joint {joint!r}",
        expected=f"finite motion at a timestep of {float(model.opt.timestep):.6g} s",
    )


def simulate_batch(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    control: Vector,
    applied: Vector,
    progress: Callable[[float], None] | None = None,
) -> tuple[Vector, Vector]:
    """Simulate several command sequences from one initial state, as rows of one batch.

    Args:
        data: the initial state, with its controls.
        control: (m, n, nu) controls at each of n steps.
        applied: (m, n, nv) generalized forces at each of n steps, N*m or N; (m, n, 0) for none.
        progress: called with the fraction that is done, 0 to 1.

    Returns:
        qpos (m, n, nq) and qvel (m, n, nv) after each step.

    Raises:
        SimulationError: a row diverged; the message names the time and the joint.
    """
    rows, steps, _ = control.shape
    spec = mujoco.mjtState.mjSTATE_CTRL.value
    inputs = control
    if applied.shape[2]:
        spec |= mujoco.mjtState.mjSTATE_QFRC_APPLIED.value
        inputs = np.concatenate((control, applied), axis=2)
    pool = new_batch(model, rows)
    begin = float(data.time)
    for name in _STATE:
        if np.size(getattr(data, name, ())):  # older engines have fewer
            pool.bind(name)[:] = getattr(data, name)
    qpos, qvel = np.empty((rows, steps, model.nq)), np.empty((rows, steps, model.nv))
    stride = 2000
    for first in range(0, steps, stride):
        last = min(steps, first + stride)
        out = pool.rollout(
            last - first,
            np.ascontiguousarray(inputs[:, first:last]),
            spec,
            record=("qpos", "qvel", mujoco.mjtState.mjSTATE_TIME),
        )
        qpos[:, first:last], qvel[:, first:last] = out["qpos"], out["qvel"]
        time = out[mujoco.mjtState.mjSTATE_TIME][..., 0]
        _check_rows(model, time, qvel[:, first:last], begin + first * float(model.opt.timestep))
        if progress is not None:
            progress(last / steps)
    return qpos, qvel


def _check_rows(model: mujoco.MjModel, time: Vector, qvel: Vector, begin: float) -> None:
    """Check that no row (m, n) stopped at a warning; the time of such a row does not advance."""
    timestep = float(model.opt.timestep)
    due = begin + timestep * np.arange(1, 1 + time.shape[1])
    stopped = (time < due - 0.5 * timestep) | ~np.isfinite(qvel).all(axis=2)
    if stopped.any():
        step = int(np.argmax(stopped.any(axis=0)))
        row = int(np.argmax(stopped[:, step]))
        velocity = np.where(np.isfinite(qvel[row, step]), np.abs(qvel[row, step]), np.inf)
        raise divergence_error(model, int(np.argmax(velocity)), begin + step * timestep)


def resample(time: Vector, values: Vector, grid: Vector) -> Vector:
    """Values (n, k) or (n,), interpolated linearly at the times of ``grid`` (s)."""
    if values.ndim == 1:
        return np.interp(grid, time, values)
    return np.column_stack([np.interp(grid, time, column) for column in values.T])
