"""Transmission: what stands between the drive and the link."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pytest_twin.effects.base import Effect, FloatArray, ModelFields, Parameter, Values, World


class JointSpring(Effect):
    """A passive spring at the joint: a balancer, a cable bundle, a seal."""

    id = "joint_spring"
    family = "transmission"
    law = "effort = -stiffness (q - rest), written as preload - stiffness q"
    source = "Siciliano et al., Robotics (2009), sec. 7.2"
    parameters = (
        Parameter("stiffness", "stiffness", 0.0, -2.0, 20.0, (0.1,), "stiffness"),
        Parameter("preload", "effort", 0.0, -10.0, 10.0, (0.1,), "effort"),
    )
    confused_with: ClassVar = {
        "controller_gain": "the drive off: only a spring pulls",
        "base_tilt": "another joint's pose: a spring does not feel it",
        "encoder_bias": "poses far apart",
        "asymmetric_friction": "poses far apart",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.stiffness += values["stiffness"]
        fields.constant_force += values["preload"]


class JointCoupling(Effect):
    """The drive of the joint before moves this one too: a differential, a routed cable."""

    id = "joint_coupling"
    family = "transmission"
    law = "delivered_j += ratio drive_(j-1)"
    source = "Siciliano et al., Robotics (2009), sec. 5.1: transmissions that couple joints"
    parameters = (Parameter("ratio", "one", 0.0, -2.0, 2.0, (0.1,)),)
    reads_other_joints = True
    confused_with: ClassVar = {
        "inertial_parameters": "hold the other joint still under load: only a coupling pulls",
    }

    def drive(self, world: World, values: Values) -> None:
        before = np.zeros_like(world.delivered)
        before[:, 1:] = world.delivered[:, :-1]
        world.delivered = world.delivered + values["ratio"] * before


@dataclass(slots=True)
class _MotorSide:
    """Where motors are, and what of their gears does not change, (rows, joints) each.

    ``half_gap`` is None where gears have no play; ``momentum`` is inertia over a step, ``inert`` it
    with what always acts on the motor.
    """

    angle: FloatArray
    speed: FloatArray
    stiffness: FloatArray
    gear: FloatArray
    half_gap: FloatArray | None
    momentum: FloatArray
    inert: FloatArray
    servo: FloatArray


class _Compliance(Effect):
    """A motor side that moves apart from the link: one more inertia per joint.

    The motor side is integrated implicitly over a step in which the link keeps its velocity; the
    link feels what the gear then transmits.
    """

    remembers = True

    def _gear(
        self, world: World, values: Values
    ) -> tuple[NDArray[np.bool_], FloatArray, FloatArray, FloatArray | None]:
        """Where it acts, and stiffness, damping and gap of the gear, (rows, joints) each."""
        raise NotImplementedError

    def _at_rest(self, world: World, values: Values) -> _MotorSide:
        """Start where the gear carries the load: stretched, on one flank."""
        acts, stiffness, damping, gap = self._gear(world, values)
        dt = world.timestep
        stretch = world.load / np.maximum(stiffness, 1e-9)
        if gap is not None:
            stretch = stretch + np.sign(world.load) * gap / 2.0
        # Where it does not act nothing is transmitted.
        stiffness, damping = np.where(acts, stiffness, 0.0), np.where(acts, damping, 0.0)
        gear = stiffness * dt + damping
        momentum = np.maximum(world.motor_armature, 1e-9) / dt
        inert = momentum + world.motor_damping
        if gap is None:
            inert = inert + gear
        return _MotorSide(
            world.position + stretch, world.velocity.copy(), stiffness, gear,
            None if gap is None else gap / 2.0, momentum, inert,
            world.damping + world.stiffness * dt,
        )  # fmt: skip

    def transmit(self, world: World, values: Values) -> None:
        side = world.state.get(self.id)
        if side is None:
            side = world.state[self.id] = self._at_rest(world, values)
        angle, speed, gear = side.angle, side.speed, side.gear
        deflection = angle - world.position
        law = world.asked(angle, speed)
        drive = np.minimum(np.maximum(law, world.lower), world.upper)
        # A drive within its bounds gives way over the step as its gains say.
        free = drive == law
        inert = side.inert + side.servo * free
        half = side.half_gap
        if half is not None:
            deflection = deflection - np.minimum(np.maximum(deflection, -half), half)
            gear = gear * (deflection != 0.0)
            inert = inert + gear
        pull = side.stiffness * deflection
        push = (side.momentum + world.damping * free) * speed + drive - pull + gear * world.velocity
        moving = push / inert
        # Dry friction as the impulse that stops the motor, at most its level (Moreau 1988).
        most = world.friction_level / inert
        moving = moving - np.minimum(np.maximum(moving, -most), most)
        transmitted = pull + gear * (moving - world.velocity)
        if half is not None:
            # Flanks push and never pull.
            flank = np.sign(deflection)
            transmitted = flank * np.maximum(flank * transmitted, 0.0)
        side.angle, side.speed = angle + world.timestep * moving, moving
        world.applied += transmitted


class Backlash(_Compliance):
    """Play between the teeth: the link is free within a gap."""

    id = "backlash"
    family = "transmission"
    law = "effort passes where |motor - link| > gap / 2"
    source = "Nordin, Gutman, Automatica 38 (2002): controlling systems with backlash"
    parameters = (Parameter("gap", "position", 0.0, 0.0, 0.4, (0.01, 0.025, 0.06)),)
    confused_with: ClassVar = {
        "dead_zone": "hold the link by hand: only backlash lets it move freely",
        "coulomb_friction": "hold the link by hand",
        "joint_elasticity": "two loads: a gap does not grow with the load",
    }

    def separates(self, values: Values) -> NDArray[np.bool_] | None:
        return values["gap"] > 0.0

    def _gear(
        self, world: World, values: Values
    ) -> tuple[NDArray[np.bool_], FloatArray, FloatArray, FloatArray | None]:
        # Teeth as stiff as the step resolves: their deflection is small beside the gap.
        stiffness = 0.05 * np.maximum(world.motor_armature, 1e-9) / world.timestep**2
        damping = 0.6 * np.sqrt(stiffness * np.maximum(world.motor_armature, 1e-9))
        gap = values["gap"]
        return gap > 0.0, stiffness, damping, gap


class JointElasticity(_Compliance):
    """A gear or belt that yields: motor and link swing against each other."""

    id = "joint_elasticity"
    family = "transmission"
    law = (
        "effort = stiffness (motor - link) + damping (their velocities), compliance = 1 / stiffness"
    )
    source = "Spong, J. Dyn. Syst. Meas. Control 109 (1987): elastic joint robots"
    parameters = (
        # Absent at infinity: the parameter is the reciprocal of the stiffness.
        Parameter(
            "compliance", "one", 0.0, 0.0, 20.0, (0.02, 0.06, 0.15, 0.4), "compliance",
            ("stiffness", "stiffness"),
        ),
        Parameter("damping_time", "time", None, 0.0, 0.2, (0.004, 0.015)),
    )  # fmt: skip
    confused_with: ClassVar = {
        "backlash": "two loads: elasticity yields in proportion",
        "actuator_lag": "tap the link: only elasticity rings",
        "controller_gain": "fast and slow: elasticity rings",
    }

    def separates(self, values: Values) -> NDArray[np.bool_] | None:
        return values["compliance"] > 0.0

    def _gear(
        self, world: World, values: Values
    ) -> tuple[NDArray[np.bool_], FloatArray, FloatArray, FloatArray | None]:
        acts = values["compliance"] > 0.0
        stiffest = 0.5 * np.maximum(world.motor_armature, 1e-9) / world.timestep**2
        stiffness = np.minimum(1.0 / np.maximum(values["compliance"], 1e-12), stiffest)
        return acts, stiffness, values["damping_time"] * stiffness, None
