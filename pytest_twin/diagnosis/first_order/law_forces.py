"""Generalized forces of laws along a given motion, without simulation.

The hooks of :class:`~pytest_twin.effects.base.Effect` are called on samples of the motion as rows:
on all samples at once if no law has a memory, otherwise step by step. Joints with unchanged laws
are left out. Dry friction has the sign of the velocity. At rest it is the force that the motion
requires, up to the friction level.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.measured_trajectory import MeasuredTrajectory
from pytest_twin.diagnosis.first_order.rigid_terms import RigidTerms, upsample
from pytest_twin.effects.active_effects import ActiveEffects, acts_at, hooks_between_steps
from pytest_twin.effects.base import ModelFields, World, find_elastic_joints
from pytest_twin.effects.batch_models import ROW_ATTRIBUTES
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.memory_warmup import run_hooks

_POSITION_STEP = 1e-4
"""Step of position in rad or m for the finite differences of forces."""
# Largest number of elements of one array. If all samples are evaluated at once, an array must fit
# into a core's cache. Step by step each call has a fixed cost, so only memory limits it.
_IN_CACHE, _MAX_NUMBERS = 100_000, 2_000_000
_BLOCK = 64
"""Number of steps that are evaluated together, so that they fit into a core's cache."""
_PER_ROW = (
    "gain", "stiffness", "damping", "offset", "lower", "upper", "friction_level",
    "motor_armature", "motor_damping", "link_inertia", "cold_fraction", "least_setpoint",
    "greatest_setpoint",
)  # fmt: skip
_AT_ONCE, _SAMPLES, _STEPS = 0, 1, 2
"""Evaluation of a joint's laws: all samples at once, sample by sample, or at the model's step."""


@dataclass(frozen=True, slots=True)
class Forces:
    """Generalized forces along a motion, (variants, segments, samples, joints), N*m or N.

    Within this module they are (lanes, samples, columns), with one sample if they are constant.

    Attributes:
        total: sum of all forces except those of rigid-body dynamics: drive, friction, springs,
            external forces.
        drive: effort of the drive, a part of ``total``.
        dry: dry friction, a part of ``total``.
        level: largest possible dry friction.
        stiffness, damping: coefficients of the drive's control law, N*m/rad and N*m*s/rad, or N/m
            and N*s/m.
        passive_stiffness, passive_damping: coefficients of springs and viscous friction.
    """

    total: FloatArray
    drive: FloatArray
    dry: FloatArray
    level: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    passive_stiffness: FloatArray
    passive_damping: FloatArray


