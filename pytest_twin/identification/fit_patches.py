"""Changes of an identification to the model, as the table ``fit:`` of a twin."""

from __future__ import annotations

from typing import Any

import numpy as np

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
    """Return ``joint`` and ``body`` -> name -> attribute -> value, of accepted stages.

    Args:
        realization: the nominal model.
        result: identification; its physically consistent parameters are written.
    """
    accepted = {stage.name for stage in result.stages if stage.state in ("accepted", "reopened")}
    values = dict(
        zip((c.name for c in result.regressor.columns), result.physical.parameters, strict=True)
    )
    found: Patches = {"joint": {}, "body": {}}
    for joint in result.regressor.joints:
        if joint in result.without_effort:
            continue
        # If the effort of a joint is a current, the drive parameters are in A.
        scale = values.get(f"{joint}.effort_scale", 1.0)
        if scale <= 0.0:
            continue
        own = {}
        for kind, attribute in _ATTRIBUTE.items():
            stage = "inertia" if kind == "armature" else "friction"
            if stage in accepted:
                own[attribute] = max(float(values[f"{joint}.{kind}"]) / scale, 0.0)
        if own:
            found["joint"][joint] = own
    if {"gravity", "inertia"} <= accepted:
        dynamics = InverseDynamics(realization, result.regressor.joints)
        links = np.array(
            [[values[f"{link}.{kind}"] for kind in INERTIAL] for link in dynamics.links]
        )
        for body, own in body_patches(dynamics, links).items():
            found["body"][body] = {
                name: list(value) if isinstance(value, tuple) else value
                for name, value in own.items()
            }
    return {family: own for family, own in found.items() if own}
