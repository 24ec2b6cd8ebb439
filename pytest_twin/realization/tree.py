"""Kinematics and masses of a tree of rigid bodies in numpy, independent of any engine.

The forms are the textbook ones (Siciliano et al., "Robotics: Modelling, Planning and Control",
2009, ch. 3 and 7), with the Jacobian of each body's centre of mass: short rather than fast.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
GRAVITY = (0.0, 0.0, -9.81)
"""m/s^2, in the frame of the root."""


@dataclass(frozen=True, slots=True)
class TreeJoint:
    """One degree of freedom between a body and its parent.

    Attributes:
        kind: ``hinge`` (rad) or ``slide`` (m).
        axis: (3,) unit vector in the frame ``anchor``.
        anchor: (4, 4) of the joint's frame in the body.
    """

    name: str
    kind: Literal["hinge", "slide"]
    axis: Vector
    anchor: Vector

    def motion(self, value: float) -> Vector:
        """(4, 4) from the body's place at zero to its place at ``value``."""
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
        parent: the body that carries it, None for the root.
        placement: (4, 4) in the parent with the joint at zero.
        joint: what it moves by, None where it is fixed (or free, and stands as it is drawn).
        mass: kg.
        com: (3,) centre of mass in the body, m.
        inertia: (3, 3) about that centre, body axes, kg*m^2.
    """

    name: str
    parent: str | None
    placement: Vector
    joint: TreeJoint | None
    mass: float
    com: Vector
    inertia: Vector


def rotation_about(axis: Vector, angle: float) -> Vector:
    """(3, 3) by Rodrigues' formula; ``axis`` of unit length, ``angle`` in rad."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: Vector = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return turned


def inverse(pose: Vector) -> Vector:
    """Of a rigid transform (4, 4)."""
    result = np.eye(4)
    result[:3, :3] = pose[:3, :3].T
    result[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return result


class RigidTree:
    """Bodies, each after its parent; poses are told from the root.

    Joint values are mappings from joint to rad or m; joints left out stand at zero.
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
        """``transform_root_to_body`` (4, 4) of every body."""
        found: dict[str, Vector] = {}
        for body in self.bodies.values():
            pose = body.placement
            if body.joint is not None:
                pose = pose @ body.joint.motion(q.get(body.joint.name, 0.0))
            found[body.name] = pose if body.parent is None else found[body.parent] @ pose
        return found

    def frame_pose(self, q: Mapping[str, float], frame: str) -> Vector:
        """``transform_root_to_frame`` (4, 4)."""
        return self.poses(q)[frame]

    def mass(self) -> float:
        """Of all bodies, kg."""
        return float(sum(body.mass for body in self.bodies.values()))

    def center_of_mass(self, q: Mapping[str, float]) -> Vector:
        """(3,) of all bodies, in the root, m."""
        poses, total, moment = self.poses(q), self.mass(), np.zeros(3)
        for body in self.bodies.values():
            moment += body.mass * (poses[body.name][:3, :3] @ body.com + poses[body.name][:3, 3])
        return moment / total if total > 0 else moment

    def gravity_torque(self, q: Mapping[str, float]) -> Vector:
        """(n,) N*m or N that holds each joint against ``GRAVITY``, in the order of ``joints``."""
        torque = np.zeros(len(self.joints))
        for body, linear, _, _ in self._jacobians(q):
            torque -= body.mass * (linear.T @ np.array(GRAVITY))
        return torque

    def mass_matrix(self, q: Mapping[str, float]) -> Vector:
        """(n, n) sum of m Jv^T Jv + Jw^T I Jw, in the order of ``joints``."""
        matrix = np.zeros((len(self.joints),) * 2)
        for body, linear, angular, rotation in self._jacobians(q):
            inertia = rotation @ body.inertia @ rotation.T
            matrix += body.mass * linear.T @ linear + angular.T @ inertia @ angular
        return matrix

    def _jacobians(
        self, q: Mapping[str, float]
    ) -> Iterable[tuple[TreeBody, Vector, Vector, Vector]]:
        """Each body, (3, n) Jacobians of its centre of mass and its rotation, and its axes."""
        poses = self.poses(q)
        index = {name: i for i, name in enumerate(self.joints)}
        above: dict[str, tuple[tuple[int, TreeJoint, Vector], ...]] = {}
        for body in self.bodies.values():
            chain = () if body.parent is None else above[body.parent]
            if body.joint is not None:
                # The axis stays put under its own motion, so the body's own pose gives it.
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
