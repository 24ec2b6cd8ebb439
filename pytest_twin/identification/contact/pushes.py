"""External wrenches on an object while its pose was measured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import RecordingError
from pytest_twin.formats.pose_track import WrenchTrack
from pytest_twin.realization.free_body import FreeBody

_WORLD = ("", "world")
_ACTS = 0.02
"""Fraction of the largest force of a recording above which a force counts as acting."""


@dataclass(frozen=True)
class Push:
    """A wrench on an object, in the axes of the world and about its centre of mass.

    Attributes:
        time: (k,) s from the first pose, ascending.
        values: (k, 6) force (N) and torque (N*m).
    """

    time: FloatArray
    values: FloatArray

    def after(self, seconds: float) -> Push:
        """Return the wrench with times counted from a later pose."""
        return Push(self.time - seconds, self.values)

    def acts(self, start: float, end: float) -> bool:
        """Whether the wrench acts within a time interval, s."""
        sizes = np.linalg.norm(self.values[:, :3], axis=1)
        inside = (self.time >= start) & (self.time <= end)
        return bool((sizes[inside] > _ACTS * sizes.max()).any())


def push_of(
    wrench: WrenchTrack,
    body: FreeBody,
    centre: FloatArray,
    time: FloatArray,
    poses: FloatArray,
    path: Path,
) -> Push:
    """Transform a measured wrench to the world's axes and the object's centre of mass.

    Args:
        wrench: about the object's origin, in the axes of the object (its frame is named like the
            body) or of the world.
        centre: (3,) its centre of mass in its own axes, m.
        time: (n,) stamps of its poses, s.
        poses: (n, 7) m, quaternion w x y z.

    Raises:
        RecordingError: the wrench is in another frame.
    """
    frame = wrench.frame.lstrip("/")
    if frame not in (*_WORLD, body.name):
        raise RecordingError(
            "a wrench in a frame that is neither the object nor the world",
            path=path, where="header.frame_id", value=wrench.frame,
            expected=f"'{body.name}' for the object's axes and origin, or 'world' for the world's "
            "axes about the object's origin",
        )  # fmt: skip
    at = np.clip(wrench.time, time[0], time[-1])
    turns = Slerp(time, Rotation.from_quat(poses[:, [4, 5, 6, 3]]))(at)
    force, torque = wrench.values[:, :3], wrench.values[:, 3:]
    if frame == body.name:
        force, torque = turns.apply(force), turns.apply(torque)
    torque = torque - np.cross(turns.apply(centre), force)
    return Push(wrench.time, np.hstack([force, torque]))
