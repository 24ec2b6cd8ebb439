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

TOOTH_DAMPING = 0.6
"""Damping of the teeth divided by the square root of stiffness times inertia; little ringing."""
_MAX_SPEED_LOSS = 0.5
"""Largest share of its speed against the motor that a link may lose in a step, for stability."""
MAX_STIFFNESS = 0.5
"""Largest stiffness that a step resolves, in units of inertia divided by the step squared."""


@dataclass(slots=True)
class Gear:
    """The transmission between motor and link.

    Attributes:
        is_elastic: where the transmission is not rigid.
    """

    is_elastic: NDArray[np.bool_]
    stiffness: FloatArray
    damping: FloatArray
    gap: FloatArray

    @classmethod
    def rigid(cls, like: FloatArray) -> Gear:
        """A rigid transmission with the (rows, joints) shape of ``like``."""
        none = np.zeros(like.shape)
        return cls(none != 0.0, none.copy(), none.copy(), none.copy())

    def deflection(self, load: FloatArray) -> FloatArray:
        """Deflection between motor and link under a (rows, joints) load."""
        return load / np.maximum(self.stiffness, 1e-9) + np.sign(load) * self.gap / 2.0

    def add_compliance(
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
        series_compliance = np.where(
            self.stiffness > 0.0, 1.0 / np.maximum(self.stiffness, 1e-12), 0.0
        )
        stiffness = np.minimum(
            1.0 / np.maximum(compliance + series_compliance, 1e-12),
            MAX_STIFFNESS * inertia / timestep**2,
        )
        if damping_time is None:
            damping = np.where(
                self.damping > 0.0, self.damping, TOOTH_DAMPING * np.sqrt(stiffness * inertia)
            )
        else:
            damping = damping_time * stiffness
        stability = _stability_factor(
            stiffness * timestep + damping, inertia, link_inertia, timestep
        )
        stiffness, damping = stability * stiffness, stability * damping
        self.is_elastic = self.is_elastic | acts
        self.stiffness = np.where(acts, stiffness, self.stiffness)
        self.damping = np.where(acts, damping, self.damping)


def _stability_factor(
    tooth_impedance: FloatArray,
    motor_inertia: FloatArray,
    link_inertia: FloatArray,
    timestep: float,
) -> FloatArray:
    """Factor on stiffness and damping at which a link loses at most :data:`_MAX_SPEED_LOSS` of its
    speed against the motor in a step.
    """
    # Teeth in series with the motor's momentum over a step, limited by the link's momentum.
    largest = _MAX_SPEED_LOSS * link_inertia / timestep
    motor_impedance = motor_inertia / timestep
    is_bounded = largest < motor_impedance
    margin = np.where(is_bounded, motor_impedance - largest, 1.0)
    factor = np.minimum(1.0, largest * motor_impedance / margin / tooth_impedance)
    return np.where(is_bounded, factor, 1.0)


@dataclass(frozen=True, slots=True)
class Motor:
    """Properties of the motor side, converted to the joint side, (rows, joints) each.

    Attributes:
        armature: motor inertia, kg*m^2 or kg.
        damping: viscous coefficient, N*m*s/rad or N*s/m.
        constant_effort: constant effort, N*m or N.
        effective_servo_damping: reduction of the drive's effort per unit of motor velocity over a
            step.
    """

    armature: FloatArray
    damping: FloatArray
    constant_effort: FloatArray
    effective_servo_damping: FloatArray


@dataclass(slots=True)
class MotorSide:
    """State and coefficients of the motor sides.

    Attributes:
        is_elastic: where the transmission is not rigid; elsewhere the motor is part of the link.
        all_elastic: whether it is rigid nowhere.
        position, velocity: motor state, converted to the joint side.
        constant_effort: constant effort on the motor.
        applied: effort on the motor in this step, without the drive's.
        damping: viscous coefficient on the motor in this step.
        tooth_impedance: effort of the teeth per unit of relative speed over a step.
        half_gap: half of the backlash, None without any.
        inertia_per_step: inertia divided by the step; ``impedance`` adds the constant damping.
        effective_servo_damping: reduction of the drive's effort per unit of motor velocity over a
            step.
    """

    is_elastic: NDArray[np.bool_]
    all_elastic: bool
    position: FloatArray
    velocity: FloatArray
    constant_effort: FloatArray
    applied: FloatArray
    damping: FloatArray
    stiffness: FloatArray
    tooth_impedance: FloatArray
    half_gap: FloatArray | None
    inertia_per_step: FloatArray
    impedance: FloatArray
    effective_servo_damping: FloatArray

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
            motor: properties of the motor side.
            timestep: s.
        """
        deflection, constant_effort = gear.deflection(load), motor.constant_effort
        # A rigid transmission transmits nothing here.
        stiffness = np.where(gear.is_elastic, gear.stiffness, 0.0)
        tooth_impedance = stiffness * timestep + np.where(gear.is_elastic, gear.damping, 0.0)
        inertia_per_step = np.maximum(motor.armature, 1e-9) / timestep
        has_gap = bool(gear.gap.any())
        impedance = inertia_per_step + motor.damping
        return cls(
            is_elastic=gear.is_elastic,
            all_elastic=bool(gear.is_elastic.all()),
            position=position + np.where(gear.is_elastic, deflection, 0.0),
            velocity=velocity.copy(),
            constant_effort=constant_effort,
            applied=constant_effort,
            damping=np.zeros_like(constant_effort),
            stiffness=stiffness,
            tooth_impedance=tooth_impedance,
            half_gap=gear.gap / 2.0 if has_gap else None,
            inertia_per_step=inertia_per_step,
            impedance=impedance if has_gap else impedance + tooth_impedance,
            effective_servo_damping=motor.effective_servo_damping,
        )

    def begin_step(self, position: FloatArray, velocity: FloatArray) -> None:
        """Begin a step: with a rigid transmission the motor has the link's state."""
        if not self.all_elastic:
            self.position = np.where(self.is_elastic, self.position, position)
            self.velocity = np.where(self.is_elastic, self.velocity, velocity)
        self.applied, self.damping = (
            self.constant_effort.copy(),
            np.zeros(self.constant_effort.shape),
        )

    def step(
        self,
        position: FloatArray,
        velocity: FloatArray,
        drive: FloatArray,
        *,
        is_free: NDArray[np.bool_],
        servo_damping: FloatArray,
        friction_level: FloatArray,
        timestep: float,
    ) -> FloatArray:
        """Integrate the motors over a step.

        Args:
            is_free: where the drive is within its limits.
            servo_damping: damping gain of the drive.
            friction_level: largest dry friction on the motor.
            timestep: s.

        Returns:
            Effort on the link: transmitted, or with a rigid transmission all effort on the motor
            except the drive's.
        """
        deflection = self.position - position
        impedance = self.impedance + self.effective_servo_damping * is_free + self.damping
        tooth_impedance = self.tooth_impedance
        half = self.half_gap
        if half is not None:
            deflection = deflection - fast_clip(deflection, -half, half)
            # Without backlash the teeth are always in contact, even at zero deflection.
            tooth_impedance = tooth_impedance * ((deflection != 0.0) | (half == 0.0))
            impedance = impedance + tooth_impedance
        spring_effort = self.stiffness * deflection
        push = (
            (self.inertia_per_step + servo_damping * is_free) * self.velocity + drive + self.applied
        )
        next_velocity = (push - spring_effort + tooth_impedance * velocity) / impedance
        # Dry friction as the impulse that stops the motor, at most its level (Moreau 1988).
        max_change = friction_level / impedance
        next_velocity = next_velocity - fast_clip(next_velocity, -max_change, max_change)
        transmitted = spring_effort + tooth_impedance * (next_velocity - velocity)
        if half is not None:
            # A tooth flank can only push.
            flank = np.sign(deflection)
            no_gap = half == 0.0
            transmitted = np.where(
                no_gap, transmitted, flank * np.maximum(flank * transmitted, 0.0)
            )
        self.position, self.velocity = self.position + timestep * next_velocity, next_velocity
        if self.all_elastic:
            return transmitted
        return np.where(self.is_elastic, transmitted, self.applied - self.damping * velocity)
