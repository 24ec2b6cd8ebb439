"""Content of actuator parts: transmission, law and limits."""

from __future__ import annotations

from typing import Any

import mujoco

from pytest_twin.realization.features.canonical import (
    as_list,
    number,
    value_of,
)
from pytest_twin.realization.features.elements import OBJ, Elements
from pytest_twin.realization.features.sensors import site


def actuator(elements: Elements, actuator: int) -> dict[str, Any]:
    """Transmission, law and limits of an actuator."""
    model, trn = elements.model, mujoco.mjtTrn
    kind = int(model.actuator_trntype[actuator])
    targets = {
        int(trn.mjTRN_JOINT): OBJ.mjOBJ_JOINT,
        int(trn.mjTRN_JOINTINPARENT): OBJ.mjOBJ_JOINT,
        int(trn.mjTRN_TENDON): OBJ.mjOBJ_TENDON,
        int(trn.mjTRN_SITE): OBJ.mjOBJ_SITE,
        int(trn.mjTRN_SLIDERCRANK): OBJ.mjOBJ_SITE,
        int(trn.mjTRN_BODY): OBJ.mjOBJ_BODY,
    }
    obj = int(targets.get(kind, OBJ.mjOBJ_UNKNOWN))
    ends = [int(i) for i in model.actuator_trnid[actuator]]
    if obj not in (int(OBJ.mjOBJ_SITE), int(OBJ.mjOBJ_UNKNOWN)):
        ends = ends[:1]
    controls = slice(
        int(model.actuator_ctrladr[actuator]),
        int(model.actuator_ctrladr[actuator]) + int(model.actuator_ctrlnum[actuator]),
    )
    outputs = slice(
        int(model.actuator_outadr[actuator]),
        int(model.actuator_outadr[actuator]) + int(model.actuator_outnum[actuator]),
    )
    return {
        "transmission": trn(kind).name.removeprefix("mjTRN_").lower(),
        "target": [elements.object(obj, i) for i in ends],
        "sites": [site(elements, i) for i in ends if obj == int(OBJ.mjOBJ_SITE) and i >= 0],
        "gear": as_list(model.actuator_gear[outputs]),
        "length range": as_list(model.actuator_lengthrange[outputs]),
        "control range": [
            as_list(limits) if limited else None
            for limited, limits in zip(
                model.actuator_ctrllimited[controls],
                model.actuator_ctrlrange[controls],
                strict=True,
            )
        ],
        "force range": as_list(model.actuator_forcerange[actuator])
        if model.actuator_forcelimited[actuator]
        else None,
        "activation range": as_list(model.actuator_actrange[actuator])
        if model.actuator_actlimited[actuator]
        else None,
        "delay [s]": number(model.actuator_delay[actuator]),
        **{
            name: value_of(getattr(model, f"actuator_{name}")[actuator])
            for name in (
                "dyntype",
                "gaintype",
                "biastype",
                "ctrlspec",
                "actnum",
                "cranklength",
                "dynprm",
                "gainprm",
                "biasprm",
                "actearly",
                "history",
                "damping",
                "dampingpoly",
                "armature",
                "group",
            )
        },
    }
