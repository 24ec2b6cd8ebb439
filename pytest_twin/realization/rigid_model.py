"""A rigid-body tree in Pinocchio, with the names of joints and frames."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from pytest_twin.realization import inertia

Vector = NDArray[np.float64]


@dataclass(slots=True)
class RigidModel:
    """A Pinocchio model, with the mapping of names to its joints and frames.

    Attributes:
        model: model of Pinocchio; ``inertias[0]`` is that of all fixed bodies.
        joints: joint name -> index in Pinocchio, in the order of the realization.
        frames: site or body -> (index of its joint in Pinocchio, pose in that joint).
        reference: joint -> joint value of the pose that the file describes, rad or m.
        neutral: joint -> value where none is given, rad or m; quaternion or pose for a ball or
            free joint.
        armature: joint -> kg*m^2 or kg.
        world: pose of Pinocchio's universe frame in the world.
        notes: values that were taken from MuJoCo.
    """

    model: pin.Model = field(default_factory=pin.Model)
    joints: dict[str, int] = field(default_factory=dict)
    frames: dict[str, tuple[int, pin.SE3]] = field(default_factory=dict)
    reference: dict[str, float] = field(default_factory=dict)
    neutral: dict[str, float | Vector] = field(default_factory=dict)
    armature: dict[str, float] = field(default_factory=dict)
    world: pin.SE3 = field(default_factory=pin.SE3.Identity)
    notes: list[str] = field(default_factory=list)


def add_inertia(model: pin.Model, joint: int, *changes: tuple[float, Vector]) -> None:
    """Add bodies to a joint of ``model`` or subtract them.

    Args:
        model: changed in place.
        changes: pairs of a factor (1 or -1) and the :func:`moments` of a body.
    """
    total = model.inertias[joint].toDynamicParameters()
    for factor, parameters in changes:
        total = total + factor * parameters
    if total[0] < 1e-15:
        model.inertias[joint] = pin.Inertia.Zero()
    else:
        model.inertias[joint] = pin.Inertia.FromDynamicParameters(total)


def moments(mass: float, com: Vector, tensor: Vector, placement: pin.SE3) -> Vector:
    """(10,) mass [kg], first [kg*m] and second moments [kg*m^2] of a body, in Pinocchio's order.

    Args:
        mass: kg.
        com: (3,) centre of mass in the body's frame, m.
        tensor: (3, 3) inertia about the centre of mass, body axes, kg*m^2.
        placement: pose of the body in the frame of the result.
    """
    lever = placement.act(np.asarray(com, dtype=np.float64))
    axes = placement.rotation
    i = axes @ tensor @ axes.T + inertia.point_inertia(mass, lever)
    return np.array([mass, *(mass * lever), i[0, 0], i[0, 1], i[1, 1], i[0, 2], i[1, 2], i[2, 2]])
