"""Why MuJoCo has no form of an effect."""

from __future__ import annotations

from collections.abc import Mapping

from pytest_twin.effects import (
    actuation,
    directional,
    environment,
    friction,
    motor,
    sensing,
    servo,
    timing,
    unnamed_law,
)

_OF_THE_LOG = "a property of the recorded log: correct the log, not the simulator"
_LEVEL = "MuJoCo's dry friction has one level for each joint"

LOSSES: Mapping[str, str] = {
    actuation.DeadZone.id: "no MuJoCo actuator ignores small errors",
    actuation.RateLimit.id: "MuJoCo limits the rate of a setpoint, not that of an effort",
    friction.LoadDependentFriction.id: f"{_LEVEL}, which does not follow the load",
    motor.MotorLoadFriction.id: f"{_LEVEL}, which does not follow the motor's effort",
    directional.GearEfficiency.id: f"{_LEVEL}, which does not follow the direction of power",
    friction.ThermalFriction.id: f"{_LEVEL}, which does not change over time; the thermal term of "
    "a dcmotor is the resistance of its winding",
    friction.ViscousFriction.id: "MJCF has no negative damping",
    friction.QuadraticDrag.id: "MJCF has no negative damping",
    motor.TorqueRolloff.id: "MuJoCo's motor constant does not fall with the current",
    motor.WatchdogTimeout.id: "no MuJoCo actuator switches itself off",
    servo.VelocityFilter.id: "MuJoCo's velocity gain acts on the unfiltered velocity",
    servo.VelocityFeedforward.id: "MuJoCo does not differentiate a setpoint: send its rate on the "
    "input 'vel' of a pid",
    servo.ControlPeriod.id: "MuJoCo's actuators are not sampled",
    environment.ExternalForce.id: "a disturbance during the recording, not a property of the robot",
    sensing.EncoderEccentricity.id: "no MuJoCo sensor has a periodic error",
    sensing.EffortBias.id: _OF_THE_LOG,
    sensing.EffortScale.id: _OF_THE_LOG,
    timing.ClockDrift.id: _OF_THE_LOG,
    **dict.fromkeys(unnamed_law.TABLES, "a table over a state, which no MuJoCo element takes"),
}
"""Id of an effect -> why it is lost."""
