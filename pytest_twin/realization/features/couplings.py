"""Content of coupling parts: equality constraints and tendons."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import mujoco

from pytest_twin.realization.engine import model_field
from pytest_twin.realization.features.canonical import (
    as_list,
    as_rounded_list,
    value_of,
)
from pytest_twin.realization.features.elements import OBJ, Elements
from pytest_twin.realization.features.sensors import site
from pytest_twin.realization.features.surfaces import shape


def couplings(elements: Elements) -> Iterable[tuple[str, dict[str, Any]]]:
    """Yield (name, content) of each equality and tendon."""
    model = elements.model
    for eq in range(model.neq):
        obj, ends = elements.equality_ends(eq)
        yield (
            elements.equality[eq],
            {
                "equality": mujoco.mjtEq(int(model.eq_type[eq])).name.removeprefix("mjEQ_"),
                "of": [elements.object(obj, i) for i in ends],
                "object type": obj,
                "sites": [site(elements, i) for i in ends if obj == int(OBJ.mjOBJ_SITE) and i >= 0],
                "active": bool(model.eq_active0[eq]),
                "data": as_list(model.eq_data[eq]),
                "solref": as_list(model.eq_solref[eq]),
                "solimp": as_list(model.eq_solimp[eq]),
            },
        )
    for t in range(model.ntendon):
        yield elements.tendon[t], tendon(elements, t)


def tendon(elements: Elements, tendon: int) -> dict[str, Any]:
    """Path of a tendon, its limits and its passive forces."""
    model, wrap = elements.model, mujoco.mjtWrap
    path = []
    start = int(model.tendon_adr[tendon])
    for w in range(start, start + int(model.tendon_num[tendon])):
        kind, index = int(model.wrap_type[w]), int(model.wrap_objid[w])
        prm = float(model.wrap_prm[w])
        step: dict[str, Any] = {"type": wrap(kind).name.removeprefix("mjWRAP_")}
        if kind == int(wrap.mjWRAP_JOINT):
            step |= {"joint": elements.joint[index], "coefficient": prm}
        elif kind == int(wrap.mjWRAP_SITE):
            step |= {"site": elements.site[index], **site(elements, index)}
        elif kind in (int(wrap.mjWRAP_SPHERE), int(wrap.mjWRAP_CYLINDER)):
            body = elements.body[int(model.geom_bodyid[index])]
            step |= {"geom": elements.geom[index], "body": body, **shape(elements, index)}
            if prm >= 0:
                side = round(prm)
                step |= {"side": elements.site[side], "side frame": site(elements, side)}
        else:
            step["divisor"] = prm
        path.append(step)
    limited = bool(model.tendon_limited[tendon])
    forces = bool(model.tendon_actfrclimited[tendon])
    return {
        "path": path,
        "tendon type": int(model_field(model, "tendon_type")[tendon]),
        "range": as_list(model.tendon_range[tendon]) if limited else None,
        "actuator force range": as_list(model.tendon_actfrcrange[tendon]) if forces else None,
        "spring length": as_rounded_list(model.tendon_lengthspring[tendon]),
        **{
            name: value_of(model_field(model, f"tendon_{name}")[tendon])
            for name in (
                "solref_lim",
                "solimp_lim",
                "solref_fri",
                "solimp_fri",
                "margin",
                "stiffness",
                "stiffnesspoly",
                "damping",
                "dampingpoly",
                "armature",
                "frictionloss",
                "springyield",
            )
        },
    }
