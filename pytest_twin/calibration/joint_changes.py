"""Changes of a calibration in the frame of each joint."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.metrics.pose import rigid


def joint_changes(
    records: Mapping[str, Any], axes: Mapping[str, tuple[FloatArray, bool]]
) -> Iterator[tuple[str, FloatArray]]:
    """Yield joint and (4, 4) deviation in its frame: offsets, tilts, then the zero about its axis.

    Args:
        records: ``records`` of ``calibration.json``.
        axes: joint -> its axis in its own frame, and whether it is prismatic.
    """
    geometry = records.get("geometry", {"values": {}})["values"].values()
    for joint in dict.fromkeys(one["joint"] for one in geometry):
        mine = [one for one in geometry if one["joint"] == joint]
        offset, tilt = (
            np.sum(
                [np.array(one["direction"]) * one["value"] for one in mine if one["kind"] == kind]
                or [np.zeros(3)],
                axis=0,
            )
            for kind in ("translation", "rotation")
        )
        yield joint, rigid(Rotation.from_rotvec(tilt).as_matrix(), offset)
    for joint, one in records.get("joint_zeros", {"values": {}})["values"].items():
        if joint not in axes:
            continue
        axis, slides = axes[joint]
        moved = axis / np.linalg.norm(axis) * one["value"]
        if slides:
            yield joint, rigid(np.eye(3), moved)
        else:
            yield joint, rigid(Rotation.from_rotvec(moved).as_matrix(), np.zeros(3))
