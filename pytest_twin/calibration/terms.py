"""Residual terms: each predicts one kind of measurement and returns its residuals.

Each term names the poses and points that it needs. A new kind of measurement, such as corner pixels
of a board, is a further class with the same four members.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.parameters import Poses, Variables
from pytest_twin.calibration.plan import Mount
from pytest_twin.calibration.transform_derivatives import (
    TransformWithJacobian,
    inverse_left_jacobian,
)
from pytest_twin.metrics.pose import rigid


class Term(Protocol):
    """Measurements of one kind."""

    @property
    def name(self) -> str:
        """Name in reports."""

    @property
    def rows(self) -> np.ndarray:
        """(m,) row of the observations that each measurement belongs to."""

    @property
    def noise(self) -> tuple[str, ...]:
        """Kind of noise of each residual column."""

    def residuals(
        self, flange: TransformWithJacobian, variables: Poses
    ) -> tuple[FloatArray, FloatArray]:
        """Predicted minus measured, (m, columns), and its derivatives, (m, columns, count).

        Args:
            flange: ``transform_base_to_flange`` of all rows of the observations.
        """
        ...


def by_flange(term: Term, flange: TransformWithJacobian, variables: Variables) -> FloatArray:
    """(m, columns, 6) derivatives of a term's residuals by position and rotation of the flange.

    Both are in the flange's own axes, m and rad.
    """
    turned = flange.rotation
    nothing = np.zeros_like(turned)
    own = TransformWithJacobian(
        turned,
        flange.position,
        np.concatenate([nothing, turned], axis=2),
        np.concatenate([turned, nothing], axis=2),
    )
    return term.residuals(own, variables.held(6))[1]


def at_rows(moving: TransformWithJacobian, rows: np.ndarray) -> TransformWithJacobian:
    """Return the transforms of the given rows."""
    return TransformWithJacobian(
        moving.rotation[rows], moving.position[rows], moving.turn[rows], moving.shift[rows]
    )


@dataclass(frozen=True)
class PoseTerm:
    """Poses of a target in a camera, or of a body in a tracker.

    For a camera on the flange, ``camera_from_target = inv(flange @ mounted) @ world``. For a fixed
    camera, ``camera_from_target = inv(world) @ flange @ mounted``. Positions are multiplied by the
    camera's scale, which is 1 unless it is unknown.

    Attributes:
        rows: (m,).
        measured: (m, 4, 4) ``camera_from_target``.
        mount: where the camera is mounted.
        mounted: name of the carried body's pose in the flange.
        world: name of the fixed body's pose in the base.
    """

    rows: np.ndarray
    measured: FloatArray
    mount: Mount
    mounted: str = "camera.mounted"
    world: str = "camera.world"
    name: str = "camera_from_target"
    noise: tuple[str, ...] = ("translation",) * 3 + ("rotation",) * 3

    def residuals(
        self, flange: TransformWithJacobian, variables: Poses
    ) -> tuple[FloatArray, FloatArray]:
        """Return position errors in the camera's axes (m) and rotation vectors (rad)."""
        predicted = self._moving(flange, variables)
        back = np.swapaxes(self.measured[:, :3, :3], 1, 2)
        rotation = Rotation.from_matrix(back @ predicted.rotation).as_rotvec()
        translation = predicted.position - self.measured[:, :3, 3]
        slope = inverse_left_jacobian(rotation) @ back @ predicted.turn
        return (
            np.concatenate([translation, rotation], axis=1),
            np.concatenate([predicted.shift, slope], axis=1),
        )

    def predicted(self, flange: TransformWithJacobian, variables: Poses) -> FloatArray:
        """(m, 4, 4) ``camera_from_target``, m."""
        moving = self._moving(flange, variables)
        return rigid(moving.rotation, moving.position)

    def _moving(self, flange: TransformWithJacobian, variables: Poses) -> TransformWithJacobian:
        count = len(self.rows)
        carried = at_rows(flange, self.rows) @ variables.pose(self.mounted, count)
        world = variables.pose(self.world, count)
        seen = carried.inverse() @ world if self.mount == "hand" else world.inverse() @ carried
        scale, slope = variables.scale
        shift = scale * seen.shift + seen.position[:, :, None] * slope
        return TransformWithJacobian(seen.rotation, scale * seen.position, seen.turn, shift)


@dataclass(frozen=True)
class PointTerm:
    """Positions of a marker on the flange, or of the tool's tip, in the measuring frame.

    Attributes:
        rows: (m,).
        measured: (m, 3) m.
        point: name of the marker's position in the frame ``mounted``.
        mounted: name of the tool's pose in the flange; None if markers are given in the flange.
        world: name of the measuring frame's pose in the base.
    """

    rows: np.ndarray
    measured: FloatArray
    point: str
    mounted: str | None = None
    world: str = "tracker.world"
    noise: tuple[str, ...] = ("point",) * 3

    @property
    def name(self) -> str:
        """``point.NAME``, the name of the column."""
        return f"point.{self.point.removeprefix('marker.')}"

    def residuals(
        self, flange: TransformWithJacobian, variables: Poses
    ) -> tuple[FloatArray, FloatArray]:
        """Return position errors in the axes of the measuring frame, m."""
        predicted, slope = self._moving(flange, variables)
        return predicted - self.measured, slope

    def predicted(self, flange: TransformWithJacobian, variables: Poses) -> FloatArray:
        """(m, 3) predicted positions in the measuring frame, m."""
        return self._moving(flange, variables)[0]

    def _moving(
        self, flange: TransformWithJacobian, variables: Poses
    ) -> tuple[FloatArray, FloatArray]:
        count = len(self.rows)
        carried = at_rows(flange, self.rows)
        if self.mounted is not None:
            carried = carried @ variables.pose(self.mounted, count)
        seen = variables.pose(self.world, count).inverse() @ carried
        return seen.act(*variables.point(self.point, count))


@dataclass(frozen=True)
class PivotTerm:
    """Positions of a tool's tip that stays at a fixed point while the flange rotates about it.

    Attributes:
        rows: (m,).
        tip: name of the tip, in the flange.
        pivot: name of the fixed point, in the base.
    """

    rows: np.ndarray
    pivot: str
    tip: str = "tip"
    noise: tuple[str, ...] = ("point",) * 3

    @property
    def name(self) -> str:
        """``pivot``."""
        return "pivot"

    def residuals(
        self, flange: TransformWithJacobian, variables: Poses
    ) -> tuple[FloatArray, FloatArray]:
        """Return the offset of the tip from the fixed point, in the base, m."""
        count = len(self.rows)
        tip, slope = at_rows(flange, self.rows).act(*variables.point(self.tip, count))
        fixed, fixed_slope = variables.point(self.pivot, count)
        return tip - fixed, slope - fixed_slope
