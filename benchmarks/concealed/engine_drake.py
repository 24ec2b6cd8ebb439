"""A robot in Drake's multibody plant, for blind cases: SAP solver, Drake's effort limits.

Dry friction is a second actuator at each joint: a stiff brake of limited effort, which Drake's
contact solver solves implicitly. A surface is a compliant point contact with Hunt and Crossley's
dissipation.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from cell import Background
from plant import Hidden
from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
    DiscreteContactApproximation,
)
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    JointActuator,
    PdControllerGains,
    PrismaticJoint,
    RevoluteJoint,
    RevoluteSpring,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from robots import Joint, Robot

# A half space cannot touch deformable bodies; there are none.
logging.getLogger("drake").setLevel(logging.ERROR)

STEP = 1e-3
"""Time step of Drake's discrete plant, s."""
BRAKE = 2e4
"""Damping of the brake that represents dry friction, in friction levels per rad/s."""
DEPTH = 2e-3
"""Depth at which the dissipation of a contact equals that of the nominal model's damper, m."""
LIGHT = 1e-6
"""Mass of a rotor, kg; only its inertia matters."""
NAMED = (
    "command_delay", "sensor_delay", "clock_drift", "encoder_bias", "encoder_scale",
    "encoder_eccentricity", "actuator_lag", "rate_limit", "torque_constant", "torque_saturation",
    "torque_speed_limit", "dead_zone", "cogging", "controller_gain", "viscous_friction",
    "coulomb_friction", "asymmetric_friction", "quadratic_drag", "joint_elasticity", "joint_spring",
    "payload", "inertial_parameters", "armature", "base_tilt", "external_force",
)  # fmt: skip
"""Effects that can be hidden in this engine, in addition to those of a contact."""


def _inertia(joint: Joint, scale: float, shift: np.ndarray) -> SpatialInertia:
    """Inertia of a link about its frame's origin."""
    center, mass = np.array(joint.center) + shift, joint.mass * scale
    about = UnitInertia(*(np.array(joint.inertia) / joint.mass))
    return SpatialInertia.MakeFromCentralInertia(mass, center, about * mass)


