"""The motor's side of gears that give: one more inertia per joint.

It is integrated implicitly over a step in which the link keeps its velocity; the link feels what
the gear then transmits. All arrays are (rows, joints), SI units at the joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(slots=True)
class Gear:
    """What stands between motor and link.

    Attributes:
        apart: where they move apart at all.
        stiffness, damping: of the teeth.
        gap: play between them.
    """

    apart: NDArray[np.bool_]
    stiffness: FloatArray
    damping: FloatArray
    gap: FloatArray

    @classmethod
    def stiff(cls, armature: FloatArray, timestep: float) -> Gear:
        """Teeth as stiff as the step resolves: their deflection is small beside any gap."""
        stiffness = 0.05 * np.maximum(armature, 1e-9) / timestep**2
        damping = 0.6 * np.sqrt(stiffness * np.maximum(armature, 1e-9))
        return cls(np.zeros(armature.shape, dtype=bool), stiffness, damping, np.zeros_like(damping))


@dataclass(slots=True)
class MotorSide:
    """Where motors are, what pushes them, and what of their gears does not change.

    Attributes:
        apart: where motor and link move apart; elsewhere the motor is the link.
        angle, speed: of the motor, seen from the link.
        constant: effort that always acts on it.
        applied: effort on it in this step beside the drive's.
        stiffness: of the teeth.
        gear: effort that the teeth add over a step for each unit of speed between both sides.
        half_gap: play to either side, None where there is none anywhere.
        momentum: inertia over a step; ``inert`` with what always resists the motor.
        servo: effort that the drive takes back over a step for each unit of speed.
    """

    apart: NDArray[np.bool_]
    angle: FloatArray
    speed: FloatArray
    constant: FloatArray
    applied: FloatArray
    stiffness: FloatArray
    gear: FloatArray
    half_gap: FloatArray | None
    momentum: FloatArray
    inert: FloatArray
    servo: FloatArray

    @classmethod
    def at_rest(
        cls,
        gear: Gear,
        position: FloatArray,
        velocity: FloatArray,
        load: FloatArray,
        *,
        armature: FloatArray,
        damping: FloatArray,
        constant: FloatArray,
        servo: FloatArray,
        timestep: float,
    ) -> MotorSide:
        """Motors that carry a load: gears stretched, on one flank.

        Args:
            gear: in between.
            position, velocity: of the link.
            load: effort that it asks for.
            armature, damping, constant: of the motor: inertia, viscous damping, effort that always
                acts on it.
            servo: effort that the drive takes back over a step for each unit of speed.
            timestep: s.
        """
        stretch = load / np.maximum(gear.stiffness, 1e-9) + np.sign(load) * gear.gap / 2.0
        # Where it does not act nothing is transmitted.
        stiffness = np.where(gear.apart, gear.stiffness, 0.0)
        pull = stiffness * timestep + np.where(gear.apart, gear.damping, 0.0)
        momentum = np.maximum(armature, 1e-9) / timestep
        play = bool(gear.gap.any())
        inert = momentum + damping
        return cls(
            gear.apart, position + np.where(gear.apart, stretch, 0.0), velocity.copy(), constant,
            constant, stiffness, pull, gear.gap / 2.0 if play else None, momentum,
            inert if play else inert + pull, servo,
        )  # fmt: skip

    def meet(self, position: FloatArray, velocity: FloatArray) -> None:
        """Begin a step: without a gear that gives the motor is where the link is."""
        self.angle = np.where(self.apart, self.angle, position)
        self.speed = np.where(self.apart, self.speed, velocity)
        self.applied = self.constant.copy()

    def step(
        self,
        position: FloatArray,
        velocity: FloatArray,
        drive: FloatArray,
        *,
        free: NDArray[np.bool_],
        servo_damping: FloatArray,
        friction_level: FloatArray,
        timestep: float,
    ) -> FloatArray:
        """Move the motors by a step.

        Args:
            position, velocity: of the link.
            drive: effort of the drive.
            free: where the drive is within its bounds and gives way over the step as its gains say.
            servo_damping: of the drive.
            friction_level: dry friction that may hold the motor.
            timestep: s.

        Returns:
            What reaches the link: through the gear, or where none gives all that pushes the motor
            beside its drive.
        """
        deflection = self.angle - position
        inert, gear = self.inert + self.servo * free, self.gear
        half = self.half_gap
        if half is not None:
            deflection = deflection - np.minimum(np.maximum(deflection, -half), half)
            # Without play teeth always touch, also where they are not deflected.
            gear = gear * ((deflection != 0.0) | (half == 0.0))
            inert = inert + gear
        pull = self.stiffness * deflection
        push = (self.momentum + servo_damping * free) * self.speed + drive + self.applied
        moving = (push - pull + gear * velocity) / inert
        # Dry friction as the impulse that stops the motor, at most its level (Moreau 1988).
        most = friction_level / inert
        moving = moving - np.minimum(np.maximum(moving, -most), most)
        transmitted = pull + gear * (moving - velocity)
        if half is not None:
            # Flanks push and never pull.
            flank = np.sign(deflection)
            flat = half == 0.0
            transmitted = np.where(flat, transmitted, flank * np.maximum(flank * transmitted, 0.0))
        self.angle, self.speed = self.angle + timestep * moving, moving
        return np.where(self.apart, transmitted, self.applied)
