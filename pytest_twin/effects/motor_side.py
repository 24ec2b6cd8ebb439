"""The motor's side of gears that give: one more inertia per joint.

It is integrated implicitly over a step in which the link keeps its velocity; the link feels what
the gear then transmits. All arrays are (rows, joints), SI units at the joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.within import within

_RING = 0.6
"""Damping of teeth, in units of the root of stiffness times inertia."""
_KEPT = 0.5
"""Share of its speed against the motor that a link may lose in a step, which it feels late."""
_STIFFEST = 0.5
"""Stiffest gear, in units of inertia over a step squared."""


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
    def rigid(cls, like: FloatArray) -> Gear:
        """Nothing that gives, for (rows, joints) joints like these."""
        none = np.zeros(like.shape)
        return cls(none != 0.0, none.copy(), none.copy(), none.copy())

    def stretch(self, load: FloatArray) -> FloatArray:
        """How far a motor that carries a load (rows, joints) stands from its link."""
        return load / np.maximum(self.stiffness, 1e-9) + np.sign(load) * self.gap / 2.0

    def give(
        self, acts: NDArray[np.bool_], compliance: FloatArray, damping_time: FloatArray | None,
        armature: FloatArray, link_inertia: FloatArray, timestep: float,
    ) -> None:  # fmt: skip
        """Yield by a compliance in series with what yields already.

        Args:
            acts: where.
            compliance: rad/(N*m) or m/N.
            damping_time: s, damping over stiffness; by default so much that the motor hardly rings.
            armature: of the motor, kg*m^2 or kg: teeth are no stiffer than a step resolves.
            link_inertia: what they push on the other side: a link feels them a step late, and one
                that is light beside its motor would be thrown back and forth.
            timestep: s.
        """
        inertia = np.maximum(armature, 1e-9)
        before = np.where(self.stiffness > 0.0, 1.0 / np.maximum(self.stiffness, 1e-12), 0.0)
        stiffness = np.minimum(
            1.0 / np.maximum(compliance + before, 1e-12), _STIFFEST * inertia / timestep**2
        )
        if damping_time is None:
            damping = np.where(
                self.damping > 0.0, self.damping, _RING * np.sqrt(stiffness * inertia)
            )
        else:
            damping = damping_time * stiffness
        share = _resolved(stiffness * timestep + damping, inertia, link_inertia, timestep)
        stiffness, damping = share * stiffness, share * damping
        self.apart = self.apart | acts
        self.stiffness = np.where(acts, stiffness, self.stiffness)
        self.damping = np.where(acts, damping, self.damping)


def _resolved(
    teeth: FloatArray, motor: FloatArray, link: FloatArray, timestep: float
) -> FloatArray:
    """Share of what teeth add for each unit of speed at which a step takes from a link no more than
    :data:`_KEPT` of its speed against the motor, which itself gives way within the step.
    """
    # teeth in series with the motor's momentum over a step: at most as much of the link's.
    most = _KEPT * link / timestep
    momentum = motor / timestep
    bound = most < momentum
    least = np.where(bound, momentum - most, 1.0)
    return np.where(bound, np.minimum(1.0, most * momentum / least / teeth), 1.0)


@dataclass(slots=True)
class MotorSide:
    """Where motors are, what pushes them, and what of their gears does not change.

    Attributes:
        apart: where motor and link move apart; elsewhere the motor is the link.
        angle, speed: of the motor, seen from the link.
        constant: effort that always acts on it.
        applied: effort on it in this step beside the drive's.
        drag: in this step effort against it for each unit of its speed.
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
    drag: FloatArray
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
        stretch = gear.stretch(load)
        # Where it does not act nothing is transmitted.
        stiffness = np.where(gear.apart, gear.stiffness, 0.0)
        pull = stiffness * timestep + np.where(gear.apart, gear.damping, 0.0)
        momentum = np.maximum(armature, 1e-9) / timestep
        play = bool(gear.gap.any())
        inert = momentum + damping
        return cls(
            gear.apart, position + np.where(gear.apart, stretch, 0.0), velocity.copy(), constant,
            constant, np.zeros_like(constant), stiffness, pull, gear.gap / 2.0 if play else None,
            momentum, inert if play else inert + pull, servo,
        )  # fmt: skip

    def meet(self, position: FloatArray, velocity: FloatArray) -> None:
        """Begin a step: without a gear that gives the motor is where the link is."""
        self.angle = np.where(self.apart, self.angle, position)
        self.speed = np.where(self.apart, self.speed, velocity)
        self.applied, self.drag = self.constant.copy(), np.zeros(self.constant.shape)

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
        inert, gear = self.inert + self.servo * free + self.drag, self.gear
        half = self.half_gap
        if half is not None:
            deflection = deflection - within(deflection, -half, half)
            # Without play teeth always touch, also where they are not deflected.
            gear = gear * ((deflection != 0.0) | (half == 0.0))
            inert = inert + gear
        pull = self.stiffness * deflection
        push = (self.momentum + servo_damping * free) * self.speed + drive + self.applied
        moving = (push - pull + gear * velocity) / inert
        # Dry friction as the impulse that stops the motor, at most its level (Moreau 1988).
        most = friction_level / inert
        moving = moving - within(moving, -most, most)
        transmitted = pull + gear * (moving - velocity)
        if half is not None:
            # Flanks push and never pull.
            flank = np.sign(deflection)
            flat = half == 0.0
            transmitted = np.where(flat, transmitted, flank * np.maximum(flank * transmitted, 0.0))
        self.angle, self.speed = self.angle + timestep * moving, moving
        return np.where(self.apart, transmitted, self.applied - self.drag * velocity)
