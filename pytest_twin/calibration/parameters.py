"""Unknowns of a calibration: names, values, and order in one vector."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.chain import ChainParameters, LinkParameter
from pytest_twin.calibration.transform_derivatives import TransformWithJacobian, left_jacobian

POSE_LABELS = ("x", "y", "z", "rx", "ry", "rz")
"""Order of a pose's six parameters: its position along the parent's axes (m), then its rotation
about its own axes (rad): ``R = R0 exp([rx, ry, rz])``, a right perturbation."""


@dataclass(frozen=True)
class State:
    """Values of all parameters of the prediction of an observation.

    Attributes:
        poses: name -> (4, 4).
        points: name -> (3,), m.
        zeros: (joints,) values added to the readings, rad or m.
        links: (deviations,) link deviations, m or rad.
        scale: scale factor of the positions from a camera without metric scale.
    """

    poses: Mapping[str, FloatArray]
    points: Mapping[str, FloatArray]
    zeros: FloatArray
    links: FloatArray
    scale: float = 1.0


@dataclass(frozen=True)
class Parameter:
    """One unknown.

    Attributes:
        block: ``pose:NAME``, ``point:NAME``, ``joint_zeros``, ``geometry`` or ``scale``.
        label: name of the coordinate, joint, or link deviation.
        unit: ``rad``, ``m`` or ``1``.
        prior: standard deviation about the nominal value, None for none.
    """

    block: str
    label: str
    unit: str
    prior: float | None = None

    @property
    def name(self) -> str:
        """``block.label``."""
        return f"{self.block}.{self.label}"


@dataclass(frozen=True)
class Layout:
    """Order of the unknowns in the parameter vector.

    Attributes:
        poses, points: names of the free poses and points.
        zeros: indices of the joints whose zero is free.
        joints: names of all joints.
        revolute: whether each joint is revolute.
        links: free link deviations.
        zero_prior, offset_prior, tilt_prior: standard deviations, rad or m.
        scale: whether the scale of the camera's positions is free.
        scale_prior: standard deviation of the scale about 1, None for none.
    """

    poses: tuple[str, ...]
    points: tuple[str, ...]
    zeros: tuple[int, ...] = ()
    joints: tuple[str, ...] = ()
    revolute: tuple[bool, ...] = ()
    links: tuple[LinkParameter, ...] = ()
    zero_prior: float | None = None
    offset_prior: float = 0.0
    tilt_prior: float = 0.0
    scale: bool = False
    scale_prior: float | None = None

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """All unknowns, in order."""
        found = [
            Parameter(f"pose:{name}", label, "m" if at < 3 else "rad")
            for name in self.poses
            for at, label in enumerate(POSE_LABELS)
        ]
        found += [Parameter(f"point:{name}", axis, "m") for name in self.points for axis in "xyz"]
        found += [
            Parameter(
                "joint_zeros",
                self.joints[at],
                "rad" if self.revolute[at] else "m",
                self.zero_prior,
            )
            for at in self.zeros
        ]
        found += [
            Parameter(
                "geometry",
                link.label,
                link.unit,
                self.tilt_prior if link.is_rotation else self.offset_prior,
            )
            for link in self.links
        ]
        if self.scale:
            found.append(Parameter("scale", "camera", "1", self.scale_prior))
        return tuple(found)

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return len(self.parameters)

    @cached_property
    def blocks(self) -> Mapping[str, slice]:
        """Block -> its slice in the vector."""
        found: dict[str, slice] = {}
        for at, parameter in enumerate(self.parameters):
            start = found.get(parameter.block, slice(at, at)).start
            found[parameter.block] = slice(start, at + 1)
        return found

    def without_zeros(self, held: set[int]) -> Layout:
        """Return the layout with the zeros of some joints fixed."""
        return replace(self, zeros=tuple(at for at in self.zeros if at not in held))

    def moved(self, state: State, step: FloatArray) -> State:
        """Return the state after a step of all unknowns."""
        poses = dict(state.poses)
        points = dict(state.points)
        for name in self.poses:
            change = step[self.blocks[f"pose:{name}"]]
            pose = poses[name].copy()
            pose[:3, 3] += change[:3]
            pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(change[3:]).as_matrix()
            poses[name] = pose
        for name in self.points:
            points[name] = points[name] + step[self.blocks[f"point:{name}"]]
        zeros, links, scale = state.zeros.copy(), state.links, state.scale
        if self.zeros:
            zeros[list(self.zeros)] += step[self.blocks["joint_zeros"]]
        if self.links:
            links = links + step[self.blocks["geometry"]]
        if self.scale:
            scale = scale + float(step[self.blocks["scale"]][0])
        return State(poses, points, zeros, links, scale)


class Poses(Protocol):
    """Named transforms and the camera's scale, with derivatives."""

    @property
    def scale(self) -> tuple[float, FloatArray]:
        """Factor of the camera's positions, and its derivatives, (count,)."""
        ...

    def pose(self, name: str, rows: int) -> TransformWithJacobian:
        """A named transform, once for each row."""
        ...

    def point(self, name: str, rows: int) -> tuple[FloatArray, FloatArray]:
        """(rows, 3) position of a named point, m, and its derivatives, (rows, 3, count)."""
        ...


