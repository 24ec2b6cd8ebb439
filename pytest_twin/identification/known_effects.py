"""Efforts along a measured motion that a regressor does not contain: springs and drag of the model,
and effects of an earlier diagnosis that an MJCF cannot contain.

The inverse dynamics is fitted with these given. Effects of drives, commands and clocks do not
change it: the measured effort is what the drive delivers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.model import AppliedEffect, PatchedModel, read_patched_model
from pytest_twin.diagnosis.patched.replay import fixed_values
from pytest_twin.diagnosis.temperature import ColdFractions, WithMetadata, cold_fraction_of_trial
from pytest_twin.effects import catalogue
from pytest_twin.effects.active_effects import ActiveEffects, active_effects
from pytest_twin.effects.base import ModelFields, World
from pytest_twin.realization import Realization
from pytest_twin.realization.driven_base import BaseStates
from pytest_twin.realization.inverse_dynamics import InverseDynamics

_IDENTIFIED_ANEW = ("rigid_body", "contact")
"""Families of effects without a place in the inverse dynamics of the fitted model: its masses and
inertias are identified as a whole, and contacts do not occur in it."""
_AT_JOINT = ("fields", "friction", "force")
"""Hooks of effects whose effort acts on the joint beside that of the drive."""

_PASSIVE = (
    "jnt_stiffness", "jnt_stiffnesspoly", "dof_dampingpoly", "tendon_stiffness",
    "tendon_stiffnesspoly", "tendon_damping", "tendon_dampingpoly",
)  # fmt: skip
"""Fields of a model for springs and for damping that no parameter of the regressor represents."""


@dataclass(frozen=True)
class KnownEfforts:
    """Efforts of a model along a motion, beside those of its regressor.

    Attributes:
        joints: joints of the recording, in the order of all columns.
        effects: effects beside the MJCF that the fit takes as given.
        cold_fractions: temperature in the metadata -> cold fraction.
    """

    realization: Realization
    joints: tuple[str, ...]
    effects: tuple[AppliedEffect, ...]
    cold_fractions: ColdFractions

    def true_motion(
        self, position: FloatArray, velocity: FloatArray | None
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return (n, joints) positions and velocities of the joints from those of the encoders."""
        speed = np.zeros_like(position) if velocity is None else velocity
        for effect, values in reversed(self._active(len(position))):
            position, speed = effect.unsense(position, speed, values)
        return position, None if velocity is None else speed

    def true_effort(self, effort: FloatArray) -> FloatArray:
        """Return (n, joints) efforts of the drives from the readings, which are linear in them."""
        shape = (len(effort), 1, len(self.joints))
        for effect, values in reversed(self._active(len(effort))):
            offset, with_one = (
                effect.sense_effort(np.full(shape, size), values)[:, 0] for size in (0.0, 1.0)
            )
            effort = (effort - offset) / (with_one - offset)
        return effort

    def along(
        self,
        time: FloatArray,
        motion: tuple[FloatArray, FloatArray],
        delivered: FloatArray,
        recording: WithMetadata,
        base: BaseStates | None = None,
    ) -> FloatArray:
        """(n, joints) effort by which springs, drag and effects push the joints, N*m or N.

        Dry friction opposes the velocity; it is zero where the velocity is.

        Args:
            time: (n,) equidistant times since the start of the recording, s.
            motion: (n, joints) positions and velocities.
            delivered: (n, joints) efforts of the drives; NaN where they are unknown.
            base: motion of the floating base, where its pose was recorded.

        Raises:
            RecordingError: friction depends on the temperature, and the metadata have none.
        """
        position, velocity = motion
        found = _springs_and_drag(self.realization, self.joints, position, velocity)
        acting = [each for each in self._active(len(time)) if each[0].overrides(*_AT_JOINT)]
        if not acting:
            return found
        cold = cold_fraction_of_trial(self.cold_fractions, recording)
        load = _load(self.realization, self.joints, position, velocity, base)
        step = float(time[1] - time[0])
        drives = np.nan_to_num(delivered)
        whole = [slice(None)]
        each_row = [slice(k, k + 1) for k in range(len(time))]
        state: dict[str, Any] = {}
        for rows in each_row if any(effect.remembers for effect, _ in acting) else whole:
            world = measured_world(
                time[rows], step, position[rows], velocity[rows], drives[rows], load[rows], cold
            )
            world.state = state
            found[rows] += effort_of_effects(
                world, [(e, {n: x[rows] for n, x in own.items()}) for e, own in acting]
            )
        return found

    def _active(self, rows: int) -> ActiveEffects:
        return active_effects(fixed_values(self.effects, self.joints, rows))


