"""Model files of other formats, which installed packages turn into MJCF.

A format is a class under the entry points ``pytest_twin.model_formats``. The entry point's name is
the suffix of its files without the dot, in lower case.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from pytest_twin.errors import ModelError, TwinError
from pytest_twin.installed import brought, only_one, package_of, points_by_name
from pytest_twin.twin import MODEL_FORMATS


class ModelFormat(Protocol):
    """Turns a model file of another format into MJCF."""

    def mjcf(self, path: Path) -> str:
        """The MJCF of a file; paths in it are relative to the file's folder.

        MuJoCo loads and steps the model, with every check that an MJCF file gets. Lines in errors
        about the text are lines of the text, not of the file.

        Raises:
            TwinError: the file holds no such model.
        """
        ...


def as_mjcf(path: Path) -> bytes | None:
    """The MJCF of a file whose format an installed package reads; None for any other file.

    Raises:
        SpecError: two packages read this format, or the package cannot be loaded.
        ModelError: the package fails.
    """
    points = points_by_name(MODEL_FORMATS).get(path.suffix.lower().removeprefix("."))
    if points is None:
        return None
    point = only_one(points, "model format")
    reader: ModelFormat = brought(point, "model format")
    try:
        return reader.mjcf(path).encode()
    except TwinError:
        raise
    except Exception as error:  # an installed package's own code
        raise ModelError(
            f"{package_of(point)} cannot read it: {type(error).__name__}: {error}",
            path=path,
            expected=f"a model of the format {point.name!r}",
        ) from error
