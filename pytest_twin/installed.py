"""What installed packages bring through entry points."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from pytest_twin.errors import SpecError


@functools.cache
def points_by_name(group: str) -> Mapping[str, tuple[EntryPoint, ...]]:
    """Name -> entry points of this name in a group: one, or several that contradict one another."""
    found: dict[str, tuple[EntryPoint, ...]] = {}
    for point in entry_points(group=group):
        found[point.name] = (*found.get(point.name, ()), point)
    return found


def only_one(points: tuple[EntryPoint, ...], noun: str) -> EntryPoint:
    """The single entry point of a name.

    Args:
        points: at least one, all of the same name.
        noun: what they bring, for the error.

    Raises:
        SpecError: several packages bring the same name.
    """
    if len(points) > 1:
        packages = " and ".join(package_of(point) for point in points)
        raise SpecError(
            f"{packages} both bring this {noun}",
            where=noun,
            value=points[0].name,
            expected="one of them; uninstall the other",
        )
    return points[0]


def is_own(point: EntryPoint) -> bool:
    """Whether pytest-twin itself brings this, not another package."""
    return point.value.startswith("pytest_twin.")


def refuse_stale(points: Iterable[EntryPoint], group: str) -> None:
    """Check that pytest-twin's own entry points are among those of a group.

    An installation of another version has none of a group that came later.

    Raises:
        SpecError: none is.
    """
    if not any(map(is_own, points)):
        raise SpecError(
            "the installation of pytest-twin is stale: none of its entry points is registered",
            where=group,
            expected="entry points of this version; reinstall pytest-twin: "
            "pip install --force-reinstall pytest-twin (in a checkout: pip install -e .)",
        )


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
