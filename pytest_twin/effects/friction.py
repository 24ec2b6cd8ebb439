"""Friction: everything that resists motion at a joint.

Levels go to the solver, which holds the joint where the level suffices: no velocity band. Laws add
to the model's own friction.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import Effect, ModelFields, Parameter, Values, World
from pytest_twin.effects.motor import motor_effort

_SURVEY = "Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994)"


class _DryFriction(Effect):
    """A level that may vary: without that it is Coulomb friction.

    Attributes:
        level: the parameter that is the level then.
    """

    level: ClassVar[str]
    has_in_it = frozenset({"coulomb_friction"})

    def special_cases(self, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        return {"coulomb_friction": {"coulomb": values[self.level]}}

    def holds(self, effect: str) -> Mapping[str, str]:
        return {"coulomb": self.level} if effect == "coulomb_friction" else {}


class ViscousFriction(Effect):
    """Effort in proportion to velocity."""

    id = "viscous_friction"
    family = "friction"
    of_every_drive = True
    law = "effort = -coefficient v"
    source = _SURVEY
    parameters = (Parameter("coefficient", "damping", 0.0, -5.0, 50.0, (0.2,), "damping"),)
    confused_with: ClassVar = {
        "controller_gain": "the drive off: only friction remains",
        "quadratic_drag": "speeds a factor of four apart",
        "coulomb_friction": "constant speeds a factor of four apart",
        "command_delay": "an outside push: a delay does not damp it",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.damping += values["coefficient"]


class CoulombFriction(Effect):
    """A constant level against motion, which also holds at rest."""

    id = "coulomb_friction"
    family = "friction"
    of_every_drive = True
    law = "|effort| <= level; effort = -level sign(v) in motion"
    source = _SURVEY
    parameters = (Parameter("coulomb", "effort", 0.0, -3.0, 5.0, (0.2,), "effort"),)
    confused_with: ClassVar = {
        "stribeck_friction": "slow reversals: only Stribeck falls with speed",
        "load_dependent_friction": "two loads",
        "dead_zone": "release at rest",
        "backlash": "hold the link by hand",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.friction += values["coulomb"]


class AsymmetricFriction(_DryFriction):
    """A level that differs between the two directions."""

    id = "asymmetric_friction"
    family = "friction"
    level = "coulomb"
    law = "|effort| <= coulomb + offset for v > 0, coulomb - offset for v < 0"
    source = "Janot, Gautier, Brunot, Mech. Syst. Signal Process. (2019): EMPS benchmark"
    parameters = (
        Parameter("coulomb", "effort", 0.0, -3.0, 5.0, (0.2,), "effort"),
        Parameter("offset", "effort", 0.0, -3.0, 3.0, (0.1,), "effort"),
    )
    confused_with: ClassVar = {
        "coulomb_friction": "the same speed both ways",
        "joint_spring": "poses far apart: a spring grows with the angle",
        "base_tilt": "another joint's pose: a tilt acts on every joint by its load",
        "encoder_bias": "hold with the drive off",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.friction += values["coulomb"]
        fields.motor_force -= values["offset"]


class StribeckFriction(_DryFriction):
    """A level that falls from stiction to Coulomb as lubrication builds up with speed."""

    id = "stribeck_friction"
    family = "friction"
    level = "coulomb"
    law = "level = coulomb + (stiction - coulomb) exp(-(v / stribeck_velocity)^2)"
    source = "Bo, Pavelescu, Wear 82 (1982); " + _SURVEY
    parameters = (
        Parameter("coulomb", "effort", 0.0, -3.0, 5.0, (0.2,), "effort"),
        Parameter("stiction_excess", "effort", 0.0, 0.0, 5.0, (0.2,), "effort"),
        Parameter(
            "stribeck_velocity", "velocity", None, 0.003, 3.0, (0.03, 0.08, 0.2, 0.5), "velocity"
        ),
    )
    confused_with: ClassVar = {
        "coulomb_friction": "slow reversals",
        "presliding_hysteresis": "symmetric slow reversals smaller than the break-away",
    }

    def friction(self, world: World, values: Values) -> None:
        fall = np.exp(
            -((world.motor_velocity / np.maximum(values["stribeck_velocity"], 1e-9)) ** 2)
        )
        world.friction_level = (
            world.friction_level + values["coulomb"] + values["stiction_excess"] * fall
        )


class LoadDependentFriction(Effect):
    """A level that grows with the effort that the gear transmits: with what the load puts on it, or
    with what the motor does.
    """

    id = "load_dependent_friction"
    family = "friction"
    of_every_drive = True
    law = (
        "level = coefficient |load|, load: gravity, Coriolis and centrifugal effort; with of_drive "
        "1: level = coefficient |delivered|"
    )
    source = "Duclos et al., arXiv:2410.08650 (extended friction of servo actuators)"
    parameters = (
        # Poor worm gears still pass a fifth of the effort on.
        Parameter("coefficient", "effort_per_load", 0.0, 0.0, 0.8, (0.1,)),
        Parameter("of_drive", "one", None, 0.0, 1.0, (0.0, 1.0), choice=True),
    )
    reads_drive = True
    confused_with: ClassVar = {
        "coulomb_friction": "two loads at the same speed",
        "torque_constant": "both directions: friction changes its sign",
    }

    def friction(self, world: World, values: Values) -> None:
        load = np.where(values["of_drive"] > 0.0, motor_effort(world), world.load)
        world.friction_level = world.friction_level + values["coefficient"] * np.abs(load)


class PreslidingHysteresis(_DryFriction):
    """Before it slides, a contact yields like a spring that forgets: loops without sliding."""

    id = "presliding_hysteresis"
    family = "friction"
    level = "coulomb"
    law = "dz/dt = v - |v| z / (coulomb / stiffness); effort = -stiffness z"
    source = "Dahl (1968); Canudas de Wit et al., IEEE Trans. Autom. Control 40 (1995): LuGre"
    parameters = (
        Parameter("coulomb", "effort", 0.0, 0.0, 5.0, (0.2,), "effort"),
        Parameter(
            "presliding_distance", "position", None, 0.002, 0.5, (0.005, 0.015, 0.04, 0.1), "one"
        ),
    )
    remembers = True
    remembers_path = True
    confused_with: ClassVar = {
        "coulomb_friction": "symmetric reversals smaller than the break-away",
        "joint_spring": "both directions: a spring has no loop",
        "joint_elasticity": "fast and slow: elasticity rings",
    }

    def force(self, world: World, values: Values) -> None:
        level = values["coulomb"]
        distance = np.maximum(values["presliding_distance"], 1e-9)
        bristle = world.state.get(self.id)
        if bristle is None:
            bristle = np.zeros_like(level)
        # Exact for a velocity that is held over the step: z tends to its bound exponentially. What
        # acts is the mean over the step.
        travel = world.motor_velocity * world.timestep
        bound = distance * np.sign(travel)
        share = np.maximum(np.abs(travel) / distance, 1e-12)
        off = bristle - bound
        world.state[self.id] = bound + off * np.exp(-share)
        world.push_motor(-level * (bound - off * np.expm1(-share) / share) / distance)


class ThermalFriction(_DryFriction):
    """Dry and viscous friction that falls as the gear warms up in use, and in a warmer room."""

    id = "thermal_friction"
    family = "friction"
    level = "excess"
    law = (
        "cold = coldness exp(-t / warm_up_time), coldness 1 in the coldest trials (metadata "
        "temperature), 0 in the warmest, 1 where no temperatures are told; level = dry friction + "
        "excess cold; effort = -viscous_excess cold v"
    )
    source = "Bittencourt, Axelsson, J. Dyn. Syst. Meas. Control 136 (2014)"
    parameters = (
        Parameter("excess", "effort", 0.0, -5.0, 5.0, (0.2,), "effort"),
        Parameter("viscous_excess", "damping", 0.0, -5.0, 50.0, (0.2,), "damping"),
        Parameter("warm_up_time", "time", None, 0.5, 1000.0, (2.0, 5.0, 12.0, 40.0)),
    )
    asks_temperature = True
    confused_with: ClassVar = {
        "coulomb_friction": "the same motion cold and warm",
        "viscous_friction": "the same motion cold and warm",
        "external_force": "the same motion twice, with a pause",
    }
    has_in_it = _DryFriction.has_in_it | {"viscous_friction"}

    def friction(self, world: World, values: Values) -> None:
        cold = world.state[self.id] = self._cold(world, values)
        world.friction_level = world.friction_level + values["excess"] * cold

    def force(self, world: World, values: Values) -> None:
        # Of the same step: friction comes before.
        world.drag_motor(values["viscous_excess"] * world.state[self.id])

    @staticmethod
    def _cold(world: World, values: Values) -> FloatArray:
        warm = np.maximum(values["warm_up_time"], 1e-6)
        cold: FloatArray = world.coldness[:, None] * np.exp(-world.time[:, None] / warm)
        return cold

    def special_cases(self, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        viscous = {"viscous_friction": {"coefficient": values["viscous_excess"]}}
        return {**super().special_cases(values), **viscous}

    def holds(self, effect: str) -> Mapping[str, str]:
        if effect == "viscous_friction":
            return {"coefficient": "viscous_excess"}
        return super().holds(effect)


class PositionDependentFriction(_DryFriction):
    """A level that varies over the turn, once or several times: a bent shaft, an eccentric gear."""

    id = "position_dependent_friction"
    family = "friction"
    level = "mean"
    law = "level = mean + sine sin(harmonic q) + cosine cos(harmonic q), not below zero"
    source = _SURVEY + ", sec. 2.2"
    parameters = (
        Parameter("mean", "effort", 0.0, -3.0, 5.0, (0.1,), "effort"),
        Parameter("sine", "effort", 0.0, -3.0, 3.0, (0.1,), "effort"),
        Parameter("cosine", "effort", 0.0, -3.0, 3.0, (0.1,), "effort"),
        Parameter(
            "harmonic", "wavenumber", None, 1.0, 200.0, (1.0, 2.0, 3.0, 4.0, 6.0, 8.0), choice=True
        ),
    )
    over_the_turn = True
    confused_with: ClassVar = {
        "coulomb_friction": "the same speed at poses far apart",
        "cogging": "both directions: cogging keeps its sign",
        "load_dependent_friction": "the same pose under two loads",
    }

    def friction(self, world: World, values: Values) -> None:
        turn = values["harmonic"] * world.position
        wave = values["sine"] * np.sin(turn) + values["cosine"] * np.cos(turn)
        world.friction_level = world.friction_level + values["mean"] + wave


class QuadraticDrag(Effect):
    """Effort with the square of velocity."""

    id = "quadratic_drag"
    family = "friction"
    law = "effort = -coefficient v |v|"
    source = "drag equation; Batchelor, An Introduction to Fluid Dynamics (1967), sec. 5.11"
    parameters = (Parameter("coefficient", "drag", 0.0, -2.0, 20.0, (0.2,), "drag"),)
    confused_with: ClassVar = {"viscous_friction": "speeds a factor of four apart"}

    def force(self, world: World, values: Values) -> None:
        world.drag_motor(values["coefficient"] * np.abs(world.motor_velocity))
