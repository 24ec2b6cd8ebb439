"""Initial state and controls of joints and actuators that a recording does not contain."""

from __future__ import annotations

from collections.abc import Collection

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.realization.inputs import (
    JOINT_TRANSMISSIONS,
    LINEAR_GAINS,
    joint_inputs,
    steady_activation,
)

_INTEGRATOR = int(mujoco.mjtDyn.mjDYN_INTEGRATOR)


def follow_joint_equalities(
    model: mujoco.MjModel, data: mujoco.MjData, placed: Collection[int]
) -> None:
    """Set positions and velocities of joints that follow others by active joint equalities.

    A follower may itself be followed by another joint.

    Args:
        model: the model with its equalities.
        data: its ``qpos`` and ``qvel`` are changed.
        placed: ids of joints that keep their position.
    """
    still = set(placed)
    pending = [
        i
        for i in range(model.neq)
        if model.eq_type[i] == mujoco.mjtEq.mjEQ_JOINT
        and data.eq_active[i]
        and model.eq_obj2id[i] >= 0
    ]
    moved = True
    while moved:
        moved = False
        for i in pending:
            follower, leader = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
            if follower in still or leader not in still:
                continue
            q1, q2 = model.jnt_qposadr[[follower, leader]]
            v1, v2 = model.jnt_dofadr[[follower, leader]]
            away = data.qpos[q2] - model.qpos0[q2]
            law = np.polynomial.Polynomial(model.eq_data[i, :5])
            data.qpos[q1] = model.qpos0[q1] + law(away)
            data.qvel[v1] = law.deriv()(away) * data.qvel[v2]
            still.add(follower)
            moved = True


def settle_actuators(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Set filters, integrators and delays of actuators to their steady state for ``data.ctrl``.

    Args:
        model: the model with its actuators.
        data: contains positions and controls; its activations and delay buffers are changed.
    """
    mujoco.mj_fwdPosition(model, data)
    for actuator in range(model.nactuator):
        steady = steady_activation(model, data, actuator)
        if steady is not None:
            data.act[steady[0]] = steady[1]
        if model.actuator_historyadr[actuator] >= 0:
            first = int(model.actuator_ctrladr[actuator])
            held = data.ctrl[first : first + model.actuator_ctrlnum[actuator]]
            samples = int(model.actuator_history[actuator, 0])
            mujoco.mj_initCtrlHistory(model, data, actuator, None, np.tile(held, samples))


def settle_under_load(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """As :func:`settle_actuators`; servos with an integrator also support the load at rest.

    A recorded joint rests at the start, so that the integrator of its servo must have reached the
    value that supports the load. Joints with several such servos are left unchanged.
    """
    settle_actuators(model, data)
    integrators = [
        actuator
        for actuator in range(model.nactuator)
        if int(model.actuator_dyntype[actuator]) == _INTEGRATOR
        and int(model.actuator_trntype[actuator]) in JOINT_TRANSMISSIONS
        and float(model.actuator_biasprm[actuator, 1]) != 0.0
    ]
    driven = [int(model.actuator_trnid[actuator, 0]) for actuator in integrators]
    load = _load_at_rest(model, data) if integrators else np.zeros(0)
    for actuator, joint in zip(integrators, driven, strict=True):
        gain = float(model.actuator_gainprm[actuator, 0])
        gear = float(model.actuator_gear[model.actuator_outadr[actuator], 0])
        if driven.count(joint) == 1 and gain != 0.0 and gear != 0.0:
            carried = float(load[model.jnt_dofadr[joint]]) / gear
            constant = float(model.actuator_biasprm[actuator, 0])
            data.act[model.actuator_actadr[actuator]] += (carried - constant) / gain


def holding_controls(
    model: mujoco.MjModel, data: mujoco.MjData, commanded: Collection[str]
) -> NDArray[np.float64]:
    """(nu,) controls with which position servos hold the joints that have no recorded command.

    The command of such a servo is unknown, but it holds the joint. Its setpoint is the position
    of the joint plus the deflection of the servo under the load. A servo of a tendon holds the
    tendon's length. Other controls are zero.

    Args:
        model: the model with its servos.
        commanded: joints with recorded commands.
    """
    control = np.zeros(model.nu)
    load = _load_at_rest(model, data)
    for joint in range(model.njnt):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
        if not name or name in commanded:
            continue
        servos = [i for i in joint_inputs(model, name) if i.mode == "position"]
        laws = [_linear_law(model, servo.actuator) for servo in servos]
        stiffness, constant = (sum(each) for each in zip((0.0, 0.0), *laws, strict=True))
        position = float(data.qpos[model.jnt_qposadr[joint]])
        if stiffness > 0.0:
            position += (float(load[model.jnt_dofadr[joint]]) - constant) / stiffness
        for servo in servos:
            control[servo.control] = servo.scale * position
    for actuator in range(model.nactuator):
        setpoint = _tendon_setpoint(model, data, actuator)
        if setpoint is not None:
            control[model.actuator_ctrladr[actuator]] = setpoint
    return control


def _tendon_setpoint(model: mujoco.MjModel, data: mujoco.MjData, actuator: int) -> float | None:
    """Control with which a linear servo of a tendon exerts no force; None for other actuators."""
    if (
        int(model.actuator_trntype[actuator]) != int(mujoco.mjtTrn.mjTRN_TENDON)
        or int(model.actuator_gaintype[actuator]) != LINEAR_GAINS[0]
        or int(model.actuator_dyntype[actuator]) != int(mujoco.mjtDyn.mjDYN_NONE)
    ):
        return None
    gain = float(model.actuator_gainprm[actuator, 0])
    constant, slope = (float(b) for b in model.actuator_biasprm[actuator, :2])
    if gain == 0.0 or slope == 0.0:
        return None
    moved = mujoco.MjData(model)
    moved.qpos[:] = data.qpos
    mujoco.mj_fwdPosition(model, moved)
    length = float(moved.actuator_length[model.actuator_outadr[actuator]])
    return -(constant + slope * length) / gain


def _load_at_rest(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.float64]:
    """(nv,) efforts of the drives that keep the model at rest in the pose of ``data``, N*m or N."""
    still = mujoco.MjData(model)
    still.qpos[:] = data.qpos
    mujoco.mj_fwdPosition(model, still)
    mujoco.mj_fwdVelocity(model, still)
    load: NDArray[np.float64] = still.qfrc_bias - still.qfrc_passive
    # Gravity that MuJoCo compensates in the actuators does not load a servo.
    by_drives = model.jnt_actgravcomp[model.dof_jntid] != 0
    return load - np.where(by_drives, still.qfrc_gravcomp, 0.0)


def _linear_law(model: mujoco.MjModel, actuator: int) -> tuple[float, float]:
    """Stiffness (N*m/rad or N/m) and constant effort (N*m or N) of a servo at its joint.

    Both are zero for an actuator whose effort is not linear in its gains.
    """
    if int(model.actuator_gaintype[actuator]) not in LINEAR_GAINS:
        return 0.0, 0.0
    gear = float(model.actuator_gear[model.actuator_outadr[actuator], 0])
    constant, slope = (float(b) for b in model.actuator_biasprm[actuator, :2])
    return -slope * gear**2, constant * gear
