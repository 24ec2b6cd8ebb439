"""Model files of other formats, which installed packages convert to MJCF.

A format is a class under the entry points ``pytest_twin.model_formats``. The entry point's name is
the suffix of its files without the dot, in lower case.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from pytest_twin.errors import ModelError, TwinError
from pytest_twin.installed import entry_points_by_name, load_plugin, package_of, single_entry_point
from pytest_twin.twin import MODEL_FORMATS


class ModelFormat(Protocol):
    """Converts a model file of another format to MJCF."""

    def mjcf(self, path: Path) -> str:
        """Return the MJCF of a file, with paths relative to the file's folder.

        The MJCF is checked like an MJCF file, and MuJoCo steps the model. Line numbers in errors
        are those of the returned text, not of the file.

        Raises:
            TwinError: the file contains no such model.
        """
        ...


def as_mjcf(path: Path) -> bytes | None:
    """The MJCF of a file whose format an installed package reads; None for any other file.

    Raises:
        SpecError: two packages read this format, or the package cannot be loaded.
        ModelError: the package fails.
    """
    points = entry_points_by_name(MODEL_FORMATS).get(path.suffix.lower().removeprefix("."))
    if points is None:
        return None
    point = single_entry_point(points, "model format")
    reader: ModelFormat = load_plugin(point, "model format")
    try:
        return reader.mjcf(path).encode()
    except TwinError:
        raise
    except Exception as error:  # the code of another package
        raise ModelError(
            f"{package_of(point)} cannot read it: {type(error).__name__}: {error}",
            path=path,
            expected=f"a model of the format {point.name!r}",
        ) from error