def known_efforts(realization: Realization, joints: Sequence[str]) -> KnownEfforts:
    """Return the efforts that an identification from measured effort takes as given.

    Raises:
        SpecError: ``effects.json`` of the model cannot be used.
    """
    patched = kept_effects(realization)
    if patched is None:
        return KnownEfforts(realization, tuple(joints), (), {})
    return KnownEfforts(realization, tuple(joints), patched.effects, patched.cold_fractions)


def kept_effects(realization: Realization) -> PatchedModel | None:
    """Return the effects that the fitted model keeps beside its MJCF; None for a plain model.

    Raises:
        SpecError: ``effects.json`` of the model cannot be used.
    """
    patched = read_patched_model(realization)
    if patched is None:
        return None
    kept = tuple(
        one
        for one in patched.outside_mjcf
        if catalogue()[one.effect].family not in _IDENTIFIED_ANEW
    )
    return replace(patched, effects=kept)


def notes_on_effects(realization: Realization) -> list[str]:
    """Return what becomes of the effects beside the MJCF of the given model, one line each."""
    patched, kept = read_patched_model(realization), kept_effects(realization)
    if patched is None or kept is None:
        return []
    left = [one for one in patched.outside_mjcf if one not in kept.effects]
    notes = []
    if kept.effects:
        notes.append(
            f"effects of the given model that its MJCF does not contain act in the fit and in the "
            f"fitted model, with their values: {_effect_names(kept.effects)}"
        )
    if left:
        notes.append(
            "effects of the given model that are identified anew, and not kept: "
            f"{_effect_names(left)}"
        )
    return notes


def _effect_names(effects: Sequence[AppliedEffect]) -> str:
    return ", ".join(
        one.effect if one.joint is None else f"{one.effect} of {one.joint}" for one in effects
    )


def _load(
    realization: Realization,
    joints: Sequence[str],
    position: FloatArray,
    velocity: FloatArray,
    base: BaseStates | None,
) -> FloatArray:
    """(n, joints) gravity and Coriolis effort of the given model, N*m or N."""
    dynamics = InverseDynamics(realization, joints)
    rows = dynamics.regressor(position, velocity, np.zeros_like(velocity), base)
    found: FloatArray = np.einsum("njlp,lp->nj", rows, dynamics.parameters)
    return found


def _springs_and_drag(
    realization: Realization, joints: Sequence[str], position: FloatArray, velocity: FloatArray
) -> FloatArray:
    """(n, joints) effort of the MJCF's springs, and of its damping beyond that of the joints
    proportional to velocity. Joints that are not recorded stay at the model's reference.
    """
    model = realization.model
    found = np.zeros_like(position)
    if not any(getattr(model, name).any() for name in _PASSIVE):
        return found
    dofs = [realization.joint_dof_index(joint) for joint in joints]
    places = [realization.joint_qpos_index(joint) for joint in joints]
    data = mujoco.MjData(model)
    for row, (at, speed) in enumerate(zip(position, velocity, strict=True)):
        data.qpos[places], data.qvel[dofs] = at, speed
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        found[row] = data.qfrc_spring[dofs] + data.qfrc_damper[dofs]
    found += model.dof_damping[dofs] * velocity
    return found


def measured_world(
    time: FloatArray,
    step: float,
    position: FloatArray,
    velocity: FloatArray,
    delivered: FloatArray,
    load: FloatArray,
    cold: float,
) -> World:
    """Return rows without drives, friction and forces, in a measured state."""
    zero = np.zeros_like(position)
    return World(
        time=time,
        timestep=step,
        position=position,
        velocity=velocity,
        setpoint=position.copy(),
        gain=zero,
        stiffness=zero,
        damping=zero,
        offset=zero,
        lower=np.full_like(zero, -np.inf),
        upper=np.full_like(zero, np.inf),
        servo=np.full(position.shape[1], "none"),
        delivered=delivered,
        friction_level=zero.copy(),
        applied=zero.copy(),
        load=load,
        motor_armature=zero,
        motor_damping=zero,
        motor_constant_effort=zero,
        link_inertia=zero,
        cold_fraction=np.full(len(time), cold),
    )


def effort_of_effects(world: World, effects: ActiveEffects) -> FloatArray:
    """(rows, joints) effort of effects in a state, N*m or N."""
    fields = ModelFields.neutral(np.zeros((len(world.time), 3)), world.position.shape[1])
    for effect, values in effects:
        effect.fields(fields, values)
    world.friction_level = world.friction_level + fields.friction
    for effect, values in effects:
        effect.friction(world, values)
    for effect, values in effects:
        effect.force(world, values)
    found: FloatArray = (
        world.applied
        + fields.constant_force
        + fields.motor_force
        - fields.damping * world.velocity
        - fields.stiffness * world.position
        - world.friction_level * np.sign(world.velocity)
    )
    return found
