"""Build batches of simulations: initial states, drives, and effects in model fields."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.active_effects import STEP_HOOKS, overrides_any
from pytest_twin.effects.base import Effect, ModelFields, Values, World, find_elastic_joints
from pytest_twin.effects.constraint import stiffen_friction
from pytest_twin.effects.contact_geoms import ContactGeoms, find_contact_geoms, least_time_constant
from pytest_twin.effects.engine_options import disable_unused_features
from pytest_twin.effects.layout import Index, Layout, as_slice
from pytest_twin.effects.link_inertia import link_inertia
from pytest_twin.effects.point_mass import change_links
from pytest_twin.effects.sampling import age_of_initial_state
from pytest_twin.effects.segment import Segment
from pytest_twin.realization.engine import Batch, new_batch

ROW_ATTRIBUTES = (
    "time", "position", "velocity", "setpoint", "gain", "stiffness", "damping", "offset", "lower",
    "upper", "delivered", "friction_level", "applied", "load", "motor_armature", "motor_damping",
    "motor_constant_effort", "link_inertia", "cold_fraction", "least_setpoint", "greatest_setpoint",
)  # fmt: skip
"""Attributes of a world that have a row for each simulation."""

_MIN_SIZE_FOR_THREADS = 64
"""Smallest number of rows times degrees of freedom for which threads save time."""
# Largest number of poses of a segment at which the inertia of its links is computed, and the
# shortest time between two of them in s.
_MAX_POSES, _MIN_POSE_INTERVAL = 8, 0.2
_CONTROL_LAW = ("gain", "stiffness", "damping", "offset")
_UNBOUNDED = 1e9
"""Limit of an unlimited control or force, N*m, N or the control's unit."""
_INERTIAL = ("body_mass", "body_ipos", "body_inertia", "body_iquat")


@dataclass(frozen=True, slots=True)
class PreparedBatch:
    """A batch whose model fields hold the effects of each row.

    Attributes:
        world: initial state and drives of the rows.
        is_elastic: (rows, joints) whether the transmission is not rigid.
        constant: (rows, joints) constant effort on the links, N*m or N.
        friction: (rows, dofs) dry friction of the batch, N*m or N; None if no effect changes it
            between steps.
        force_range: (rows, actuators, 2) force ranges of the batch, N*m or N; None if all rows have
            those of the model.
    """

    batch: Batch
    world: World
    is_elastic: NDArray[np.bool_]
    constant: FloatArray
    friction: FloatArray | None
    force_range: FloatArray | None


class _Drives(NamedTuple):
    """Drives of a layout.

    Attributes:
        driven: joints with a drive.
        gear: (drives,) gear ratios; None if all are 1.
        reversed_drive: (drives,) whether the gear ratio is negative; None if none is.
    """

    driven: Index
    act: Index
    gear: FloatArray | None
    reversed_drive: NDArray[np.bool_] | None


@dataclass(frozen=True, slots=True)
class _BatchWithModels:
    """A batch and the model of each of its rows.

    Attributes:
        expanded: fields with values for each row.
    """

    batch: Batch
    models: Sequence[mujoco.MjModel]
    expanded: set[str] = field(default_factory=set)

    @property
    def has_several_models(self) -> bool:
        """Whether the rows have different models."""
        return len({id(m) for m in self.models}) > 1

    def expand(self, name: str) -> FloatArray:
        """(rows, ...) writable values of a field, initialized from the model of each row."""
        self.expanded.add(name)
        array: FloatArray = self.batch.expand(name)
        (array[:],) = self.values_per_row(name)
        return array

    def values_per_row(self, *names: str) -> list[FloatArray]:
        """(rows, ...) values of fields of each row's model."""
        distinct = {id(m): m for m in self.models}
        number = {key: i for i, key in enumerate(distinct)}
        index = [number[id(m)] for m in self.models]
        return [np.array([getattr(m, name) for m in distinct.values()])[index] for name in names]


