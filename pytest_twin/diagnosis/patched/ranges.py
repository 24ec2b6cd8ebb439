"""Report where a replay leaves the range of the data behind a table of a patched realization."""

from __future__ import annotations

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.effects.segment import Predicted
from pytest_twin.effects.unnamed_law import POSITION, SPEED, TABLES, VELOCITY, Variable
from pytest_twin.realization import Realization


def describe_range_exits(
    realization: Realization, patched: PatchedModel, time: FloatArray, predicted: Predicted
) -> tuple[str, ...]:
    """Return a line for each table over position or velocity whose data range the motion leaves.

    Args:
        realization: realization with the types of joints.
        time: (n,) s.
        predicted: predicted motion, (n, joints), in the order of ``patched.joints``.
    """
    slide = int(mujoco.mjtJoint.mjJNT_SLIDE)
    said = []
    for effect in patched.outside_mjcf:
        if effect.effect not in TABLES or effect.joint is None:
            continue
        variable = TABLES[effect.effect].variable(effect.values)
        at = _values_of(variable, predicted, patched.joints.index(effect.joint))
        if at is None:
            continue
        low, high = effect.values["valid_low"], effect.values["valid_high"]
        outside = (at < low) | (at > high)
        if not outside.any():
            continue
        seconds = float(np.sum(np.diff(time)[outside[:-1]]))
        kind = realization.model.jnt_type[realization.joint_index(effect.joint)]
        unit = variable.unit("slide" if kind == slide else "hinge")
        said.append(
            f"joint {effect.joint} leaves the range in which its unnamed law is known "
            f"({variable.name} {low:.3g} to {high:.3g} {unit}) for {seconds:.2g} s: no force is "
            "added there"
        )
    return tuple(said)


def _values_of(variable: Variable, predicted: Predicted, joint: int) -> FloatArray | None:
    """(n,) values of the variable; None if a prediction does not contain it."""
    if variable == POSITION:
        return predicted.position[:, joint]
    if variable in (VELOCITY, SPEED):
        velocity = predicted.velocity[:, joint]
        return np.abs(velocity) if variable == SPEED else velocity
    return None
