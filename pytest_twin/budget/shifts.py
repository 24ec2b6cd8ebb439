"""Parameters that shift joint positions: delays, encoder zeros, gears and gains.

Gears and servos deflect under load. Their rules are quasi-static: the load is the gravity effort of
the links at a pose, or the effort of the drive along a simulated motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.model import read_patched_model
from pytest_twin.effects import PoseShift, catalogue
from pytest_twin.formats.identification_record import IdentificationRecord
from pytest_twin.realization import Realization

NO_RULE = "no rule carries it to the task; its uncertainty is stated"


@dataclass(frozen=True)
class Shift:
    """Shift of a joint's position by one parameter."""

    joint: str
    of_pose: PoseShift

    def rate(self, velocity: FloatArray, load: FloatArray) -> FloatArray:
        """(n,) change of the joint's position per unit of the parameter.

        Args:
            velocity: (n,) velocity of the joint, rad/s or m/s.
            load: (n,) effort that holds the joint, N*m or N.
        """
        factors = {
            "one": np.ones_like(velocity), "velocity": velocity, "load": load,
            "side": np.where(load < 0.0, -1.0, 1.0),
        }  # fmt: skip
        return np.asarray(self.of_pose.slope * factors[self.of_pose.by])


def shift_of(name: str, record: IdentificationRecord, realization: Realization) -> Shift | str:
    """Return the shift by a parameter, or the reason why there is no rule.

    Effects state their rules. A servo of stiffness ``k`` has a position error of ``u / k`` under
    the effort ``u``.

    Args:
        name: ``JOINT.EFFECT`` or ``JOINT.EFFECT.PARAMETER``.
        record: the record with its value and unit.
        realization: the model, whose servo may contain the gain already.
    """
    value, unit = record.values.get(name, 0.0), record.units.get(name, "")
    joint, _, rest = name.partition(".")
    effect, _, parameter = rest.partition(".")
    if effect == "servo_stiffness" and value > 0.0:
        return Shift(joint, PoseShift(1.0 / value**2, "load"))
    if effect not in catalogue():
        return NO_RULE
    stiffness = servo_stiffness(realization).get(joint)
    if stiffness is not None and _has_fitted_gain(realization, record, effect, joint):
        stiffness = stiffness / (1.0 + value) if value > -1.0 else None
    rule = catalogue()[effect].pose_shift(parameter, value, unit, stiffness)
    return Shift(joint, rule) if isinstance(rule, PoseShift) else rule or NO_RULE


def _has_fitted_gain(
    realization: Realization, record: IdentificationRecord, effect: str, joint: str
) -> bool:
    """Whether the model's servo has the gain of the record, and not that of the nominal model."""
    patched = read_patched_model(realization)
    effects = () if patched is None else patched.effects
    if any((e.effect, e.joint) == (effect, joint) and e.is_in_mjcf for e in effects):
        return True
    driven = realization.structure.actuator_joints
    return any(joint in driven.get(one, ()) for one in record.fit.get("actuator", {}))


def servo_stiffness(realization: Realization) -> Mapping[str, float]:
    """Return joint -> stiffness of its position servo, N*m/rad or N/m."""
    model = realization.model
    found: dict[str, float] = {}
    for actuator in range(model.nu):
        joints = realization.structure.actuator_joints.get(model.actuator(actuator).name, ())
        gear = float(model.actuator_gear[actuator, 0])
        stiffness = -float(model.actuator_biasprm[actuator, 1]) * gear**2
        if len(joints) == 1 and stiffness > 0.0:
            found[joints[0]] = found.get(joints[0], 0.0) + stiffness
    return found
