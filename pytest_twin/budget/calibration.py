"""Propagate the uncertainty of a calibration to the pose of the task's frame.

All unknowns of one record are one cause, because they were estimated together and have a joint
covariance. Unknowns that the twin does not use are left out; the others keep their marginal
distribution.

Joint zeros and link deviations move the frame through the kinematic chain. The pose of a tool or
camera on the flange moves it about its mount; for a camera, the moved pose is the measured pose of
an object at the frame. The frame's pose is measured in a frame that is fixed to the base: the
world, a fixture or a fixed camera. Errors that move both frames equally cancel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.budget.task import Task
from pytest_twin.calibration.chain import ChainParameters, LinkParameter, forward
from pytest_twin.calibration.transform_derivatives import TransformWithJacobian, left_jacobian
from pytest_twin.metrics.pose import inverse
from pytest_twin.twin import CalibrationEntry

Estimate = tuple[float | None, str]
"""A value and its unit; the value is None for deviations from the estimate."""


@dataclass(frozen=True)
class UncertainPose:
    """A pose among the unknowns.

    Attributes:
        record: name of the record in the calibration.
        pose: (4, 4) estimated pose, m.
        mount: (4, 4) pose of its parent frame in the last link of the chain, m; None for a pose in
            the base.
        columns: columns of x y z and, for a full pose, of rx ry rz.
    """

    record: str
    pose: FloatArray
    mount: FloatArray | None
    columns: tuple[int, ...]


@dataclass(frozen=True)
class Part:
    """Unknowns of one kind in a cause.

    Attributes:
        columns: columns of its unknowns.
        estimate: unknown -> value and unit.
    """

    name: str
    category: str
    columns: tuple[int, ...]
    estimate: Mapping[str, Estimate]


@dataclass(frozen=True)
class CalibrationUnknowns:
    """Unknowns of one calibration that move a task's frame.

    Attributes:
        entry: the record in the twin.
        names: (p,) names of the unknowns.
        covariance: (p, p) covariance, m, rad and s.
        parts: unknowns by kind.
        zeros: joint of the chain -> column of its zero.
        links: link deviations, each with its column.
        delay: column of the time offset, or None.
        left_out: unknowns that do not move the frame, with the reason.
    """

    entry: CalibrationEntry
    names: tuple[str, ...]
    covariance: FloatArray
    parts: tuple[Part, ...]
    placed: tuple[UncertainPose, ...] = ()
    zeros: Mapping[int, int] = field(default_factory=dict)
    links: tuple[tuple[LinkParameter, int], ...] = ()
    delay: int | None = None
    left_out: tuple[str, ...] = ()

    def frame(self, task: Task, step: FloatArray) -> TransformWithJacobian:
        """Return the task's frame after a step of the unknowns, with derivatives at step 0.

        Only displacements matter, so the base's pose in the world, which moves everything equally,
        is left out.
        """
        chain, width = task.chain, len(self.names)
        columns = tuple(self.zeros.get(at, -1) for at in range(len(chain.joints)))
        zeros = np.array([0.0 if at < 0 else step[at] for at in columns])
        links = tuple(link for link, _ in self.links)
        at = tuple(column for _, column in self.links)
        parameters = ChainParameters(
            width, zeros, columns, links, step[list(at)] if at else None, at
        )
        readings, drift = task.readings, np.zeros((0, 0))
        if self.delay is not None:
            assert task.velocity is not None
            readings = readings + step[self.delay] * task.velocity
            drift = task.velocity * chain.signs
        moving = forward(replace(chain, end=np.eye(4)), readings, parameters)
        if self.delay is not None:
            moving = self._late(task, readings, moving, drift)
        rows = len(readings)
        for one in self.placed:
            if one.mount is not None:
                own = _pose_after_step(one, step, width, rows)
                back = _fixed_pose(inverse(one.pose) @ inverse(one.mount), width, rows)
                moving = moving @ _fixed_pose(one.mount, width, rows) @ own @ back
        moving = moving @ _fixed_pose(chain.end, width, rows)
        for one in self.placed:
            if one.mount is None:
                own = _pose_after_step(one, step, width, rows) @ _fixed_pose(
                    inverse(one.pose), width, rows
                )
                moving = own.inverse() @ moving
        return moving

    def _late(
        self, task: Task, readings: FloatArray, moving: TransformWithJacobian, drift: FloatArray
    ) -> TransformWithJacobian:
        """Add the derivative by the time offset, the sum of joint derivatives times velocities."""
        count = len(task.chain.joints)
        every = ChainParameters(count, np.zeros(count), tuple(range(count)))
        by_joint = forward(replace(task.chain, end=np.eye(4)), readings, every)
        turn, shift = moving.turn.copy(), moving.shift.copy()
        turn[:, :, self.delay] = np.einsum("nij,nj->ni", by_joint.turn, drift)
        shift[:, :, self.delay] = np.einsum("nij,nj->ni", by_joint.shift, drift)
        return TransformWithJacobian(moving.rotation, moving.position, turn, shift)


def _pose_after_step(
    one: UncertainPose, step: FloatArray, width: int, rows: int
) -> TransformWithJacobian:
    """Return a pose after a step, ``t + d`` and ``R exp(r)``, with derivatives."""
    own = step[list(one.columns)]
    shift, turn = np.zeros((3, width)), np.zeros((3, width))
    shift[:, list(one.columns[:3])] = np.eye(3)
    rotation = one.pose[:3, :3]
    if len(own) > 3:
        turn[:, list(one.columns[3:])] = rotation @ left_jacobian(own[3:])
        rotation = rotation @ Rotation.from_rotvec(own[3:]).as_matrix()
    return TransformWithJacobian(
        np.tile(rotation, (rows, 1, 1)),
        np.tile(one.pose[:3, 3] + own[:3], (rows, 1)),
        np.tile(turn, (rows, 1, 1)),
        np.tile(shift, (rows, 1, 1)),
    )


def _fixed_pose(pose: FloatArray, width: int, rows: int) -> TransformWithJacobian:
    """Return a fixed pose with zero derivatives."""
    nothing = np.zeros((rows, 3, width))
    return TransformWithJacobian(
        np.tile(pose[:3, :3], (rows, 1, 1)), np.tile(pose[:3, 3], (rows, 1)), nothing, nothing
    )
