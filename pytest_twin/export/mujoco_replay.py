"""Step an exported MJCF with MuJoCo alone, and read its joints as the robot's encoders do."""

from __future__ import annotations

import copy

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.export.mjcf_forms import READING, ExportedMjcf
from pytest_twin.open_loop import Row, RowSimulation
from pytest_twin.realization.first_state import settle_under_load
from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings


def replay_exported(exported: ExportedMjcf, model: mujoco.MjModel, row: Row) -> FloatArray:
    """(n, joints) predicted readings at the stamps of a trial, rad or m; NaN where it diverges.

    Args:
        exported: what was written.
        model: the written file, loaded by MuJoCo.
        row: the trial, with the model before the export, whose controls are the same.
    """
    before = copy.copy(row.model)
    before.opt.timestep = model.opt.timestep
    run = RowSimulation(Row(row.trial, before, row.calibration, row.source), mujoco.MjData(before))
    controls = np.empty((run.steps, before.nu + before.nv))
    run.controls(0, run.steps, controls)
    with suppress_mujoco_warnings():
        return _step(exported, model, run, controls)


def _step(
    exported: ExportedMjcf, model: mujoco.MjModel, run: RowSimulation, controls: FloatArray
) -> FloatArray:
    data = mujoco.MjData(model)
    joints = run.trial.joints
    _set_first_state(exported, model, data, run)
    data.ctrl[:] = controls[0, : model.nu]
    settle_under_load(model, data)
    mujoco.mj_forward(model, data)
    _settle_drives(exported, model, data, run)
    sensors = {
        joint: int(model.sensor(f"{joint}{READING}").adr[0])
        for joint in joints
        if joint in exported.readings
    }
    _fill_sensor_delays(exported, model, data)
    addresses = np.array([int(model.joint(joint).qposadr[0]) for joint in joints])
    dofs = np.array([int(model.joint(joint).dofadr[0]) for joint in joints])
    positions = np.full((run.steps + 1, len(joints)), np.nan)
    forced = [
        (int(model.joint(name).dofadr[0]), run.model.nu + int(run.model.joint(name).dofadr[0]))
        for name in joints
    ]

    def read(k: int) -> None:
        positions[k] = data.qpos[addresses]
        for joint, address in sensors.items():
            positions[k, joints.index(joint)] = data.sensordata[address]

    for k in range(run.steps):
        data.ctrl[:] = controls[k, : model.nu]
        if run.applies_effort:
            for target, source in forced:
                data.qfrc_applied[target] = controls[k, source]
        if k == 0 or sensors:
            mujoco.mj_forward(model, data)
        read(k)
        mujoco.mj_step(model, data)
        if not np.isfinite(data.qvel[dofs]).all() or data.warning.number.any():
            break
    else:
        mujoco.mj_forward(model, data)
        read(run.steps)
    return run.encoders.read_position(at_stamps(positions, run))


def at_stamps(positions: FloatArray, run: RowSimulation) -> FloatArray:
    """Positions at the stamps, by a straight line between steps."""
    first = np.minimum(run.sample_step, len(positions) - 2)
    share = run.sample_fraction[:, None]
    straight: FloatArray = (1.0 - share) * positions[first] + share * positions[first + 1]
    return np.where(share == 0.0, positions[first], straight)


def _set_first_state(
    exported: ExportedMjcf, model: mujoco.MjModel, data: mujoco.MjData, run: RowSimulation
) -> None:
    """Put the joints where the first readings are, and motors where they carry the load."""
    for name in (run.model.joint(i).name for i in range(run.model.njnt)):
        there, here = run.model.joint(name), model.joint(name)
        size = len(np.atleast_1d(here.qpos0))
        of = slice(int(there.qposadr[0]), int(there.qposadr[0]) + size)
        to = slice(int(here.qposadr[0]), int(here.qposadr[0]) + size)
        data.qpos[to] = run.initial["qpos"][of]
        width = 1 if size == 1 else 6 if size == 7 else 3
        of = slice(int(there.dofadr[0]), int(there.dofadr[0]) + width)
        to = slice(int(here.dofadr[0]), int(here.dofadr[0]) + width)
        data.qvel[to] = run.initial["qvel"][of]
    _invert_readings(exported, model, data, run.trial.joints)
    load = _loads(model, data)
    for joint, motor in exported.motors.items():
        carried = load[int(model.joint(joint).dofadr[0])]
        at = int(model.joint(motor.motor).qposadr[0])
        data.qpos[at] = (
            data.qpos[int(model.joint(joint).qposadr[0])]
            + carried / motor.stiffness
            + float(np.sign(carried)) * motor.gap / 2.0
        )
        data.qvel[int(model.joint(motor.motor).dofadr[0])] = data.qvel[
            int(model.joint(joint).dofadr[0])
        ]


