"""Parameters that shift a joint along its way: delays, encoder zeros, gears and gains.

A gear and a servo hold a load by giving way to it. Their rules are quasi-static: the load is the
gravity of the links at a pose, or the effort of the drive along a simulated motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.realization import Realization

DELAYS = ("command_delay", "sensor_delay")
_ZERO = "encoder_bias"
LOADED = ("backlash", "joint_elasticity", "controller_gain")
"""Effects whose shift depends on the load of the joint."""
NO_RULE = "no rule carries it to the task; its uncertainty is stated"
_STIFF = frozenset({"N*m/rad", "N/m"})
_SOFT = frozenset({"rad/(N*m)", "m/N"})


@dataclass(frozen=True)
class Shift:
    """What one parameter does to its joint.

    Attributes:
        joint: name.
        slope: change of the position by a unit of the parameter, over what it is proportional to.
        by: that is the joint's ``velocity``, its ``load``, the ``side`` on which the load presses
            the teeth (1 or -1), or nothing (``one``).
    """

    joint: str
    slope: float
    by: str

    def rate(self, velocity: FloatArray, load: FloatArray) -> FloatArray:
        """(n,) change of the joint's position by a unit of the parameter.

        Args:
            velocity: (n,) of the joint, rad/s or m/s.
            load: (n,) effort that holds it, N*m or N.
        """
        factors = {
            "one": np.ones_like(velocity), "velocity": velocity, "load": load,
            "side": np.where(load < 0.0, -1.0, 1.0),
        }  # fmt: skip
        return np.asarray(self.slope * factors[self.by])


def shift_of(name: str, value: float, unit: str, realization: Realization) -> Shift | str:
    """The rule of a parameter, or why there is none.

    A robot that is later by ``d`` is where it was: ``q - v d``. A reading that is too high by ``b``
    leaves the joint at ``q - b``. Under the effort ``u`` a gear of stiffness ``k`` and gap ``g``
    leaves the link at ``q - u / k - g sign(u) / 2`` of its motor, and a servo of stiffness
    ``(1 + e) kp`` leaves the joint at ``u / ((1 + e) kp)`` before its command.

    Args:
        name: ``JOINT.EFFECT`` or ``JOINT.EFFECT.PARAMETER``.
        value: in its unit.
        unit: as the record states it.
        realization: the model.
    """
    joint, _, rest = name.partition(".")
    effect, _, parameter = rest.partition(".")
    if effect in DELAYS:
        return Shift(joint, -1.0, "velocity")
    if effect == _ZERO:
        return Shift(joint, -1.0, "one")
    if effect == "backlash" and parameter in ("", "gap"):
        return Shift(joint, -0.5, "side")
    if effect == "joint_elasticity" and unit in _STIFF and value > 0.0:
        return Shift(joint, 1.0 / value**2, "load")
    if effect == "joint_elasticity" and unit in _SOFT:
        return Shift(joint, -1.0, "load")
    if effect == "controller_gain" and parameter in ("", "stiffness_error") and value > -1.0:
        stiffness = servo_stiffness(realization).get(joint)
        if stiffness is not None:
            return Shift(joint, 1.0 / (stiffness * (1.0 + value) ** 2), "load")
        return "no position servo drives this joint, so its gain holds no load"
    return NO_RULE


def servo_stiffness(realization: Realization) -> Mapping[str, float]:
    """Joint -> stiffness of the position servo that drives it, N*m/rad or N/m."""
    model = realization.model
    found: dict[str, float] = {}
    for actuator in range(model.nu):
        joints = realization.structure.actuator_joints.get(model.actuator(actuator).name, ())
        gear = float(model.actuator_gear[actuator, 0])
        stiffness = -float(model.actuator_biasprm[actuator, 1]) * gear**2
        if len(joints) == 1 and stiffness > 0.0:
            found[joints[0]] = found.get(joints[0], 0.0) + stiffness
    return found
