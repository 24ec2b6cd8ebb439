"""Predict observations with the estimates of a calibration record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.parameters import State
from pytest_twin.calibration.plan import Plan
from pytest_twin.calibration.problem import (
    INVERTED_RECORDS,
    TIP,
    CalibrationProblem,
    describe_pose,
    marker_of,
    records_of,
)
from pytest_twin.calibration.records import NOT_ASKED
from pytest_twin.errors import SpecError
from pytest_twin.formats.calibration_record import CalibrationRecord, Transform
from pytest_twin.metrics.pose import inverse, rigid, rotation_of


def recorded_state(problem: CalibrationProblem, record: CalibrationRecord) -> State:
    """Return the state of a problem with the transforms and points of a record.

    Joint zeros and geometry stay those of the chain, because they belong to the robot.

    Raises:
        SpecError: the record lacks a transform or a point that the observations need.
    """
    poses = dict(problem.fixed.poses)
    for name in problem.layout.poses:
        poses[name] = recorded_pose(problem.plan, name, record)
    points = dict(problem.fixed.points)
    for name in problem.layout.points:
        points[name] = _point(name, record)
    return replace(problem.fixed, poses=poses, points=points, scale=record.target_scale)


def held_out_observations(observations: Observations, record: CalibrationRecord) -> Observations:
    """Return the held-out rows of a record, with the target poses that it found in their images.

    Raises:
        SpecError: the record names no held-out observation, or one that does not exist.
    """
    if not record.held_out_ids:
        raise SpecError(
            "the calibration has no held-out observations",
            path=record.path,
            where="held_out.ids",
            expected="hold_out: in its plan, with a fraction above 0 or ids",
        )
    place = {name: row for row, name in enumerate(observations.ids)}
    for name in record.held_out_ids:
        if name not in place:
            raise SpecError(
                "a held-out observation is missing in the file",
                path=record.path,
                where="held_out.ids",
                value=name,
                expected="ids of the observations that the record was made from",
            )
    held = observations.rows([place[name] for name in record.held_out_ids])
    if not record.seen:
        return held
    poses = np.full((len(held), 4, 4), np.nan)
    if held.camera_from_target is not None:
        poses = held.camera_from_target.copy()
    for row, name in enumerate(held.ids):
        if name in record.seen:
            numbers = record.seen[name]
            poses[row] = rigid(rotation_of(numbers[3:]), np.array(numbers[:3]))
    return replace(held, camera_from_target=poses)


def recorded_pose(plan: Plan, name: str, record: CalibrationRecord) -> FloatArray:
    """(4, 4) pose of the transform chain, such as ``camera.mounted``, from a record, m.

    Raises:
        SpecError: the record lacks the pose.
    """
    family, _, role = name.partition(".")
    mount = plan.mount if family == "camera" else "hand"
    names = (*records_of(role, family, mount), NOT_ASKED[family, mount, role])
    for one in names:
        pose = _full(record.transforms, one)
        if pose is not None:
            return inverse(pose) if one in INVERTED_RECORDS else pose
    raise _missing(record, f"no transform of {describe_pose(name, plan.mount)}", names)


def _full(transforms: Mapping[str, Transform], name: str) -> FloatArray | None:
    xyz, quaternion = transforms.get(name, (None, None))
    if xyz is None or quaternion is None:
        return None
    return rigid(rotation_of(quaternion), np.array(xyz))


def _point(name: str, record: CalibrationRecord) -> FloatArray:
    tip, quaternion = record.transforms.get("tcp", (None, None))
    if name != TIP and marker_of(name) in record.points:
        return np.array(record.points[marker_of(name)])
    if tip is not None and quaternion is None:
        return np.array(tip)
    raise _missing(record, f"no place of {marker_of(name)}", ("tcp", "points"))


def _missing(record: CalibrationRecord, problem: str, names: tuple[str, ...]) -> SpecError:
    return SpecError(
        problem,
        path=record.path,
        where="records",
        value=", ".join(record.transforms) or None,
        expected=" or ".join(dict.fromkeys(names)),
    )
