"""Robots for blind cases: one table of numbers, written as MJCF for the case folder and built in
Pinocchio for the plant. Shares no code with pytest_twin.

Units: m, kg, rad, s, N*m (N on slides).
"""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin


@dataclass(frozen=True)
class Joint:
    """A joint and the link that it moves.

    Attributes:
        origin: (3,) m in the parent's link frame; frames are parallel at zero.
        axis: (3,) unit.
        mass, center, inertia: of the link, about its centre, principal axes along the frame.
        kp, kv: servo gains; ``effort``: the drive's bound.
    """

    name: str
    slide: bool
    origin: tuple[float, float, float]
    axis: tuple[float, float, float]
    mass: float
    center: tuple[float, float, float]
    inertia: tuple[float, float, float]
    damping: float
    friction: float
    armature: float
    kp: float
    kv: float
    effort: float
    range: float


@dataclass(frozen=True)
class Robot:
    """A serial chain on a fixed base; ``mode`` is what its drives take."""

    name: str
    joints: tuple[Joint, ...]
    mode: str
    timestep: float


def draw(rng: np.random.Generator, count: int, mode: str) -> Robot:
    """A random serial robot of ``count`` joints: a slide only where it has one joint."""
    joints = []
    length, mass = 0.35, 1.6
    axes = [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)]
    slide = count == 1 and rng.random() < 0.3
    distal = np.zeros(count)
    for i in range(count):
        side = float(length * rng.uniform(0.85, 1.15))
        m = float(mass * rng.uniform(0.8, 1.2))
        along = (1, 0, 0) if slide else (0.0, 0.0, 1.0)
        axis = (1.0, 0.0, 0.0) if slide else axes[i % 4] if count > 1 else (0.0, 1.0, 0.0)
        # A yaw link's weight hangs off its axis, so that its inertia shows.
        center = (0.4 * side, 0.0, 0.3 * side) if axis[2] else (0.02, 0.01, 0.5 * side)
        i_cross = m * side**2 / 12.0
        joints.append(
            {"slide": slide, "along": along, "axis": axis, "side": side, "mass": m,
             "center": center, "inertia": (i_cross, i_cross, 0.3 * i_cross)}
        )  # fmt: skip
        distal[i] = m
        length *= 0.85
        mass *= 0.7
    out = []
    for i, j in enumerate(joints):
        beyond = distal[i:].sum()
        reach = sum(k["side"] for k in joints[i:])
        inertia = max(beyond * (0.5 * reach) ** 2, 5e-3) if not slide else beyond
        gravity = beyond * 9.81 * 0.5 * reach if not slide else beyond * 3.0
        bandwidth = float(rng.uniform(18.0, 30.0))
        armature = 0.25 * inertia
        kp = (inertia + armature) * bandwidth**2
        kv = 1.2 * (inertia + armature) * bandwidth
        if mode == "velocity":
            kp, kv = 0.0, (inertia + armature) * bandwidth * 1.5
        origin = (0.0, 0.0, 0.1) if i == 0 else (0.0, 0.0, joints[i - 1]["side"])
        out.append(
            Joint(f"joint{i + 1}", slide, origin, j["axis"], j["mass"], j["center"], j["inertia"],
                  damping=0.03 * inertia * bandwidth, friction=0.03 * gravity, armature=armature,
                  kp=kp, kv=kv, effort=6.0 * gravity + 4.0 * inertia, range=2.4)
        )  # fmt: skip
    return Robot(f"chain{count}", tuple(out), mode, 0.002 if count > 1 else 0.001)


def mjcf(robot: Robot) -> str:
    """The nominal model, as an engineer would have it."""
    root = ElementTree.Element("mujoco", model=robot.name)
    ElementTree.SubElement(root, "compiler", angle="radian")
    ElementTree.SubElement(root, "option", timestep=repr(robot.timestep), integrator="implicitfast")
    parent = ElementTree.SubElement(root, "worldbody")
    actuator = ElementTree.SubElement(root, "actuator")

    def row(values: tuple[float, ...]) -> str:
        return " ".join(repr(float(v)) for v in values)

    for i, j in enumerate(robot.joints):
        body = ElementTree.SubElement(parent, "body", name=f"link{i + 1}", pos=row(j.origin))
        ElementTree.SubElement(
            body,
            "inertial",
            pos=row(j.center),
            mass=repr(float(j.mass)),
            diaginertia=row(j.inertia),
        )
        ElementTree.SubElement(
            body, "joint", name=j.name, type="slide" if j.slide else "hinge", axis=row(j.axis),
            damping=repr(float(j.damping)), frictionloss=repr(float(j.friction)),
            armature=repr(float(j.armature)),
        )  # fmt: skip
        bound = row((-j.effort, j.effort))
        if robot.mode == "position":
            ElementTree.SubElement(actuator, "position", name=j.name, joint=j.name,
                                   kp=repr(float(j.kp)), kv=repr(float(j.kv)), forcerange=bound
                                   )  # fmt: skip
        elif robot.mode == "velocity":
            ElementTree.SubElement(actuator, "velocity", name=j.name, joint=j.name,
                                   kv=repr(float(j.kv)), forcerange=bound)  # fmt: skip
        else:
            ElementTree.SubElement(actuator, "motor", name=j.name, joint=j.name,
                                   forcerange=bound)  # fmt: skip
        parent = body
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def pinocchio_model(
    robot: Robot,
    scale: dict[int, float],
    payload: tuple[float, float],
    gravity: np.ndarray,
) -> pin.Model:
    """The plant's rigid bodies.

    Args:
        scale: joint index -> factor on mass and inertia of its link.
        payload: (kg, m along the last link's z axis).
        gravity: (3,) m/s^2 in the base frame.
    """
    model = pin.Model()
    model.gravity.linear = gravity
    parent = 0
    for i, j in enumerate(robot.joints):
        axis = np.array(j.axis)
        joint = (
            pin.JointModelPrismaticUnaligned(axis)
            if j.slide
            else pin.JointModelRevoluteUnaligned(axis)
        )
        placement = pin.SE3(np.eye(3), np.array(j.origin))
        parent = model.addJoint(parent, joint, placement, j.name)
        factor = scale.get(i, 1.0)
        body = pin.Inertia(
            factor * j.mass, np.array(j.center), factor * np.diag(np.array(j.inertia))
        )
        if i == len(robot.joints) - 1 and payload[0]:
            body += pin.Inertia(payload[0], np.array([0.0, 0.0, payload[1]]), np.zeros((3, 3)))
        model.appendBodyToJoint(parent, body, pin.SE3.Identity())
    return model