@dataclass(frozen=True)
class HeldPoses:
    """Transforms and points of a state that are fixed, with ``width`` zero derivatives."""

    state: State
    width: int

    @property
    def scale(self) -> tuple[float, FloatArray]:
        """Factor of the camera's positions, and its derivatives."""
        return self.state.scale, np.zeros(self.width)

    def pose(self, name: str, rows: int) -> TransformWithJacobian:
        """A named transform, once for each row."""
        pose = np.tile(self.state.poses[name], (rows, 1, 1))
        nothing = np.zeros((rows, 3, self.width))
        return TransformWithJacobian(pose[:, :3, :3], pose[:, :3, 3], nothing, nothing)

    def point(self, name: str, rows: int) -> tuple[FloatArray, FloatArray]:
        """(rows, 3) position of a named point, m, and its derivatives, (rows, 3, width)."""
        return np.tile(self.state.points[name], (rows, 1)), np.zeros((rows, 3, self.width))


@dataclass(frozen=True)
class Variables:
    """Transforms and points at a state plus a step, with derivatives by the step."""

    layout: Layout
    state: State
    step: FloatArray

    @cached_property
    def now(self) -> State:
        """Return the state after the step."""
        return self.layout.moved(self.state, self.step)

    def held(self, width: int) -> HeldPoses:
        """Return the current transforms and points as fixed ones, with ``width`` derivatives."""
        return HeldPoses(self.now, width)

    @property
    def scale(self) -> tuple[float, FloatArray]:
        """Factor of the camera's positions, and its derivatives, (count,)."""
        slope = np.zeros(self.layout.count)
        if self.layout.scale:
            slope[self.layout.blocks["scale"]] = 1.0
        return self.now.scale, slope

    def pose(self, name: str, rows: int) -> TransformWithJacobian:
        """A named transform, once for each row."""
        pose = self.now.poses[name]
        turn = np.zeros((3, self.layout.count))
        shift = np.zeros((3, self.layout.count))
        if name in self.layout.poses:
            place = self.layout.blocks[f"pose:{name}"]
            vector = self.step[place][3:]
            shift[:, place.start : place.start + 3] = np.eye(3)
            turn[:, place.start + 3 : place.stop] = self.state.poses[name][:3, :3] @ left_jacobian(
                vector
            )
        return TransformWithJacobian(
            np.tile(pose[:3, :3], (rows, 1, 1)),
            np.tile(pose[:3, 3], (rows, 1)),
            np.tile(turn, (rows, 1, 1)),
            np.tile(shift, (rows, 1, 1)),
        )

    def point(self, name: str, rows: int) -> tuple[FloatArray, FloatArray]:
        """(rows, 3) position of a named point, m, and its derivatives, (rows, 3, count)."""
        slope = np.zeros((3, self.layout.count))
        if name in self.layout.points:
            slope[:, self.layout.blocks[f"point:{name}"]] = np.eye(3)
        return np.tile(self.now.points[name], (rows, 1)), np.tile(slope, (rows, 1, 1))

    def chain(self) -> ChainParameters:
        """Return joint zeros and link deviations."""
        columns = [-1] * len(self.layout.joints)
        if self.layout.zeros:
            start = self.layout.blocks["joint_zeros"].start
            for offset, joint in enumerate(self.layout.zeros):
                columns[joint] = start + offset
        if not self.layout.links:
            return ChainParameters(self.layout.count, self.now.zeros, tuple(columns))
        place = self.layout.blocks["geometry"]
        return ChainParameters(
            self.layout.count,
            self.now.zeros,
            tuple(columns),
            self.layout.links,
            self.now.links,
            tuple(range(place.start, place.stop)),
        )
