"""Read tosses of one object from a NumPy archive: an array for each toss, a row for each sample.

Columns: position x y z [m], quaternion w x y z, velocity of the origin in the world, angular
velocity in the object's axes, and further ones that are not read (layout of DAIRLab/contact-nets).
The reader unpickles nothing, and checks the size in an array's header before it allocates memory.
"""

from __future__ import annotations

import io
import math
import tokenize
import zipfile
import zlib
from pathlib import Path

import numpy as np

from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats.limits import TOSSES
from pytest_twin.formats.paths import read_bytes
from pytest_twin.formats.pose_track import PoseTrack
from pytest_twin.formats.ros_serialization import Floats

SUFFIX = ".npz"
_COLUMNS = 13
"""Columns of a row: position, quaternion, linear and angular velocity."""
_EXPECTED = (
    "an .npz file with one array for each toss: rows of x y z, qw qx qy qz, vx vy vz, wx wy wz"
)
_NO_HEADER = (
    ValueError, KeyError, TypeError, SyntaxError, RecursionError, MemoryError, tokenize.TokenError,
)  # fmt: skip
"""Exceptions of NumPy for an invalid header, which it parses as a Python literal."""
_UNIT_LENGTH = 0.02
"""Largest deviation of a quaternion's length from 1; rounding of 32-bit floats gives 1e-7."""


def read_tosses(path: Path) -> list[PoseTrack]:
    """Read all tosses of an archive, in the order of the file.

    Raises:
        PathError: missing, a link, or no regular file.
        LimitError: beyond ``limits.TOSSES``.
        FormatError: not an archive of tosses.
    """
    data = read_bytes(path, TOSSES.file_bytes)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if len(members) > TOSSES.tosses_count:
                raise _limit(path, len(members), "tosses", TOSSES.tosses_count)
            total = sum(one.file_size for one in members)
            if total > TOSSES.unpacked_bytes:
                raise _limit(path, total, "unpacked bytes", TOSSES.unpacked_bytes)
            found = [_track(archive.read(one), one.filename, path) for one in members]
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, zlib.error) as error:
        raise FormatError(f"not a NumPy archive: {error}", path=path, expected=_EXPECTED) from None
    if not found:
        raise FormatError("the archive contains no toss", path=path, expected=_EXPECTED)
    return found


def _track(data: bytes, member: str, path: Path) -> PoseTrack:
    name = member.removesuffix(".npy")
    table = _array(data, name, path)
    if table.ndim != 2 or table.shape[1] < _COLUMNS or len(table) < TOSSES.least_rows:
        raise FormatError(
            "not a toss", path=path, where=name, value=f"array of shape {table.shape}",
            expected=f"at least {TOSSES.least_rows} rows of at least {_COLUMNS} numbers",
        )  # fmt: skip
    table = table[:, :_COLUMNS].astype(np.float64)
    if not np.isfinite(table).all():
        row = int(np.flatnonzero(~np.isfinite(table).all(axis=1))[0])
        raise FormatError(
            "a number that is not finite", path=path, where=f"{name}, row {row}", expected=_EXPECTED
        )
    length = np.linalg.norm(table[:, 3:7], axis=1)
    off = np.flatnonzero(np.abs(length - 1.0) > _UNIT_LENGTH)
    if len(off):
        raise FormatError(
            "not a unit quaternion", path=path, where=f"{name}, row {off[0]}",
            value=float(length[off[0]]), expected="qw qx qy qz in columns 4 to 7, of length 1",
        )  # fmt: skip
    return PoseTrack(
        name,
        path,
        np.arange(len(table), dtype=np.float64),
        table[:, :3],
        table[:, 3:7] / length[:, None],
        table[:, 7:10],
        table[:, 10:13],
        has_times=False,
    )


def _array(data: bytes, name: str, path: Path) -> Floats:
    """Read the array of a ``.npy`` member, after comparing its header with its size."""
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        read = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, fortran, kind = read(stream)
        if kind.kind != "f" or fortran:
            raise ValueError(f"{kind} in {'columns' if fortran else 'rows'}")
        left = len(data) - stream.tell()
        if math.prod(shape) * kind.itemsize != left or min(shape, default=0) < 0:
            raise ValueError(f"shape {shape} of {kind} for {left} bytes")
        return np.frombuffer(data, kind, offset=stream.tell()).reshape(shape)
    except _NO_HEADER as error:
        raise FormatError(
            f"not an array of floating-point numbers: {error}", path=path, where=name,
            expected=_EXPECTED,
        ) from None  # fmt: skip


def _limit(path: Path, value: int, unit: str, most: int) -> LimitError:
    return LimitError(
        "too large", path=path, value=value, unit=unit, expected=f"at most {most} {unit}"
    )
