"""Content of parts of bodies and joints: pose, inertia, passive forces, limits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pytest_twin.realization.engine import model_field
from pytest_twin.realization.features.canonical import (
    as_list,
    as_rounded_list,
    number,
    one_or_listed,
    rotation_of,
    tensor_of,
    with_unit,
)
from pytest_twin.realization.features.elements import DOFS, QPOS, Elements
from pytest_twin.realization.features.surfaces import shape


def kinematics(elements: Elements, body: int) -> dict[str, Any]:
    """Pose of a body in its parent, and anchor, axis and reference of its joints."""
    model = elements.model
    joints = []
    first = int(model.body_jntadr[body])
    for joint in range(first, first + int(model.body_jntnum[body])):
        kind = elements.joint_type[joint]
        at = int(model.jnt_qposadr[joint])
        joints.append(
            {
                "name": elements.joint[joint],
                "type": kind,
                "anchor [m]": as_rounded_list(model.jnt_pos[joint]),
                "axis": as_rounded_list(model.jnt_axis[joint]),
                "reference": as_rounded_list(model.qpos0[at : at + QPOS[kind]]),
            }
        )
    return {
        "parent": elements.body[int(model.body_parentid[body])],
        "position [m]": as_rounded_list(model.body_pos[body]),
        "quaternion": rotation_of(model.body_quat[body]),
        "mocap": bool(model.body_mocapid[body] >= 0),
        "joints": joints,
    }


def inertia(elements: Elements, body: int) -> dict[str, Any]:
    """Mass, centre of mass and inertia of a body, and its fluid interaction."""
    model = elements.model
    content: dict[str, Any] = {
        "mass [kg]": float(model.body_mass[body]),
        "centre of mass [m]": as_rounded_list(model.body_ipos[body]),
        "inertia [kg*m^2]": tensor_of(model.body_iquat[body], model.body_inertia[body]),
        "gravity compensation": float(model.body_gravcomp[body]),
    }
    start = int(model.body_geomadr[body])
    fluid = [
        {"fluid": as_list(model.geom_fluid[g]), **shape(elements, g)}
        for g in range(start, start + int(model.body_geomnum[body]))
        if np.any(model.geom_fluid[g])
    ]
    if fluid:
        content["fluid"] = fluid
    return content


def joint(elements: Elements, joint: int) -> dict[str, Any]:
    """Passive forces of a joint (damping, friction, spring), armature and solver parameters."""
    model = elements.model
    kind = elements.joint_type[joint]
    dof, at = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
    dofs = slice(dof, dof + DOFS[kind])
    torque = {"hinge": "N*m", "ball": "N*m", "slide": "N"}.get(kind)
    rate = {"hinge": "N*m*s/rad", "ball": "N*m*s/rad", "slide": "N*s/m"}.get(kind)
    spring = {"hinge": "N*m/rad", "ball": "N*m/rad", "slide": "N/m"}.get(kind)
    inertia = {"hinge": "kg*m^2", "ball": "kg*m^2", "slide": "kg"}.get(kind)
    forces = bool(model.jnt_actfrclimited[joint])
    return {
        with_unit("damping", rate): one_or_listed(model.dof_damping[dofs]),
        "damping polynomial": as_list(model.dof_dampingpoly[dofs]),
        with_unit("friction loss", torque): one_or_listed(model.dof_frictionloss[dofs]),
        with_unit("armature", inertia): one_or_listed(model.dof_armature[dofs]),
        "friction solref": as_list(model.dof_solref[dofs]),
        "friction solimp": as_list(model.dof_solimp[dofs]),
        with_unit("stiffness", spring): float(model.jnt_stiffness[joint]),
        "stiffness polynomial": as_list(model.jnt_stiffnesspoly[joint]),
        "spring reference": as_rounded_list(model.qpos_spring[at : at + QPOS[kind]]),
        "spring yield": number(model_field(model, "jnt_springyield")[joint]),
        "limit solref": as_list(model.jnt_solref[joint]),
        "limit solimp": as_list(model.jnt_solimp[joint]),
        "limit margin": float(model.jnt_margin[joint]),
        with_unit("actuator force range", torque): as_list(model.jnt_actfrcrange[joint])
        if forces
        else None,
        "gravity compensation by actuators": bool(model.jnt_actgravcomp[joint]),
    }


def limit(elements: Elements, joint: int, velocity_limit: Mapping[str, float]) -> dict[str, Any]:
    """Range of a joint, and its velocity limit where the source states one."""
    model = elements.model
    slide = elements.joint_type[joint] == "slide"
    limited = bool(model.jnt_limited[joint])
    unit = "m" if slide else "rad"
    content: dict[str, Any] = {
        f"range [{unit}]": as_rounded_list(model.jnt_range[joint]) if limited else None
    }
    speed = velocity_limit.get(elements.joint[joint])
    if speed is not None:
        content[f"velocity [{unit}/s]"] = number(speed)
    return content


def tree(elements: Elements, tree: int) -> dict[str, Any]:
    """Order of the bodies in a tree, which determines the order of constraints in the solver."""
    model = elements.model
    start = int(model.tree_bodyadr[tree])
    bodies = range(start, start + int(model.tree_bodynum[tree]))
    return {
        "bodies": [elements.body[body] for body in bodies],
        "sleep policy": int(model.tree_sleep_policy[tree]),
    }
