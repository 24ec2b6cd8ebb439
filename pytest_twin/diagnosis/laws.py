"""The generalized force that laws give along a motion, without simulating it.

The hooks of :class:`~pytest_twin.effects.base.Effect` are called on samples of the motion as rows:
all samples at once where no law remembers, else step by step. Dry friction follows the sign of the
velocity; where the joint stands it is what the motion asks for, up to its level.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from pytest_twin.diagnosis.along import Along
from pytest_twin.diagnosis.rigid_terms import Rigid, upsampled
from pytest_twin.effects.base import Effect, FloatArray, ModelFields, Values, World
from pytest_twin.effects.roll_in import act
from pytest_twin.effects.rows import RowSimulator, hooks_between_steps

_MOST_NUMBERS = 2_000_000
_PER_ROW = (
    "gain", "stiffness", "damping", "offset", "lower", "upper", "friction_level",
    "motor_armature", "motor_damping",
)  # fmt: skip
ActiveEffects = Sequence[tuple[Effect, Values]]


@dataclass(frozen=True, slots=True)
class Forces:
    """What acts along a motion, (variants, segments, samples, joints) N*m or N.

    Attributes:
        total: all that is not rigid-body: drive, friction, springs, pushes.
        drive: of it, what the drive delivers.
        dry: of it, dry friction; ``level`` its greatest value.
        stiffness, damping: of the drive's law.
        passive_stiffness, passive_damping: of the joint, beside the drive.
    """

    total: FloatArray
    drive: FloatArray
    dry: FloatArray
    level: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    passive_stiffness: FloatArray
    passive_damping: FloatArray


@dataclass(slots=True)
class _Joint:
    """What a variant's joints have beside the drive, (rows, joints)."""

    damping: FloatArray
    armature: FloatArray
    own_armature: FloatArray
    constant: FloatArray
    spring: FloatArray
    model_spring: FloatArray
    rest: FloatArray
    soft: FloatArray


