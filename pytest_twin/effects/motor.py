"""Motor effects: how a geared DC motor turns the requested effort into delivered effort."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import ClassVar

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import Effect, Parameter, Values, World
from pytest_twin.effects.proposal import JointFit, Start

# Setpoints that differ by less are equal: 1/2000 of an encoder count (12 bits per turn), in rad.
_SAME_COMMAND = 1e-6
# Rest of a command, s, from which a watchdog may act: shorter ones are the steps of a slow log.
_SHORTEST_REST = 0.05
# Times of a watchdog that are tried, as shares of the longest rest.
_SHARES_OF_REST = (0.95, 0.8, 0.6, 0.4, 0.2)
# Part of ``delivered`` that cancels back-EMF, which the model holds as passive damping.
_BACK_EMF_EFFORT = "back_emf"


class TorqueRolloff(Effect):
    """The motor's torque per ampere falls as the current grows (magnetic saturation, supply).

    Models represent back-EMF as passive damping. It stays there, but it reduces the current, and
    so the part that saturates.
    """

    id = "torque_rolloff"
    family = "actuation"
    stage = "drive"
    law = (
        "ideal = drive - back_emf v; effort of the motor = ideal / (1 + |ideal| / knee); "
        "back_emf v: the part of the model's passive damping that is back-EMF"
    )
    source = (
        "torque constant that falls with current by saturation and armature reaction; Hughes, "
        "Drury, Electric Motors and Drives (2019), ch. 3; the curve: Froehlich (1881)"
    )
    parameters = (
        # Absent at infinity: the parameter is the reciprocal of the knee.
        Parameter(
            "inverse_knee", "one", 0.0, 0.0, 10.0, (0.3, 1.0), "inverse_effort",
            ("knee", "effort"), meaning="effort at which half the ideal effort is lost",
        ),
        Parameter(
            "back_emf", "damping", None, 0.0, 3.0, (0.0, 0.3), "damping",
            meaning="damping by back-EMF", part_of="damping",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "torque_saturation": "increase the load in steps up to the limit: a roll-off shows from "
        "the first step",
        "torque_constant": "hold two loads a factor of four apart: a torque constant scales both "
        "equally",
        "controller_gain": "hold two loads a factor of four apart: a gain scales both equally",
        "motor_load_friction": "lift and lower one load: friction changes its sign",
    }

    def drive(self, world: World, values: Values) -> None:
        inverse_knee = values["inverse_knee"]
        back_emf_effort = np.where(
            inverse_knee > 0.0, values["back_emf"] * world.motor_velocity, 0.0
        )
        ideal = world.delivered - back_emf_effort
        world.delivered = ideal / (1.0 + np.abs(ideal) * inverse_knee) + back_emf_effort
        world.state[_BACK_EMF_EFFORT] = back_emf_effort


class WatchdogTimeout(Effect):
    """The drive switches off after its command has been constant for some time.

    A watchdog, an idle release and a controller that disables torque after a motion look the same
    in a recording. The motor's back-EMF, part of the model's passive damping, ends too. This effect
    acts after all other effects of the drive.
    """

    id = "watchdog_timeout"
    family = "actuation"
    stage = "drive"
    law = (
        "delivered = 0 once the command has been constant for timeout, until it changes; "
        "back_emf v: the part of the model's passive damping that disappears while the drive is off"
    )
    source = "Bus Watchdog, ROBOTIS e-Manual, X series, control table address 98"
    parameters = (
        # Absent at infinity: the parameter is the reciprocal of the time.
        Parameter(
            "inverse_timeout", "one", 0.0, 0.0, 140.0, (2.0, 30.0, 120.0), "one",
            ("timeout", "time"), meaning="watchdog timeout",
        ),
        Parameter(
            "back_emf", "damping", None, 0.0, 3.0, (0.0, 0.3), "damping",
            meaning="damping by back-EMF", part_of="damping",
        ),
    )  # fmt: skip
    remembers = True
    confused_with: ClassVar = {
        "torque_saturation": "keep the command moving under the same load: a drive with a watchdog "
        "then holds it",
        "external_force": "repeat the motion with a command that never stops: a watchdog does not "
        "act then",
    }

    def propose(self, at: JointFit) -> Iterable[Start]:
        """Times within the longest rest: a time beyond it does nothing, and has no slope."""
        if at.present is None and at.longest_rest > _SHORTEST_REST:
            for share in _SHARES_OF_REST:
                yield Start(np.array([1.0 / (share * at.longest_rest), 0.0]))

    def command(self, world: World, values: Values) -> None:
        held = world.state.get(self.id)
        if held is None:
            last, constant_time = world.setpoint.copy(), np.zeros_like(world.setpoint)
        else:
            last, constant_time = held
            changed = np.abs(world.setpoint - last) > _SAME_COMMAND
            constant_time = np.where(changed, 0.0, constant_time + world.timestep)
            last = np.where(changed, world.setpoint, last)
        world.state[self.id] = (last, constant_time)

    def follow_commands(
        self, world: World, values: Values, commands: Iterable[tuple[FloatArray, FloatArray]]
    ) -> None:
        for command, seconds in commands:
            last, constant_time = world.state.get(self.id, (command, np.zeros_like(command)))
            changed = (seconds > 0.0) & (np.abs(command - last) > _SAME_COMMAND)
            last = np.where(changed, command, last)
            world.state[self.id] = (last, np.where(changed, 0.0, constant_time) + seconds)

    def drive(self, world: World, values: Values) -> None:
        _, constant_time = world.state[self.id]
        is_off = constant_time * values["inverse_timeout"] > 1.0
        undamped = values["back_emf"] * world.motor_velocity
        world.delivered = np.where(is_off, undamped, world.delivered)
        world.state[_BACK_EMF_EFFORT] = np.where(
            is_off, undamped, world.state.get(_BACK_EMF_EFFORT, 0.0)
        )


class MotorLoadFriction(Effect):
    """Dry friction of the gear that grows with the motor's effort.

    Unlike friction that grows with the load, it is zero while the motor is off.
    """

    id = "motor_load_friction"
    family = "friction"
    stage = "friction"
    law = "level = (coefficient + stiction_excess exp(-|v| / stribeck_velocity)) |delivered|"
    source = (
        "Duclos et al., arXiv:2410.08650 (friction by motor and by external torque); fall with "
        "speed: Tustin (1947), in Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994)"
    )
    parameters = (
        # Bounds as in load_dependent_friction.
        Parameter(
            "coefficient", "effort_per_load", 0.0, 0.0, 0.8, (0.2,),
            meaning="friction in motion per unit of effort",
        ),
        Parameter(
            "stiction_excess", "effort_per_load", 0.0, 0.0, 0.8, (0.1,),
            meaning="extra friction at rest per unit of effort", sums_with="coefficient",
        ),
        Parameter(
            "stribeck_velocity", "velocity", None, 0.005, 3.0, (0.15, 0.5), "velocity",
            meaning="Stribeck velocity",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "load_dependent_friction": "move the same load with the motor off: only friction from the "
        "load remains",
        "torque_constant": "lift and lower one load: friction changes its sign",
        "coulomb_friction": "repeat the same speed with two payloads: Coulomb friction stays the "
        "same",
        "stribeck_friction": "repeat the same speeds with two payloads: Stribeck friction stays "
        "the same",
    }
    generalizes = frozenset({"load_dependent_friction"})
    reads_delivered_effort = True

    def friction(self, world: World, values: Values) -> None:
        stribeck_velocity = np.maximum(values["stribeck_velocity"], 1e-9)
        fall = np.exp(-np.abs(world.motor_velocity) / stribeck_velocity)
        share = values["coefficient"] + values["stiction_excess"] * fall
        world.friction_level = world.friction_level + share * np.abs(motor_effort(world))

    def special_cases(self, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        plain = {"coefficient": values["coefficient"], "of_drive": 1.0}
        return {"load_dependent_friction": plain}


def motor_effort(world: World) -> FloatArray:
    """(rows, joints) part of the delivered effort that the motor produces, N*m or N."""
    effort: FloatArray = world.delivered - world.state.get(_BACK_EMF_EFFORT, 0.0)
    return effort
