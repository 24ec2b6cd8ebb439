"""The measured motion of one free object: its poses, one track for each toss or recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pytest_twin.formats.serialized import Floats


@dataclass(frozen=True)
class WrenchTrack:
    """Force and torque on an object over time.

    Attributes:
        frame: in whose axes and about whose origin, as the messages name it.
        time: (k,) s from the first pose on.
        values: (k, 6) N and N*m.
    """

    frame: str
    time: Floats
    values: Floats


@dataclass(frozen=True)
class PoseTrack:
    """Poses of one object over time.

    Attributes:
        name: of the toss in its file.
        path: the file.
        time: (n,) from the first sample, s; in samples where ``timed`` is False.
        position: (n, 3) of the object's frame in the world, m, or the file's unit of length.
        quaternion: (n, 4) w x y z, object to world.
        velocity: (n, 3) of the frame's origin in the world, or None where none was recorded.
        angular: (n, 3) in the object's own axes, rad/s, or None.
        has_times: whether the file says when each pose was measured.
        metadata: what the recording says of itself.
        wrench: what was measured to push the object, beside gravity and contact.
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