class BatchModels:
    """Builds batches of segments with effects.

    Args:
        segments: segments whose models have the same joints and drives.
        layout: indices of these joints and drives.
        timestep: time step, s.
    """

    def __init__(
        self,
        segments: Sequence[Segment],
        layout: Layout,
        timestep: float,
    ) -> None:
        self.segments = segments
        self.layout = layout
        self.timestep = timestep
        self._bounded: dict[int, mujoco.MjModel] = {}
        self._link_inertia: dict[int, tuple[FloatArray, FloatArray]] = {}

    @cached_property
    def contact(self) -> ContactGeoms:
        """Return the surfaces that the robot touches, or nearly touches, at measured positions."""
        if any(s.base is not None for s in self.segments):
            # Recordings in which such a robot touches something are refused.
            return ContactGeoms()
        poses = [s.position for s in self.segments]
        return find_contact_geoms(self.segments[0].model, self.layout.joint_ids, poses)

    def bounded_model(self, segment: int) -> mujoco.MjModel:
        """A copy of a segment's model in which every actuator has an active force range.

        Rows can then reduce the range. The copy also has the time step and the friction constraint
        of the segment.
        """
        of = self.segments[segment]
        if id(of.model) not in self._bounded:
            model = copy.copy(of.model)
            free = model.actuator_forcelimited == 0
            model.actuator_forcelimited[free] = 1
            model.actuator_forcerange[free] = (-_UNBOUNDED, _UNBOUNDED)
            model.opt.timestep = self.timestep
            if not of.has_friction_creep:
                stiffen_friction(model, self.layout.dof_index, float(of.model.opt.timestep))
            disable_unused_features(model)
            self._bounded[id(of.model)] = model
        return self._bounded[id(of.model)]

    def link_inertia(self, rows: NDArray[np.int64]) -> FloatArray:
        """(rows, joints) smallest articulated inertia along each segment, kg*m^2 or kg."""
        segments = [self.segments[r] for r in rows]
        # Segments with another start share the array of positions, so its id is the key. The array
        # is kept, so that its id is not used again.
        new = {id(s.position): s for s in segments if id(s.position) not in self._link_inertia}
        models = {id(s.model): s.model for s in new.values()}
        data = {key: mujoco.MjData(model) for key, model in models.items()}
        for key, s in new.items():
            stride = int(np.searchsorted(s.time, s.time[0] + _MIN_POSE_INTERVAL))
            stride = max(stride, len(s.time) // _MAX_POSES, 1)
            least = link_inertia(
                data[id(s.model)], s.position[::stride], self.layout.qpos_index,
                self.layout.dof_index,
            )  # fmt: skip
            self._link_inertia[key] = (s.position, least)
        return np.array([self._link_inertia[id(s.position)][1] for s in segments])

    def precompute(self, rows: NDArray[np.int64], effects: Sequence[tuple[Effect, Values]]) -> None:
        """Compute and cache data shared by batches of ``rows``, before processes are forked."""
        for r in np.unique(rows):
            self.bounded_model(int(r))
        if any(effect.is_elastic_transmission for effect, _ in effects):
            self.link_inertia(np.unique(rows))

    def world(self, rows: NDArray[np.int64]) -> World:
        """Initial states of segments ``rows``, with the nominal drives."""
        segments, of = np.unique(rows, return_inverse=True)
        # There are many segments and few models.
        of_segment = [self.bounded_model(int(s)) for s in segments]
        models = list({id(m): m for m in of_segment}.values())
        place = {id(m): i for i, m in enumerate(models)}
        which = np.array([place[id(m)] for m in of_segment], dtype=int)
        layout = self.layout
        count = (len(segments), len(layout.joints))
        driven = layout.driven
        act, gear = layout.actuator[driven], layout.gear[driven]
        dry = np.array([m.dof_frictionloss[layout.dof_index] for m in models])
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
            servo=layout.servo,
            delivered=np.zeros(count),
            friction_level=dry[which],
            applied=np.zeros(count),
            load=np.zeros(count),
            motor_armature=np.zeros(count),
            motor_damping=np.zeros(count),
            motor_constant_effort=np.zeros(count),
            link_inertia=np.full(count, np.inf),
            cold_fraction=np.array([self.segments[r].cold_fraction for r in segments]),
            least_setpoint=np.full(count, -np.inf),
            greatest_setpoint=np.full(count, np.inf),
        )
        limited, ends = self._command_ranges()
        world.least_setpoint[:, limited] = ends.min(axis=0)
        world.greatest_setpoint[:, limited] = ends.max(axis=0)
        world.gain[:, layout.is_unactuated] = 1.0
        gain = np.array([m.actuator_gainprm[act, 0] for m in models])
        world.gain[:, driven] = (gain * gear * layout.scale[driven])[which]
        biased = np.array([m.actuator_biastype[act].any() for m in models])[which]
        bias = np.array([m.actuator_biasprm[act, :3] for m in models])[which[biased]]
        at = np.ix_(biased, driven)
        world.offset[at] = bias[..., 0] * gear
        world.stiffness[at] = -bias[..., 1] * gear**2
        world.damping[at] = -bias[..., 2] * gear**2
        limits = np.array([m.actuator_forcerange[act] * gear[:, None] for m in models])[which]
        world.lower[:, driven], world.upper[:, driven] = limits.min(axis=2), limits.max(axis=2)
        for name in ROW_ATTRIBUTES:
            setattr(world, name, getattr(world, name)[of])
        return world

    def command_range(self, rows: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
        """Range of effort commands that the nominal drives can follow, (rows, joints) each.

        It is infinite for drives with other commands.
        """
        world, layout = self.world(rows), self.layout
        effort = (layout.servo == "effort") & (world.gain > 0.0)
        gain = np.where(effort, world.gain, 1.0)
        least, greatest = ((b - world.offset) / gain for b in (world.lower, world.upper))
        limited, ends = self._command_ranges()
        least[:, limited] = np.maximum(least[:, limited], ends.min(axis=0))
        greatest[:, limited] = np.minimum(greatest[:, limited], ends.max(axis=0))
        return np.where(effort, least, -np.inf), np.where(effort, greatest, np.inf)

    def _command_ranges(self) -> tuple[NDArray[np.int64], FloatArray]:
        """Joints whose drives limit their commands, and (2, joints) ends of these ranges."""
        model, layout = self.segments[0].model, self.layout
        limited = layout.driven[model.actuator_ctrllimited[layout.actuator[layout.driven]] != 0]
        ends = model.actuator_ctrlrange[layout.actuator[limited]].T / layout.scale[limited]
        return limited, ends

    def prepare(
        self, rows: NDArray[np.int64], effects: Sequence[tuple[Effect, Values]], threads: int
    ) -> PreparedBatch:
        """Return a batch of segments with the effects in its model fields.

        Args:
            rows: index of the segment of each row.
            effects: effects with their (rows, joints) parameters.
        """
        models = [self.bounded_model(int(r)) for r in rows]
        # Effects between steps synchronize the threads at every step, so few rows use one thread.
        few = (
            overrides_any(effects, *STEP_HOOKS) and len(rows) * models[0].nv < _MIN_SIZE_FOR_THREADS
        )
        batched = _BatchWithModels(new_batch(models[0], len(rows), 1 if few else threads), models)
        self._set_unrecorded_state(batched.batch, rows)
        world = self.world(rows)
        for effect, parameters in reversed(effects):
            world.position, world.velocity = effect.unsense(
                world.position, world.velocity, parameters
            )
        joints = len(self.layout.joints)
        world.time = (
            world.time
            - age_of_initial_state([self.segments[r] for r in rows], effects, joints)[:, 0]
        )
        gravity = np.array([m.opt.gravity for m in models])
        fields = ModelFields.neutral(gravity.copy(), joints)
        for effect, v in effects:
            effect.fields(fields, v)
        native = {n: getattr(world, n).copy() for n in (*_CONTROL_LAW, "lower", "upper")}
        for effect, v in effects:
            effect.gains(world, v)
        changed = {n for n, before in native.items() if (before != getattr(world, n)).any()}
        is_elastic = find_elastic_joints(effects, (len(rows), joints))
        if batched.has_several_models:
            for name in _INERTIAL:
                batched.expand(name)
        friction = self._write_dofs(batched, rows, effects, fields, world, is_elastic)
        if (fields.gravity != gravity).any() or batched.has_several_models:
            batched.batch.expand("opt.gravity")[:] = fields.gravity
        if fields.has_changed_links:
            self._write_inertia(batched, fields)
        own = batched.has_several_models
        if own or is_elastic.any() or changed.intersection(_CONTROL_LAW):
            self._write_gains(batched, world, is_elastic)
        force_range = None
        narrowed = overrides_any(effects, "servo") or not changed.isdisjoint(("lower", "upper"))
        if (own or narrowed) and len(self.layout.driven):
            force_range = batched.expand("actuator_forcerange")
            self.write_force_ranges(force_range, world)
        if overrides_any(effects, "servo"):
            # The command range applies to commands, not to a setpoint that a servo has changed.
            batched.expand("actuator_ctrlrange")[:] = (-_UNBOUNDED, _UNBOUNDED)
        constant, world.motor_constant_effort = fields.split_force(is_elastic)
        if any(effect.family == "contact" for effect, _ in effects):
            least_time = least_time_constant(models[0], self.timestep)
            self.contact.write(batched.expand, fields, least_time)
        # A moved geom or mass changes frames and bounding volumes, which the engine precomputes.
        moved = not batched.expanded.isdisjoint(("body_mass", "geom_pos"))
        if own or fields.armature.any() or moved:
            batched.batch.set_const()
        return PreparedBatch(batched.batch, world, is_elastic, constant, friction, force_range)

    def _set_unrecorded_state(self, batch: Batch, rows: NDArray[np.int64]) -> None:
        """Set the initial state of joints, drives and actuators that are not recorded."""
        rest = [self.segments[r].unrecorded for r in rows]
        known = [each.state for each in rest if each is not None]
        if len(known) == len(rest):
            for name in known[0]:
                places = batch.bind(name)
                places[:] = np.reshape([state[name] for state in known], places.shape)

    def _write_dofs(
        self,
        batched: _BatchWithModels,
        rows: NDArray[np.int64],
        effects: Sequence[tuple[Effect, Values]],
        fields: ModelFields,
        world: World,
        is_elastic: NDArray[np.bool_],
    ) -> FloatArray | None:
        """Write damping, armature, dry friction and stiffness of the joints.

        Returns:
            (rows, dofs) dry friction of the batch, N*m or N; None if no effect changes it later.
        """
        batch, dof = batched.batch, self.layout.dof_index
        between_steps = overrides_any(effects, "friction")
        added = {
            "dof_damping": fields.damping,
            "dof_armature": fields.armature,
            "dof_frictionloss": fields.friction,
        }
        for name, change in added.items():
            moving = name == "dof_frictionloss" and between_steps
            if batched.has_several_models or change.any() or moving or is_elastic.any():
                batched.expand(name)[:, dof] += change
        if "dof_frictionloss" in batched.expanded:
            levels = batch.expand("dof_frictionloss")
            np.maximum(levels, 0.0, out=levels)
            world.friction_level = levels[:, dof].copy()
        if is_elastic.any():
            # Properties of the motor side are simulated between steps instead of on the link.
            world.motor_armature = batch.expand("dof_armature")[:, dof]
            world.motor_damping = batch.expand("dof_damping")[:, dof]
            world.link_inertia = self.link_inertia(rows)
            for name in added:
                array = batch.expand(name)
                array[:, dof] = np.where(is_elastic, 0.0, array[:, dof])
        if fields.stiffness.any():
            batched.expand("jnt_stiffness")[:, self.layout.joint_ids] += fields.stiffness
        return batch.expand("dof_frictionloss") if between_steps else None

    def _write_gains(
        self, batched: _BatchWithModels, world: World, is_elastic: NDArray[np.bool_]
    ) -> None:
        """Write the control laws of the drives; zero where the transmission is not rigid."""
        driven = self.layout.driven
        if not len(driven):
            return
        act, gear = self.layout.actuator[driven], self.layout.gear[driven]
        gain, bias = batched.expand("actuator_gainprm"), batched.expand("actuator_biasprm")
        rigid = ~is_elastic[:, driven]
        gain[:, act, 0] = rigid * world.gain[:, driven] / (gear * self.layout.scale[driven])
        bias[:, act, 0] = rigid * world.offset[:, driven] / gear
        bias[:, act, 1] = rigid * -world.stiffness[:, driven] / gear**2
        bias[:, act, 2] = rigid * -world.damping[:, driven] / gear**2

    def write_force_ranges(self, force_range: FloatArray, world: World) -> None:
        """Write the effort limits of the drives into (rows, actuators, 2) force ranges."""
        driven, act, gear, reversed_drive = self._drives
        low, high = world.lower[:, driven], world.upper[:, driven]
        if gear is not None:
            low, high = low / gear, high / gear
        if reversed_drive is not None:
            low, high = np.where(reversed_drive, high, low), np.where(reversed_drive, low, high)
        force_range[:, act, 0] = np.maximum(low, -_UNBOUNDED)
        force_range[:, act, 1] = np.minimum(high, _UNBOUNDED)

    @cached_property
    def _drives(self) -> _Drives:
        """The drives, for code that runs before each step."""
        driven = self.layout.driven
        gear = self.layout.gear[driven]
        reversed_drive = gear < 0.0
        return _Drives(
            as_slice(driven),
            as_slice(self.layout.actuator[driven]),
            None if (gear == 1.0).all() else gear,
            reversed_drive if reversed_drive.any() else None,
        )

    def _write_inertia(self, batched: _BatchWithModels, fields: ModelFields) -> None:
        """Write changed masses, inertias and centres of mass of links, and added point masses."""
        mass, ipos, inertia, iquat = (batched.expand(name) for name in _INERTIAL)
        (position,) = batched.values_per_row("jnt_pos")
        change_links(self.layout, fields, (mass, ipos, inertia, iquat), position)
