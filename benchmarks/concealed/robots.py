"""Robots for blind cases, written as MJCF and built in Pinocchio from one table of numbers.

This module shares no code with pytest_twin.

Units: m, kg, rad, s, N*m (N on slides).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin


@dataclass(frozen=True)
class Joint:
    """A joint and the link that it moves.

    Attributes:
        origin: (3,) position in the parent's link frame, m; frames are parallel at zero.
        axis: (3,) unit vector.
        mass, center, inertia: of the link; inertia about its centre, axes of the frame are
            principal.
        kp, kv: servo gains; ``effort``: effort limit of the drive.
        teeth: stiffness of a gear with backlash, N*m/rad; stiff compared with the drive.
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
    teeth: float


@dataclass(frozen=True)
class Contact:
    """A small sphere at the end of the last link, and a plane that it touches.

    Attributes:
        normal: (3,) unit normal of the plane, base frame; the plane is normal . x = ``height``, m.
        tip: (3,) sphere's centre in the last link's frame, m; ``radius`` in m.
        stiffness, damping: coefficients of depth and its rate, N/m and N*s/m.
        friction: Coulomb coefficient.
        creep: viscous coefficient of tangential friction below the Coulomb level, N*s/m.
    """

    normal: tuple[float, float, float]
    height: float
    tip: tuple[float, float, float]
    radius: float
    stiffness: float
    damping: float
    friction: float
    creep: float


@dataclass(frozen=True)
class Robot:
    """A serial chain on a fixed base; ``mode`` is the command mode of its drives."""

    name: str
    joints: tuple[Joint, ...]
    mode: str
    timestep: float
    contact: Contact | None = None

    def gravity_joints(self) -> list[int]:
        """Joints with pose-dependent gravity effort: no slide, no vertical first axis."""
        return [i for i, j in enumerate(self.joints) if not j.slide and (i or not j.axis[2])]


def draw(rng: np.random.Generator, count: int, mode: str, *, hinges: bool = False) -> Robot:
    """A random serial robot of ``count`` joints.

    A robot with one joint may be a slide, unless ``hinges`` is set.
    """
    joints = []
    length, mass = 0.35, 1.6
    axes = [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)]
    slide = count == 1 and rng.random() < 0.3 and not hinges
    distal = np.zeros(count)
    for i in range(count):
        side = float(length * rng.uniform(0.85, 1.15))
        m = float(mass * rng.uniform(0.8, 1.2))
        along = (1, 0, 0) if slide else (0.0, 0.0, 1.0)
        axis = (1.0, 0.0, 0.0) if slide else axes[i % 4] if count > 1 else (0.0, 1.0, 0.0)
        # The centre of mass of a yaw link is off its axis, so that its inertia is observable.
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
        teeth = 40.0 * kp
        if mode == "velocity":
            # The servo is stiff enough that the arm does not fall under gravity.
            kp, kv = 0.0, (inertia + armature) * bandwidth * 5.0
        origin = (0.0, 0.0, 0.1) if i == 0 else (0.0, 0.0, joints[i - 1]["side"])
        out.append(
            Joint(f"joint{i + 1}", slide, origin, j["axis"], j["mass"], j["center"], j["inertia"],
                  damping=0.03 * inertia * bandwidth, friction=0.03 * gravity, armature=armature,
                  kp=kp, kv=kv, effort=6.0 * gravity + 4.0 * inertia, range=2.4, teeth=teeth)
        )  # fmt: skip
    return Robot(f"chain{count}", tuple(out), mode, 0.002 if count > 1 else 0.001)


IMPEDANCE, IMPEDANCE_RATIO = 0.0001, 300.0
"""MuJoCo's solimp (constant) and impratio of the nominal model's contact."""


