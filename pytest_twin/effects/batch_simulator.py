"""Simulate segments of trials under effects; each simulation is a row of one batch.

Effects that MuJoCo has natively are written into the model fields of each row and run at the
engine's speed: damping, dry friction, armature, springs, masses, gravity, gains, force ranges. All
other effects act between steps, on arrays of all rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.active_effects import (
    ActiveEffects,
    EffectValues,
    active_effects,
    acts_at,
    acts_between_steps,
    add_fixed_effects,
    hooks_between_steps,
)
from pytest_twin.effects.base import Effect, Values, World
from pytest_twin.effects.batch_division import Part, divide_rows, is_worth_forking
from pytest_twin.effects.batch_models import BatchModels, PreparedBatch
from pytest_twin.effects.commands_over_steps import CommandsOverSteps
from pytest_twin.effects.layout import Layout, as_slice
from pytest_twin.effects.memory_warmup import (
    PATH_TIMESTEP,
    WARM_UP_TIME,
    Hooks,
    build_transmission,
    run_hooks,
    shift_motors,
    update_fading_memories,
    warm_up,
)
from pytest_twin.effects.sampling import (
    age_of_initial_state,
    predicted_readings,
    true_reading_times,
)
from pytest_twin.effects.segment import Predicted, Segment
from pytest_twin.effects.simulation_cache import SimulationCache, row_keys
from pytest_twin.realization.driven_base import BaseCourse
from pytest_twin.realization.engine import BatchError
from pytest_twin.realization.executor import Forks
from pytest_twin.realization.forks import free_cores, threads_here, usable_cores
from pytest_twin.realization.lockstep import lockstep
from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings

Result = TypeVar("Result")
Motion = tuple[FloatArray, FloatArray, FloatArray]
"""(steps + 1, rows, joints) positions, velocities and efforts."""


@dataclass(slots=True)
class _StepCount:
    """Number of simulated steps, and of those that came from the cache."""

    simulated_steps: int = 0
    cached_steps: int = 0


@dataclass(frozen=True, slots=True)
class _BaseForces:
    """Forces that move floating bases along their recorded poses.

    Attributes:
        dof: degrees of freedom of the base.
        at_steps: (steps, rows, 6) N and N*m.
    """

    dof: slice
    at_steps: FloatArray


class BatchSimulator:
    """Simulates segments of trials under effects.

    Args:
        segments: pieces of trials; their models have the same layout and the same joints.
        joints: names of hinges and slides, in the order of the segments' columns.
        threads: number of threads, or of processes instead; 0 for all cores that the process may
            use.
        refine: substeps per model step, to measure the discretization error.
        fixed: effects that act in every row: parameters as (1, joints) arrays.
    """

    def __init__(
        self,
        segments: Sequence[Segment],
        joints: Sequence[str],
        *,
        threads: int = 0,
        refine: int = 1,
        fixed: EffectValues | None = None,
    ) -> None:
        self.segments = list(segments)
        self.joints = tuple(joints)
        self.threads = threads or usable_cores()
        model = self.segments[0].model
        self.layout = Layout(model, self.segments, joints)
        self.refine = refine
        self.timestep = float(model.opt.timestep) / refine
        self.models = BatchModels(self.segments, self.layout, self.timestep)
        self.steps = np.array(
            [int(np.ceil((s.time[-1] - s.start) / self.timestep - 1e-6)) + 1 for s in segments]
        )
        self.fixed: EffectValues = fixed or {}
        self._count = _StepCount()
        self._cache = SimulationCache()
        self._courses: dict[tuple[int, float, int], BaseCourse] = {}
        idle = np.array([self._holding_commands(s) for s in self.segments])
        followable = self.models.command_range(np.arange(len(self.segments)))
        self._commands = CommandsOverSteps(self.segments, self.timestep, idle, *followable)

    @property
    def simulated_steps(self) -> int:
        """Simulated steps of all rows so far, those from the cache included."""
        return self._count.simulated_steps

    @property
    def cached_steps(self) -> int:
        """Steps of :attr:`simulated_steps` that came from the cache."""
        return self._count.cached_steps

    def with_motor_shifts(self, shifts: Mapping[int, FloatArray]) -> BatchSimulator:
        """The same simulator with other initial motor positions; cache and counts are shared.

        Args:
            shifts: segment -> (joints,) shift, rad or m, as in :class:`Segment`; the motors of
                other segments are not shifted.
        """
        other = copy(self)
        other.segments = [
            s if s.motor_shift is shifts.get(i) else replace(s, motor_shift=shifts.get(i))
            for i, s in enumerate(self.segments)
        ]
        return other

    def _holding_commands(self, segment: Segment) -> FloatArray:
        """(joints,) commands that hold position servos without recorded commands; 0 elsewhere."""
        servo = (self.layout.servo == "position") & (self.layout.control >= 0)
        if segment.unrecorded is None:
            return np.zeros(len(self.joints))
        control = segment.unrecorded.control[self.layout.control]
        return np.where(servo, control / self.layout.scale, 0.0)

    def simulate(self, rows: NDArray[np.int64], values: EffectValues) -> list[Predicted]:
        """Simulate segment ``rows[i]`` under row ``i`` of ``values``, for every i.

        Rows that were simulated before are read from the cache; :attr:`simulated_steps` counts them
        too.

        Args:
            rows: (rows,) index of each row's segment.
            values: effects; parameters as (rows, joints) arrays in SI units.

        Returns:
            The sensor readings of each row at the stamps of its segment; NaN if it diverged.
        """
        values = add_fixed_effects(values, self.fixed, len(rows))
        keys = row_keys([self.segments[r] for r in rows], values)
        found = {key: self._cache.get(key) for key in keys}
        first = {key: i for i, key in reversed(list(enumerate(keys)))}
        new = np.array(sorted(first[k] for k, known in found.items() if known is None), dtype=int)
        steps = self.steps[rows]
        self._count.simulated_steps += int(steps.sum())
        self._count.cached_steps += int(steps.sum() - steps[new].sum())
        if new.size:
            some = {e: {n: v[new] for n, v in vs.items()} for e, vs in values.items()}
            for i, predicted in zip(new, self._simulate_new(rows[new], some), strict=True):
                segment = self.segments[rows[i]]
                found[keys[i]] = self._cache.store(keys[i], segment, predicted)
        return [p for key in keys if (p := found[key]) is not None]

    def _simulate_new(self, rows: NDArray[np.int64], values: EffectValues) -> list[Predicted]:
        """Sensor readings of rows that are not in the cache; ``values`` has the fixed effects."""
        return self._map_rows(rows, values, self._read)

    def _read(
        self, segments: Sequence[Segment], effects: ActiveEffects, motion: Motion
    ) -> list[Predicted]:
        return predicted_readings(segments, effects, motion, self.timestep)

    def _map_rows(
        self,
        rows: NDArray[np.int64],
        values: EffectValues,
        read: Callable[[Sequence[Segment], ActiveEffects, Motion], list[Result]],
    ) -> list[Result]:
        """One result for each row's motion; rows with the same laws share a batch and a core.

        Args:
            rows: (rows,) index of each row's segment.
            values: effects, the fixed ones included.
            read: segments, effects and motion -> one result for each segment.
        """
        laws = acts_between_steps(values, len(rows))
        cores = free_cores(self.threads)
        divided = divide_rows(self.steps[rows], laws, len(self.joints), cores)

        def work(part: Part) -> list[Result]:
            of_part = rows[part.rows]
            effects = active_effects(
                {e: {n: v[part.rows] for n, v in vs.items()} for e, vs in values.items()}
            )
            return read(
                [self.segments[r] for r in of_part],
                effects,
                self._simulate_motion(of_part, effects),
            )

        if not is_worth_forking(divided):
            cores = 1
        if cores > 1:
            self.models.precompute(rows, active_effects(values))
        results_of_parts = Forks(cores).map(work, divided)
        found: dict[int, Result] = {}
        for part, results in zip(divided, results_of_parts, strict=True):
            found.update(zip(part.rows.tolist(), results, strict=True))
        return [found[i] for i in range(len(rows))]

    def trajectories(
        self, rows: NDArray[np.int64], values: EffectValues
    ) -> tuple[FloatArray, FloatArray]:
        """Simulated positions and velocities at every step, without sensor effects.

        A row that is shorter than the longest one continues under its last command.

        Returns:
            Positions (rad or m) and velocities (rad/s or m/s), both (rows, steps + 1, joints).
        """
        effects = active_effects(add_fixed_effects(values, self.fixed, len(rows)))
        q, v, _ = self._simulate_motion(rows, effects)
        self.count(rows)
        return q, v

    def trajectories_with_readings(
        self, rows: NDArray[np.int64], values: EffectValues
    ) -> tuple[FloatArray, FloatArray, list[Predicted]]:
        """As :meth:`trajectories`, with the sensor readings of each row."""
        effects = active_effects(add_fixed_effects(values, self.fixed, len(rows)))
        motion = self._simulate_motion(rows, effects)
        self.count(rows)
        segments = [self.segments[r] for r in rows]
        return motion[0], motion[1], predicted_readings(segments, effects, motion, self.timestep)

    def efforts_at_neighbouring_steps(
        self, rows: NDArray[np.int64], values: EffectValues
    ) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        """Effort sensor readings of each row at its stamps, one step earlier, and one step later.

        Each is (stamps, joints), N m or N.
        """
        self.count(rows)
        return self._map_rows(
            rows, add_fixed_effects(values, self.fixed, len(rows)), self._read_at_neighbouring_steps
        )

    def _read_at_neighbouring_steps(
        self, segments: Sequence[Segment], effects: ActiveEffects, motion: Motion
    ) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        q, v, effort = motion
        earlier = np.concatenate([effort[:, :1], effort[:, :-1]], axis=1)
        later = np.concatenate([effort[:, 1:], effort[:, -1:]], axis=1)
        here, before, after = (
            self._read(segments, effects, (q, v, e)) for e in (effort, earlier, later)
        )
        return [(a.effort, b.effort, c.effort) for a, b, c in zip(here, before, after, strict=True)]

    def transmission_deflection(
        self, rows: NDArray[np.int64], values: EffectValues, load: FloatArray
    ) -> FloatArray:
        """(rows, joints) deflection of elastic transmissions under ``load``, rad or m.

        Half the backlash is included. It is 0 where the transmission is rigid.

        Args:
            rows: (rows,) index of each row's segment.
            load: (joints,) effort, N m or N.
        """
        effects = active_effects(add_fixed_effects(values, self.fixed, len(rows)))
        gear_effects = hooks_between_steps(effects)["gear"]
        if not gear_effects:
            return np.zeros((len(rows), len(self.joints)))
        with suppress_mujoco_warnings():
            gear = build_transmission(self.prepare_batch(rows, effects).world, gear_effects)
        return np.where(gear.is_elastic, gear.deflection(load), 0.0)

    def prepare_batch(
        self, rows: NDArray[np.int64], effects: Sequence[tuple[Effect, Values]]
    ) -> PreparedBatch:
        """A batch of rows: model fields with the effects, initial states and drives."""
        return self.models.prepare(rows, effects, threads_here(self.threads))

    def count(self, rows: NDArray[np.int64], *, repeated: bool = False) -> None:
        """Count the steps of rows as simulated, and on request as cached."""
        steps = int(self.steps[rows].sum())
        self._count.simulated_steps += steps
        if repeated:
            self._count.cached_steps += steps

    def commands(
        self,
        rows: NDArray[np.int64],
        effects: Sequence[tuple[Effect, Values]],
        steps: int,
        joints: NDArray[np.int64] | None = None,
    ) -> FloatArray:
        """Mean over each step of the zero-order-held command, after all delays.

        Args:
            rows: (rows,) index of each row's segment.
            effects: effects with (rows, columns) values.
            steps: number of model steps.
            joints: (rows, columns) joint of each column; all joints in their order by default.

        Returns:
            (rows, steps, columns), in the unit of each command.
        """
        joints = self._columns(rows, joints)
        delay = self._command_delay(rows, effects, joints.shape[1])
        return self._commands.means(rows, delay, steps, joints, self.timestep)

    def true_reading_times(
        self,
        rows: NDArray[np.int64],
        stamps: FloatArray,
        effects: Sequence[tuple[Effect, Values]],
    ) -> FloatArray:
        """(rows, n, joints) true times of readings with the given stamps, s."""
        return true_reading_times([self.segments[r] for r in rows], stamps, effects)

    def warm_up(
        self,
        world: World,
        rows: NDArray[np.int64],
        effects: Sequence[tuple[Effect, Values]],
        joints: NDArray[np.int64] | None = None,
    ) -> None:
        """Bring the memory of effects up to date with the recorded motion before the windows.

        Args:
            world: rows at their initial state; its memory is changed.
            rows: (rows,) index of each row's segment.
            effects: effects with (rows, columns) values.
            joints: (rows, columns) joint of each column; all joints in their order by default.
        """
        histories = [self.segments[r].history for r in rows]
        if not any(e.remembers for e, _ in effects) or any(h is None for h in histories):
            return
        joints = self._columns(rows, joints)
        steps = round(WARM_UP_TIME / world.timestep)
        before = -world.timestep * np.arange(steps, 0, -1)
        which, of = np.unique(rows, return_inverse=True)
        known = np.empty((2, len(which), len(self.joints), steps))
        for i, r in enumerate(which):
            segment = self.segments[r]
            known[:, i] = np.moveaxis(segment.state_before(segment.start + before), 1, 2)
        motion = np.ascontiguousarray(np.moveaxis(known[:, of[:, None], joints], -1, 1))
        delay = self._command_delay(rows, effects, joints.shape[1]) + WARM_UP_TIME
        until = np.array([self.segments[r].start for r in rows])[:, None] - delay
        for effect, v in effects:
            effect.follow_commands(world, v, self._commands.commands_before(rows, joints, until))
        command = np.moveaxis(
            self._commands.means(rows, delay, steps, joints, world.timestep), 1, 0
        )
        for effect, v in reversed(effects):
            if effect.overrides("unsense"):
                affected = np.flatnonzero(acts_at(effect, v).any(axis=1))
                values = {n: np.tile(x[affected], (steps, 1)) for n, x in v.items()}
                read = motion[:, :, affected].reshape(2, -1, joints.shape[1])
                true = np.array(effect.unsense(read[0], read[1], values))
                motion[:, :, affected] = true.reshape(2, steps, len(affected), -1)
        fading = [(e, v) for e, v in effects if e.remembers_path]
        if fading:
            update_fading_memories(
                world, fading, self._displacements(which)[:, of[:, None], joints]
            )
        warm_up(world, hooks_between_steps(effects), motion[0], motion[1], command)

    def _columns(
        self, rows: NDArray[np.int64], joints: NDArray[np.int64] | None
    ) -> NDArray[np.int64]:
        return np.tile(np.arange(len(self.joints)), (len(rows), 1)) if joints is None else joints

    def _command_delay(
        self, rows: NDArray[np.int64], effects: Sequence[tuple[Effect, Values]], columns: int
    ) -> FloatArray:
        """(rows, columns) delay between sending a command and its action on the drive, s."""
        delay = age_of_initial_state([self.segments[r] for r in rows], effects, columns)
        for effect, v in effects:
            added = effect.command_latency(v)
            delay = delay if added is None else delay + added
        return delay

    def _displacements(self, rows: NDArray[np.int64]) -> FloatArray:
        """(steps, rows, joints) displacement in each step before the warm-up, rad or m.

        It is zero before the start of the trial.
        """
        longest = max(self.segments[r].start for r in rows) - WARM_UP_TIME
        steps = max(0, int(np.ceil(longest / PATH_TIMESTEP)))
        out = np.zeros((steps, len(rows), len(self.joints)))
        for i, r in enumerate(rows):
            segment = self.segments[r]
            stamps = segment.start - WARM_UP_TIME - PATH_TIMESTEP * np.arange(steps, -1, -1)
            out[:, i] = np.diff(segment.state_before(stamps)[0], axis=0)
        return out

    def _simulate_motion(
        self, rows: NDArray[np.int64], effects: Sequence[tuple[Effect, Values]]
    ) -> Motion:
        """Motion of rows, (rows, steps + 1, joints) each; NaN in rows that diverged."""
        steps = int(self.steps[rows].max())
        commands = self.commands(rows, effects, steps)
        hooks = hooks_between_steps(effects)
        added = self._forces_at_steps(rows, steps)
        with suppress_mujoco_warnings():
            prepared = self.prepare_batch(rows, effects)
            base = self._drive_base(prepared, rows, steps)
            if any(hooks.values()) or self.layout.is_unactuated.any() or added is not None:
                self._set_initial_state(prepared, rows, effects, hooks)
                motion = self._step_through(prepared, hooks, commands, added, base)
            else:
                motion = self._roll_out(prepared, commands, base)
        failed = prepared.batch.warning[:, :, 1].any(axis=1)
        for array in motion:
            array[:, failed] = np.nan
        q, v, effort = (array.swapaxes(0, 1) for array in motion)
        return q, v, effort

    def _forces_at_steps(self, rows: NDArray[np.int64], steps: int) -> FloatArray | None:
        """(steps, rows, joints) forces that segments add at each step; None if none does."""
        segments = [self.segments[r] for r in rows]
        if all(s.added_force is None for s in segments):
            return None
        out = np.zeros((steps, len(rows), len(self.joints)))
        for i, segment in enumerate(segments):
            if segment.added_force is not None:
                stamps, forces = segment.added_force
                time = segment.start + self.timestep * np.arange(steps)
                for j, force in enumerate(forces.T):
                    out[:, i, j] = np.interp(time, stamps, force)
        return out

    def _drive_base(
        self, prepared: PreparedBatch, rows: NDArray[np.int64], steps: int
    ) -> _BaseForces | None:
        """Put floating bases at their recorded poses; None if no pose was recorded."""
        bases = [self.segments[r].base for r in rows]
        if all(base is None for base in bases):
            return None
        forces = None
        qpos, qvel = prepared.batch.bind("qpos"), prepared.batch.bind("qvel")
        for i, (base, row, start) in enumerate(zip(bases, rows, prepared.world.time, strict=True)):
            assert base is not None
            key = int(row), float(start), steps
            if key not in self._courses:
                self._courses[key] = base.course(float(start), self.timestep, steps)
            course = self._courses[key]
            qpos[i, base.qpos], qvel[i, base.dof] = course.qpos, course.qvel
            if forces is None:
                forces = _BaseForces(base.dof, np.empty((steps, len(rows), course.force.shape[1])))
            forces.at_steps[:, i] = course.force
        return forces

    def _empty_motion(self, steps: int, rows: int) -> Motion:
        """Empty arrays; steps come first, so that all rows of a step are adjacent in memory."""
        q, v = np.empty((2, steps + 1, rows, len(self.joints)))
        return q, v, np.zeros(q.shape)

    def _roll_out(
        self, prepared: PreparedBatch, commands: FloatArray, base: _BaseForces | None
    ) -> Motion:
        """Motion of rows whose effects are all in the model fields: one call of the engine."""
        batch, world, layout = prepared.batch, prepared.world, self.layout
        at_qpos, at_dof = as_slice(layout.qpos_index), as_slice(layout.dof_index)
        batch.bind("qpos")[:, at_qpos] = world.position
        batch.bind("qvel")[:, at_dof] = world.velocity
        batch.bind("qfrc_applied")[:, at_dof] = prepared.constant
        ctrl = batch.bind("ctrl")
        rows, steps = commands.shape[:2]
        driven = layout.driven
        width = ctrl.shape[1]
        spec = int(mujoco.mjtState.mjSTATE_CTRL)
        if base is not None:
            spec |= int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
            width += batch.bind("qfrc_applied").shape[1]
        inputs = np.zeros((rows, steps, width))
        inputs[:, :, : ctrl.shape[1]] = ctrl[:, None]
        if base is not None:
            applied = inputs[:, :, ctrl.shape[1] :]
            applied[:, :, at_dof] = prepared.constant[:, None]
            applied[:, :, base.dof] = base.at_steps.swapaxes(0, 1)
        inputs[:, :, layout.control[driven]] = commands[:, :, driven] * layout.scale[driven]
        q, v, effort = self._empty_motion(steps, rows)
        q[0], v[0] = world.position, world.velocity
        try:
            out = batch.rollout(
                steps, inputs, control_spec=spec, record=("qpos", "qvel", "qfrc_actuator")
            )
        except BatchError:
            q[1:], v[1:] = np.nan, np.nan
        else:
            q[1:] = out["qpos"][:, :, at_qpos].swapaxes(0, 1)
            v[1:] = out["qvel"][:, :, at_dof].swapaxes(0, 1)
            effort[:-1] = out["qfrc_actuator"][:, :, at_dof].swapaxes(0, 1)
            effort[-1] = effort[-2]
        return q, v, effort

    def _set_initial_state(
        self,
        prepared: PreparedBatch,
        rows: NDArray[np.int64],
        effects: Sequence[tuple[Effect, Values]],
        hooks: Hooks,
    ) -> None:
        """Set the initial state of rows, and the memory of effects that act between steps."""
        batch, world = prepared.batch, prepared.world
        at_qpos, at_dof = as_slice(self.layout.qpos_index), as_slice(self.layout.dof_index)
        batch.bind("qpos")[:, at_qpos] = world.position
        batch.bind("qvel")[:, at_dof] = world.velocity
        batch.bind("qfrc_applied")[:, at_dof] = prepared.constant
        # An array has the results of those calls of the engine that follow its first binding.
        bias = batch.bind("qfrc_bias")
        batch.forward()
        if _reads_load(hooks):
            world.load = bias[:, at_dof]
        self.warm_up(world, rows, effects)
        shifts = [self.segments[r].motor_shift for r in rows]
        if hooks["gear"] and any(s is not None for s in shifts):
            none = np.zeros(len(self.joints))
            shift = np.array([none if s is None else s for s in shifts])
            shift_motors(world, hooks["gear"], shift)

    def _step_through(
        self,
        prepared: PreparedBatch,
        hooks: Hooks,
        commands: FloatArray,
        added_forces: FloatArray | None,
        base: _BaseForces | None,
    ) -> Motion:
        """Motion of rows whose effects or added forces act between the steps of the engine."""
        batch, world, layout = prepared.batch, prepared.world, self.layout
        at_qpos, at_dof = as_slice(layout.qpos_index), as_slice(layout.dof_index)
        qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
        ctrl, applied = batch.bind("ctrl"), batch.bind("qfrc_applied")
        bias, actuator_force = batch.bind("qfrc_bias"), batch.bind("qfrc_actuator")
        driven, is_unactuated = layout.driven, layout.is_unactuated
        control, at_driven = as_slice(layout.control[driven]), as_slice(driven)
        scale = layout.scale[driven]
        rows, steps = commands.shape[:2]
        q, v, effort = self._empty_motion(steps, rows)
        level, start = world.friction_level, world.time
        reads_load = _reads_load(hooks)
        commanded = np.ascontiguousarray(commands.swapaxes(0, 1))
        applied_effort = np.empty((rows, len(self.joints)))
        has_unactuated = is_unactuated.any()
        # The drive's effort is computed between steps only if an effect reads or changes it.
        needs_drive = bool(hooks["drive"]) or any(
            e.reads_delivered_effort for e, _ in hooks["friction"]
        )
        is_forced = added_forces is not None
        applies_effort = bool(
            hooks["force"] or hooks["drive"] or hooks["gear"] or has_unactuated or is_forced
        )
        has_elastic = prepared.is_elastic.any()
        has_own_bounds = False

        def act_before_step(k: int) -> None:
            nonlocal has_own_bounds
            world.time = start + k * self.timestep
            q[k], v[k] = qpos[:, at_qpos], qvel[:, at_dof]
            world.position, world.velocity = q[k], v[k]
            if k:
                effort[k - 1] += actuator_force[:, at_dof]
            world.setpoint = commanded[k]
            if applies_effort:
                applied_effort[:] = prepared.constant
                if added_forces is not None:
                    applied_effort[:] += added_forces[k]
                world.applied = applied_effort
            if reads_load:
                world.friction_level = level
                world.load = bias[:, at_dof]
            bounds = world.lower, world.upper
            native = run_hooks(world, hooks, drives=needs_drive)
            if hooks["servo"]:
                own = world.lower is bounds[0] and world.upper is bounds[1]
                if prepared.force_range is not None and not (own and has_own_bounds):
                    self.models.write_force_ranges(prepared.force_range, world)
                world.lower, world.upper = bounds
                has_own_bounds = own
            if prepared.friction is not None:
                level_now = np.maximum(world.friction_level, 0.0)
                prepared.friction[:, at_dof] = (
                    np.where(prepared.is_elastic, 0.0, level_now) if has_elastic else level_now
                )
            if hooks["drive"] or hooks["gear"]:
                # On a rigid joint the engine applies the control law itself. The motor of an
                # elastic transmission is not part of the engine's model.
                added = world.delivered - native
                world.applied += np.where(prepared.is_elastic, 0.0, added) if has_elastic else added
                effort[k] = (
                    np.where(prepared.is_elastic, world.delivered, added) if has_elastic else added
                )
            if has_unactuated:
                commanded_effort = np.where(prepared.is_elastic, 0.0, world.setpoint)[
                    :, is_unactuated
                ]
                world.applied[:, is_unactuated] += commanded_effort
                effort[k][:, is_unactuated] += commanded_effort
            if applies_effort:
                applied[:, at_dof] = world.applied
            if base is not None:
                applied[:, base.dof] = base.at_steps[k]
            ctrl[:, control] = world.setpoint[:, at_driven] * scale

        lockstep(batch, steps, act_before_step)
        q[steps], v[steps] = qpos[:, at_qpos], qvel[:, at_dof]
        effort[steps - 1] += actuator_force[:, at_dof]
        effort[steps] = effort[steps - 1]
        return q, v, effort


def _reads_load(hooks: Hooks) -> bool:
    """Whether an effect between steps needs the load of its joint."""
    return bool(hooks["friction"] or hooks["gear"] or any(e.reads_load for e, _ in hooks["servo"]))
