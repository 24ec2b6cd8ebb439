"""Tosses in SI units, with the initial state of each prediction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import RecordingError
from pytest_twin.formats.pose_track import PoseTrack
from pytest_twin.identification.contact.pushes import Push

_LEADING = 10
"""Number of samples at the start of a toss for measuring its free-fall acceleration."""
_SAME_UNIT = 0.05
"""Largest relative difference of the free-fall acceleration from the model's gravity if both use
the same unit of length."""
_AGREE = 0.1
"""Largest relative difference of a toss's free-fall acceleration from the median."""


@dataclass(frozen=True)
class Toss:
    """One toss, in the model's units.

    Attributes:
        name: name, including the file's.
        time: (n,) s, from 0.
        poses: (n, 7) x y z (m) and quaternion w x y z.
        twist: (n, 6) linear velocity in the world's axes (m/s) and angular velocity in the object's
            axes (rad/s).
        role: ``fit`` or ``held_out`` if the recording states it.
        push: external wrench on the object, without gravity and contact.
    """

    name: str
    path: Path
    time: FloatArray
    poses: FloatArray
    twist: FloatArray
    role: str | None = None
    push: Push | None = None

    def state(self, row: int) -> FloatArray:
        """(13,) pose and velocity at sample ``row``."""
        return np.concatenate([self.poses[row], self.twist[row]])


@dataclass(frozen=True)
class Units:
    """Stated or detected units of a file that has none.

    Attributes:
        length: unit of length, m.
        period: time between two samples, s; None if the file has stamps.
        lag: delay of recorded velocities against the poses of the same sample, s.
    """

    length: float
    period: float | None
    lag: float
    notes: tuple[str, ...]


def in_model_units(
    tracks: Sequence[PoseTrack],
    gravity: FloatArray,
    length: float | None = None,
    rate: float | None = None,
    lag: float | None = None,
) -> tuple[list[Toss], Units]:
    """Convert tosses to m and s.

    For a file without stamps, displacement over velocity gives the time between two samples. The
    unit of length follows from the free fall at the start of the tosses. Recorded velocities may be
    means over the last interval, which delays them by half a sample. The comparison with the
    derivative of the poses in free fall detects this.

    Args:
        tracks: tracks of one file, or of files with the same units.
        gravity: (3,) gravity of the model, m/s^2.
        length: unit of length, m, if known.
        rate: sampling rate, Hz, if known.
        lag: delay of recorded velocities, s, if known.

    Raises:
        RecordingError: the unit is not given and cannot be detected.
    """
    notes: list[str] = []
    period: float | None = None
    # Poses from ROS have stamps and are in m.
    unitless = length is None and not all(track.has_times for track in tracks)
    if not all(track.has_times for track in tracks):
        period = 1.0 / rate if rate is not None else _period(tracks)
        if rate is None:
            notes.append(
                f"sample rate {1.0 / period:.4g} Hz, found from displacements and velocities; "
                "--rate states another"
            )
        tracks = [track if track.has_times else _with_times(track, period) for track in tracks]
    down = float(np.linalg.norm(gravity))
    unit = 1.0 if length is None else length
    fall = _fall(tracks, gravity) if unitless and down > 0.0 else down
    if abs(fall - down) > _SAME_UNIT * down:
        unit = down / fall
        notes.append(
            f"unit of length {unit:.4g} m: the tosses begin with a fall of {fall:.4g} units/s^2, "
            f"gravity is {down:.4g} m/s^2; --length-unit states another"
        )
    known = lag is not None
    lag = _lag(tracks, gravity, unit) if lag is None else lag
    if lag and not known:
        notes.append(
            f"recorded velocities are {1e3 * lag:.2g} ms older than the poses beside them, found "
            "from the fall at the start of the tosses, and are brought forward by gravity"
        )
    tosses = [_toss(track, unit, lag * gravity) for track in tracks]
    return tosses, Units(unit, period, lag, tuple(notes))


def _with_times(track: PoseTrack, period: float) -> PoseTrack:
    return replace(track, time=track.time * period, has_times=True)


