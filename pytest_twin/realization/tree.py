"""Kinematics, gravity torque and mass matrix of a rigid-body tree in NumPy.

This module is independent of all physics engines. It uses the Jacobian of each body's centre of
mass (Siciliano et al., "Robotics: Modelling, Planning and Control", 2009, ch. 3 and 7) and is
written for clarity, not for speed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pytest_twin.metrics.pose import inverse

Vector = NDArray[np.float64]
GRAVITY = (0.0, 0.0, -9.81)
"""(3,) m/s^2, in the frame of the root body."""


@dataclass(frozen=True, slots=True)
class TreeJoint:
    """One degree of freedom between a body and its parent.

    Attributes:
        kind: ``hinge`` (rad) or ``slide`` (m).
        axis: (3,) unit vector in the frame of the joint.
        anchor: (4, 4) pose of the joint's frame in the body, m.
    """

    name: str
    kind: Literal["hinge", "slide"]
    axis: Vector
    anchor: Vector

    def motion(self, value: float) -> Vector:
        """(4, 4) motion of the body from joint value zero to ``value`` (rad or m), in its frame."""
        moved = np.eye(4)
        if self.kind == "slide":
            moved[:3, 3] = value * self.axis
        else:
            moved[:3, :3] = rotation_about(self.axis, value)
        result: Vector = self.anchor @ moved @ inverse(self.anchor)
        return result


@dataclass(frozen=True, slots=True)
class TreeBody:
    """A rigid body.

    Attributes:
        parent: name of the parent body, None for the root.
        placement: (4, 4) pose in the parent with the joint at zero, m.
        joint: joint to the parent; None for a fixed body, and for a free body, which stays at its
            initial pose.
        mass: kg.
        com: (3,) centre of mass in the body's frame, m.
        inertia: (3, 3) about the centre of mass, body axes, kg*m^2.
    """

    name: str
    parent: str | None
    placement: Vector
    joint: TreeJoint | None
    mass: float
    com: Vector
    inertia: Vector


def rotation_about(axis: Vector, angle: float) -> Vector:
    """(3, 3) rotation matrix by Rodrigues' formula; unit vector ``axis`` (3,), ``angle`` in rad."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: Vector = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return turned


class RigidTree:
    """A tree of rigid bodies, each listed after its parent; poses are in the frame of the root.

    Joint values are mappings from joint to rad or m; joints that are not given are at zero.
    """

    def __init__(self, bodies: Iterable[TreeBody]) -> None:
        self.bodies: dict[str, TreeBody] = {body.name: body for body in bodies}

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """Joint names, in the order of the bodies."""
        return tuple(body.joint.name for body in self.bodies.values() if body.joint)

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the bodies."""
        return tuple(self.bodies)

    def poses(self, q: Mapping[str, float]) -> dict[str, Vector]:
        """Pose (4, 4) of each body in the root, m."""
        found: dict[str, Vector] = {}
        for body in self.bodies.values():
            pose = body.placement
            if body.joint is not None:
                pose = pose @ body.joint.motion(q.get(body.joint.name, 0.0))
            found[body.name] = pose if body.parent is None else found[body.parent] @ pose
        return found

    def frame_pose(self, q: Mapping[str, float], frame: str) -> Vector:
        """Pose (4, 4) of a body in the root, m."""
        return self.poses(q)[frame]

    def mass(self) -> float:
        """Total mass, kg."""
        return float(sum(body.mass for body in self.bodies.values()))

    def center_of_mass(self, q: Mapping[str, float]) -> Vector:
        """(3,) centre of mass of all bodies in the root, m."""
        poses, total, moment = self.poses(q), self.mass(), np.zeros(3)
        for body in self.bodies.values():
            moment += body.mass * (poses[body.name][:3, :3] @ body.com + poses[body.name][:3, 3])
        return moment / total if total > 0 else moment

    def gravity_torque(self, q: Mapping[str, float]) -> Vector:
        """(n,) generalized forces (N*m or N) that balance ``GRAVITY``; order of ``joints``."""
        torque = np.zeros(len(self.joints))
        for body, linear, _, _ in self._jacobians(q):
            torque -= body.mass * (linear.T @ np.array(GRAVITY))
        return torque

    def mass_matrix(self, q: Mapping[str, float]) -> Vector:
        """(n, n) mass matrix, sum of m Jv^T Jv + Jw^T I Jw; order of ``joints``, SI units."""
        matrix = np.zeros((len(self.joints),) * 2)
        for body, linear, angular, rotation in self._jacobians(q):
            inertia = rotation @ body.inertia @ rotation.T
            matrix += body.mass * linear.T @ linear + angular.T @ inertia @ angular
        return matrix

    def _jacobians(
        self, q: Mapping[str, float]
    ) -> Iterable[tuple[TreeBody, Vector, Vector, Vector]]:
        """Yield each body, its (3, n) linear and angular Jacobians, and its (3, 3) orientation."""
        poses = self.poses(q)
        index = {name: i for i, name in enumerate(self.joints)}
        above: dict[str, tuple[tuple[int, TreeJoint, Vector], ...]] = {}
        for body in self.bodies.values():
            chain = () if body.parent is None else above[body.parent]
            if body.joint is not None:
                # The axis does not move with its own joint, so that the pose of the body gives it.
                frame = poses[body.name] @ body.joint.anchor
                chain = (*chain, (index[body.joint.name], body.joint, frame))
            above[body.name] = chain
            linear, angular = np.zeros((3, len(index))), np.zeros((3, len(index)))
            pose = poses[body.name]
            center = pose[:3, :3] @ body.com + pose[:3, 3]
            for column, joint, frame in chain:
                axis = frame[:3, :3] @ joint.axis
                if joint.kind == "slide":
                    linear[:, column] = axis
                else:
                    angular[:, column] = axis
                    linear[:, column] = np.cross(axis, center - frame[:3, 3])
            yield body, linear, angular, pose[:3, :3]
