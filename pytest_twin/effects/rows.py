"""Simulate segments of trials under effects: trials, perturbations and rivals as rows of one batch.

What MuJoCo has natively (damping, dry friction, armature, springs, masses, gravity, gains, force
ranges) is written into the rows' model fields and runs at the engine's speed; the rest acts between
steps on arrays of all rows.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch
from mujoco.batch import SimulationError as BatchError
from numpy.typing import NDArray

from pytest_twin.effects import catalogue
from pytest_twin.effects.base import Effect, FloatArray, ModelFields, Values, World, moving_apart
from pytest_twin.effects.contact_geoms import ContactGeoms, contact_geoms, least_time_constant
from pytest_twin.effects.link_inertia import link_inertia
from pytest_twin.effects.point_mass import with_point_mass
from pytest_twin.effects.roll_in import (
    LEAD,
    PATH_STEP,
    Hooks,
    act,
    follow,
    gears,
    roll_in,
    shift_motors,
)
from pytest_twin.realization.inputs import command_input
from pytest_twin.realization.lockstep import lockstep
from pytest_twin.realization.quiet import quiet

EffectValues = Mapping[str, Values]
"""Effect id -> parameter name -> (rows, joints) values."""

_MAX_ROWS = 384
_WORTH_THREADS = 64
# Poses of a segment that are asked for the inertia of its links, at most, and s between two.
_POSES, _POSE_SECONDS = 8, 0.2
OF_ROWS = (
    "time", "position", "velocity", "setpoint", "gain", "stiffness", "damping", "offset", "lower",
    "upper", "delivered", "friction_level", "applied", "load", "motor_armature", "motor_damping",
    "motor_constant", "link_inertia",
)  # fmt: skip
_LAW = ("gain", "stiffness", "damping", "offset")
_UNBOUNDED = 1e9
BETWEEN_STEPS = ("command", "servo", "drive", "friction", "force", "gear")


@dataclass(frozen=True, slots=True)
class Segment:
    """A stretch of a trial, simulated from its own initial state. Arrays in the model's frame.

    Attributes:
        trial: index of the trial.
        model: what to step, the trial's controller and payload applied.
        mode: ``position``, ``velocity`` or ``effort``: what is commanded.
        start: s on the trial's clock, where the simulation begins.
        time: (n,) s on the trial's clock, stamps of the samples.
        position: (n, joints) rad or m, measured.
        velocity, effort: (n, joints) or None.
        command_time: (m,) s on the trial's clock.
        command: (m, joints); NaN columns for joints that are not commanded.
        initial_position, initial_velocity: (joints,).
        history: where the start lies amid a motion, (m,) s on the trial's clock and (m, joints)
            positions and velocities of the whole trial, smoothed.
        motor_shift: (joints,) rad or m by which motors behind gears that give start elsewhere than
            where they would carry their links at rest, or where their windows' lead brought them.
    """

    trial: int
    model: mujoco.MjModel
    mode: str
    start: float
    time: FloatArray
    position: FloatArray
    velocity: FloatArray | None
    effort: FloatArray | None
    command_time: FloatArray
    command: FloatArray
    initial_position: FloatArray
    initial_velocity: FloatArray
    history: tuple[FloatArray, FloatArray, FloatArray] | None = None
    motor_shift: FloatArray | None = None

    @property
    def amid(self) -> bool:
        """Whether it starts amid a motion."""
        return self.history is not None

    def before(self, time: FloatArray) -> FloatArray:
        """Positions and velocities at (n,) s on the trial's clock, (2, n, joints); only
        :attr:`amid` a motion.
        """
        assert self.history is not None
        stamps, *known = self.history
        columns = [[np.interp(time, stamps, x) for x in of_joints.T] for of_joints in known]
        return np.moveaxis(np.array(columns), 1, 2)


@dataclass(frozen=True, slots=True)
class Predicted:
    """What a row's sensors would have read at its segment's stamps; NaN where it diverged.

    Attributes:
        position, velocity, effort: (n, joints), SI units.
    """

    position: FloatArray
    velocity: FloatArray
    effort: FloatArray


class RowSimulator:
    """Steps segments under effects.

    Args:
        segments: all of one layout of model and of the same joints.
        joints: hinges and slides, in the order of the segments' columns.
        threads: of the batch, 0 for all cores that the process may use.
        refine: substeps per model step, to measure the discretization.
    """

    def __init__(
        self,
        segments: Sequence[Segment],
        joints: Sequence[str],
        *,
        threads: int = 0,
        refine: int = 1,
    ) -> None:
        self.segments = list(segments)
        self.joints = tuple(joints)
        self.threads = threads or _cores()
        model = self.segments[0].model
        ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, j) for j in joints]
        self.joint_ids = np.array(ids)
        self.qpos_index = model.jnt_qposadr[self.joint_ids]
        self.dof_index = model.jnt_dofadr[self.joint_ids]
        self.body_index = model.jnt_bodyid[self.joint_ids]
        self.slides = model.jnt_type[self.joint_ids] == int(mujoco.mjtJoint.mjJNT_SLIDE)
        self.timestep = float(model.opt.timestep) / refine
        self.steps = np.array(
            [int(np.ceil((s.time[-1] - s.start) / self.timestep - 1e-6)) + 1 for s in segments]
        )
        self.fixed: EffectValues = {}
        """Effects under every row: parameters as (1, joints) arrays."""
        self._link_inertia: dict[int, tuple[FloatArray, FloatArray]] = {}
        self.stepped = 0
        """Rows times steps so far: what the engine alone would have had to step."""
        self._inputs(model)
        self._models: dict[int, mujoco.MjModel] = {}
        self._commands: dict[tuple[int, int], FloatArray] = {}
        self._areas: dict[int, tuple[FloatArray, FloatArray]] = {}
        self._contact: ContactGeoms | None = None
        self.directions = self._link_directions(model)
        driven = np.flatnonzero(self.actuator >= 0)
        gear = self.gear[driven]
        self._driven = self.actuator[driven], driven, gear < 0.0, gear

    def _inputs(self, model: mujoco.MjModel) -> None:
        count = len(self.joints)
        self.control = np.full(count, -1)
        self.actuator = np.full(count, -1)
        self.scale = np.ones(count)
        self.gear = np.ones(count)
        self.servo = np.full(count, "none", dtype="<U8")
        for j, joint in enumerate(self.joints):
            modes = {s.mode for s in self.segments if np.isfinite(s.command[:, j]).all()}
            if not modes:
                continue
            mode = modes.pop()
            target = command_input(model, joint, mode)  # type: ignore[arg-type]
            self.servo[j] = mode
            if target is not None:
                self.control[j], self.actuator[j] = target.control, target.actuator
                self.scale[j] = target.scale
                self.gear[j] = model.actuator_gear[model.actuator_outadr[target.actuator], 0]

    def _link_directions(self, model: mujoco.MjModel) -> FloatArray:
        """Unit vectors (joints, 3) from each joint to its link's centre of mass, link frame."""
        offset = model.body_ipos[self.body_index] - model.jnt_pos[self.joint_ids]
        length = np.linalg.norm(offset, axis=1, keepdims=True)
        self.link_length = np.maximum(length[:, 0], 1e-3)
        return np.where(length > 1e-6, offset / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])

    @property
    def contact(self) -> ContactGeoms:
        """What the robot touches, or nearly, in the segments as measured."""
        if self._contact is None:
            poses = [s.position for s in self.segments]
            self._contact = contact_geoms(self.segments[0].model, self.joint_ids, poses)
        return self._contact

    # -- commands

    def _mean_commands(
        self,
        rows: NDArray[np.int64],
        delay: FloatArray,
        steps: int,
        joints: NDArray[np.int64],
        timestep: float,
    ) -> FloatArray:
        """Mean over each step of the held command, (rows, steps, columns).

        Args:
            rows: segments; joints: (rows, columns) of them.
            delay: (rows, columns) s.
            steps: how many.
            timestep: s.
        """
        # Most rows ask for the same: each is worked out once.
        asked = np.stack([(rows[:, None] * len(self.joints) + joints).ravel(), delay.ravel()])
        unlike, of = np.unique(asked, axis=1, return_inverse=True)
        means = np.empty((unlike.shape[1], steps))
        for i, (which, late) in enumerate(unlike.T):
            segment, joint = divmod(int(which), len(self.joints))
            means[i] = self._mean_command(segment, joint, float(late), steps, timestep)
        return np.swapaxes(means[of.reshape(joints.shape)], 1, 2)

    def _mean_command(
        self, segment: int, joint: int, delay: float, steps: int, timestep: float
    ) -> FloatArray:
        kept = (segment, joint)
        prompt = delay == 0.0 and timestep == self.timestep
        if prompt and len(self._commands.get(kept, ())) >= steps:
            return self._commands[kept][:steps]
        s = self.segments[segment]
        at = s.start - delay + timestep * np.arange(steps + 1)
        far, area = self._command_area(segment)
        # Before the first stamp the first command holds.
        summed = np.interp(at, far, area[joint])
        summed += np.minimum(at - far[0], 0.0) * s.command[0, joint]
        mean: FloatArray = np.diff(summed) / timestep
        if prompt:
            self._commands[kept] = mean
        return mean

    def _command_area(self, segment: int) -> tuple[FloatArray, FloatArray]:
        """(stamps + 1,) s and (joints, stamps + 1) integral of the held command up to there."""
        if segment not in self._areas:
            s = self.segments[segment]
            far = np.append(s.command_time, s.command_time[-1] + 1e6)
            area = np.zeros((s.command.shape[1], len(far)))
            np.cumsum((np.diff(far)[:, None] * s.command).T, axis=1, out=area[:, 1:])
            self._areas[segment] = far, area
        return self._areas[segment]

    # -- models

    def _bounded(self, segment: int) -> mujoco.MjModel:
        """The segment's model with every force range in force, so that rows can narrow it."""
        key = id(self.segments[segment].model)
        if key not in self._models:
            model = copy.copy(self.segments[segment].model)
            free = model.actuator_forcelimited == 0
            model.actuator_forcelimited[free] = 1
            model.actuator_forcerange[free] = (-_UNBOUNDED, _UNBOUNDED)
            model.opt.timestep = self.timestep
            # MuJoCo's default friction constraint creeps under load (some 0.03 rad/s for half the
            # level on a small servo); dry friction holds. Stiff, it creeps 500 times less.
            model.dof_solref[self.dof_index] = (2.0 * self.timestep, 1.0)
            model.dof_solimp[self.dof_index, :3] = (0.999, 0.9999, 0.001)
            self._models[key] = model
        return self._models[key]

    # -- simulation

    def simulate(self, rows: NDArray[np.int64], values: EffectValues) -> list[Predicted]:
        """Simulate segment ``rows[i]`` under row ``i`` of ``values``, for every i."""
        values = with_fixed(values, self.fixed, len(rows))
        found: list[Predicted | None] = [None] * len(rows)
        stepwise = _between_steps(values, len(rows))
        order = np.lexsort((self.steps[rows], stepwise))
        begin = 0
        while begin < len(order):
            # Rows of like length step together; none waits for one more than a tenth longer, and
            # none that the engine steps alone waits for laws between steps.
            shortest, kind = self.steps[rows[order[begin]]], stepwise[order[begin]]
            end = begin
            while (
                end < len(order)
                and end - begin < _MAX_ROWS
                and stepwise[order[end]] == kind
                and self.steps[rows[order[end]]] <= 1.1 * shortest + 8
            ):
                end += 1
            chosen = order[begin:end]
            part = {e: {n: v[chosen] for n, v in vs.items()} for e, vs in values.items()}
            for i, predicted in zip(chosen, self._batch(rows[chosen], part), strict=True):
                found[i] = predicted
            begin = end
        return [p for p in found if p is not None]

    def _batch(self, rows: NDArray[np.int64], values: EffectValues) -> list[Predicted]:
        effects = _acting(values)
        return self._sample(rows, effects, *self._moved(rows, effects))

    def trajectories(
        self, rows: NDArray[np.int64], values: EffectValues
    ) -> tuple[FloatArray, FloatArray]:
        """True positions and velocities at every step, (rows, steps + 1, joints), one batch.

        A row that is shorter than the longest goes on under its last command.
        """
        q, v, _ = self._moved(rows, _acting(with_fixed(values, self.fixed, len(rows))))
        return q, v

    def _moved(
        self, rows: NDArray[np.int64], effects: list[tuple[Effect, Values]]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        steps = int(self.steps[rows].max())
        commands = self.commands(rows, effects, steps)
        self.stepped += len(rows) * steps
        with quiet():
            batch, world = self.batch(rows, effects)
            return self._step(batch, rows, world, effects, commands, steps)

    def batch(
        self, rows: NDArray[np.int64], effects: list[tuple[Effect, Values]]
    ) -> tuple[Batch, World]:
        """Rows with their model fields written, and the state and drives that they start from."""
        models = [self._bounded(int(r)) for r in rows]
        # Threads meet at every step that laws act between: few rows are sooner done alone.
        few = _any_hook(effects, *BETWEEN_STEPS) and len(rows) * models[0].nv < _WORTH_THREADS
        batch = Batch(models[0], len(rows), nthread=1 if few else self.threads)
        world = self.world(rows)
        for effect, parameters in reversed(effects):
            world.position, world.velocity = effect.unsense(
                world.position, world.velocity, parameters
            )
        world.time = world.time - self.behind(rows, effects, len(self.joints))[:, 0]
        self._write_fields(batch, rows, models, effects, world)
        return batch, world

    def link_inertia(self, rows: NDArray[np.int64]) -> FloatArray:
        """(rows, joints) the least inertia that links put against their gears along a segment,
        kg*m^2 or kg.
        """
        segments = [self.segments[r] for r in rows]
        # Segments that start elsewhere share what was measured, which is kept: so it stays its own.
        new = {id(s.position): s for s in segments if id(s.position) not in self._link_inertia}
        models = {id(s.model): s.model for s in new.values()}
        data = {key: mujoco.MjData(model) for key, model in models.items()}
        for key, s in new.items():
            apart = int(np.searchsorted(s.time, s.time[0] + _POSE_SECONDS))
            apart = max(apart, len(s.time) // _POSES, 1)
            least = link_inertia(
                data[id(s.model)], s.position[::apart], self.qpos_index, self.dof_index
            )
            self._link_inertia[key] = (s.position, least)
        return np.array([self._link_inertia[id(s.position)][1] for s in segments])

    def commands(
        self,
        rows: NDArray[np.int64],
        effects: Sequence[tuple[Effect, Values]],
        steps: int,
        joints: NDArray[np.int64] | None = None,
    ) -> FloatArray:
        """Mean over each step of the held command after every delay, (rows, steps, columns).

        Args:
            rows: segments.
            effects: values (rows, columns).
            steps: of the model.
            joints: (rows, columns) which; all of them, in their order, by default.
        """
        joints = self._columns(rows, joints)
        delay = self._late(rows, effects, joints.shape[1])
        return np.nan_to_num(self._mean_commands(rows, delay, steps, joints, self.timestep))

    def _late(
        self, rows: NDArray[np.int64], effects: Sequence[tuple[Effect, Values]], columns: int
    ) -> FloatArray:
        """How much later than it was sent a command reaches each row, (rows, columns) s."""
        late = self.behind(rows, effects, columns)
        for effect, v in effects:
            added = effect.command_delay(v)
            late = late if added is None else late + added
        return late

    def _columns(
        self, rows: NDArray[np.int64], joints: NDArray[np.int64] | None
    ) -> NDArray[np.int64]:
        return np.tile(np.arange(len(self.joints)), (len(rows), 1)) if joints is None else joints

    def roll_in(
        self,
        world: World,
        rows: NDArray[np.int64],
        effects: Sequence[tuple[Effect, Values]],
        joints: NDArray[np.int64] | None = None,
    ) -> None:
        """Let laws that remember live through what came before windows, as far as it is known.

        Args:
            world: rows at their start.
            rows: segments.
            effects: values (rows, columns).
            joints: (rows, columns) which; all of them, in their order, by default.
        """
        histories = [self.segments[r].history for r in rows]
        if not any(e.remembers for e, _ in effects) or any(h is None for h in histories):
            return
        joints = self._columns(rows, joints)
        steps = round(LEAD / world.timestep)
        before = -world.timestep * np.arange(steps, 0, -1)
        which, of = np.unique(rows, return_inverse=True)
        known = np.empty((2, len(which), len(self.joints), steps))
        for i, r in enumerate(which):
            segment = self.segments[r]
            known[:, i] = np.moveaxis(segment.before(segment.start + before), 1, 2)
        motion = np.ascontiguousarray(np.moveaxis(known[:, of[:, None], joints], -1, 1))
        late = self._late(rows, effects, joints.shape[1]) + LEAD
        command = np.moveaxis(self._mean_commands(rows, late, steps, joints, world.timestep), 1, 0)
        for effect, v in reversed(effects):
            if effect.overrides("unsense"):
                for k in range(steps):
                    motion[0, k], motion[1, k] = effect.unsense(motion[0, k], motion[1, k], v)
        far = [(e, v) for e, v in effects if e.remembers_path]
        if far:
            follow(world, far, self._paths(which)[:, of[:, None], joints])
        roll_in(world, hooks_between_steps(effects), motion[0], motion[1], np.nan_to_num(command))

    def _paths(self, rows: NDArray[np.int64]) -> FloatArray:
        """(steps, rows, joints) that joints went in each step before the lead of windows; nowhere
        before the trial began.
        """
        longest = max(self.segments[r].start for r in rows) - LEAD
        steps = max(0, int(np.ceil(longest / PATH_STEP)))
        out = np.zeros((steps, len(rows), len(self.joints)))
        for i, r in enumerate(rows):
            segment = self.segments[r]
            stamps = segment.start - LEAD - PATH_STEP * np.arange(steps, -1, -1)
            out[:, i] = np.diff(segment.before(stamps)[0], axis=0)
        return out

    def behind(
        self, rows: NDArray[np.int64], effects: Sequence[tuple[Effect, Values]], columns: int
    ) -> FloatArray:
        """How long before its stamp the state was that a window starts from, (rows, columns) s.

        A window begins with what was read amid a motion: where readings are late, so is its start,
        and commands reach it that much later. A whole trial begins at rest, and when it says.
        """
        start = np.array([self.segments[r].start for r in rows])[:, None, None]
        stamp = np.repeat(start, columns, axis=2)
        taken = stamp
        for effect, v in effects:
            taken = effect.sample_time(taken, v)
        window = np.array([self.segments[r].amid for r in rows])
        out: FloatArray = np.where(window[:, None], (stamp - taken)[:, 0], 0.0)
        return out

    def taken(
        self,
        rows: NDArray[np.int64],
        stamps: FloatArray,
        effects: Sequence[tuple[Effect, Values]],
    ) -> FloatArray:
        """When readings with (rows, n, joints) stamps were taken, on the clock of their motion."""
        for effect, v in effects:
            stamps = effect.sample_time(stamps, v)
        return stamps + self.behind(rows, effects, stamps.shape[2])[:, None]

    def world(self, rows: NDArray[np.int64]) -> World:
        """The rows' segments at their start, the drives as the model has them."""
        segments, of = np.unique(rows, return_inverse=True)
        models = [self._bounded(int(s)) for s in segments]
        count = (len(segments), len(self.joints))
        driven = self.actuator >= 0
        act, gear = self.actuator[driven], self.gear[driven]
        world = World(
            time=np.array([self.segments[r].start for r in segments]),
            timestep=self.timestep,
            position=np.array([self.segments[r].initial_position for r in segments]),
            velocity=np.array([self.segments[r].initial_velocity for r in segments]),
            setpoint=np.zeros(count),
            gain=np.zeros(count),
            stiffness=np.zeros(count),
            damping=np.zeros(count),
            offset=np.zeros(count),
            lower=np.full(count, -np.inf),
            upper=np.full(count, np.inf),
            servo=self.servo,
            delivered=np.zeros(count),
            friction_level=np.array([m.dof_frictionloss[self.dof_index] for m in models]),
            applied=np.zeros(count),
            load=np.zeros(count),
            motor_armature=np.zeros(count),
            motor_damping=np.zeros(count),
            motor_constant=np.zeros(count),
            link_inertia=np.full(count, np.inf),
        )
        bare = (self.servo == "effort") & ~driven
        world.gain[:, bare] = 1.0
        for i, m in enumerate(models):
            world.gain[i, driven] = m.actuator_gainprm[act, 0] * gear * self.scale[driven]
            if m.actuator_biastype[act].any():
                world.offset[i, driven] = m.actuator_biasprm[act, 0] * gear
                world.stiffness[i, driven] = -m.actuator_biasprm[act, 1] * gear**2
                world.damping[i, driven] = -m.actuator_biasprm[act, 2] * gear**2
            limits = m.actuator_forcerange[act] * gear[:, None]
            world.lower[i, driven], world.upper[i, driven] = limits.min(axis=1), limits.max(axis=1)
        for name in OF_ROWS:
            setattr(world, name, getattr(world, name)[of])
        return world

    def _write_fields(
        self,
        batch: Batch,
        rows: NDArray[np.int64],
        models: list[mujoco.MjModel],
        effects: list[tuple[Effect, Values]],
        world: World,
    ) -> None:
        count = (len(rows), len(self.joints))
        several = len({id(m) for m in models}) > 1
        gravity = np.array([m.opt.gravity for m in models])
        fields = ModelFields.neutral(gravity.copy(), count[1])
        for effect, v in effects:
            effect.fields(fields, v)
        before = tuple(getattr(world, name).copy() for name in _LAW)
        bounds = (world.lower.copy(), world.upper.copy())
        for effect, v in effects:
            effect.gains(world, v)
        soft = moving_apart(effects, count)

        def expand(name: str) -> FloatArray:
            array: FloatArray = batch.expand(name)
            (array[:],) = _of_each(models, name)
            return array

        if several:
            for name in ("body_mass", "body_ipos", "body_inertia", "body_iquat"):
                expand(name)
        dof, driven = self.dof_index, self.actuator >= 0
        act = self.actuator[driven]
        for name, change in (
            ("dof_damping", fields.damping),
            ("dof_armature", fields.armature),
            ("dof_frictionloss", fields.friction),
        ):
            moving = name == "dof_frictionloss" and _any_hook(effects, "friction")
            if several or change.any() or moving or soft.any():
                expand(name)[:, dof] += change
        self._friction = (
            batch.expand("dof_frictionloss") if _any_hook(effects, "friction") else None
        )
        if batch.expanded("dof_frictionloss") is not None:
            levels = batch.expand("dof_frictionloss")
            np.maximum(levels, 0.0, out=levels)
            world.friction_level = levels[:, dof].copy()
        if soft.any():
            # What sits on the motor side leaves the link; laws between steps carry it.
            world.motor_armature = batch.expand("dof_armature")[:, dof]
            world.motor_damping = batch.expand("dof_damping")[:, dof]
            world.link_inertia = self.link_inertia(rows)
            for name in ("dof_damping", "dof_armature", "dof_frictionloss"):
                array = batch.expand(name)
                array[:, dof] = np.where(soft, 0.0, array[:, dof])
        self._soft = soft
        if fields.stiffness.any():
            expand("jnt_stiffness")[:, self.joint_ids] += fields.stiffness
        if (fields.gravity != gravity).any() or several:
            batch.expand("opt.gravity")[:] = fields.gravity
        if fields.added_mass.any() or (fields.inertia_scale != 1.0).any():
            self._write_inertia(batch, models, fields)
        gains_changed = (
            several
            or soft.any()
            or any((a != getattr(world, name)).any() for a, name in zip(before, _LAW, strict=True))
        )
        if gains_changed and driven.any():
            gear = self.gear[driven]
            gain = expand("actuator_gainprm")
            bias = expand("actuator_biasprm")
            rigid = ~soft[:, driven]
            gain[:, act, 0] = rigid * world.gain[:, driven] / (gear * self.scale[driven])
            bias[:, act, 0] = rigid * world.offset[:, driven] / gear
            bias[:, act, 1] = rigid * -world.stiffness[:, driven] / gear**2
            bias[:, act, 2] = rigid * -world.damping[:, driven] / gear**2
        moving = _any_hook(effects, "servo")
        bounds_changed = (bounds[0] != world.lower).any() or (bounds[1] != world.upper).any()
        self._range = None
        if (several or moving or bounds_changed) and driven.any():
            self._range = expand("actuator_forcerange")
            self._write_bounds(world)
        self._constant, world.motor_constant = fields.split_force(soft)
        if any(effect.family == "contact" for effect, _ in effects):
            self.contact.write(expand, fields, least_time_constant(models[0], self.timestep))
        # A geom that moves takes its frame and its body's bounding volume along.
        changed = ("body_mass", "geom_pos")
        if several or fields.armature.any() or any(batch.expanded(n) is not None for n in changed):
            batch.set_const()

    def _write_bounds(self, world: World) -> None:
        assert self._range is not None
        act, columns, reverse, gear = self._driven
        low, high = world.lower[:, columns] / gear, world.upper[:, columns] / gear
        if reverse.any():
            low, high = np.where(reverse, high, low), np.where(reverse, low, high)
        self._range[:, act, 0] = np.maximum(low, -_UNBOUNDED)
        self._range[:, act, 1] = np.minimum(high, _UNBOUNDED)

    def _write_inertia(
        self, batch: Batch, models: list[mujoco.MjModel], fields: ModelFields
    ) -> None:
        mass, ipos = batch.expand("body_mass"), batch.expand("body_ipos")
        inertia = batch.expand("body_inertia")
        iquat = batch.expand("body_iquat")
        mass[:], ipos[:], inertia[:], iquat[:], joints = _of_each(
            models, "body_mass", "body_ipos", "body_inertia", "body_iquat", "jnt_pos"
        )
        bodies = self.body_index
        mass[:, bodies] *= fields.inertia_scale
        inertia[:, bodies] *= fields.inertia_scale[:, :, None]
        row, joint = np.nonzero(fields.added_mass)
        if not len(row):
            return
        here = (row, bodies[joint])
        at = joints[row, self.joint_ids[joint]]
        at = at + fields.added_distance[row, joint, None] * self.directions[joint]
        mass[here], ipos[here], inertia[here], iquat[here] = with_point_mass(
            mass[here], ipos[here], inertia[here], iquat[here], fields.added_mass[row, joint], at
        )

    def _step(
        self,
        batch: Batch,
        rows: NDArray[np.int64],
        world: World,
        effects: list[tuple[Effect, Values]],
        commands: FloatArray,
        steps: int,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        count, joints = len(rows), len(self.joints)
        at_qpos, at_dof = _span(self.qpos_index), _span(self.dof_index)
        qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
        ctrl, applied = batch.bind("ctrl"), batch.bind("qfrc_applied")
        qpos[:, at_qpos], qvel[:, at_dof] = world.position, world.velocity
        applied[:, at_dof] = self._constant
        driven = np.flatnonzero(self.actuator >= 0)
        bare = (self.servo == "effort") & (self.actuator < 0)
        control, scale = _span(self.control[driven]), self.scale[driven]
        at_driven = _span(driven)
        # Steps first: one step of all rows lies together.
        q, v = np.empty((2, steps + 1, count, joints))
        effort = np.zeros((steps + 1, count, joints))
        hooks = hooks_between_steps(effects)
        if not any(hooks.values()) and not bare.any():
            inputs = np.zeros((count, steps, ctrl.shape[1]))
            inputs[:] = ctrl[:, None]
            inputs[:, :, control] = commands[:, :, at_driven] * scale
            q[0], v[0] = world.position, world.velocity
            try:
                out = batch.rollout(steps, inputs, record=("qpos", "qvel", "qfrc_actuator"))
            except BatchError:
                q[1:], v[1:] = np.nan, np.nan
            else:
                q[1:] = out["qpos"][:, :, at_qpos].swapaxes(0, 1)
                v[1:] = out["qvel"][:, :, at_dof].swapaxes(0, 1)
                effort[:-1] = out["qfrc_actuator"][:, :, at_dof].swapaxes(0, 1)
                effort[-1] = effort[-2]
            return self._by_row(batch, q, v, effort)
        bias = batch.bind("qfrc_bias")
        actuator_force = batch.bind("qfrc_actuator")
        batch.forward()
        level = world.friction_level
        start = world.time
        loaded = bool(hooks["friction"] or hooks["gear"])
        if loaded:
            world.load = bias[:, at_dof]
        self.roll_in(world, rows, effects)
        self._shift_motors(world, rows, hooks)
        commanded = np.ascontiguousarray(commands.swapaxes(0, 1))
        pushed = np.empty((count, joints))
        # Friction may depend on what the motor puts through its gear.
        asked = bool(hooks["drive"] or hooks["friction"])
        by_hand = bare.any()

        def before(k: int) -> None:
            world.time = start + k * self.timestep
            q[k], v[k] = qpos[:, at_qpos], qvel[:, at_dof]
            world.position, world.velocity = q[k], v[k]
            if k:
                effort[k - 1] += actuator_force[:, at_dof]
            world.setpoint = commanded[k]
            pushed[:] = self._constant
            world.applied = pushed
            if loaded:
                world.friction_level = level
                world.load = bias[:, at_dof]
            bounds = world.lower, world.upper
            native = act(world, hooks, drives=asked)
            if hooks["servo"]:
                if self._range is not None:
                    self._write_bounds(world)
                world.lower, world.upper = bounds
            if hooks["friction"]:
                assert self._friction is not None
                self._friction[:, at_dof] = np.where(
                    self._soft, 0.0, np.maximum(world.friction_level, 0.0)
                )
            if hooks["drive"] or hooks["gear"]:
                # A rigid joint's engine gives what the law asks for; a motor apart has no engine.
                added = world.delivered - native
                world.applied += np.where(self._soft, 0.0, added)
                effort[k] = np.where(self._soft, world.delivered, added)
            if by_hand:
                by_command = np.where(self._soft, 0.0, world.setpoint)[:, bare]
                world.applied[:, bare] += by_command
                effort[k][:, bare] += by_command
            applied[:, at_dof] = world.applied
            ctrl[:, control] = world.setpoint[:, at_driven] * scale

        lockstep(batch, steps, before)
        q[steps], v[steps] = qpos[:, at_qpos], qvel[:, at_dof]
        effort[steps - 1] += actuator_force[:, at_dof]
        effort[steps] = effort[steps - 1]
        return self._by_row(batch, q, v, effort)

    def _shift_motors(self, world: World, rows: NDArray[np.int64], hooks: Hooks) -> None:
        shifts = [self.segments[r].motor_shift for r in rows]
        if hooks["gear"] and any(s is not None for s in shifts):
            none = np.zeros(len(self.joints))
            shift = np.array([none if s is None else s for s in shifts])
            shift_motors(world, hooks["gear"], shift)

    def gear_stretch(
        self, rows: NDArray[np.int64], values: EffectValues, load: FloatArray
    ) -> FloatArray:
        """(rows, joints) how far (joints,) loads stretch gears that give, with half their play, rad
        or m; 0 where none gives.
        """
        effects = _acting(with_fixed(values, self.fixed, len(rows)))
        geared = hooks_between_steps(effects)["gear"]
        if not geared:
            return np.zeros((len(rows), len(self.joints)))
        with quiet():
            gear = gears(self.batch(rows, effects)[1], geared)
        return np.where(gear.apart, gear.stretch(load), 0.0)

    @staticmethod
    def _by_row(
        batch: Batch, q: FloatArray, v: FloatArray, effort: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Steps first to rows first; NaN where a row diverged."""
        failed = batch.warning[:, :, 1].any(axis=1)
        for array in (q, v, effort):
            array[:, failed] = np.nan
        return q.swapaxes(0, 1), v.swapaxes(0, 1), effort.swapaxes(0, 1)

    def _sample(
        self,
        rows: NDArray[np.int64],
        effects: list[tuple[Effect, Values]],
        q: FloatArray,
        v: FloatArray,
        effort: FloatArray,
    ) -> list[Predicted]:
        dt, joints = self.timestep, len(self.joints)
        longest = max(len(self.segments[r].time) for r in rows)
        stamps = np.empty((len(rows), longest, joints))
        for i, r in enumerate(rows):
            time = self.segments[r].time
            stamps[i, : len(time)] = time[:, None]
            stamps[i, len(time) :] = time[-1]
        stamps = self.taken(rows, stamps, effects)
        start = np.array([self.segments[r].start for r in rows])[:, None, None]
        at = np.clip((stamps - start) / dt, 0.0, q.shape[1] - 1 - 1e-9)
        index = at.astype(np.int64)
        part = at - index
        before_q, after_q = (np.take_along_axis(q, index + d, axis=1) for d in (0, 1))
        before_v, after_v = (np.take_along_axis(v, index + d, axis=1) for d in (0, 1))
        rest = 1.0 - part
        step = after_q - before_q
        bend = rest * (dt * before_v - step) - part * (dt * after_v - step)
        position = before_q + part * step + part * rest * bend
        velocity = before_v + part * (after_v - before_v)
        sampled = np.take_along_axis(effort, index, axis=1)
        for effect, p in effects:
            position, velocity = effect.sense(stamps, position, velocity, p)
            sampled = effect.sense_effort(sampled, p)
        return [
            Predicted(
                position[i, : len(self.segments[r].time)],
                velocity[i, : len(self.segments[r].time)],
                sampled[i, : len(self.segments[r].time)],
            )
            for i, r in enumerate(rows)
        ]


def _of_each(models: Sequence[mujoco.MjModel], *names: str) -> list[FloatArray]:
    """(rows, ...) fields of each row's model, read once of every model."""
    distinct = {id(m): m for m in models}
    number = {key: i for i, key in enumerate(distinct)}
    index = [number[id(m)] for m in models]
    return [np.array([getattr(m, name) for m in distinct.values()])[index] for name in names]


def _span(index: NDArray[np.int64]) -> slice | NDArray[np.int64]:
    """The same elements as a slice, where they lie side by side: views cost nothing."""
    if len(index) and (np.diff(index) == 1).all():
        return slice(int(index[0]), int(index[-1]) + 1)
    return index


def _cores() -> int:
    """Cores that the process may use; 0, all of them, where the system cannot tell."""
    allowed = getattr(os, "sched_getaffinity", None)
    return 0 if allowed is None else len(allowed(0))


def with_fixed(values: EffectValues, fixed: EffectValues, rows: int) -> EffectValues:
    """Rows' effects on top of fixed ones: switches add, a shape that is fixed stays."""
    if not fixed:
        return values
    out = {e: dict(v) for e, v in values.items()}
    for effect, own in fixed.items():
        if effect not in out:
            out[effect] = {n: np.repeat(v, rows, axis=0) for n, v in own.items()}
            continue
        parameters = catalogue()[effect].parameters
        acts = there(catalogue()[effect], own)
        for p in parameters:
            theirs = out[effect][p.name]
            if p.neutral is not None:
                out[effect][p.name] = theirs + own[p.name] - p.neutral
            else:
                out[effect][p.name] = np.where(acts, own[p.name], theirs)
    return out


def hooks_between_steps(
    effects: Sequence[tuple[Effect, Values]],
) -> dict[str, list[tuple[Effect, Values]]]:
    """Hook -> the effects that have it, in their order."""
    return {h: [(e, v) for e, v in effects if e.overrides(h)] for h in BETWEEN_STEPS}


def _between_steps(values: EffectValues, count: int) -> NDArray[np.bool_]:
    """(rows,) whether a row has an effect that acts between steps."""
    found = np.zeros(count, dtype=bool)
    for name, v in values.items():
        effect = catalogue()[name]
        if effect.overrides(*BETWEEN_STEPS):
            found |= there(effect, v).any(axis=1)
    return found


def _any_hook(effects: Sequence[tuple[Effect, Values]], *hooks: str) -> bool:
    return any(effect.overrides(*hooks) for effect, _ in effects)


def _acting(values: EffectValues) -> list[tuple[Effect, Values]]:
    """The effects that some row has."""
    effects = [(catalogue()[e], v) for e, v in values.items()]
    return [(effect, v) for effect, v in effects if there(effect, v).any()]


def there(effect: Effect, values: Values) -> NDArray[np.bool_]:
    """(rows, joints) where an effect acts: a switch that is not neutral."""
    switches = [p for p in effect.parameters if p.neutral is not None]
    found: NDArray[np.bool_] = np.any([values[p.name] != p.neutral for p in switches], axis=0)
    return found
