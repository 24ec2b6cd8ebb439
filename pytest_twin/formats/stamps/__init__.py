"""Read and write stamps of data sets and policies: the text that identifies their twin.

A carrier is a data set or file that stores the text in its format's metadata: a LeRobot data set,
an MCAP file, an HDF5 file or an ONNX model. This package does not interpret the text.
"""

from __future__ import annotations

import importlib
import stat
from pathlib import Path

from pytest_twin.errors import FormatError, PathError, require_at_most
from pytest_twin.formats import limits
from pytest_twin.formats.paths import follow
from pytest_twin.formats.stamps.base import Carrier
from pytest_twin.formats.stamps.lerobot import LeRobotStamp

__all__ = ["KINDS", "Carrier", "carriers_of", "is_carrier"]

# Suffix -> module and class, imported on demand: verifying a release needs none of them.
_BY_SUFFIX = {
    ".mcap": ("mcap", "McapStamp"),
    ".h5": ("hdf5", "Hdf5Stamp"),
    ".hdf5": ("hdf5", "Hdf5Stamp"),
    ".onnx": ("onnx", "OnnxStamp"),
}
KINDS = (
    "a LeRobot data set, an MCAP file (.mcap), an HDF5 file (.h5, .hdf5), an ONNX model (.onnx), "
    "or a folder of such files"
)
_CONVERT = "pytest-twin convert writes other recordings as MCAP"


def carriers_of(path: Path) -> list[Carrier]:
    """Return the carriers of a data set or policy: one, or one for each file of a folder, by name.

    Raises:
        PathError: missing, a link that may not be followed, or neither a regular file nor a folder.
        FormatError: nothing at ``path`` can store a stamp.
        LimitError: more than ``limits.STAMPS`` files.
    """
    try:
        mode = follow(path).lstat().st_mode
    except (OSError, ValueError) as error:
        problem = "no such file or folder" if isinstance(error, FileNotFoundError) else str(error)
        raise PathError(problem, path=path, expected=KINDS) from None
    if stat.S_ISREG(mode):
        single = _carrier(path)
        if single is None:
            raise FormatError(
                "not a data set or policy that can store a stamp",
                path=path,
                expected=f"{KINDS}; {_CONVERT}",
            )
        return [single]
    if not stat.S_ISDIR(mode):
        raise PathError("a link, or neither a file nor a folder", path=path, expected=KINDS)
    if LeRobotStamp.is_dataset(path):
        return [LeRobotStamp(path)]
    found: list[Carrier] = []
    for file in sorted(path.rglob("*")):
        if follow(file).is_file() and (carrier := _carrier(file)) is not None:
            found.append(carrier)
        require_at_most(
            len(found), limits.STAMPS.files_count, "too many files for a data set", path=path
        )
    if not found:
        raise FormatError(
            "no file in this folder can store a stamp",
            path=path,
            expected=f"{KINDS}; {_CONVERT}",
        )
    return found


def _carrier(path: Path) -> Carrier | None:
    """Return the carrier for a file's suffix, or None."""
    if path.suffix.lower() not in _BY_SUFFIX:
        return None
    module, name = _BY_SUFFIX[path.suffix.lower()]
    carrier: Carrier = getattr(importlib.import_module(f"{__name__}.{module}"), name)(path)
    return carrier


def is_carrier(path: Path) -> bool:
    """Whether a path is a data set or a policy, rather than a release or a twin."""
    if path.is_file():
        return path.suffix.lower() in _BY_SUFFIX
    if not path.is_dir():
        return False
    return LeRobotStamp.is_dataset(path) or any(
        file.suffix.lower() in _BY_SUFFIX for file in path.rglob("*")
    )