class DrakeRobot:
    """A robot that Drake steps.

    Attributes:
        motor: whether each joint's servo reads a motor with its own position.
    """

    def __init__(
        self, robot: Robot, real: Hidden, background: Background, gravity: np.ndarray
    ) -> None:
        builder = DiagramBuilder()
        self.plant, scene = AddMultibodyPlantSceneGraph(builder, time_step=STEP)
        del scene  # the diagram owns it
        plant = self.plant
        plant.set_discrete_contact_approximation(DiscreteContactApproximation.kLagged)
        plant.mutable_gravity_field().set_gravity_vector(gravity)
        self.links, self.motors = [], []
        self.drives: list[JointActuator] = []
        self.brakes: list[JointActuator] = []
        n = len(robot.joints)
        h = real.get
        damping = h("viscous_friction", "coefficient", n)
        level = h("coulomb_friction", "coulomb", n) + h("asymmetric_friction", "coulomb", n)
        rotor = h("armature", "inertia", n)
        soft = h("joint_elasticity", "stiffness", n)
        twist = soft * h("joint_elasticity", "damping_time", n)
        self.motor = soft > 0
        parent = plant.world_body()
        for i, j in enumerate(robot.joints):
            scale = 1.0 + real.effects.get("inertial_parameters", {}).get(i, {}).get(
                "relative_error", 0.0
            )
            shift = background.centers[i] if len(background.centers) else np.zeros(3)
            origin = np.array(j.origin)
            if len(background.origins):
                origin = origin + background.origins[i]
            at = plant.AddFrame(
                FixedOffsetFrame(f"at{i}", parent.body_frame(), RigidTransform(origin))
            )
            body = plant.AddRigidBody(f"link{i}", _inertia(j, scale, shift))
            kind = PrismaticJoint if j.slide else RevoluteJoint
            total = j.damping + float(damping[i])
            armature = j.armature + float(rotor[i])
            if self.motor[i]:
                about = UnitInertia.SolidSphere(1.0) * (armature / 0.4)
                turning = SpatialInertia.MakeFromCentralInertia(LIGHT, np.zeros(3), about)
                motor = plant.AddRigidBody(f"motor{i}", turning)
                shaft = plant.AddJoint(
                    RevoluteJoint(f"shaft{i}", at, motor.body_frame(), j.axis, total)
                )
                link = plant.AddJoint(
                    RevoluteJoint(j.name, motor.body_frame(), body.body_frame(), j.axis,
                                  float(twist[i]))
                )  # fmt: skip
                plant.AddForceElement(RevoluteSpring(link, 0.0, float(soft[i])))
                armature = 0.0
            else:
                shaft = link = plant.AddJoint(
                    kind(j.name, at, body.body_frame(), j.axis, damping=total)
                )
            drive = plant.AddJointActuator(f"drive{i}", shaft)
            drive.set_default_rotor_inertia(armature)
            drive.set_default_gear_ratio(1.0)
            limit = max(j.friction + float(level[i]), 1e-9)
            brake = plant.AddJointActuator(f"brake{i}", shaft, limit)
            brake.set_controller_gains(PdControllerGains(p=1e-9, d=BRAKE * limit))
            self.motors.append(shaft)
            self.links.append(link)
            self.drives.append(drive)
            self.brakes.append(brake)
            parent = body
        mass = real.robot("payload", "mass")
        if mass:
            last = robot.joints[-1]
            toward = np.array(last.center) / np.linalg.norm(last.center)
            lump = plant.AddRigidBody("payload", SpatialInertia.SolidSphereWithMass(mass, 1e-3))
            where = RigidTransform(real.robot("payload", "distance") * toward)
            plant.WeldFrames(parent.body_frame(), lump.body_frame(), where)
        if robot.contact is not None:
            self._touch(robot, real, parent)
        plant.Finalize()
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        self.inner = plant.GetMyMutableContextFromRoot(self.context)
        self.effort = np.zeros(plant.num_actuators())
        self.places = [int(drive.index()) for drive in self.drives]
        self.at = [s.position_start() for s in self.motors]
        self.on = [s.velocity_start() for s in self.motors]
        self.port = plant.get_actuation_input_port()
        # A brake without a connected reference state would be inactive.
        wanted = plant.get_desired_state_input_port(self.brakes[0].model_instance())
        wanted.FixValue(self.inner, np.zeros(wanted.size()))

    def _touch(self, robot: Robot, real: Hidden, last: Any) -> None:
        c = robot.contact
        assert c is not None
        stiffness = c.stiffness * (1 + real.robot("contact_stiffness", "relative_error"))
        damping = c.damping * (1 + real.robot("contact_damping", "relative_error"))
        friction = c.friction + real.robot("contact_friction", "coefficient")
        height = c.height + real.robot("contact_offset", "offset")
        properties = ProximityProperties()
        # Two compliances in series give half of each stiffness.
        AddContactMaterial(
            dissipation=damping / (c.stiffness * DEPTH), point_stiffness=2.0 * stiffness,
            friction=CoulombFriction(friction, friction), properties=properties,
        )  # fmt: skip
        normal = np.array(c.normal)
        turn = RotationMatrix.MakeFromOneVector(normal, 2)
        plane = RigidTransform(turn, height * normal)
        self.plant.RegisterCollisionGeometry(
            self.plant.world_body(), plane, HalfSpace(), "surface", properties
        )
        self.plant.RegisterCollisionGeometry(
            last, RigidTransform(np.array(c.tip)), Sphere(c.radius), "tip", properties
        )

    def reset(self, position: np.ndarray) -> None:
        """Put the joints at rest."""
        self.ticks = 0
        self.context.SetTime(0.0)
        whole = np.zeros(self.plant.num_positions())
        for shaft, q in zip(self.motors, position, strict=True):
            whole[shaft.position_start()] = q
        self.plant.SetPositions(self.inner, whole)
        self.plant.SetVelocities(self.inner, np.zeros(self.plant.num_velocities()))
        self.simulator.Initialize()

    def state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(joints,) positions and velocities of the links and of the motors."""
        q = self.plant.GetPositions(self.inner)
        v = self.plant.GetVelocities(self.inner)
        motor, speed = q[self.at], v[self.on]
        link, moves = motor.copy(), speed.copy()
        for i in np.flatnonzero(self.motor):
            link[i] += q[self.links[i].position_start()]
            moves[i] += v[self.links[i].velocity_start()]
        return link, moves, motor, speed

    def advance(self, effort: np.ndarray, level: np.ndarray) -> None:
        """Step under joint efforts; the brakes use their own friction level."""
        del level
        self.effort[self.places] = effort
        self.port.FixValue(self.inner, self.effort)
        self.ticks += 1
        self.simulator.AdvanceTo(self.ticks * STEP)

    def close(self) -> None:
        """Do nothing; there is nothing to release."""
