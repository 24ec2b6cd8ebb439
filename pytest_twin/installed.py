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
        SpecError: its module or class cannot be loaded, whatever it raises but an interrupt.
    """
    try:
        return point.load()()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # an installed package's own code, SystemExit included
        words = f"{type(error).__name__}: {error}".removesuffix(": ")
        raise SpecError(
            f"{package_of(point)} cannot be loaded: {words}",
            where=noun,
            value=point.name,
            expected=f"{point.value} to import; repair or uninstall the package",
        ) from error


def package_of(point: EntryPoint) -> str:
    """The package that an entry point belongs to, for people: ``package 'boxes' 1.0``."""
    if point.dist is None:
        return f"the package of {point.value}"
    return f"package {point.dist.name!r} {point.dist.version}"