@dataclass(frozen=True, slots=True)
class _Lanes:
    """Lanes: joints of segments under variants of their laws, evaluated in parallel.

    A lane is one joint, or all joints of the robot if a law reads the drive of another joint.

    Attributes:
        copy: (lanes,) index of the variant.
        segment: (lanes,) index among the motion's segments.
        joint: (lanes, columns) index of the joint.
    """

    copy: NDArray[np.int64]
    segment: NDArray[np.int64]
    joint: NDArray[np.int64]

    @classmethod
    def of(cls, pairs: NDArray[np.int64], joint: NDArray[np.int64], segments: int) -> _Lanes:
        """Lanes of every segment, for (n,) variants and their (n, columns) joints."""
        return cls(
            np.repeat(pairs, segments),
            np.tile(np.arange(segments), len(pairs)),
            np.repeat(joint, segments, axis=0),
        )

    def of_copy(self, x: FloatArray) -> FloatArray:
        """Select (lanes, columns) from (copies, joints)."""
        return x[self.copy[:, None], self.joint]

    def of_segment(self, x: FloatArray) -> FloatArray:
        """Select (lanes, columns) from (segments, joints)."""
        return x[self.segment[:, None], self.joint]

    def in_time(self, x: FloatArray) -> FloatArray:
        """Select (lanes, n, columns) from (segments, n, joints)."""
        return np.moveaxis(x[self.segment[:, None], :, self.joint], 2, 1)

    def parts(self, samples: int, pace: int) -> Iterator[_Lanes]:
        """Lanes divided into the parts that are evaluated together."""
        most = _IN_CACHE if pace == _AT_ONCE else _MAX_NUMBERS
        per = max(1, most // (samples * self.joint.shape[1]))
        for first in range(0, len(self.copy), per):
            some = slice(first, first + per)
            yield _Lanes(self.copy[some], self.segment[some], self.joint[some])


@dataclass(slots=True)
class _PassiveJoint:
    """Passive properties of the joints of lanes, (lanes, columns), SI units."""

    damping: FloatArray
    armature: FloatArray
    own_armature: FloatArray
    constant: FloatArray
    spring: FloatArray
    model_spring: FloatArray
    rest: FloatArray
    is_elastic: NDArray[np.bool_]


class _Efforts(NamedTuple):
    """Efforts of the drive, of springs and constants, and the dry friction level, N*m or N."""

    drive: FloatArray
    applied: FloatArray
    level: FloatArray


class LawForces:
    """Evaluates the forces of laws along one motion."""

    def __init__(
        self, simulator: BatchSimulator, trajectory: MeasuredTrajectory, rigid: RigidTerms
    ) -> None:
        self.simulator = simulator
        self.trajectory = trajectory
        samples = trajectory.position.shape[1]
        self.load = upsample(rigid.bias, rigid.at, samples)
        self.required = upsample(rigid.effort, rigid.at, samples)
        self._mean_commands: dict[int, FloatArray] = {}
        self._at_start = simulator.models.world(trajectory.segments)
        self._rest_weight, self._direction = _slip_state(
            trajectory.velocity, trajectory.slip_velocity
        )

    def forces(self, effects: ActiveEffects, copies: int) -> Forces:
        """Forces of ``copies`` variants of the laws.

        Args:
            effects: values (copies, joints), neutral where a variant lacks the effect.
            copies: number of variants.
        """
        segments, samples, joints = self.trajectory.position.shape
        out = Forces(*(np.zeros((copies, segments, samples, joints)) for _ in fields(Forces)))
        everything = np.ones((copies, joints), dtype=bool)
        for lanes, found in self._evaluate_groups(
            effects, _required_pace(effects, (copies, joints)), everything
        ):
            at = (lanes.copy[:, None], lanes.segment[:, None], slice(None), lanes.joint)
            for field in fields(Forces):
                getattr(out, field.name)[at] = np.moveaxis(getattr(found, field.name), 1, 2)
        return out

    def changes(
        self, effects: ActiveEffects, copies: int, own: ActiveEffects, base: Forces
    ) -> tuple[FloatArray, FloatArray]:
        """Changes of the total force and of the drive's effort by variants of the laws.

        Args:
            effects: values (copies, joints), neutral where a variant lacks the effect.
            copies: number of variants.
            own: laws of the present hypothesis, values (1, joints).
            base: forces of the present hypothesis.

        Returns:
            Total force and drive effort, (copies, segments, samples, joints) each, N*m or N.
        """
        segments, samples, joints = self.trajectory.position.shape
        shape = (copies, joints)
        total, drive = np.zeros((2, copies, segments, samples, joints))
        # Base and variant must be sampled in the same way, also if the variant lacks a law with
        # memory.
        pace = np.maximum(_required_pace(effects, shape), _required_pace(own, (1, joints)))
        for lanes, found in self._evaluate_groups(effects, pace, _laws_differ(effects, own, shape)):
            here = (lanes.segment[:, None], slice(None), lanes.joint)
            at = (lanes.copy[:, None], *here)
            total[at] = np.moveaxis(found.total, 1, 2) - base.total[0][here]
            drive[at] = np.moveaxis(found.drive, 1, 2) - base.drive[0][here]
        return total, drive

    def _evaluate_groups(
        self, effects: ActiveEffects, pace: NDArray[np.int64], which: NDArray[np.bool_]
    ) -> Iterator[tuple[_Lanes, Forces]]:
        """Forces of the (copies, joints) joints ``which``; joints of one pace share a part."""
        segments, samples, joints = self.trajectory.position.shape
        coupled = np.zeros(len(which), dtype=bool)
        for effect, v in effects:
            if effect.reads_other_joints:
                coupled |= acts_at(effect, v).any(axis=1)
        coupled &= which.any(axis=1)
        together = np.where(coupled, pace.max(axis=1), -1)
        separate = np.where(which & ~coupled[:, None], pace, -1)
        for p in (_AT_ONCE, _SAMPLES, _STEPS):
            copies = np.flatnonzero(together == p)
            everything = np.tile(np.arange(joints), (len(copies), 1))
            copy, joint = np.nonzero(separate == p)
            for some, columns in ((copies, everything), (copy, joint[:, None])):
                if len(some):
                    for lanes in _Lanes.of(some, columns, segments).parts(samples, p):
                        yield lanes, self._evaluate(effects, lanes, p)

    def _evaluate(self, effects: ActiveEffects, lanes: _Lanes, pace: int) -> Forces:
        trajectory = self.trajectory
        active = [(e, {n: lanes.of_copy(x) for n, x in v.items()}) for e, v in effects]
        each = [(e, v) for e, v in active if acts_at(e, v).any()]
        world = self._world_of_lanes(lanes)
        joint = self._passive_joint(each, world, lanes)
        for effect, v in each:
            effect.gains(world, v)
        stiffness, damping = world.stiffness, world.damping
        if pace == _AT_ONCE:
            out = self._evaluate_at_once(each, world, joint, lanes)
        else:
            # Elastic transmissions are stiff and need the model's step; for other laws with memory
            # one step for each sample is enough.
            out = self._evaluate_stepwise(
                each, world, joint, lanes, trajectory.steps if pace == _STEPS else 1
            )
        total, drive, dry, level = out
        constant = (stiffness, damping, joint.spring + joint.model_spring, joint.damping)
        return Forces(total, drive, dry, level, *(x[:, None] for x in constant))

    def _world_of_lanes(self, lanes: _Lanes) -> World:
        world = replace(self._at_start, servo=self._at_start.servo[lanes.joint], state={})
        for name in ROW_ATTRIBUTES:
            value = getattr(world, name)
            value = value[lanes.segment] if value.ndim == 1 else lanes.of_segment(value)
            setattr(world, name, value)
        return world

    def _passive_joint(self, effects: ActiveEffects, world: World, lanes: _Lanes) -> _PassiveJoint:
        simulator = self.simulator
        models = [simulator.segments[s].model for s in self.trajectory.segments]
        dof = simulator.layout.dof_index

        def of(values: list[FloatArray]) -> FloatArray:
            return lanes.of_segment(np.array(values))

        gravity = np.array([m.opt.gravity for m in models])[lanes.segment]
        changed = ModelFields.neutral(gravity, lanes.joint.shape[1])
        changed.damping = of([m.dof_damping[dof] for m in models])
        changed.friction = world.friction_level
        for effect, v in effects:
            if effect.family != "contact":
                effect.fields(changed, v)
        is_elastic = find_elastic_joints(effects, lanes.joint.shape)
        if is_elastic.any():
            known = simulator.models.link_inertia(np.asarray(self.trajectory.segments))
            world.link_inertia = lanes.of_segment(known)
        world.friction_level = np.maximum(changed.friction, 0.0)
        own = of([m.dof_armature[dof] for m in models])
        world.motor_armature = own + changed.armature
        world.motor_damping = changed.damping
        constant, world.motor_constant_effort = changed.split_force(is_elastic)
        rest = of([m.qpos_spring[simulator.layout.qpos_index] for m in models])
        springs = of([m.jnt_stiffness[simulator.layout.joint_ids] for m in models])
        return _PassiveJoint(
            changed.damping, changed.armature, own, constant, changed.stiffness, springs, rest,
            is_elastic,
        )  # fmt: skip

    def _commands(self, effects: ActiveEffects, lanes: _Lanes, count: int) -> FloatArray:
        """(lanes, count, columns) means of the held commands over even parts of the motion."""
        simulator, trajectory = self.simulator, self.trajectory
        segments, samples, joints = trajectory.position.shape
        steps = (samples - 1) * trajectory.steps
        late = [(e, v) for e, v in effects if e.overrides("command_latency", "sample_time")]
        if late:
            rows = trajectory.segments[lanes.segment]
            found = simulator.commands(rows, late, steps, lanes.joint)
            mean: FloatArray = found.reshape(len(rows), count, -1, found.shape[2]).mean(axis=2)
            return mean
        if count not in self._mean_commands:
            found = simulator.commands(trajectory.segments, [], steps)
            self._mean_commands[count] = found.reshape(segments, count, -1, joints).mean(axis=2)
        return lanes.in_time(self._mean_commands[count])

    def _evaluate_at_once(
        self, effects: ActiveEffects, world: World, joint: _PassiveJoint, lanes: _Lanes
    ) -> list[FloatArray]:
        trajectory = self.trajectory
        samples = trajectory.position.shape[1]
        count, columns = lanes.joint.shape
        mean = self._commands(effects, lanes, samples - 1)
        # Commands are means over the interval after a sample; a sample represents half an interval
        # on each side.
        held = np.concatenate([mean[:, :1], 0.5 * (mean[:, 1:] + mean[:, :-1]), mean[:, -1:]], 1)

        def spread(x: NDArray[Any]) -> NDArray[Any]:
            return np.repeat(x, samples, axis=0)

        def flat(x: FloatArray) -> FloatArray:
            return lanes.in_time(x).reshape(-1, columns)

        for name in (*_PER_ROW, "servo"):
            setattr(world, name, spread(getattr(world, name)))
        wide = _PassiveJoint(*(spread(getattr(joint, f.name)) for f in fields(_PassiveJoint)))
        world.time = trajectory.time[lanes.segment].ravel()
        world.position, world.velocity = flat(trajectory.position), flat(trajectory.velocity)
        world.load = flat(self.load)
        world.setpoint = held.reshape(-1, columns)
        world.applied = wide.constant - wide.spring * (world.position - wide.rest)
        run_hooks(
            world,
            hooks_between_steps([(e, {n: spread(x) for n, x in v.items()}) for e, v in effects]),
        )
        out = self._with_dry_friction(
            wide, world.velocity, flat(trajectory.acceleration), flat(self.required),
            _Efforts(world.delivered, world.applied, world.friction_level),
            (flat(self._rest_weight), flat(self._direction)),
        )  # fmt: skip
        return [x.reshape(count, samples, columns) for x in out]

    def _evaluate_stepwise(
        self, effects: ActiveEffects, world: World, joint: _PassiveJoint, lanes: _Lanes, parts: int
    ) -> list[FloatArray]:
        trajectory = self.trajectory
        samples = trajectory.position.shape[1]
        count, columns = lanes.joint.shape
        world.timestep = trajectory.interval / parts

        def by_step(x: FloatArray) -> FloatArray:
            return np.ascontiguousarray(x.swapaxes(0, 1))

        held = by_step(self._commands(effects, lanes, (samples - 1) * parts))
        motion = [
            by_step(lanes.in_time(x))
            for x in (
                trajectory.position,
                trajectory.velocity,
                self.load,
                trajectory.acceleration,
                self.required,
            )
        ]
        start = trajectory.time[lanes.segment, 0]
        hooks = hooks_between_steps(effects)
        world.time, world.load = start, motion[2][0]
        self.simulator.warm_up(world, trajectory.segments[lanes.segment], effects, lanes.joint)
        bounds = world.lower, world.upper, world.friction_level
        # Commands are means over a step, so the motion is evaluated in the middle of the step. With
        # an elastic transmission it is evaluated at the beginning, as in the simulation.
        middle = 0.5 if parts == 1 else 0.0
        share = ((np.arange(parts) + middle) / parts)[None, :, None, None]
        slip_velocity = trajectory.slip_velocity[lanes.joint]
        mean = np.empty((4, samples - 1, count, columns))
        per = max(1, _BLOCK // parts)
        drive, level = np.empty((2, per * parts, count, columns))
        for first in range(0, samples - 1, per):
            last = min(first + per, samples - 1)
            steps = (last - first) * parts
            position, velocity, load, acceleration, required = (
                (
                    x[first:last, None] + share * (x[first + 1 : last + 1] - x[first:last])[:, None]
                ).reshape(steps, count, columns)
                for x in motion
            )
            applied = joint.constant - joint.spring * (position - joint.rest)
            for i in range(steps):
                k = first * parts + i
                world.time = start + k * world.timestep
                world.position, world.velocity = position[i], velocity[i]
                world.load, world.setpoint, world.applied = load[i], held[k], applied[i]
                world.lower, world.upper, world.friction_level = bounds
                run_hooks(world, hooks)
                drive[i], level[i] = world.delivered, world.friction_level
            found = self._with_dry_friction(
                joint, velocity, acceleration, required,
                _Efforts(drive[:steps], applied, level[:steps]),
                _slip_state(velocity, slip_velocity),
            )  # fmt: skip
            for m, x in zip(mean, found, strict=True):
                m[first:last] = x.reshape(last - first, parts, count, columns).mean(axis=1)
        out = np.empty((4, count, samples, columns))
        mean = mean.swapaxes(1, 2)
        # Means over the interval after each stamp, converted to values at the stamps.
        out[:, :, 0], out[:, :, -1] = mean[:, :, 0], mean[:, :, -1]
        out[:, :, 1:-1] = 0.5 * (mean[:, :, 1:] + mean[:, :, :-1])
        return list(out)

    @staticmethod
    def _with_dry_friction(
        joint: _PassiveJoint,
        velocity: FloatArray,
        acceleration: FloatArray,
        required: FloatArray,
        efforts: _Efforts,
        slip_state: tuple[FloatArray, FloatArray],
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Total, drive, dry friction and its level, (..., lanes, columns) like the arguments."""
        drive, applied, level = efforts
        level = np.maximum(level, 0.0)
        others = drive + applied - joint.damping * velocity - joint.armature * acceleration
        rest_weight, direction = slip_state
        # At rest dry friction balances the other forces, up to its level.
        holding = np.minimum(np.maximum(required - others, -level), level)
        dry = rest_weight * holding - (1.0 - rest_weight) * level * direction
        total = others + dry
        if joint.is_elastic.any():
            # With an elastic transmission the armature belongs to the motor; the model's mass
            # matrix contains it, so it is added back.
            total = np.where(joint.is_elastic, applied + joint.own_armature * acceleration, total)
        return total, drive, dry, level


def _slip_state(velocity: FloatArray, slip_velocity: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weight of rest (1 at rest, 0 while slipping), and direction of friction, -1 to 1."""
    slip = velocity / slip_velocity
    return np.exp(-0.25 * slip * slip), np.tanh(slip)


def state_force_derivatives(
    simulator: BatchSimulator,
    trajectory: MeasuredTrajectory,
    rigid: RigidTerms,
    effects: ActiveEffects,
) -> tuple[FloatArray, FloatArray]:
    """Stiffness and damping of forces that depend only on the state (drag, cogging).

    They are central differences, midway between the measured and the predicted motion.

    Args:
        effects: effects of the hypothesis, values (1, joints).

    Returns:
        Stiffness (N*m/rad or N/m) and damping (N*m*s/rad or N*s/m), both (segments, samples,
        joints).
    """
    of_state = [
        (e, v) for e, v in effects
        if e.overrides("force") and not e.remembers and e.family != "environment"
    ]  # fmt: skip
    out = np.zeros((2, *trajectory.position.shape))
    if not of_state:
        return out[0], out[1]
    position, velocity = trajectory.midway

    def force(q: FloatArray, v: FloatArray) -> FloatArray:
        laws = LawForces(simulator, replace(trajectory, position=q, velocity=v), rigid)
        found: FloatArray = laws.changes(of_state, 1, [], laws.forces([], 1))[0][0]
        return found

    velocity_step = trajectory.slip_velocity
    out[0] = (
        force(position - _POSITION_STEP, velocity) - force(position + _POSITION_STEP, velocity)
    ) / (2 * _POSITION_STEP)
    out[1] = (
        force(position, velocity - velocity_step) - force(position, velocity + velocity_step)
    ) / (2 * velocity_step)
    return out[0], out[1]


def _required_pace(effects: ActiveEffects, shape: tuple[int, int]) -> NDArray[np.int64]:
    """(copies, joints) evaluation that the laws of every joint need: one of the three paces."""
    out = np.full(shape, _AT_ONCE)
    for effect, v in effects:
        if effect.remembers:
            needed = _STEPS if effect.overrides("gear") else _SAMPLES
            out = np.maximum(out, np.where(acts_at(effect, v), needed, _AT_ONCE))
    return out


def _laws_differ(
    effects: ActiveEffects, own: ActiveEffects, shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """(copies, joints) whether the laws of a joint differ from those of the hypothesis."""
    out = np.zeros(shape, dtype=bool)
    unmatched = {e.id: v for e, v in own}
    for effect, v in effects:
        acts = acts_at(effect, v)
        present = unmatched.pop(effect.id, None)
        if present is None:
            out |= acts
        else:
            changed = np.any([x != present[n] for n, x in v.items()], axis=0)
            out |= changed & (acts | acts_at(effect, present))
    for effect, _ in own:
        if effect.id in unmatched:
            out |= acts_at(effect, unmatched[effect.id])
    return out