def _loads(model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray:
    """(nv,) efforts that hold the joints at rest, N*m or N."""
    still = mujoco.MjData(model)
    still.qpos[:] = data.qpos
    mujoco.mj_forward(model, still)
    return np.asarray(still.qfrc_bias, dtype=np.float64)


def _invert_readings(
    exported: ExportedMjcf, model: mujoco.MjModel, data: mujoco.MjData, joints: tuple[str, ...]
) -> None:
    mixed = np.eye(len(joints))
    for joint, reading in exported.readings.items():
        if joint in joints:
            mixed[joints.index(joint), joints.index(joint)] = reading.scale
            for neighbour, ratio in reading.neighbours.items():
                mixed[joints.index(joint), joints.index(neighbour)] = ratio
    addresses = [int(model.joint(joint).qposadr[0]) for joint in joints]
    dofs = [int(model.joint(joint).dofadr[0]) for joint in joints]
    data.qpos[addresses] = np.linalg.solve(mixed, data.qpos[addresses])
    data.qvel[dofs] = np.linalg.solve(mixed, data.qvel[dofs])


def _settle_drives(
    exported: ExportedMjcf, model: mujoco.MjModel, data: mujoco.MjData, run: RowSimulation
) -> None:
    """Let integral terms carry the load at rest, and currents deliver what the command asks for."""
    load = _loads(model, data)
    dynamics = mujoco.mjtDyn
    for joint, name in exported.drives.items():
        actuator = model.actuator(name)
        kind = int(actuator.dyntype[0])
        if kind not in (int(dynamics.mjDYN_DCMOTOR), int(dynamics.mjDYN_PID)):
            continue
        first, count = int(actuator.actadr[0]), int(actuator.actnum[0])
        motor = exported.motors.get(joint)
        driven = model.joint(joint if motor is None else motor.motor)
        gear = float(actuator.gear[0])
        is_motor = kind == int(dynamics.mjDYN_DCMOTOR)
        kp, ki = (
            (actuator.gainprm[4], actuator.gainprm[5])
            if is_motor
            else (-actuator.biasprm[1], actuator.gainprm[0])
        )
        command = float(data.ctrl[int(model.actuator_ctrladr[actuator.id])])
        error = command - gear * float(data.qpos[int(driven.qposadr[0])])
        has_slew = float(actuator.dynprm[7 if is_motor else 1]) > 0.0
        integral = 0.0
        if ki > 0.0:
            carried = float(load[int(model.joint(joint).dofadr[0])]) / gear
            integral = (carried - kp * error) / ki
            data.act[first + int(has_slew)] = integral
        if is_motor and float(actuator.dynprm[0]) > 0.0:
            kd = float(actuator.gainprm[6])
            speed = gear * float(data.qvel[int(driven.dofadr[0])])
            effort = command if run.trial.command_modes[0] == "effort" else kp * error
            effort += ki * integral - kd * speed
            if model.actuator_forcelimited[actuator.id]:
                effort = float(np.clip(effort, *model.actuator_forcerange[actuator.id]))
            data.act[first + count - 1] = effort / float(actuator.gainprm[1])


def _fill_sensor_delays(exported: ExportedMjcf, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    for joint, reading in exported.readings.items():
        if reading.delay > 0.0:
            sensor = model.sensor(f"{joint}{READING}")
            value = reading.scale * data.qpos[int(model.joint(joint).qposadr[0])] + sum(
                ratio * data.qpos[int(model.joint(other).qposadr[0])]
                for other, ratio in reading.neighbours.items()
            )
            samples = int(model.sensor_history[sensor.id, 0])
            mujoco.mj_initSensorHistory(
                model, data, sensor.id, None, np.full((samples, 1), value), 0.0
            )
