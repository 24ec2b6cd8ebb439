"""Resolve the orientation of boards whose print is unchanged by a half turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.detection import Detection
from pytest_twin.calibration.boards.target import Target
from pytest_twin.calibration.cameras.images import Images


def has_half_turn_symmetry(target: Target) -> bool:
    """Whether a half turn leaves the print of a board unchanged."""
    columns, rows = target.squares
    return target.kind == "chessboard" and (columns + rows) % 2 == 0


def with_consistent_orientation(
    images: Images, ids: tuple[str, ...], flange: FloatArray
) -> tuple[Images, str]:
    """Return the images with the same board orientation in all, and a note ("" if none changed).

    Between two poses, the flange and a body on it turn by the same angle, independent of the
    hand-eye transform (screw congruence; Chen: A screw motion approach to uniqueness analysis of
    head-eye geometry, 1991). A half turn of the board changes this angle. The orientation in the
    first image is taken as the right one.

    Args:
        flange: (rows, 4, 4) as the robot reports it.
    """
    if not has_half_turn_symmetry(images.target):
        return images, ""
    rows = [
        row
        for row, one in enumerate(ids)
        if one in images.detections and np.isfinite(flange[row]).all()
    ]
    camera = images.camera([ids[row] for row in rows])
    poses = {row: images.pose(ids[row], camera) for row in rows}
    half = Rotation.from_rotvec([0.0, 0.0, np.pi])
    known: list[tuple[Rotation, Rotation]] = []
    turned = []
    for row in rows:
        pose = poses[row]
        if pose is None:
            continue
        robot = Rotation.from_matrix(flange[row, :3, :3])
        seen = Rotation.from_matrix(pose.camera_from_target[:3, :3])
        if known and _misfit(known, robot, seen * half) < _misfit(known, robot, seen):
            seen = seen * half
            turned.append(ids[row])
        known.append((robot, seen))
    if not turned:
        return images, ""
    detections = {
        name: _half_turned(images, name) if name in turned else one
        for name, one in images.detections.items()
    }
    note = (
        f"the board looks the same after a half turn; in the images of {', '.join(turned)} it is "
        "taken the other way round, as the robot's rotation says"
    )
    return replace(images, detections=detections), note


def _misfit(known: list[tuple[Rotation, Rotation]], robot: Rotation, seen: Rotation) -> float:
    """Sum of squared differences between robot and board angles to known poses, rad^2."""
    return sum(
        float((before.inv() * robot).magnitude() - (view.inv() * seen).magnitude()) ** 2
        for before, view in known
    )


def _half_turned(images: Images, name: str) -> Detection:
    """Return the detection with corner ids counted from the opposite end of the board."""
    detection = images.detections[name]
    ids = images.target.corners - 1 - detection.corner_ids
    order = np.argsort(ids)
    return replace(
        detection,
        corner_ids=ids[order],
        pixels=detection.pixels[order],
        board_points=images.target.board_points()[ids[order]],
    )
