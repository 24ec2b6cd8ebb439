"""Open-loop replay: simulate a trial from its commands and its first state alone.

How a trial becomes a simulation:

- Between their stamps commands are held, interpolated or ramped (``Trial.command_between``);
  before the first stamp the first is held. Each step gets the mean of that signal over the step,
  so that the time step shifts no command.
- The first state sets positions and, where it was recorded, velocities; otherwise the robot
  starts at rest. Joints outside the recording start at the model's reference (or where a joint
  equality puts them), and their position servos hold them there: the setpoint includes the
  deflection of the servo under gravity. The same holds for joints that were recorded but not
  commanded.
- Filters and delays of actuators start in the steady state of the first command. The integrators
  of servos start with the value that supports the load.
- Where the pose of a floating base was recorded, the base moves along it, and the joints feel its
  acceleration (``realization/driven_base.py``).
- An effort command on a joint without any actuator acts on the joint itself.
- Between steps, positions follow the cubic through positions and velocities of both ends (error
  of the order of step^4; of a straight line, step^2), velocities are linear; ``effort`` is the one
  that MuJoCo computed for the step which contains the stamp (at the step's start; with the RK4
  integrator at its end).

Trials are rows of one batch (``realization/engine.py``), each with its own model where needed. The
steps equal those of ``mj_step`` bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import SimulationError, SpecError
from pytest_twin.realization import Realization
from pytest_twin.realization.driven_base import BaseCourse, DrivenBase, drive_base
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.realization.engine import BatchError, new_batch
from pytest_twin.realization.first_state import (
    follow_joint_equalities,
    holding_controls,
    settle_under_load,
)
from pytest_twin.realization.inputs import command_input
from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings
from pytest_twin.trial import Trial
from pytest_twin.trial.setpoint import Setpoint
from pytest_twin.twin import JointCalibration

# Steps per call of the batch. The overhead of a call is then negligible. The second constant bounds
# the memory of the recorded states, bytes.
_BLOCK_STEPS = 4096
_BLOCK_BYTES = 64 * 2**20
# Steps. A row may be stepped past its end by this much, so that it does not shorten the block of
# the other rows.
_SHORTEST_BLOCK = 64
# Fraction of a step. A stamp this close to a step's end counts as on it: stamps are rounded to
# nanoseconds.
_ON_STEP = 1e-5
_STATE = mujoco.mjtState
_TIME = int(_STATE.mjSTATE_TIME)
_INITIAL = ("qpos", "qvel", "act", "history", "ctrl")


@dataclass(frozen=True, slots=True)
class Row:
    """One simulation of a batch.

    Attributes:
        model: model to step; models of one batch need not be equal.
        calibration: joint -> sign, scale and offset of its encoder.
        source: the model's file, for error messages.
    """

    trial: Trial
    model: mujoco.MjModel
    calibration: Mapping[str, JointCalibration] = field(default_factory=dict)
    source: Path | None = None


@dataclass(frozen=True, slots=True)
class Replayed:
    """Simulated motion under the commands of a trial, at the trial's state stamps.

    Attributes:
        time: (n,) s from the first state.
        position: (n, j) rad or m, joints as ``trial.joints``, as the robot's encoders would read.
        velocity: (n, j) rad/s or m/s, likewise.
        effort: (n, j) N*m or N at the joints, by actuators and applied efforts, likewise.
        qpos: (n, nq) configuration of the whole model.
        error: where and why the simulation diverged; samples from then on are NaN.
        notes: assumptions of the replay, one line each.
    """

    trial: Trial
    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    effort: FloatArray
    qpos: FloatArray
    error: SimulationError | None = None
    notes: tuple[str, ...] = ()


def replay(
    realization: Realization,
    trials: Sequence[Trial],
    *,
    threads: int = 0,
    progress: Callable[[float], None] | None = None,
) -> list[Replayed]:
    """Replay trials on a realization, each with its own controller and payload.

    A trial that diverges does not stop the others: see ``Replayed.error``.

    Args:
        realization: the model to step.
        trials: their metadata may name ``controller`` and ``payload`` of the twin.
        threads: number of threads, 0 for all cores.
        progress: called with the fraction of steps that are done.

    Raises:
        SpecError: a joint, actuator, controller or payload that the realization lacks.
    """
    variants: dict[tuple[str | None, str | None], Realization] = {}
    rows, notes = [], []
    for trial in trials:
        controller, payload, said = _variant_ids(realization, trial)
        if (controller, payload) not in variants:
            variants[controller, payload] = realization.variant(controller, payload)
        variant = variants[controller, payload]
        notes.append(said)
        rows.append(Row(trial, variant.model, calibration_of(realization), realization.path))
    replayed = replay_rows(rows, threads=threads, progress=progress)
    return [
        replace(result, notes=(*result.notes, *said))
        for result, said in zip(replayed, notes, strict=True)
    ]


def row_of(realization: Realization, trial: Trial) -> Row:
    """Row of a trial: with the model for the controller and payload that its metadata name.

    Raises:
        SpecError: a controller or payload that the realization lacks.
    """
    controller, payload, _ = _variant_ids(realization, trial)
    variant = realization.variant(controller, payload)
    return Row(trial, variant.model, calibration_of(realization), realization.path)


def replay_rows(
    rows: Sequence[Row],
    *,
    threads: int = 0,
    progress: Callable[[float], None] | None = None,
) -> list[Replayed]:
    """Replay rows, each a trial with its own model, in the given order.

    Rows whose models have the same array sizes are stepped in one batch.

    Raises:
        SpecError: a joint or an actuator that a model lacks.
    """
    scratch: dict[int, mujoco.MjData] = {}
    runs = []
    for row in rows:
        if id(row.model) not in scratch:
            scratch[id(row.model)] = mujoco.MjData(row.model)
        runs.append(RowSimulation(row, scratch[id(row.model)]))
    total = max(1, sum(run.steps for run in runs))
    done = 0

    def advance(steps: int) -> None:
        nonlocal done
        done += steps
        if progress is not None:
            progress(min(1.0, done / total))

    with suppress_mujoco_warnings():
        for group in _batches(runs):
            _step(group, threads, advance)
    return [run.result() for run in runs]


def frame_poses(realization: Realization, qpos: FloatArray, frame: str) -> FloatArray:
    """(n, 7) position (m) and quaternion (w x y z) of a frame in the world.

    Args:
        qpos: (n, nq) configurations; rows with NaN give NaN.
        frame: a site or a body.

    Raises:
        SpecError: no such frame.
    """
    data = mujoco.MjData(realization.model)
    realization.frame_index(frame)
    poses = np.full((len(qpos), 7), np.nan)
    for i in np.flatnonzero(np.isfinite(qpos).all(axis=1)):
        data.qpos[:] = qpos[i]
        mujoco.mj_kinematics(realization.model, data)
        pose = realization.frame_pose(data, frame)
        poses[i, :3] = pose[:3, 3]
        mujoco.mju_mat2Quat(poses[i, 3:], pose[:3, :3].ravel())
    return poses


def measured_qpos(realization: Realization, replayed: Replayed) -> FloatArray:
    """(n, nq) configurations: measured positions for recorded joints, simulated for the others."""
    trial = replayed.trial
    encoders = Encoders.of(calibration_of(realization), trial.joints)
    qpos = replayed.qpos.copy()
    columns = [realization.joint_qpos_index(joint) for joint in trial.joints]
    qpos[:, columns] = encoders.model_position(trial.position)
    return qpos


class RowSimulation:
    """A row while it is stepped: its controls at each step, and its states at the stamps.

    Args:
        row: the row.
        data: data of the row's model; overwritten with the initial state.
    """

    def __init__(self, row: Row, data: mujoco.MjData) -> None:
        self.row = row
        self.model, self.trial = row.model, row.trial
        self.timestep = float(self.model.opt.timestep)
        self.joint_ids = [self._joint_id(joint) for joint in self.trial.joints]
        self.qpos_index = self.model.jnt_qposadr[self.joint_ids]
        self.dof_index = self.model.jnt_dofadr[self.joint_ids]
        self.encoders = Encoders.of(row.calibration, self.trial.joints)
        self.applies_effort = False
        self.notes: tuple[str, ...] = ()
        self._locate_samples()
        self.base, self.course = self._base_course()
        self._set_first_state(data)
        self._compute_commands(data)
        data.ctrl[:] = self.values[0, : self.model.nu]
        settle_under_load(self.model, data)
        self.initial = {name: getattr(data, name).copy() for name in _INITIAL}
        count = len(self.trial.time)
        self.qpos = np.full((count, self.model.nq), np.nan)
        self.velocity = np.full((count, len(self.joint_ids)), np.nan)
        self.effort = np.full((count, len(self.joint_ids)), np.nan)
        self.last_qpos, self.last_qvel = self.initial["qpos"], self.initial["qvel"]
        scalar = np.isin(
            self.model.jnt_type, [mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE]
        )
        self.scalar_qpos = self.model.jnt_qposadr[scalar]
        self.scalar_dof = self.model.jnt_dofadr[scalar]
        self.step = 0
        self.error: SimulationError | None = None

    def _refuse(self, problem: str, joint: str, expected: str | None = None) -> SpecError:
        return SpecError(problem, path=self.row.source, where=f"joint '{joint}'", expected=expected)

    def _joint_id(self, joint: str) -> int:
        index = int(mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, joint))
        if index < 0:
            raise self._refuse(f"in {self.trial.path.name} but not in the model", joint)
        kind = int(self.model.jnt_type[index])
        if kind not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            raise self._refuse("a recording gives one number per joint", joint,
                               expected="a hinge or a slide joint")  # fmt: skip
        return index

    def _locate_samples(self) -> None:
        at = self.trial.time / self.timestep
        self.sample_step = np.floor(at + _ON_STEP).astype(np.int64)
        fraction = np.clip(at - self.sample_step, 0.0, 1.0)
        self.sample_fraction = np.where(fraction < _ON_STEP, 0.0, fraction)
        # One step past the last stamp: the interpolation needs the state at the end of its step.
        self.steps = int(self.sample_step[-1]) + 1

    def _base_course(self) -> tuple[DrivenBase | None, BaseCourse | None]:
        """The base whose pose was recorded, and its course; the model then follows it.

        Raises:
            SpecError: the recorded joints are not carried by one free joint.
        """
        motion = self.trial.base
        if motion is None:
            return None, None
        self.model, base, self.notes = drive_base(
            self.model, self.joint_ids, motion, self.row.source
        )
        self.applies_effort = True
        return base, base.course(0.0, self.timestep, self.steps)

    def _set_first_state(self, data: mujoco.MjData) -> None:
        mujoco.mj_resetData(self.model, data)
        if self.base is not None and self.course is not None:
            data.qpos[self.base.qpos] = self.course.qpos
            data.qvel[self.base.dof] = self.course.qvel
        data.qpos[self.qpos_index] = self.encoders.model_position(self.trial.position[0])
        if self.trial.velocity is not None:
            velocity = self.encoders.model_velocity(self.trial.velocity[0])
            data.qvel[self.dof_index] = np.where(np.isfinite(velocity), velocity, 0.0)
        follow_joint_equalities(self.model, data, set(self.joint_ids))

    def _compute_commands(self, data: mujoco.MjData) -> None:
        """Compute the controls over time, and for held commands the step at which each begins.

        A step in which a held command changes gets a correction, so that its control is the mean.
        """
        model, trial = self.model, self.trial
        width = model.nu
        base = np.zeros(width + model.nv)
        base[:width] = holding_controls(model, data, trial.command_joints)
        asked = trial.setpoint
        values = np.tile(base, (len(asked.time), 1))
        encoders = Encoders.of(self.row.calibration, trial.command_joints)
        commands = encoders.model_command(asked.value, trial.command_modes)
        for joint, mode, command in zip(
            trial.command_joints, trial.command_modes, commands.T, strict=True
        ):
            joint_id = self._joint_id(joint)
            try:
                target = command_input(model, joint, mode)
            except SpecError as error:
                error.path = self.row.source
                raise
            if target is None:
                self.applies_effort = True
                values[:, width + model.jnt_dofadr[joint_id]] = command
            else:
                values[:, target.control] = target.scale * command
        self.values = values
        self.interpolated = (
            Setpoint(asked.time, values, is_linear=True) if asked.is_linear else None
        )
        at = asked.time / self.timestep
        inside = np.floor(at + _ON_STEP)
        fraction = np.where(at - inside < _ON_STEP, 0.0, at - inside)
        self.value_step = (inside + (fraction > 0.0)).astype(np.int64)
        late = np.flatnonzero((fraction > 0.0) & (np.arange(len(at)) > 0))
        self.split_step = inside[late].astype(np.int64)
        self.split_values = (1.0 - fraction[late])[:, None] * (values[late] - values[late - 1])

    def controls(self, begin: int, end: int, out: FloatArray) -> None:
        """Write the controls of steps ``begin`` to ``end`` into ``out`` (steps, controls)."""
        self._command_controls(begin, end, out)
        if self.base is not None and self.course is not None:
            of_base = out[:, self.model.nu :][:, self.base.dof]
            force = self.course.force[begin:end]
            of_base[: len(force)] = force
            # Steps after the last sample go on at the last velocity.
            of_base[len(force) :] = 0.0

    def _command_controls(self, begin: int, end: int, out: FloatArray) -> None:
        width = out.shape[1]
        if self.interpolated is not None:
            until = np.asarray(self.timestep * np.arange(begin, end + 1), dtype=np.float64)
            means = np.diff(self.interpolated.integral(until), axis=0) / self.timestep
            out[:] = means[:, :width]
            return
        first, last = np.searchsorted(self.value_step, (begin, end), side="right")
        first = max(int(first) - 1, 0)
        last = max(int(last), first + 1)
        edges = np.clip(self.value_step[first:last], begin, end)
        edges[0] = begin
        lengths = np.diff(edges, append=end)
        out[:] = np.repeat(self.values[first:last, :width], lengths, axis=0)
        first, last = np.searchsorted(self.split_step, (begin, end))
        np.add.at(out, self.split_step[first:last] - begin, self.split_values[first:last, :width])

    def store(self, qpos: FloatArray, qvel: FloatArray, effort: FloatArray) -> None:
        """Store the samples in the next steps, from states at their ends and efforts during them.

        Args:
            qpos: (steps, nq).
            qvel: (steps, nv).
            effort: (steps, nv).
        """
        begin, end = self.step, min(self.step + len(qpos), self.steps)
        first, last = np.searchsorted(self.sample_step, (begin, end))
        if last > first:
            index = self.sample_step[first:last] - begin
            fraction = self.sample_fraction[first:last, None]
            after_q, after_v = qpos[index], qvel[index]
            previous = np.maximum(index - 1, 0)
            at_start = (index == 0)[:, None]
            before_q = np.where(at_start, self.last_qpos, qpos[previous])
            before_v = np.where(at_start, self.last_qvel, qvel[previous])
            at = slice(first, last)
            self.qpos[at] = before_q + fraction * (after_q - before_q)
            self.qpos[at, self.scalar_qpos] = _hermite(
                fraction,
                before_q[:, self.scalar_qpos],
                after_q[:, self.scalar_qpos],
                self.timestep * before_v[:, self.scalar_dof],
                self.timestep * after_v[:, self.scalar_dof],
            )
            velocity = before_v + fraction * (after_v - before_v)
            self.velocity[at] = velocity[:, self.dof_index]
            self.effort[at] = effort[index][:, self.dof_index]
        self.last_qpos, self.last_qvel = qpos[-1].copy(), qvel[-1].copy()
        self.step += len(qpos)

    def fail(self, problem: str, step: int, joint: str | None) -> None:
        """Record a failure and end the row: samples from ``step`` on are NaN."""
        self.error = SimulationError(
            f"{problem} {step * self.timestep:.6g} s after the first state of "
            f"{self.trial.path.name}",
            path=self.row.source,
            where=None if joint is None else f"joint '{joint}'",
            expected="a stable simulation; check timestep, inertias and servo gains",
        )
        has_ended = self.sample_step >= step
        for kept in (self.qpos, self.velocity, self.effort):
            kept[has_ended] = np.nan
        self.steps = self.step

    def result(self) -> Replayed:
        """The simulated motion in the signs and zeros of the encoders."""
        return Replayed(
            trial=self.trial,
            time=self.trial.time,
            position=self.encoders.read_position(self.qpos[:, self.qpos_index]),
            velocity=self.encoders.read_velocity(self.velocity),
            effort=self.encoders.signed(self.effort),
            qpos=self.qpos,
            error=self.error,
            notes=self.notes,
        )


def _hermite(
    fraction: FloatArray,
    start: FloatArray,
    end: FloatArray,
    start_slope: FloatArray,
    end_slope: FloatArray,
) -> FloatArray:
    """Cubic Hermite interpolation at ``fraction`` (0 to 1) of an interval; slopes per interval."""
    rest = 1.0 - fraction
    straight = start + fraction * (end - start)
    bend = rest * (start_slope - (end - start)) - fraction * (end_slope - (end - start))
    curved: FloatArray = straight + fraction * rest * bend
    return curved


def _batches(runs: Iterable[RowSimulation]) -> list[list[RowSimulation]]:
    """Group the runs that one batch can step: equal array sizes, and all or none apply efforts."""
    groups: dict[tuple[object, ...], list[RowSimulation]] = {}
    for run in runs:
        m = run.model
        key = (
            m.nq, m.nv, m.nu, m.na, m.nactuator, m.nbody, m.njnt, m.ngeom, m.nsite, m.neq,
            m.ntendon, m.nsensordata, m.nhistory, m.nmocap, m.nuserdata, m.npluginstate,
            m.narena, run.applies_effort,
        )  # fmt: skip
        groups.setdefault(key, []).append(run)
    return list(groups.values())


def _step(runs: list[RowSimulation], threads: int, advance: Callable[[int], None]) -> None:
    model = runs[0].model
    batch = new_batch(model, len(runs), threads)
    if any(run.model is not model for run in runs):
        batch.set_models([run.model for run in runs])
    for name in _INITIAL:
        rows = batch.bind(name)
        for i, run in enumerate(runs):
            rows[i] = run.initial[name]
    spec, width = _STATE.mjSTATE_CTRL, model.nu
    if runs[0].applies_effort:
        spec, width = spec | _STATE.mjSTATE_QFRC_APPLIED, model.nu + model.nv
    records = ("qpos", "qvel", "qfrc_actuator", _TIME)
    arrays: dict[str | int, NDArray[np.float64]] = {}
    while active := [i for i, run in enumerate(runs) if run.step < run.steps]:
        remaining = [runs[i].steps - runs[i].step for i in active]
        longest = _BLOCK_BYTES // (8 * len(active) * (model.nq + 2 * model.nv + width))
        steps = max(_SHORTEST_BLOCK, min(_BLOCK_STEPS, longest, min(remaining)))
        shape = (len(active), steps)
        controls = np.empty((*shape, width))
        for at, i in enumerate(active):
            runs[i].controls(runs[i].step, runs[i].step + steps, controls[at])
        if not arrays or arrays["qpos"].shape[:2] != shape:
            arrays = {
                "qpos": np.empty((*shape, model.nq)),
                "qvel": np.empty((*shape, model.nv)),
                "qfrc_actuator": np.empty((*shape, model.nv)),
                _TIME: np.empty((*shape, 1)),
            }
        warned = batch.warning[active, :, 1].copy()
        try:
            batch.rollout(
                steps,
                controls,
                control_spec=int(spec),
                record=records,
                ids=active,
                out=arrays,
            )
        except BatchError as error:
            failed = {int(i) for i in error.ids}
        else:
            failed = set()
        for at, i in enumerate(active):
            run = runs[i]
            begin = run.step
            if i in failed:
                run.fail(f"MuJoCo stopped: {' '.join(batch.error(i).split())},", begin, None)
                continue
            effort = arrays["qfrc_actuator"][at]
            if run.applies_effort:
                effort = effort + controls[at, :, model.nu :]
            run.store(arrays["qpos"][at], arrays["qvel"][at], effort)
            risen = np.flatnonzero(batch.warning[i, :, 1] > warned[at])
            if risen.size:
                # MuJoCo repeats the last state of a row that warned, from the failed step on.
                repeats = np.diff(arrays[_TIME][at, :, 0], append=np.nan) == 0.0
                stopped = int(np.argmax(repeats)) if repeats.any() else steps - 1
                warning = int(risen[0])
                problem, joint = _warning_text(
                    run.model, warning, int(batch.warning[i, warning, 0])
                )
                run.fail(problem, begin + stopped, joint)
        advance(sum(min(steps, left) for left in remaining))


_WARNINGS = {
    mujoco.mjtWarning.mjWARN_INERTIA: "the inertia matrix became singular",
    mujoco.mjtWarning.mjWARN_CONTACTFULL: "more contacts than the model's arena holds",
    mujoco.mjtWarning.mjWARN_CNSTRFULL: "more constraints than the model's arena holds",
    mujoco.mjtWarning.mjWARN_BADQPOS: "the position diverged",
    mujoco.mjtWarning.mjWARN_BADQVEL: "the velocity diverged",
    mujoco.mjtWarning.mjWARN_BADQACC: "the acceleration diverged",
    mujoco.mjtWarning.mjWARN_BADCTRL: "a control is not finite",
}


def _warning_text(model: mujoco.MjModel, warning: int, index: int) -> tuple[str, str | None]:
    """Text of a MuJoCo warning, and the joint that it concerns, or None."""
    problem = _WARNINGS.get(mujoco.mjtWarning(warning), "MuJoCo warned")
    joint: int | None = None
    if warning == mujoco.mjtWarning.mjWARN_BADQPOS:
        joint = int(np.searchsorted(model.jnt_qposadr, index, side="right")) - 1
    elif warning in (
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
        mujoco.mjtWarning.mjWARN_INERTIA,
    ):
        joint = int(model.dof_jntid[index])
    if joint is None:
        return problem, None
    return problem, mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint)


def _variant_ids(
    realization: Realization, trial: Trial
) -> tuple[str | None, str | None, tuple[str, ...]]:
    """Controller and payload that a trial names, and notes on names that the twin does not declare.

    A twin that lists controllers (or payloads) must list the one that the trial names.
    """
    twin = realization.twin
    found: dict[str, str | None] = {"controller": None, "payload": None}
    notes = []
    for key in found:
        name = trial.metadata.get(key)
        if not name:
            continue
        declared = {} if twin is None else getattr(twin, f"{key}s")
        if declared:
            found[key] = name
        else:
            notes.append(
                f"{trial.path.name} names {key} {name!r}, which no twin.yaml declares: "
                "the nominal model was stepped"
            )
    return found["controller"], found["payload"], tuple(notes)
