"""A robot in Bullet, for blind cases: Featherstone's algorithm, sequential impulses.

Dry friction is Bullet's joint motor at zero velocity with a force limit, which may change at every
step. There is no reflected inertia of motors, because these robots have direct drives.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pybullet
from cell import Background
from plant import Hidden
from robots import Robot

STEP = 5e-4
"""Time step of Bullet, s."""
NAMED = (
    "command_delay", "sensor_delay", "clock_drift", "encoder_bias", "encoder_scale",
    "encoder_eccentricity", "actuator_lag", "rate_limit", "torque_constant", "torque_saturation",
    "torque_speed_limit", "dead_zone", "cogging", "controller_gain", "viscous_friction",
    "coulomb_friction", "asymmetric_friction", "stribeck_friction", "thermal_friction",
    "position_dependent_friction", "quadratic_drag", "joint_spring", "payload",
    "inertial_parameters", "base_tilt", "external_force",
)  # fmt: skip
"""Effects that can be hidden in this engine, in addition to those of a contact."""


def urdf(robot: Robot, real: Hidden, background: Background) -> str:
    """Return the true robot in the format that Bullet reads."""
    root = ElementTree.Element("robot", name=robot.name)
    base = ElementTree.SubElement(root, "link", name="base")
    resting = ElementTree.SubElement(base, "inertial")
    ElementTree.SubElement(resting, "mass", value="1")
    ElementTree.SubElement(resting, "inertia", ixx="1", ixy="0", ixz="0", iyy="1", iyz="0", izz="1")

    def row(values: np.ndarray) -> str:
        return " ".join(repr(float(v)) for v in values)

    for i, j in enumerate(robot.joints):
        scale = 1.0 + real.effects.get("inertial_parameters", {}).get(i, {}).get(
            "relative_error", 0.0
        )
        mass, center = scale * j.mass, np.array(j.center)
        if len(background.centers):
            center = center + background.centers[i]
        inertia = scale * np.diag(j.inertia)
        lump = real.robot("payload", "mass") if i == len(robot.joints) - 1 else 0.0
        if lump:
            toward = np.array(j.center) / np.linalg.norm(j.center)
            at = real.robot("payload", "distance") * toward
            both = (mass * center + lump * at) / (mass + lump)
            for m, c in ((mass, center), (lump, at)):
                d = c - both
                inertia = inertia + m * (d @ d * np.eye(3) - np.outer(d, d))
            mass, center = mass + lump, both
        link = ElementTree.SubElement(root, "link", name=f"link{i}")
        inertial = ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(inertial, "origin", xyz=row(center))
        ElementTree.SubElement(inertial, "mass", value=repr(mass))
        names = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2),
                 "izz": (2, 2)}  # fmt: skip
        ElementTree.SubElement(
            inertial, "inertia", {k: repr(float(inertia[at])) for k, at in names.items()}
        )
        if robot.contact is not None and i == len(robot.joints) - 1:
            collision = ElementTree.SubElement(link, "collision")
            ElementTree.SubElement(collision, "origin", xyz=row(np.array(robot.contact.tip)))
            shape = ElementTree.SubElement(collision, "geometry")
            ElementTree.SubElement(shape, "sphere", radius=repr(robot.contact.radius))
        kind = "prismatic" if j.slide else "continuous"
        joint = ElementTree.SubElement(root, "joint", name=j.name, type=kind)
        ElementTree.SubElement(joint, "parent", link=f"link{i - 1}" if i else "base")
        ElementTree.SubElement(joint, "child", link=f"link{i}")
        origin = np.array(j.origin)
        if len(background.origins):
            origin = origin + background.origins[i]
        ElementTree.SubElement(joint, "origin", xyz=row(origin))
        ElementTree.SubElement(joint, "axis", xyz=row(np.array(j.axis)))
        if j.slide:
            ElementTree.SubElement(
                joint, "limit", lower="-9", upper="9", effort="1e9", velocity="1e9"
            )
    return ElementTree.tostring(root, encoding="unicode")


class BulletRobot:
    """A robot that Bullet steps."""

    def __init__(
        self, robot: Robot, real: Hidden, background: Background, gravity: np.ndarray
    ) -> None:
        self.n = len(robot.joints)
        self.client = pybullet.connect(pybullet.DIRECT)
        here = {"physicsClientId": self.client}
        self.here = here
        pybullet.setTimeStep(STEP, **here)
        pybullet.setGravity(*gravity, **here)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "robot.urdf"
            file.write_text(urdf(robot, real, background))
            self.body = pybullet.loadURDF(
                str(file), useFixedBase=True, flags=pybullet.URDF_USE_INERTIA_FROM_FILE, **here
            )
        viscous = real.get("viscous_friction", "coefficient", self.n)
        for i in range(-1, self.n):
            damping = 0.0 if i < 0 else robot.joints[i].damping + float(viscous[i])
            pybullet.changeDynamics(
                self.body, i, linearDamping=0.0, angularDamping=0.0, jointDamping=damping,
                maxJointVelocity=1e3, **here,
            )  # fmt: skip
        self.axes = list(range(self.n))
        if robot.contact is not None:
            self._touch(robot, real)

    def _touch(self, robot: Robot, real: Hidden) -> None:
        c = robot.contact
        assert c is not None
        normal = np.array(c.normal)
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_PLANE, planeNormal=c.normal, **self.here
        )
        height = c.height + real.robot("contact_offset", "offset")
        plane = pybullet.createMultiBody(0.0, shape, basePosition=height * normal, **self.here)
        # Bullet combines the stiffnesses of both bodies in series, and multiplies the friction
        # coefficients.
        pybullet.changeDynamics(
            plane, -1, lateralFriction=1.0, restitution=0.0,
            contactStiffness=c.stiffness
            * (1 + real.robot("contact_stiffness", "relative_error")),
            contactDamping=c.damping * (1 + real.robot("contact_damping", "relative_error")),
            **self.here,
        )  # fmt: skip
        friction = c.friction + real.robot("contact_friction", "coefficient")
        pybullet.changeDynamics(
            self.body, self.n - 1, lateralFriction=friction, restitution=0.0, rollingFriction=0.0,
            spinningFriction=0.0, **self.here,
        )  # fmt: skip

    def reset(self, position: np.ndarray) -> None:
        """Put the joints at rest."""
        for i, q in enumerate(position):
            pybullet.resetJointState(self.body, i, float(q), 0.0, **self.here)

    def state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(joints,) positions and velocities of the links and of the motors: the same here."""
        each = pybullet.getJointStates(self.body, self.axes, **self.here)
        q, v = np.array([s[0] for s in each]), np.array([s[1] for s in each])
        return q, v, q, v

    def advance(self, effort: np.ndarray, level: np.ndarray) -> None:
        """One step under efforts of the joints, with dry friction of some level."""
        pybullet.setJointMotorControlArray(
            self.body, self.axes, pybullet.VELOCITY_CONTROL, targetVelocities=[0.0] * self.n,
            forces=level.tolist(), **self.here,
        )  # fmt: skip
        pybullet.setJointMotorControlArray(
            self.body, self.axes, pybullet.TORQUE_CONTROL, forces=effort.tolist(), **self.here
        )
        pybullet.stepSimulation(**self.here)

    def close(self) -> None:
        """Release the engine."""
        pybullet.disconnect(**self.here)
