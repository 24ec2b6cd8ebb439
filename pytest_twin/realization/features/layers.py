"""All parts of a compiled model, by layer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco

from pytest_twin.realization.features import (
    actuators,
    bodies,
    couplings,
    keyframes,
    option_parts,
    sensors,
    surfaces,
)
from pytest_twin.realization.features.canonical import (
    as_list,
    value_of,
)
from pytest_twin.realization.features.elements import OBJ, Elements
from pytest_twin.realization.features.fields import FIELDS_OF_LAYER


def layers(model: mujoco.MjModel, velocity_limit: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    """Part id without the name of the realization -> content.

    Args:
        model: a compiled model.
        velocity_limit: joint -> rad/s or m/s, where the source states it.
    """
    elements = Elements(model)
    found: dict[str, dict[str, Any]] = {}
    found.update(_bodies(elements, velocity_limit))
    found.update(_surfaces(elements))
    for coupling, value in couplings.couplings(elements):
        # An equality and a tendon may have the same name.
        found.setdefault(f"coupling:{coupling}", {}).update(value)
    if model.nflex:
        found["flex:all"] = {
            name: value_of(getattr(model, name))
            for name in sorted(FIELDS_OF_LAYER["flex"])
            if hasattr(model, name)
        }
    found.update(_inputs_and_outputs(elements))
    found["option:gravity"] = {
        "gravity [m/s^2]": as_list(model.opt.gravity),
        "disabled": bool(model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY),
    }
    found["option:integration"] = option_parts.options(elements)
    found["custom"] = option_parts.custom(elements)
    found["other"] = option_parts.other(elements)
    return found


def _bodies(elements: Elements, velocity_limit: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    model, found = elements.model, dict[str, dict[str, Any]]()
    for body in range(1, model.nbody):
        found[f"kinematics:{elements.body[body]}"] = bodies.kinematics(elements, body)
        found[f"inertia:{elements.body[body]}"] = bodies.inertia(elements, body)
    for joint in range(model.njnt):
        found[f"joint:{elements.joint[joint]}"] = bodies.joint(elements, joint)
        found[f"limit:{elements.joint[joint]}"] = bodies.limit(elements, joint, velocity_limit)
    for tree in range(model.ntree):
        root = elements.body[int(model.tree_bodyadr[tree])]
        found[f"tree:{root}"] = bodies.tree(elements, tree)
    return found


def _surfaces(elements: Elements) -> dict[str, dict[str, Any]]:
    model, found = elements.model, dict[str, dict[str, Any]]()
    for body in range(model.nbody):
        if elements.geoms_of(body):
            found[f"collision:{elements.body[body]}"] = surfaces.collision(elements, body)
    for mesh in sorted(surfaces.collision_assets(elements, {"mesh", "sdf"})):
        found[f"mesh:{elements.mesh[mesh]}"] = surfaces.mesh(elements, mesh)
    for hfield in sorted(surfaces.collision_assets(elements, {"hfield"})):
        found[f"hfield:{elements.hfield[hfield]}"] = surfaces.hfield(elements, hfield)
    for geom in range(model.ngeom):
        name = mujoco.mj_id2name(model, OBJ.mjOBJ_GEOM, geom)
        if name and not elements.can_collide[geom]:
            found[f"geom:{name}"] = surfaces.visual(elements, geom)
    found["contact:pairs"] = surfaces.pairs(elements)
    found["contact:filter"] = surfaces.weld_groups(elements)
    return found


def _inputs_and_outputs(elements: Elements) -> dict[str, dict[str, Any]]:
    model, found = elements.model, dict[str, dict[str, Any]]()
    for actuator in range(model.nactuator):
        found[f"actuator:{elements.actuator[actuator]}"] = actuators.actuator(elements, actuator)
    for site in range(model.nsite):
        found[f"frame:{elements.site[site]}"] = sensors.site(elements, site)
    for sensor in range(model.nsensor):
        found[f"sensor:{elements.sensor[sensor]}"] = sensors.sensor(elements, sensor)
    for key in range(model.nkey):
        found[f"keyframe:{elements.key[key]}"] = keyframes.keyframe(elements, key)
    return found
