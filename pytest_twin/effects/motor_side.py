"""The motor side of elastic transmissions and gears with backlash: one more inertia per joint.

It is integrated implicitly over a step in which the link velocity is constant. The transmitted
effort then acts on the link. All arrays are (rows, joints), SI units at the joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.fast_clip import fast_clip

_RING = 0.6
"""Damping of the teeth divided by the square root of stiffness times inertia; little ringing."""
_KEPT = 0.5
"""Largest share of its speed against the motor that a link may lose in a step, for stability."""
_STIFFEST = 0.5
"""Largest stiffness that a step resolves, in units of inertia divided by the step squared."""


@dataclass(slots=True)
class Gear:
    """The transmission between motor and link.

    Attributes:
        apart: where the transmission is not rigid.
        stiffness, damping: of the teeth.
        gap: backlash.
    """

    apart: NDArray[np.bool_]
    stiffness: FloatArray
    damping: FloatArray
    gap: FloatArray

    @classmethod
    def rigid(cls, like: FloatArray) -> Gear:
        """A rigid transmission with the (rows, joints) shape of ``like``."""
        none = np.zeros(like.shape)
        return cls(none != 0.0, none.copy(), none.copy(), none.copy())

    def stretch(self, load: FloatArray) -> FloatArray:
        """Deflection between motor and link under a (rows, joints) load."""
        return load / np.maximum(self.stiffness, 1e-9) + np.sign(load) * self.gap / 2.0

    def give(
        self, acts: NDArray[np.bool_], compliance: FloatArray, damping_time: FloatArray | None,
        armature: FloatArray, link_inertia: FloatArray, timestep: float,
    ) -> None:  # fmt: skip
        """Add a compliance in series.

        Args:
            acts: where it acts.
            compliance: rad/(N*m) or m/N.
            damping_time: damping divided by stiffness, s; by default nearly aperiodic.
            armature: motor inertia, kg*m^2 or kg; limits the stiffness to what a step resolves.
            link_inertia: inertia on the link side. The effort reaches the link one step late, which
                limits stiffness and damping for light links.
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
    """Factor on stiffness and damping at which a link loses at most :data:`_KEPT` of its speed
    against the motor in a step.
    """
    # Teeth in series with the motor's momentum over a step, limited by the link's momentum.
    most = _KEPT * link / timestep
    momentum = motor / timestep
    bound = most < momentum
    least = np.where(bound, momentum - most, 1.0)
    return np.where(bound, np.minimum(1.0, most * momentum / least / teeth), 1.0)


@dataclass(frozen=True, slots=True)
class Motor:
    """Properties of the motor side, converted to the joint side, (rows, joints) each.

    Attributes:
        armature: motor inertia, kg*m^2 or kg.
        damping: viscous coefficient, N*m*s/rad or N*s/m.
        constant: constant effort, N*m or N.
        servo: reduction of the drive's effort per unit of motor speed over a step.
    """

    armature: FloatArray
    damping: FloatArray
    constant: FloatArray
    servo: FloatArray


@dataclass(slots=True)
class MotorSide:
    """State and coefficients of the motor sides.

    Attributes:
        apart: where the transmission is not rigid; elsewhere the motor is part of the link.
        all_apart: whether it is rigid nowhere.
        angle, speed: motor state, converted to the joint side.
        constant: constant effort on the motor.
        applied: effort on the motor in this step, without the drive's.
        drag: viscous coefficient on the motor in this step.
        stiffness: of the teeth.
        gear: effort of the teeth per unit of relative speed over a step.
        half_gap: half of the backlash, None without any.
        momentum: inertia divided by the step; ``inert`` adds the constant damping.
        servo: reduction of the drive's effort per unit of motor speed over a step.
    """

    apart: NDArray[np.bool_]
    all_apart: bool
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
        motor: Motor,
        timestep: float,
    ) -> MotorSide:
        """Motors at rest relative to their links, with the transmission deflected by the load.

        Args:
            gear: the transmission.
            position, velocity: of the link.
            load: effort on the link.
            motor: what turns on the motor's side.
            timestep: s.
        """
        stretch, constant = gear.stretch(load), motor.constant
        # A rigid transmission transmits nothing here.
        stiffness = np.where(gear.apart, gear.stiffness, 0.0)
        pull = stiffness * timestep + np.where(gear.apart, gear.damping, 0.0)
        momentum = np.maximum(motor.armature, 1e-9) / timestep
        play = bool(gear.gap.any())
        inert = momentum + motor.damping
        return cls(
            gear.apart, bool(gear.apart.all()), position + np.where(gear.apart, stretch, 0.0),
            velocity.copy(), constant, constant, np.zeros_like(constant), stiffness, pull,
            gear.gap / 2.0 if play else None, momentum, inert if play else inert + pull,
            motor.servo,
        )  # fmt: skip

    def meet(self, position: FloatArray, velocity: FloatArray) -> None:
        """Begin a step: with a rigid transmission the motor has the link's state."""
        if not self.all_apart:
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
        """Integrate the motors over a step.

        Args:
            position, velocity: of the link.
            drive: effort of the drive.
            free: where the drive is within its limits.
            servo_damping: damping gain of the drive.
            friction_level: largest dry friction on the motor.
            timestep: s.

        Returns:
            Effort on the link: transmitted, or with a rigid transmission all effort on the motor
            except the drive's.
        """
        deflection = self.angle - position
        inert, gear = self.inert + self.servo * free + self.drag, self.gear
        half = self.half_gap
        if half is not None:
            deflection = deflection - fast_clip(deflection, -half, half)
            # Without backlash the teeth are always in contact, even at zero deflection.
            gear = gear * ((deflection != 0.0) | (half == 0.0))
            inert = inert + gear
        pull = self.stiffness * deflection
        push = (self.momentum + servo_damping * free) * self.speed + drive + self.applied
        moving = (push - pull + gear * velocity) / inert
        # Dry friction as the impulse that stops the motor, at most its level (Moreau 1988).
        most = friction_level / inert
        moving = moving - fast_clip(moving, -most, most)
        transmitted = pull + gear * (moving - velocity)
        if half is not None:
            # A tooth flank can only push.
            flank = np.sign(deflection)
            flat = half == 0.0
            transmitted = np.where(flat, transmitted, flank * np.maximum(flank * transmitted, 0.0))
        self.angle, self.speed = self.angle + timestep * moving, moving
        if self.all_apart:
            return transmitted
        return np.where(self.apart, transmitted, self.applied - self.drag * velocity)
