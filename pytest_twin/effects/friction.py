"""Friction effects: everything that resists motion at a joint.

Dry friction is a constraint of the solver, so a joint really stops; there is no velocity band. All
levels are added to the model's own friction.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import (
    MODES,
    Effect,
    ModelFields,
    Parameter,
    RegressorColumn,
    Values,
    World,
)
from pytest_twin.effects.motor import motor_effort

_SURVEY = "Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994)"


class _DryFriction(Effect):
    """Dry friction with a variable level; Coulomb friction is its special case.

    ``dry_friction_level`` names the parameter that becomes the Coulomb level.
    """

    dry_friction_level: ClassVar[str]
    generalizes = frozenset({"coulomb_friction"})

    def special_cases(self, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        return {"coulomb_friction": {"coulomb": values[self.dry_friction_level]}}

    def holds(self, effect: str) -> Mapping[str, str]:
        return {"coulomb": self.dry_friction_level} if effect == "coulomb_friction" else {}


class ViscousFriction(Effect):
    """Friction proportional to velocity."""

    id = "viscous_friction"
    family = "friction"
    stage = "friction"
    basic_modes = MODES
    mjcf_field = "damping"
    regressor_symbol = "fv"
    nearly_linear = True
    law = "effort = -coefficient v"
    source = _SURVEY
    parameters = (
        Parameter(
            "coefficient", "damping", 0.0, -5.0, 50.0, (0.2,), "damping",
            meaning="viscous friction", relation="added",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "controller_gain": "move the joint with the drive off: only friction remains",
        "quadratic_drag": "record constant speeds a factor of four apart: viscous friction grows "
        "in proportion, drag with the square",
        "coulomb_friction": "record constant speeds a factor of four apart: Coulomb friction stays "
        "the same",
        "command_delay": "push the robot by hand: a delay does not damp the motion",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.damping += values["coefficient"]

    def regressor_column(
        self, position: FloatArray, velocity: FloatArray, acceleration: FloatArray
    ) -> RegressorColumn:
        return RegressorColumn(velocity, by_velocity=1.0)


class CoulombFriction(Effect):
    """Dry friction: a constant effort against motion that also holds the joint at rest."""

    id = "coulomb_friction"
    family = "friction"
    stage = "friction"
    basic_modes = MODES
    mjcf_field = "frictionloss"
    regressor_symbol = "fs"
    dry_friction_level = "coulomb"
    nearly_linear = True
    law = "|effort| <= level; effort = -level sign(v) in motion"
    source = _SURVEY
    parameters = (
        Parameter(
            "coulomb", "effort", 0.0, -3.0, 5.0, (0.2,), "effort",
            meaning="Coulomb friction", relation="added",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "stribeck_friction": "record slow reversals: only Stribeck friction falls with speed",
        "load_dependent_friction": "repeat the recording with two payloads: only load-dependent "
        "friction changes",
        "dead_zone": "switch the drive off at rest: friction holds the joint, a dead zone does not",
        "backlash": "move the link by hand with the motor held: only backlash gives free play",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.friction += values["coulomb"]

    def regressor_column(
        self, position: FloatArray, velocity: FloatArray, acceleration: FloatArray
    ) -> RegressorColumn:
        return RegressorColumn(np.sign(velocity))


class AsymmetricFriction(_DryFriction):
    """Dry friction that differs between the two directions of motion."""

    id = "asymmetric_friction"
    family = "friction"
    dry_friction_level = "coulomb"
    law = "|effort| <= coulomb + offset for v > 0, coulomb - offset for v < 0"
    source = "Janot, Gautier, Brunot, Mech. Syst. Signal Process. (2019): EMPS benchmark"
    parameters = (
        Parameter(
            "coulomb", "effort", 0.0, -3.0, 5.0, (0.2,), "effort",
            meaning="mean Coulomb friction of both directions", relation="added",
        ),
        Parameter(
            "offset", "effort", 0.0, -3.0, 3.0, (0.1,), "effort",
            meaning="half the difference between the directions", difference_of="coulomb",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "coulomb_friction": "record the same constant speed in both directions: the friction "
        "differs",
        "joint_spring": "hold poses far apart: a spring's effort grows with the angle",
        "base_tilt": "change another joint's pose: only the effort of a tilt changes",
        "encoder_bias": "hold a pose with the drive off: only a zero offset remains",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.friction += values["coulomb"]
        fields.motor_force -= values["offset"]


class StribeckFriction(_DryFriction):
    """Dry friction that falls from stiction to the Coulomb level as speed increases."""

    id = "stribeck_friction"
    family = "friction"
    stage = "friction"
    dry_friction_level = "coulomb"
    law = "level = coulomb + (stiction - coulomb) exp(-(v / stribeck_velocity)^2)"
    source = "Bo, Pavelescu, Wear 82 (1982); " + _SURVEY
    parameters = (
        Parameter(
            "coulomb", "effort", 0.0, -3.0, 5.0, (0.2,), "effort",
            meaning="Coulomb friction", relation="added",
        ),
        Parameter(
            "stiction_excess", "effort", 0.0, 0.0, 5.0, (0.2,), "effort",
            meaning="extra friction at rest",
        ),
        Parameter(
            "stribeck_velocity", "velocity", None, 0.003, 3.0, (0.03, 0.08, 0.2, 0.5), "velocity",
            meaning="Stribeck velocity",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "coulomb_friction": "record slow reversals: only Stribeck friction falls with speed",
        "presliding_hysteresis": "record slow reversals smaller than the break-away: only "
        "presliding moves the joint",
    }

    def friction(self, world: World, values: Values) -> None:
        fall = np.exp(
            -((world.motor_velocity / np.maximum(values["stribeck_velocity"], 1e-9)) ** 2)
        )
        world.friction_level = (
            world.friction_level + values["coulomb"] + values["stiction_excess"] * fall
        )


class LoadDependentFriction(Effect):
    """Dry friction that grows with the effort through the gear, from the load or from the motor."""

    id = "load_dependent_friction"
    family = "friction"
    stage = "friction"
    law = (
        "of_drive 0: level = coefficient |load|, load = gravity, Coriolis and centrifugal effort; "
        "of_drive 1: level = coefficient |delivered|"
    )
    source = "Duclos et al., arXiv:2410.08650 (extended friction of servo actuators)"
    parameters = (
        # A poor worm gear still transmits 20 % of the effort.
        Parameter(
            "coefficient", "effort_per_load", 0.0, 0.0, 0.8, (0.1,),
            meaning="friction per unit of effort",
        ),
        Parameter(
            "of_drive", "one", None, 0.0, 1.0, (0.0, 1.0), choice=True,
            meaning="effort that causes the friction",
            choices=("caused by the load", "caused by the motor's effort"),
        ),
    )  # fmt: skip
    reads_delivered_effort = True
    confused_with: ClassVar = {
        "coulomb_friction": "repeat the same speed with two payloads: Coulomb friction stays the "
        "same",
        "torque_constant": "repeat the motion in both directions: friction changes its sign",
    }

    def friction(self, world: World, values: Values) -> None:
        load = np.where(values["of_drive"] > 0.0, motor_effort(world), world.load)
        world.friction_level = world.friction_level + values["coefficient"] * np.abs(load)


class PreslidingHysteresis(_DryFriction):
    """Elastic deformation before sliding: small reversals follow a hysteresis loop."""

    id = "presliding_hysteresis"
    family = "friction"
    dry_friction_level = "coulomb"
    law = "dz/dt = v - |v| z / (coulomb / stiffness); effort = -stiffness z"
    source = "Dahl (1968); Canudas de Wit et al., IEEE Trans. Autom. Control 40 (1995): LuGre"
    parameters = (
        Parameter(
            "coulomb", "effort", 0.0, 0.0, 5.0, (0.2,), "effort", meaning="Coulomb friction",
            relation="added",
        ),
        Parameter(
            "presliding_distance", "position", None, 0.002, 0.5, (0.005, 0.015, 0.04, 0.1), "one",
            meaning="presliding distance",
        ),
    )  # fmt: skip
    remembers = True
    remembers_path = True
    confused_with: ClassVar = {
        "coulomb_friction": "record reversals smaller than the break-away: only presliding moves "
        "the joint",
        "joint_spring": "repeat the motion in both directions: a spring has no hysteresis loop",
        "joint_elasticity": "record fast and slow motions: only elasticity resonates",
    }

    def force(self, world: World, values: Values) -> None:
        level = values["coulomb"]
        distance = np.maximum(values["presliding_distance"], 1e-9)
        bristle = world.state.get(self.id)
        if bristle is None:
            bristle = np.zeros_like(level)
        # Exact for a constant velocity over the step: z approaches its bound exponentially. The
        # mean over the step acts.
        travel = world.motor_velocity * world.timestep
        bound = distance * np.sign(travel)
        share = np.maximum(np.abs(travel) / distance, 1e-12)
        off = bristle - bound
        world.state[self.id] = bound + off * np.exp(-share)
        world.push_motor(-level * (bound - off * np.expm1(-share) / share) / distance)


class ThermalFriction(_DryFriction):
    """Dry and viscous friction that falls as the gear warms up, and in a warmer room."""

    id = "thermal_friction"
    family = "friction"
    dry_friction_level = "excess"
    law = (
        "cold = cold_fraction exp(-t / warm_up_time); level = dry friction + excess cold; "
        "effort = -viscous_excess cold v; "
        "cold_fraction: 1 in the coldest trials (metadata temperature), 0 in the warmest, 1 "
        "without temperatures"
    )
    source = "Bittencourt, Axelsson, J. Dyn. Syst. Meas. Control 136 (2014)"
    parameters = (
        Parameter(
            "excess", "effort", 0.0, -5.0, 5.0, (0.2,), "effort",
            meaning="extra dry friction when cold",
        ),
        Parameter(
            "viscous_excess", "damping", 0.0, -5.0, 50.0, (0.2,), "damping",
            meaning="extra viscous friction when cold",
        ),
        Parameter(
            "warm_up_time", "time", None, 0.5, 1000.0, (2.0, 5.0, 12.0, 40.0),
            meaning="warm-up time constant",
        ),
    )  # fmt: skip
    needs_temperature = True
    confused_with: ClassVar = {
        "coulomb_friction": "record the same motion cold and warm",
        "viscous_friction": "record the same motion cold and warm",
        "external_force": "record the same motion twice with a pause between: an external force "
        "does not repeat",
    }
    generalizes = _DryFriction.generalizes | {"viscous_friction"}

    def friction(self, world: World, values: Values) -> None:
        cold = world.state[self.id] = self._cold(world, values)
        world.friction_level = world.friction_level + values["excess"] * cold

    def force(self, world: World, values: Values) -> None:
        # The friction hook of this step ran before.
        world.drag_motor(values["viscous_excess"] * world.state[self.id])

    @staticmethod
    def _cold(world: World, values: Values) -> FloatArray:
        warm = np.maximum(values["warm_up_time"], 1e-6)
        # Memory is warmed up from before the recording, where the time is negative.
        elapsed = np.maximum(world.time, 0.0)[:, None]
        cold: FloatArray = world.cold_fraction[:, None] * np.exp(-elapsed / warm)
        return cold

    def special_cases(self, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        viscous = {"viscous_friction": {"coefficient": values["viscous_excess"]}}
        return {**super().special_cases(values), **viscous}

    def holds(self, effect: str) -> Mapping[str, str]:
        if effect == "viscous_friction":
            return {"coefficient": "viscous_excess"}
        return super().holds(effect)


class PositionDependentFriction(_DryFriction):
    """Dry friction that varies periodically with position: a bent shaft, an eccentric gear."""

    id = "position_dependent_friction"
    family = "friction"
    periodic = True
    dry_friction_level = "mean"
    law = (
        "level = max(mean + sine sin(harmonic q) + cosine cos(harmonic q), 0); "
        "harmonic: periods per turn on a hinge"
    )
    source = _SURVEY + ", sec. 2.2"
    parameters = (
        Parameter(
            "mean", "effort", 0.0, -3.0, 5.0, (0.1,), "effort",
            meaning="mean dry friction", relation="added",
        ),
        Parameter(
            "sine", "effort", 0.0, -3.0, 3.0, (0.1,), "effort", meaning="sine amplitude"
        ),
        Parameter(
            "cosine", "effort", 0.0, -3.0, 3.0, (0.1,), "effort", meaning="cosine amplitude"
        ),
        Parameter(
            "harmonic", "wavenumber", None, 1.0, 200.0, (1.0, 2.0, 3.0, 4.0, 6.0, 8.0), choice=True,
            meaning="wavenumber",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "coulomb_friction": "record the same speed at poses far apart",
        "cogging": "repeat the motion in both directions: cogging keeps its sign",
        "load_dependent_friction": "record the same poses with two payloads",
    }

    def friction(self, world: World, values: Values) -> None:
        turn = values["harmonic"] * world.position
        wave = values["sine"] * np.sin(turn) + values["cosine"] * np.cos(turn)
        world.friction_level = world.friction_level + values["mean"] + wave


class QuadraticDrag(Effect):
    """Drag proportional to the square of velocity."""

    id = "quadratic_drag"
    family = "friction"
    law = "effort = -coefficient v |v|"
    source = "drag equation; Batchelor, An Introduction to Fluid Dynamics (1967), sec. 5.11"
    parameters = (
        Parameter(
            "coefficient", "drag", 0.0, -2.0, 20.0, (0.2,), "drag",
            meaning="quadratic drag coefficient",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "viscous_friction": "record constant speeds a factor of four apart: drag grows with the "
        "square",
    }

    def force(self, world: World, values: Values) -> None:
        world.drag_motor(values["coefficient"] * np.abs(world.motor_velocity))