def _translation(robot: Robot, q: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(3, 3) mobility of a point of the last link in the base frame, 1/kg."""
    model = pinocchio_model(robot, {}, (0.0, 0.0), np.zeros(3))
    data = model.createData()
    n = len(robot.joints)
    mass = np.reshape(pin.crba(model, data, q), (n, n))
    mass = np.triu(mass) + np.triu(mass, 1).T + np.diag([j.armature for j in robot.joints])
    pin.computeJointJacobians(model, data, q)
    frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    jacobian = np.reshape(pin.getJointJacobian(model, data, n, frame), (6, n))
    linear = jacobian[:3] - pin.skew(data.oMi[n].rotation @ point) @ jacobian[3:]
    out: np.ndarray = linear @ np.linalg.solve(mass, linear.T)
    return out


def contact_inertia(robot: Robot) -> float:
    """Effective mass that MuJoCo assumes for a contact of the last link, kg.

    It is the reciprocal of the mean translational ``body_invweight0``: of the last link's centre of
    mass at the neutral pose, with the drives' reflected inertia.
    """
    yields = _translation(robot, np.zeros(len(robot.joints)), np.array(robot.joints[-1].center))
    return float(3.0 / np.trace(yields))


def end_inertia(robot: Robot, q: np.ndarray, direction: tuple[float, float, float]) -> float:
    """True effective mass of the last link's end along a direction, kg."""
    along = np.array(direction)
    return float(1.0 / (along @ _translation(robot, q, np.array(link_end(robot))) @ along))


def tip_paths(robot: Robot, q: np.ndarray) -> np.ndarray:
    """(..., 3) position of the last link's end at (..., joints) joint positions, m."""
    model = pinocchio_model(robot, {}, (0.0, 0.0), np.zeros(3))
    data = model.createData()
    last = len(robot.joints)
    out = []
    for row in q.reshape(-1, q.shape[-1]):
        pin.forwardKinematics(model, data, row)
        out.append(data.oMi[last].act(np.array(link_end(robot))))
    return np.array(out).reshape(*q.shape[:-1], 3)


def link_end(robot: Robot) -> tuple[float, float, float]:
    """(3,) end of the last link in its frame, m: twice the vector to its centre of mass."""
    return (0.0, 0.0, 2.0 * robot.joints[-1].center[2])


def with_contact(
    rng: np.random.Generator, robot: Robot, normal: tuple[float, float, float], height: float,
    pose: np.ndarray,
) -> Robot:  # fmt: skip
    """Return the robot with a sphere at its end and a soft plane of rubber.

    Args:
        pose: (joints,) pose in which the end's effective mass along the normal sets the scale.
    """
    inertia = end_inertia(robot, pose, normal)
    bandwidth = float(rng.uniform(70.0, 120.0))
    contact = Contact(
        normal, height, link_end(robot), RADIUS, inertia * bandwidth**2,
        2.0 * float(rng.uniform(0.2, 0.4)) * inertia * bandwidth,
        float(rng.uniform(0.3, 0.6)), 600.0 * inertia,
    )  # fmt: skip
    return replace(robot, contact=contact, timestep=0.001)


def contact_mjcf(root: ElementTree.Element, last: ElementTree.Element, robot: Robot) -> None:
    """Return the nominal contact: the plant's parameters converted to MuJoCo's.

    With a constant impedance d and solref = (-k, -b), the normal force of MuJoCo is m (k depth + b
    d(depth)/dt - d a) / (1 - d), where m is the effective mass (:func:`contact_inertia`) and a the
    acceleration of the depth. A small d gives a spring and a damper. The tangential force is m
    impratio b_t v / (1 - d) up to the Coulomb level. With a large impratio, sliding does not
    increase the normal force.
    """
    c = robot.contact
    if c is None:
        return
    inertia = contact_inertia(robot) / (1.0 - IMPEDANCE)
    option = root.find("option")
    world = root.find("worldbody")
    assert option is not None
    assert world is not None
    option.set("cone", "elliptic")
    option.set("impratio", repr(IMPEDANCE_RATIO))

    def row(*values: float) -> str:
        return " ".join(repr(float(v)) for v in values)

    plane = ElementTree.Element(
        "geom", name="surface", type="plane", size="2 2 0.1", zaxis=row(*c.normal),
        pos=row(*(c.height * v for v in c.normal)), contype="0", conaffinity="0",
    )  # fmt: skip
    world.insert(0, plane)
    ElementTree.SubElement(
        last, "geom", name="tip", type="sphere", size=repr(c.radius), pos=row(*c.tip), mass="0",
        contype="0", conaffinity="0",
    )  # fmt: skip
    # Only an explicit pair has a separate reference for friction (solreffriction).
    pairs = ElementTree.SubElement(root, "contact")
    ElementTree.SubElement(
        pairs, "pair", name="touch", geom1="surface", geom2="tip", condim="3",
        friction=row(c.friction, c.friction, 0.005, 0.0001, 0.0001),
        solref=row(-c.stiffness / inertia, -c.damping / inertia),
        solreffriction=row(-1e-6, -c.creep / inertia / IMPEDANCE_RATIO),
        solimp=row(IMPEDANCE, IMPEDANCE, 0.001),
    )  # fmt: skip


RADIUS = 0.02
"""Radius of the sphere at a robot's end, m."""


def mjcf(robot: Robot) -> str:
    """Return the nominal model as MJCF."""
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
    contact_mjcf(root, parent, robot)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def pinocchio_model(
    robot: Robot,
    scale: dict[int, float],
    payload: tuple[float, float],
    gravity: np.ndarray,
) -> pin.Model:
    """Build the plant's rigid bodies.

    Args:
        scale: joint index -> factor on mass and inertia of its link.
        payload: (mass, kg; distance from the last joint towards its link's centre of mass, m).
        gravity: (3,) gravity in the base frame, m/s^2.
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
            toward = np.array(j.center) / np.linalg.norm(j.center)
            body += pin.Inertia(payload[0], payload[1] * toward, np.zeros((3, 3)))
        model.appendBodyToJoint(parent, body, pin.SE3.Identity())
    return model