def _period(tracks: Sequence[PoseTrack]) -> float:
    """Median of displacement over velocity between samples, s."""
    found = []
    for track in tracks:
        if track.velocity is None:
            continue
        move = np.diff(track.position, axis=0)
        speed = np.sum(track.velocity[1:] ** 2, axis=1)
        fast = speed > 0.1 * speed.max(initial=0.0)
        found.append(np.sum(move * track.velocity[1:], axis=1)[fast] / speed[fast])
    values = np.concatenate(found) if found else np.zeros(0)
    period = float(np.median(values)) if len(values) else 0.0
    if not period > 0.0:
        raise RecordingError(
            "the file has neither times nor velocities, so its sampling rate is unknown",
            path=tracks[0].path, expected="--rate with the sample rate in Hz",
        )  # fmt: skip
    return period


def _falls(tracks: Sequence[PoseTrack], gravity: FloatArray) -> FloatArray:
    """Acceleration along gravity at the start of each toss, in units of length per s^2."""
    down = gravity / np.linalg.norm(gravity)
    found = []
    for track in tracks:
        rows = slice(0, min(_LEADING, len(track.time)))
        if track.velocity is not None:
            slope = np.polyfit(track.time[rows], track.velocity[rows] @ down, 1)[0]
        else:
            slope = 2.0 * np.polyfit(track.time[rows], track.position[rows] @ down, 2)[0]
        found.append(slope)
    return np.array(found)


def _fall(tracks: Sequence[PoseTrack], gravity: FloatArray) -> float:
    falls = _falls(tracks, gravity)
    middle = float(np.median(falls))
    agreeing = np.abs(falls - middle) < _AGREE * abs(middle)
    if middle <= 0.0 or np.mean(agreeing) < 0.5:
        raise RecordingError(
            "the tosses do not begin in free fall, so their unit of length cannot be detected",
            path=tracks[0].path,
            value=f"median acceleration {middle:.3g} units/s^2 along gravity",
            expected="--length-unit with m for one unit of length (1 for m)",
        )
    return float(np.mean(falls[agreeing]))


def _lag(tracks: Sequence[PoseTrack], gravity: FloatArray, unit: float) -> float:
    """Return the delay of recorded velocities, s; 0 if it is below 0.1 samples."""
    if not np.linalg.norm(gravity) > 0.0:
        return 0.0
    down = gravity / np.linalg.norm(gravity)
    ages, periods = [], []
    for track in tracks:
        if track.velocity is None:
            continue
        rows = slice(0, min(_LEADING, len(track.time)))
        position, time = track.position[rows] @ down, track.time[rows]
        slope = (position[2:] - position[:-2]) / (time[2:] - time[:-2])
        late = slope - (track.velocity[rows] @ down)[1:-1]
        ages.append(float(np.mean(late)) * unit / float(np.linalg.norm(gravity)))
        periods.append(float(np.mean(np.diff(time))))
    if not ages:
        return 0.0
    age, period = float(np.median(ages)), float(np.median(periods))
    return age if 0.1 * period < abs(age) < 2.0 * period else 0.0


def _toss(track: PoseTrack, unit: float, forward: FloatArray) -> Toss:
    position = track.position * unit
    time = track.time - track.time[0]
    if track.velocity is None or track.angular is None:
        twist = _velocities(time, position, track.quaternion)
    else:
        twist = np.hstack([track.velocity * unit + forward, track.angular])
    return Toss(
        f"{track.path.name}:{track.name}",
        track.path,
        time,
        np.hstack([position, track.quaternion]),
        twist,
        dict(track.metadata).get("role"),
    )


def _velocities(time: FloatArray, position: FloatArray, quaternion: FloatArray) -> FloatArray:
    """(n, 6) velocities from poses, by parabolas through neighbours and mean rotations."""
    width, count = 5, len(time)
    found = np.empty((count, 6))
    turn = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]])
    for row in range(count):
        first = min(row, max(0, count - width))
        rows = slice(first, min(first + width, count))
        fit = np.polyfit(time[rows] - time[row], position[rows], 2)
        found[row, :3] = fit[1]
        steps = (turn[rows][:-1].inv() * turn[rows][1:]).as_rotvec()
        found[row, 3:] = np.mean(steps / np.diff(time[rows])[:, None], axis=0)
    return found