class Laws:
    """Evaluates laws along one motion."""

    def __init__(self, simulator: RowSimulator, along: Along, rigid: Rigid) -> None:
        self.simulator = simulator
        self.along = along
        samples = along.position.shape[1]
        self.load = upsampled(rigid.bias, rigid.at, samples)
        self.required = upsampled(rigid.effort, rigid.at, samples)
        self._commands: FloatArray | None = None

    def forces(self, effects: ActiveEffects, copies: int) -> Forces:
        """Forces of ``copies`` variants.

        Args:
            effects: values (copies, joints), neutral where a variant lacks the effect.
            copies: how many variants.
        """
        segments, samples, joints = self.along.position.shape
        per = max(1, _MOST_NUMBERS // (segments * samples * joints))
        found = []
        for first in range(0, copies, per):
            part = slice(first, min(first + per, copies))
            some = [(e, {n: x[part] for n, x in v.items()}) for e, v in effects]
            found.append(self._forces(some, part.stop - part.start))
        return Forces(
            *(np.concatenate([getattr(f, x.name) for f in found]) for x in fields(Forces))
        )

    def _forces(self, effects: ActiveEffects, copies: int) -> Forces:
        simulator, along = self.simulator, self.along
        segments, samples, joints = along.position.shape
        rows = np.tile(along.segments, copies)
        each = [(e, {n: np.repeat(x, segments, axis=0) for n, x in v.items()}) for e, v in effects]
        world = simulator.world(rows)
        world.timestep = simulator.timestep
        joint = self._joint(each, world, rows)
        for effect, v in each:
            effect.gains(world, v)
        world_stiffness, world_damping = world.stiffness, world.damping
        commands = self._command(each, rows, copies)
        if any(effect.remembers for effect, _ in each):
            out = self._stepwise(each, world, joint, commands, copies)
        else:
            out = self._at_once(each, world, joint, commands, copies)
        shape = (copies, segments, samples, joints)
        constant = (
            world_stiffness,
            world_damping,
            joint.spring + joint.model_spring,
            joint.damping,
        )
        return Forces(
            *(x.reshape(shape) for x in out),
            *(np.broadcast_to(x.reshape(copies, segments, 1, joints), shape) for x in constant),
        )

    def _joint(self, effects: ActiveEffects, world: World, rows: NDArray[np.int64]) -> _Joint:
        simulator = self.simulator
        models = [simulator.segments[r].model for r in rows]
        dof = simulator.dof_index
        count = world.gain.shape
        changed = ModelFields.neutral(np.array([m.opt.gravity for m in models]), count[1])
        changed.damping = np.array([m.dof_damping[dof] for m in models])
        changed.friction = world.friction_level
        soft = np.zeros(count, dtype=bool)
        for effect, v in effects:
            if effect.family != "contact":
                effect.fields(changed, v)
            apart = effect.separates(v)
            if apart is not None:
                soft |= apart
        world.friction_level = np.maximum(changed.friction, 0.0)
        own = np.array([m.dof_armature[dof] for m in models])
        world.motor_armature = own + changed.armature
        world.motor_damping = changed.damping
        rest = np.array([m.qpos_spring[simulator.qpos_index] for m in models])
        springs = np.array([m.jnt_stiffness[simulator.joint_ids] for m in models])
        return _Joint(
            changed.damping, changed.armature, own, changed.constant_force, changed.stiffness,
            springs, rest, soft,
        )  # fmt: skip

    def _command(self, effects: ActiveEffects, rows: NDArray[np.int64], copies: int) -> FloatArray:
        """(rows, steps, joints) held commands of every step of the model."""
        simulator, along = self.simulator, self.along
        steps = (along.position.shape[1] - 1) * along.steps
        late = [(e, v) for e, v in effects if e.overrides("command_delay", "sample_time")]
        if late:
            return simulator.commands(rows, late, steps)
        if self._commands is None:
            self._commands = simulator.commands(along.segments, [], steps)
        return np.tile(self._commands, (copies, 1, 1))

    def _at_once(
        self, effects: ActiveEffects, world: World, joint: _Joint, commands: FloatArray, copies: int
    ) -> tuple[FloatArray, ...]:
        along = self.along
        segments, samples, joints = along.position.shape
        rows = copies * segments
        mean = commands.reshape(rows, samples - 1, along.steps, joints).mean(axis=2)
        # A command holds from its sample on; a sample stands for half a sample to either side.
        held = np.concatenate([mean[:, :1], 0.5 * (mean[:, 1:] + mean[:, :-1]), mean[:, -1:]], 1)

        def spread(x: FloatArray) -> FloatArray:
            return np.repeat(x, samples, axis=0)

        def tiled(x: FloatArray) -> FloatArray:
            return np.tile(x, (copies, 1, 1)).reshape(-1, joints)

        for name in _PER_ROW:
            setattr(world, name, spread(getattr(world, name)))
        wide = _Joint(*(spread(getattr(joint, f.name)) for f in fields(_Joint)))
        each = [(e, {n: spread(x) for n, x in v.items()}) for e, v in effects]
        world.time = np.tile(along.time, (copies, 1)).ravel()
        world.position, world.velocity = tiled(along.position), tiled(along.velocity)
        world.load = tiled(self.load)
        out = self._law(
            hooks_between_steps(each),
            world,
            wide,
            held.reshape(-1, joints),
            tiled(along.acceleration),
            tiled(self.required),
        )
        return tuple(x.reshape(rows, samples, joints) for x in out)

    def _stepwise(
        self, effects: ActiveEffects, world: World, joint: _Joint, commands: FloatArray, copies: int
    ) -> tuple[FloatArray, ...]:
        along = self.along
        segments, samples, joints = along.position.shape
        rows = copies * segments
        # Gears are stiff: they need the model's own step. A sample will do for the rest.
        parts = along.steps if any(effect.overrides("transmit") for effect, _ in effects) else 1
        world.timestep = along.interval / parts
        held = commands.reshape(rows, (samples - 1) * parts, -1, joints).mean(axis=2)
        motion = np.stack(
            [along.position, along.velocity, self.load, along.acceleration, self.required], axis=0
        )
        motion = np.ascontiguousarray(np.tile(motion, (1, copies, 1, 1)).swapaxes(0, 2))
        start = np.tile(along.time[:, 0], copies)
        hooks = hooks_between_steps(effects)
        world.time, world.load = start, motion[0, :, 2]
        self.simulator.roll_in(world, np.tile(along.segments, copies), effects)
        found = np.empty((4, (samples - 1) * parts, rows, joints))
        bounds = world.lower, world.upper, world.friction_level
        for k in range((samples - 1) * parts):
            t, part = divmod(k, parts)
            now = motion[t]
            if parts > 1:
                now = now + (part / parts) * (motion[t + 1] - now)
            world.time = start + k * world.timestep
            world.position, world.velocity, world.load = now[:, 0], now[:, 1], now[:, 2]
            found[:, k] = self._law(hooks, world, joint, held[:, k], now[:, 3], now[:, 4])
            world.lower, world.upper, world.friction_level = bounds
        out = np.empty((4, rows, samples, joints))
        mean = found.reshape(4, samples - 1, parts, rows, joints).mean(axis=2).swapaxes(1, 2)
        # Means over the sample after each stamp, moved to the stamps.
        out[:, :, 0], out[:, :, -1] = mean[:, :, 0], mean[:, :, -1]
        out[:, :, 1:-1] = 0.5 * (mean[:, :, 1:] + mean[:, :, :-1])
        return tuple(out)

    def _law(
        self,
        hooks: Mapping[str, ActiveEffects],
        world: World,
        joint: _Joint,
        command: FloatArray,
        acceleration: FloatArray,
        required: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Total, drive, dry friction and its level."""
        world.setpoint = command.copy()
        world.applied = joint.constant - joint.spring * (world.position - joint.rest)
        act(world, hooks)
        drive = world.delivered
        level = np.maximum(world.friction_level, 0.0)
        others = (
            drive + world.applied - joint.damping * world.velocity - joint.armature * acceleration
        )
        slip = world.velocity / self.along.slip_velocity
        # At rest dry friction is what holds the joint, as far as its level goes.
        standing = np.exp(-0.25 * slip * slip)
        holding = np.minimum(np.maximum(required - others, -level), level)
        dry = standing * holding - (1.0 - standing) * level * np.tanh(slip)
        rigid = others + dry
        for effect, v in hooks["transmit"]:
            effect.transmit(world, v)
        total = rigid
        if hooks["transmit"]:
            # A link that the gear lets go has no armature: the mass matrix has it all the same.
            total = np.where(joint.soft, world.applied + joint.own_armature * acceleration, rigid)
        return total, drive, dry, level
