"""Displacement of the tool centre point between two versions of a twin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.open_loop import frame_poses
from pytest_twin.provenance.poses import Poses
from pytest_twin.realization import Realization
from pytest_twin.realization.encoders import Encoders
from pytest_twin.twin import JointCalibration


@dataclass(frozen=True, slots=True)
class Displacement:
    """Displacement of a frame between two versions of a twin at the same encoder readings.

    Attributes:
        translation: largest distance over the poses, m.
        rotation: largest angle, rad.
        translation_rms: root mean square, m.
    """

    translation: float
    rotation: float
    translation_rms: float

    def to_json(self) -> dict[str, float]:
        """Return the fields as JSON-able values, m and rad."""
        return {
            "translation": self.translation,
            "rotation": self.rotation,
            "translation_rms": self.translation_rms,
        }


def displacement_between(before: FloatArray, after: FloatArray) -> Displacement:
    """Displacement between two (n, 7) series of poses: position (m) and quaternion (w x y z)."""
    distance = np.linalg.norm(after[:, :3] - before[:, :3], axis=1)
    # The chord between unit quaternions is precise for small angles, unlike the arc cosine.
    sign = np.sign(np.sum(before[:, 3:] * after[:, 3:], axis=1))
    sign[sign == 0.0] = 1.0
    chord = np.linalg.norm(after[:, 3:] - sign[:, None] * before[:, 3:], axis=1)
    angle = 4.0 * np.arcsin(np.clip(chord / 2.0, 0.0, 1.0))
    return Displacement(
        float(distance.max()), float(angle.max()), float(np.sqrt(np.mean(np.square(distance))))
    )


def tool_poses(
    realization: Realization,
    frame: str,
    calibration: Mapping[str, JointCalibration],
    poses: Poses,
) -> FloatArray:
    """(n, 7) poses of a frame in the world at given encoder readings.

    Joints that ``poses`` does not contain are at the model's reference.
    """
    encoders = Encoders.of(calibration, poses.joints)
    qpos = np.tile(realization.model.qpos0, (len(poses.positions), 1))
    columns = [realization.joint_qpos_index(joint) for joint in poses.joints]
    qpos[:, columns] = encoders.model_position(poses.positions)
    return frame_poses(realization, qpos, frame)
