"""Changes of an identification to the model, as the table ``fit:`` of a twin."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from pytest_twin.diagnosis.patched.model import AppliedEffect
from pytest_twin.effects import mjcf_fields
from pytest_twin.effects.sensing import EffortBias, EffortScale
from pytest_twin.identification.effort.identify_effort import EffortResult
from pytest_twin.identification.regressor.columns import drive_effects
from pytest_twin.identification.write import Patches
from pytest_twin.realization import Realization
from pytest_twin.realization.inverse_dynamics import INERTIAL, InverseDynamics, body_patches


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
        scale = values.get(f"{joint}.{EffortScale.id}", 1.0)
        if joint in result.without_effort or scale <= 0.0:
            continue
        changed = {
            attribute: max(float(values[f"{joint}.{kind}"]) / scale, 0.0)
            for kind, attribute in mjcf_fields().items()
            if f"{joint}.{EffortScale.id}" in values
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
        scale, offset = 1.0, values[f"{joint}.{EffortBias.id}"]
        if f"{joint}.{EffortScale.id}" in values:
            scale = values[f"{joint}.{EffortScale.id}"]
        elif joint in result.used_scales:
            scale = result.used_scales[joint].value
            offset *= scale
        if scale > 0.0 and scale != 1.0:
            error = {"scale_error": scale - 1.0}
            found.append(AppliedEffect(EffortScale.id, joint, error, is_in_mjcf=False))
        if offset and joint not in moved:
            found.append(AppliedEffect(EffortBias.id, joint, {"bias": offset}, is_in_mjcf=False))
    return found


def laws_of(result: EffortResult) -> list[AppliedEffect]:
    """Return the effects of drives that no MJCF contains, other than those of readings."""
    names = (column.name for column in result.regressor.columns)
    values = dict(zip(names, result.physical.parameters.tolist(), strict=True))
    laws = []
    for joint in result.regressor.joints:
        scale = values.get(f"{joint}.{EffortScale.id}", 1.0)
        for effect in drive_effects():
            value = values[f"{joint}.{effect.id}"] / scale if scale > 0.0 else 0.0
            is_known = effect.mjcf_field or effect.needs_effort_sensor
            if value and not is_known and joint not in result.without_effort:
                name = effect.parameters[0].name
                laws.append(AppliedEffect(effect.id, joint, {name: value}, is_in_mjcf=False))
    return laws
