"""Changes of an identification to the model, as the table ``fit:`` of a twin."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from pytest_twin.diagnosis.patched.model import AppliedEffect
from pytest_twin.effects.sensing import EffortBias, EffortScale
from pytest_twin.identification.effort.identify_effort import EffortResult
from pytest_twin.realization import Realization
from pytest_twin.realization.inverse_dynamics import INERTIAL, InverseDynamics, body_patches

Patches = dict[str, dict[str, dict[str, Any]]]

_ATTRIBUTE = {
    "armature": "armature",
    "viscous_friction": "damping",
    "coulomb_friction": "frictionloss",
}


def patches_of(realization: Realization, result: EffortResult) -> Patches:
    """Return ``joint`` and ``body`` -> name -> attribute -> value, where they change.

    Args:
        result: identification; its physically consistent parameters are written. Those of rejected
            stages have their nominal values.
    """
    columns = result.regressor.columns
    values = dict(zip((c.name for c in columns), result.physical.parameters, strict=True))
    nominal = dict(zip((c.name for c in columns), result.regressor.prior, strict=True))
    found: Patches = {"joint": {}, "body": {}}
    for joint in result.regressor.joints:
        # If the effort of a joint is a current, the drive parameters are in A.
        scale = values.get(f"{joint}.effort_scale", 1.0)
        if joint in result.without_effort or scale <= 0.0:
            continue
        changed = {
            attribute: max(float(values[f"{joint}.{kind}"]) / scale, 0.0)
            for kind, attribute in _ATTRIBUTE.items()
            if f"{joint}.effort_scale" in values
            or values[f"{joint}.{kind}"] != nominal[f"{joint}.{kind}"]
        }
        if changed:
            found["joint"][joint] = changed
    bodies = [column.name for column in columns if column.is_inertial]
    if any(values[name] != nominal[name] for name in bodies):
        dynamics = InverseDynamics(realization, result.regressor.joints)
        links = np.array(
            [[values[f"{link}.{kind}"] for kind in INERTIAL] for link in dynamics.links]
        )
        for body, changed_body in body_patches(dynamics, links).items():
            found["body"][body] = {
                name: list(value) if isinstance(value, tuple) else value
                for name, value in changed_body.items()
            }
    return {family: elements for family, elements in found.items() if elements}


def reading_effects(result: EffortResult, moved: Collection[str]) -> list[AppliedEffect]:
    """Return the effects of the readings: reading = scale * effort + offset.

    Args:
        result: identification; scales that held-out recordings reject are left out.
        moved: joints whose constant effort acts on the motion, by an effect that is written.
    """
    names = (column.name for column in result.regressor.columns)
    values = dict(zip(names, result.physical.parameters.tolist(), strict=True))
    found = []
    for joint in result.regressor.joints:
        if joint in result.without_effort:
            continue
        scale, offset = 1.0, values[f"{joint}.effort_bias"]
        if f"{joint}.effort_scale" in values:
            scale = values[f"{joint}.effort_scale"]
        elif joint in result.used_scales:
            scale = result.used_scales[joint].value
            offset *= scale
        if scale > 0.0 and scale != 1.0:
            error = {"scale_error": scale - 1.0}
            found.append(AppliedEffect(EffortScale.id, joint, error, is_in_mjcf=False))
        if offset and joint not in moved:
            found.append(AppliedEffect(EffortBias.id, joint, {"bias": offset}, is_in_mjcf=False))
    return found
