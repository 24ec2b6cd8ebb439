"""A tree of rigid bodies in Pinocchio, with the names that people use."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from pytest_twin.realization import inertia

Vector = NDArray[np.float64]


@dataclass(slots=True)
class RigidModel:
    """A Pinocchio model with the assignment of joints and frames to it.

    Attributes:
        model: joints in a tree; ``inertias[0]`` is what stands still.
        joints: joint name -> Pinocchio's joint, in the order of the realization.
        frames: site or body -> (Pinocchio's joint, placement in it).
        reference: joint -> value at which the robot stands as it is drawn, rad or m.
        neutral: ball or free joint -> value where none is given.
        armature: joint -> kg*m^2 or kg.
        world: placement of Pinocchio's universe in the world.
        notes: what was taken from MuJoCo.
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
    """Add bodies to a joint, or take them away: pairs of a factor and :func:`moments`.

    Mass, first and second moments about one origin add up, whatever their sign.
    """
    total = model.inertias[joint].toDynamicParameters()
    for factor, parameters in changes:
        total = total + factor * parameters
    if total[0] < 1e-15:
        model.inertias[joint] = pin.Inertia.Zero()
    else:
        model.inertias[joint] = pin.Inertia.FromDynamicParameters(total)


def moments(mass: float, com: Vector, tensor: Vector, placement: pin.SE3) -> Vector:
    """(10,) mass, first and second moments of a body, as Pinocchio orders them.

    Args:
        com: (3,) centre of mass in the body's frame, m.
        tensor: (3, 3) about the centre of mass, body axes, kg*m^2.
        placement: of the body in the frame that is wanted.
    """
    lever = placement.act(np.asarray(com, dtype=np.float64))
    axes = placement.rotation
    i = axes @ tensor @ axes.T + inertia.of_point(mass, lever)
    return np.array([mass, *(mass * lever), i[0, 0], i[0, 1], i[1, 1], i[0, 2], i[1, 2], i[2, 2]])
