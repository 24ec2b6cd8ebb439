"""Friction that differs with the direction of motion or of the power through the gear."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from pytest_twin.effects.base import Effect, ModelFields, Parameter, Values, World
from pytest_twin.effects.motor import motor_effort

_REST_SPEED = 1e-4
"""Speed below which a joint is at rest, rad/s or m/s: residual velocity of dry friction."""


class DirectionalViscousFriction(Effect):
    """Viscous friction that differs between the two directions of motion."""

    id = "directional_viscous_friction"
    family = "friction"
    law = (
        "effort = -(coefficient + difference) v for v > 0, -(coefficient - difference) v for v < 0"
    )
    source = "Janot, Gautier, Brunot, Mech. Syst. Signal Process. (2019): EMPS benchmark"
    parameters = (
        Parameter(
            "coefficient", "damping", 0.0, -5.0, 50.0, (0.2,), "damping",
            meaning="mean viscous friction of both directions", relation="added",
        ),
        Parameter(
            "difference", "damping", 0.0, -5.0, 5.0, (0.1,), "damping",
            meaning="half the difference between the directions", difference_of="coefficient",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "viscous_friction": "record the same constant speeds in both directions: the slopes of "
        "friction over speed differ",
        "asymmetric_friction": "record constant speeds a factor of four apart: the difference "
        "between the directions grows with speed",
        "quadratic_drag": "record the same constant speeds in both directions: drag is the same",
    }
    generalizes = frozenset({"viscous_friction"})

    def special_cases(self, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        return {"viscous_friction": {"coefficient": values["coefficient"]}}

    def holds(self, effect: str) -> Mapping[str, str]:
        return {"coefficient": "coefficient"} if effect == "viscous_friction" else {}

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.damping += values["coefficient"]

    def force(self, world: World, values: Values) -> None:
        world.drag_motor(values["difference"] * np.sign(world.motor_velocity))


class GearEfficiency(Effect):
    """The losses of the gear depend on whether the motor drives the load or the load the motor.

    A worm or harmonic gear that the motor drives loses less than one that the load drives. A gear
    that the load cannot drive is self-locking: its ``backward_loss`` is 1 or more.
    """

    id = "gear_efficiency"
    family = "friction"
    law = (
        "level = forward_loss |delivered| while the motor drives the load (delivered v > 0), "
        "backward_loss |delivered| while the load drives the motor; "
        "forward efficiency = 1 - forward_loss, backward efficiency = 1 / (1 + backward_loss)"
    )
    source = "Giberti, Cinquemani, Legnani, Mech. Mach. Theory 45 (2010): efficiency of gearmotors"
    parameters = (
        Parameter(
            "forward_loss", "effort_per_load", 0.0, 0.0, 0.8, (0.2,),
            meaning="share of the motor's effort lost while the motor drives the load",
        ),
        Parameter(
            "backward_loss", "effort_per_load", 0.0, 0.0, 4.0, (0.3,),
            meaning="friction per unit of the motor's effort while the load drives the motor",
        ),
    )  # fmt: skip
    reads_delivered_effort = True
    confused_with: ClassVar = {
        "load_dependent_friction": "lift and lower one load at the same speed: the loss per unit "
        "of effort differs",
        "motor_load_friction": "lift and lower one load at the same speed: the loss per unit of "
        "effort differs",
        "coulomb_friction": "repeat the same speed with two payloads: Coulomb friction stays the "
        "same",
        "torque_constant": "lift and lower one load: friction changes its sign",
    }
    generalizes = frozenset({"load_dependent_friction"})

    def special_cases(self, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        mean = 0.5 * (values["forward_loss"] + values["backward_loss"])
        return {"load_dependent_friction": {"coefficient": mean, "of_drive": 1.0}}

    def friction(self, world: World, values: Values) -> None:
        effort = motor_effort(world)
        # At rest the direction of power is that in which the joint would break away.
        standing = np.abs(world.motor_velocity) < _REST_SPEED
        way = np.where(standing, effort - world.load, world.motor_velocity)
        loss = np.where(effort * way > 0.0, values["forward_loss"], values["backward_loss"])
        world.friction_level = world.friction_level + loss * np.abs(effort)
