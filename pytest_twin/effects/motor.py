"""Motor: what a geared DC motor makes of the effort that its drive asks for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import ClassVar

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import Effect, Parameter, Values, World

# Setpoints that differ by less are the same: a two-thousandth of an encoder's count.
_SAME_COMMAND = 1e-6
# Effort within ``delivered`` that stands for back-EMF held as passive damping: not the motor's.
_TAKEN = "back_emf"


class TorqueRolloff(Effect):
    """The effort gained per ampere falls as the current grows: iron, supply and bridge give way.

    Models hold a motor's back-EMF as passive damping. There it stays, but it takes from the current
    and so from what rolls off.
    """

    id = "torque_rolloff"
    family = "actuation"
    of_every_drive = True
    law = (
        "ideal = drive - back_emf v; effort of the motor = ideal / (1 + |ideal| / knee); of the "
        "model's passive damping, back_emf v is in it"
    )
    source = (
        "torque constant that falls with current by saturation and armature reaction; Hughes, "
        "Drury, Electric Motors and Drives (2019), ch. 3; the curve: Froehlich (1881)"
    )
    parameters = (
        # Absent at infinity: the parameter is the reciprocal of the knee.
        Parameter(
            "inverse_knee", "one", 0.0, 0.0, 10.0, (0.3, 1.0), "inverse_effort", ("knee", "effort")
        ),
        Parameter("back_emf", "damping", None, 0.0, 3.0, (0.0, 0.3), "damping"),
    )
    confused_with: ClassVar = {
        "torque_saturation": "loads in steps up to the limit: a roll-off bends from the first",
        "torque_constant": "two loads a factor of four apart: a constant scales both alike",
        "controller_gain": "two loads a factor of four apart: a gain scales both alike",
        "motor_load_friction": "lowering and lifting one load: friction changes its sign",
    }

    def drive(self, world: World, values: Values) -> None:
        bent = values["inverse_knee"]
        taken = np.where(bent > 0.0, values["back_emf"] * world.motor_velocity, 0.0)
        ideal = world.delivered - taken
        world.delivered = ideal / (1.0 + np.abs(ideal) * bent) + taken
        world.state[_TAKEN] = taken


class WatchdogTimeout(Effect):
    """A drive that lets go once its command has stood still for some time.

    A watchdog, an idle release, or a controller that disables torque when its motion is done: the
    recordings of commands and states look alike. The motor's back-EMF is gone with it, though the
    model has it as passive damping. Acts on what every other law of the drive leaves.
    """

    id = "watchdog_timeout"
    family = "actuation"
    law = (
        "drive off from when the command has not changed for timeout until it changes; of the "
        "model's passive damping, back_emf v goes with it"
    )
    source = "Bus Watchdog, ROBOTIS e-Manual, X series, control table address 98"
    parameters = (
        # Absent at infinity: the parameter is the reciprocal of the time.
        Parameter(
            "inverse_timeout", "one", 0.0, 0.0, 140.0, (2.0, 30.0, 120.0), "one",
            ("timeout", "time"),
        ),
        Parameter("back_emf", "damping", None, 0.0, 3.0, (0.0, 0.3), "damping"),
    )  # fmt: skip
    remembers = True
    confused_with: ClassVar = {
        "torque_saturation": "a command that moves while the load stays: only a timeout holds then",
        "external_force": "the same motion with a command that never stands still",
    }

    def command(self, world: World, values: Values) -> None:
        held = world.state.get(self.id)
        if held is None:
            last, still = world.setpoint.copy(), np.zeros_like(world.setpoint)
        else:
            last, still = held
            changed = np.abs(world.setpoint - last) > _SAME_COMMAND
            still = np.where(changed, 0.0, still + world.timestep)
            last = np.where(changed, world.setpoint, last)
        world.state[self.id] = (last, still)

    def follow_commands(
        self, world: World, values: Values, commands: Iterable[tuple[FloatArray, FloatArray]]
    ) -> None:
        for command, seconds in commands:
            last, still = world.state.get(self.id, (command, np.zeros_like(command)))
            changed = (seconds > 0.0) & (np.abs(command - last) > _SAME_COMMAND)
            last = np.where(changed, command, last)
            world.state[self.id] = (last, np.where(changed, 0.0, still) + seconds)

    def drive(self, world: World, values: Values) -> None:
        _, still = world.state[self.id]
        gone = still * values["inverse_timeout"] > 1.0
        undamped = values["back_emf"] * world.motor_velocity
        world.delivered = np.where(gone, undamped, world.delivered)
        world.state[_TAKEN] = np.where(gone, undamped, world.state.get(_TAKEN, 0.0))


class MotorLoadFriction(Effect):
    """Dry friction of gears that grows with the effort that the motor puts through them.

    Unlike friction that grows with the load, it is gone where the motor is off and the load drives.
    """

    id = "motor_load_friction"
    family = "friction"
    of_every_drive = True
    law = "level = (coefficient + stiction_excess exp(-|v| / stribeck_velocity)) |delivered|"
    source = (
        "Duclos et al., arXiv:2410.08650 (friction by motor and by external torque); fall with "
        "speed: Tustin (1947), in Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994)"
    )
    parameters = (
        # As of load_dependent_friction.
        Parameter("coefficient", "effort_per_load", 0.0, 0.0, 0.8, (0.2,)),
        Parameter("stiction_excess", "effort_per_load", 0.0, 0.0, 0.8, (0.1,)),
        Parameter("stribeck_velocity", "velocity", None, 0.005, 3.0, (0.15, 0.5), "velocity"),
    )
    confused_with: ClassVar = {
        "load_dependent_friction": "the same load with the motor off: only friction by load stays",
        "torque_constant": "lowering and lifting one load: friction changes its sign",
        "coulomb_friction": "two loads at the same speed",
        "stribeck_friction": "two loads at the same speeds",
    }
    has_in_it = frozenset({"load_dependent_friction"})
    reads_drive = True

    def friction(self, world: World, values: Values) -> None:
        reach = np.maximum(values["stribeck_velocity"], 1e-9)
        fall = np.exp(-np.abs(world.motor_velocity) / reach)
        share = values["coefficient"] + values["stiction_excess"] * fall
        world.friction_level = world.friction_level + share * np.abs(motor_effort(world))

    def special_cases(self, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        plain = {"coefficient": values["coefficient"], "of_drive": 1.0}
        return {"load_dependent_friction": plain}


def motor_effort(world: World) -> FloatArray:
    """(rows, joints) of what is delivered that the motor gives, N*m or N."""
    effort: FloatArray = world.delivered - world.state.get(_TAKEN, 0.0)
    return effort
