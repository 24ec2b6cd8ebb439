"""Pose streams: read files of stamped poses, and interpolate between the stamps."""

from __future__ import annotations

import gzip
import io
import zlib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats import limits
from pytest_twin.formats.paths import decode_text, read_bytes
from pytest_twin.metrics.pose import inverse, rigid

_COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_FEWEST = 20
"""Smallest number of poses of a stream."""
_QUATERNION_TOLERANCE = 0.02
"""Largest deviation of a quaternion's length from 1."""
_MOST_BACK_S = 1.0
"""Largest step back of a stamp. Messages from several threads or over a network arrive out of order
by less; a clock that was adjusted jumps by more."""

_LONGEST_PERIOD_S = 2.0
"""Motion between poses that are further apart cannot be interpolated. A camera at 0.5 Hz or more is
read; one at 500 Hz whose stamps are in ms is not."""


@dataclass(frozen=True)
class PoseStream:
    """Poses with stamps of one clock.

    Attributes:
        time: (n,) stamps, s, ascending.
        poses: (n, 4, 4) poses as in the file, m.
        is_inverted: whether ``at`` returns the inverse of the interpolated poses.
    """

    time: FloatArray
    poses: FloatArray
    is_inverted: bool = False

    @cached_property
    def _turning(self) -> Slerp:
        return Slerp(self.time, Rotation.from_matrix(self.poses[:, :3, :3]))

    def at(self, time: FloatArray) -> FloatArray:
        """(m, 4, 4) poses at times within the stream, by linear and spherical interpolation."""
        found = np.tile(np.eye(4), (len(time), 1, 1))
        inside = np.clip(time, self.time[0], self.time[-1])
        found[:, :3, :3] = self._turning(inside).as_matrix()
        for axis in range(3):
            found[:, axis, 3] = np.interp(inside, self.time, self.poses[:, axis, 3])
        return inverse(found) if self.is_inverted else found

    def rows(self, chosen: np.ndarray) -> PoseStream:
        """Return the stream with the chosen poses only."""
        return replace(self, time=self.time[chosen], poses=self.poses[chosen])


def read_stream(path: Path) -> PoseStream:
    """Read poses from a CSV file (plain or gzip): t x y z qx qy qz qw, header optional.

    Poses are sorted by their stamps, since messages may arrive out of order. Poses that repeat a
    stamp are left out, since some loggers write a sample twice.

    Raises:
        PathError, LimitError: as every reader.
        FormatError: a cell is no number, columns are missing, a stamp goes back by more than 1 s, a
            quaternion has no unit length, or there are fewer than 20 poses. The error names the
            line.
    """
    data = read_bytes(path, limits.OBSERVATIONS.file_bytes)
    if data[:2] == b"\x1f\x8b":
        data = _decompress(data, path)
    lines = decode_text(data.removeprefix(b"\xef\xbb\xbf"), path).splitlines()
    rows: list[list[float]] = []
    numbers: list[int] = []
    for number, line in enumerate(lines, 1):
        cells = line.replace(",", " ").replace(";", " ").split()
        if not cells or cells[0].startswith("#"):
            continue
        if not rows and [cell.strip('"').lower() for cell in cells] == list(_COLUMNS):
            continue
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError:
            rows.append([])
        if len(rows[-1]) != len(_COLUMNS) or not np.isfinite(rows[-1]).all():
            raise FormatError(
                "not a stamped pose",
                path=path,
                line=number,
                value=line[:80],
                expected=f"eight numbers: {' '.join(_COLUMNS)} (s, m)",
            )
        numbers.append(number)
    return _stream(np.array(rows).reshape(-1, len(_COLUMNS)), numbers, path)


def _stream(values: FloatArray, lines: list[int], path: Path) -> PoseStream:
    if len(values) < _FEWEST:
        raise FormatError(
            "too few poses", path=path, value=len(values), expected=f"at least {_FEWEST}"
        )
    step = np.diff(values[:, 0])
    if (step < -_MOST_BACK_S).any():
        at = int(np.flatnonzero(step < -_MOST_BACK_S)[0]) + 1
        raise FormatError(
            "the stamps go back", path=path, line=lines[at], value=values[at, 0], unit="s",
            expected=f"at least {values[at - 1, 0]}",
        )  # fmt: skip
    lengths = np.linalg.norm(values[:, 4:], axis=1)
    wrong = np.flatnonzero(np.abs(lengths - 1.0) > _QUATERNION_TOLERANCE)
    if len(wrong):
        raise FormatError(
            "a quaternion that is not of unit length",
            path=path,
            line=lines[int(wrong[0])],
            value=f"length {lengths[wrong[0]]:.4g}",
            expected="qx qy qz qw of length 1",
        )
    values = values[np.argsort(values[:, 0], kind="stable")]
    values = values[np.concatenate([[True], np.diff(values[:, 0]) > 0.0])]
    if len(values) < _FEWEST:
        raise FormatError(
            "too few poses with different stamps",
            path=path,
            value=len(values),
            expected=f"at least {_FEWEST}",
        )
    period = float(np.median(np.diff(values[:, 0])))
    if period > _LONGEST_PERIOD_S:
        raise FormatError(
            f"most rows are {period:.4g} s apart: t seems to be in ms, us or ns", path=path,
            line=lines[0], value=values[0, 0], expected="t in s, several rows a second",
        )  # fmt: skip
    poses = rigid(Rotation.from_quat(values[:, 4:]).as_matrix(), values[:, 1:4])
    return PoseStream(values[:, 0], poses)


def _decompress(data: bytes, path: Path) -> bytes:
    most = limits.OBSERVATIONS.file_bytes
    try:
        with gzip.open(io.BytesIO(data)) as stream:
            found = stream.read(most + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise FormatError(f"not readable as gzip: {error}", path=path) from None
    if len(found) > most:
        raise LimitError("file is too large", path=path, expected=f"at most {most} bytes unpacked")
    return found
