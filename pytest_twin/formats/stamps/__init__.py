"""Stamps in data sets and policies: the text that says which twin they belong to.

A carrier is one file that holds the text in the place that its format has for metadata: a LeRobot
data set, an MCAP file, an HDF5 file, an ONNX model. The text is opaque here.
"""

from __future__ import annotations

import stat
from pathlib import Path

from pytest_twin.errors import FormatError, LimitError, PathError
from pytest_twin.formats import limits
from pytest_twin.formats.stamps.base import Carrier
from pytest_twin.formats.stamps.hdf5 import Hdf5Stamp
from pytest_twin.formats.stamps.lerobot import LeRobotStamp
from pytest_twin.formats.stamps.mcap import McapStamp
from pytest_twin.formats.stamps.onnx import OnnxStamp

__all__ = ["KINDS", "Carrier", "carriers_of", "is_carrier"]

_BY_SUFFIX: dict[str, type[McapStamp] | type[Hdf5Stamp] | type[OnnxStamp]] = {
    ".mcap": McapStamp,
    ".h5": Hdf5Stamp,
    ".hdf5": Hdf5Stamp,
    ".onnx": OnnxStamp,
}
KINDS = (
    "a LeRobot data set, an MCAP file (.mcap), an HDF5 file (.h5, .hdf5), an ONNX model (.onnx), "
    "or a folder of such files"
)


def carriers_of(path: Path) -> list[Carrier]:
    """The carriers of a data set or policy: one, or each file of a folder, by name.

    Raises:
        PathError: missing, a link, or neither a regular file nor a folder.
        FormatError: nothing that holds a stamp.
        LimitError: more files than a data set has.
    """
    try:
        mode = path.lstat().st_mode
    except (OSError, ValueError) as error:
        problem = "no such file or folder" if isinstance(error, FileNotFoundError) else str(error)
        raise PathError(problem, path=path, expected=KINDS) from None
    if stat.S_ISREG(mode):
        kind = _BY_SUFFIX.get(path.suffix.lower())
        if kind is None:
            raise FormatError(
                "no data set or policy that holds a stamp",
                path=path,
                expected=f"{KINDS}; pytest-twin convert writes other recordings as MCAP",
            )
        return [kind(path)]
    if not stat.S_ISDIR(mode):
        raise PathError("a link, or neither a file nor a folder", path=path, expected=KINDS)
    if LeRobotStamp.is_dataset(path):
        return [LeRobotStamp(path)]
    found: list[Carrier] = []
    for file in sorted(path.rglob("*")):
        carrier = _BY_SUFFIX.get(file.suffix.lower())
        if carrier is not None and file.is_file() and not file.is_symlink():
            found.append(carrier(file))
        if len(found) > limits.STAMPS.files_count:
            raise LimitError(
                "too many files for a data set",
                path=path,
                expected=f"at most {limits.STAMPS.files_count}",
            )
    if not found:
        raise FormatError("nothing in this folder holds a stamp", path=path, expected=KINDS)
    return found


def is_carrier(path: Path) -> bool:
    """Whether a path looks like a data set or a policy, and not like a release or a twin."""
    if path.is_file():
        return path.suffix.lower() in _BY_SUFFIX
    if not path.is_dir():
        return False
    return LeRobotStamp.is_dataset(path) or any(
        file.suffix.lower() in _BY_SUFFIX for file in path.rglob("*")
    )
