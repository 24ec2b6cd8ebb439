"""What installed packages bring through entry points."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import Any

from pytest_twin.errors import SpecError


def brought(point: EntryPoint, noun: str) -> Any:
    """An instance of the class that an entry point names.

    Args:
        point: its name is that of what it brings.
        noun: what that is called in an error.

    Raises:
        SpecError: it cannot be loaded.
    """
    try:
        return point.load()()
    except Exception as error:  # an installed package's own code
        raise SpecError(
            f"the package that brings this {noun} cannot be loaded: {type(error).__name__}: "
            f"{error}",
            where=noun, value=point.name,
        ) from error  # fmt: skip
