"""Forward kinematics of a serial chain, with derivatives by joint zeros and link geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.transform_derivatives import TransformWithJacobian, left_jacobian
from pytest_twin.realization.serial_chain import SerialChain

PARALLEL_SINE = 0.2
"""Sine of the angle between neighbouring axes below which they are treated as parallel. The
Denavit-Hartenberg offset grows without bound there and is replaced by Hayati's second angle."""


@dataclass(frozen=True)
class LinkParameter:
    """One deviation of a link from its nominal geometry.

    Attributes:
        joint: index of the joint whose placement on the preceding link deviates.
        is_rotation: True for an angle about ``direction`` (rad), False for an offset along it (m).
        direction: (3,) in the joint's frame.
        label: text such as ``offset along x of fr3_joint3``.
    """

    joint: int
    is_rotation: bool
    direction: FloatArray
    label: str

    @property
    def unit(self) -> str:
        """Unit of the deviation, ``rad`` or ``m``."""
        return "rad" if self.is_rotation else "m"


def link_parameters(
    chain: SerialChain, first: int, *, zeros_are_free: bool = True
) -> tuple[LinkParameter, ...]:
    """Return a minimal complete set of link deviations for the joints from ``first`` on.

    The rotation about a joint's axis is the joint's zero. The displacement along the axis belongs
    to the preceding link. The remaining deviations of a joint are the twist and two offsets where
    its axis is inclined to the preceding one (Denavit and Hartenberg, 1955), and two angles and one
    offset where both are parallel (Hayati, 1983). If no joint zero is free, each joint has two
    angles and two offsets, because the angle between the links is then geometry too.
    """
    found: list[LinkParameter] = []
    for at in range(first, len(chain.joints)):
        axis = chain.axes[at]
        before = None
        if at > 0 and chain.revolute[at - 1]:
            before = chain.placements[at, :3, :3].T @ chain.axes[at - 1]
        angles, offsets = _directions(axis, before, chain.placements[at])
        if at == 0 or not chain.revolute[at - 1] or not zeros_are_free:
            angles, offsets = _across(axis), _across(axis)
        if not chain.revolute[at]:
            # Only the direction of a prismatic axis matters, not its position.
            offsets = []
        for rotation, directions in ((False, offsets), (True, angles)):
            for direction in directions:
                found.append(_parameter(chain, at, rotation, direction))
    return tuple(found)


def _parameter(chain: SerialChain, at: int, rotation: bool, direction: FloatArray) -> LinkParameter:
    largest = int(np.argmax(np.abs(direction)))
    direction = direction * np.sign(direction[largest])
    name = "xyz"[largest]
    if abs(direction[largest]) < 0.999:
        name = "(" + ", ".join(f"{value:.2f}" for value in direction) + ")"
    kind = "tilt about" if rotation else "offset along"
    return LinkParameter(at, rotation, direction, f"{kind} {name} of {chain.joints[at]}")


def _across(axis: FloatArray) -> list[FloatArray]:
    """Two directions perpendicular to an axis, along axes of the frame where possible."""
    start = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = start - axis * (axis @ start)
    first = first / np.linalg.norm(first)
    return [first, np.cross(axis, first)]


def _directions(
    axis: FloatArray, before: FloatArray | None, placement: FloatArray
) -> tuple[list[FloatArray], list[FloatArray]]:
    if before is None:
        return _across(axis), _across(axis)
    normal = np.cross(before, axis)
    sine = float(np.linalg.norm(normal))
    if sine > PARALLEL_SINE:
        normal = normal / sine
        return [normal], [normal, np.cross(axis, normal)]
    # The common normal of both axes.
    lever = placement[:3, :3].T @ placement[:3, 3]
    lever = lever - axis * (axis @ lever)
    length = float(np.linalg.norm(lever))
    return _across(axis), [lever / length] if length > 1e-6 else _across(axis)


@dataclass(frozen=True)
class ChainParameters:
    """Values of the chain's parameters, and their columns among all parameters of a fit.

    Attributes:
        count: number of all parameters of the fit.
        zeros: (n,) value added to each joint's reading, rad or m.
        zero_columns: (n,) column of each joint's zero, -1 where it is fixed.
        link_values: values of the deviations, m or rad.
        link_columns: columns of the deviations.
    """

    count: int
    zeros: FloatArray
    zero_columns: tuple[int, ...]
    links: tuple[LinkParameter, ...] = ()
    link_values: FloatArray | None = None
    link_columns: tuple[int, ...] = ()


def forward(
    chain: SerialChain, readings: FloatArray, parameters: ChainParameters
) -> TransformWithJacobian:
    """``transform_base_to_flange`` of each row, with derivatives.

    Args:
        readings: (rows, n) joint positions as read from the encoders, rad or m.
    """
    rows, width = len(readings), parameters.count
    rotation = np.tile(np.eye(3), (rows, 1, 1))
    position = np.zeros((rows, 3))
    # A change (v, w) at origin o moves a point p by v + w x (p - o). It is stored as v - w x o and
    # w.
    turn = np.zeros((rows, 3, width))
    shift = np.zeros((rows, 3, width))
    values = chain.signs * readings + chain.offsets + parameters.zeros
    for at in range(len(chain.joints)):
        rotation, position = _step(rotation, position, chain.placements[at])
        rotation, position = _deviate(rotation, position, at, parameters, turn, shift)
        axis = rotation @ chain.axes[at]
        column = parameters.zero_columns[at]
        if chain.revolute[at]:
            if column >= 0:
                turn[:, :, column] = axis
                shift[:, :, column] = -np.cross(axis, position)
            angle = values[:, at, None] * chain.axes[at]
            rotation = rotation @ Rotation.from_rotvec(angle).as_matrix()
        else:
            if column >= 0:
                shift[:, :, column] = axis
            position = position + axis * values[:, at, None]
    rotation, position = _step(rotation, position, chain.end)
    cross = np.cross(np.moveaxis(turn, 2, 1), position[:, None, :])
    return TransformWithJacobian(rotation, position, turn, shift + np.moveaxis(cross, 1, 2))


def _step(
    rotation: FloatArray, position: FloatArray, placement: FloatArray
) -> tuple[FloatArray, FloatArray]:
    return rotation @ placement[:3, :3], position + rotation @ placement[:3, 3]


def _deviate(
    rotation: FloatArray,
    position: FloatArray,
    at: int,
    parameters: ChainParameters,
    turn: FloatArray,
    shift: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    if parameters.link_values is None:
        return rotation, position
    own = [
        (link, float(value), column)
        for link, value, column in zip(
            parameters.links, parameters.link_values, parameters.link_columns, strict=True
        )
        if link.joint == at
    ]
    for link, value, column in own:
        if not link.is_rotation:
            direction = rotation @ link.direction
            shift[:, :, column] = direction
            position = position + value * direction
    tilts = [(link, value, column) for link, value, column in own if link.is_rotation]
    if tilts:
        vector = np.sum([value * link.direction for link, value, _ in tilts], axis=0)
        jacobian = left_jacobian(vector)
        for link, _, column in tilts:
            direction = rotation @ (jacobian @ link.direction)
            turn[:, :, column] = direction
            shift[:, :, column] = -np.cross(direction, position)
        rotation = rotation @ Rotation.from_rotvec(vector).as_matrix()
    return rotation, position
