"""Data classes for the measured motion of a free object: poses, and forces on it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pytest_twin.formats.ros_serialization import Floats


@dataclass(frozen=True)
class WrenchTrack:
    """Force and torque on an object over time.

    Attributes:
        frame: frame of the axes and of the torque's reference point, as named in the messages.
        time: (k,) time since the first pose, s.
        values: (k, 6) force [N] and torque [N*m].
    """

    frame: str
    time: Floats
    values: Floats


@dataclass(frozen=True)
class PoseTrack:
    """Poses of one object over time.

    Attributes:
        name: name of the toss in its file.
        time: (n,) time since the first sample, s; sample numbers if ``has_times`` is False.
        position: (n, 3) of the object's frame in the world, m, or the file's unit of length.
        quaternion: (n, 4) w x y z, object to world.
        velocity: (n, 3) velocity of the frame's origin in the world, m/s, or None if not recorded.
        angular: (n, 3) angular velocity in the object's axes, rad/s, or None.
        has_times: whether the file has the time of each pose.
        metadata: the trial's metadata, as pairs of key and value.
        wrench: measured external force and torque, without gravity and contact, or None.
    """

    name: str
    path: Path
    time: Floats
    position: Floats
    quaternion: Floats
    velocity: Floats | None = None
    angular: Floats | None = None
    has_times: bool = True
    metadata: tuple[tuple[str, str], ...] = ()
    wrench: WrenchTrack | None = None
