"""Load plugins (kinds, effects, layers, readers) through entry points of installed packages."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from pytest_twin.errors import SpecError


@functools.cache
def entry_points_by_name(group: str) -> Mapping[str, tuple[EntryPoint, ...]]:
    """Map each name in a group to its entry points; more than one is a conflict of packages."""
    found: dict[str, tuple[EntryPoint, ...]] = {}
    for point in entry_points(group=group):
        found[point.name] = (*found.get(point.name, ()), point)
    return found


def single_entry_point(points: tuple[EntryPoint, ...], noun: str) -> EntryPoint:
    """Return the only entry point of a name.

    Args:
        points: at least one, all of the same name.
        noun: what they provide, for the error message, such as ``effect``.

    Raises:
        SpecError: several packages provide the same name.
    """
    if len(points) > 1:
        packages = " and ".join(package_of(point) for point in points)
        raise SpecError(
            f"{packages} both provide this {noun}",
            where=noun,
            value=points[0].name,
            expected="one of them; uninstall the other",
        )
    return points[0]


def is_own(point: EntryPoint) -> bool:
    """Whether the entry point belongs to pytest-twin itself."""
    return point.value.startswith("pytest_twin.")


def refuse_stale_installation(points: Iterable[EntryPoint], group: str) -> None:
    """Check that a group contains entry points of pytest-twin itself.

    The metadata of an older installation lacks groups that were added later.

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


def load_plugin(point: EntryPoint, noun: str) -> Any:
    """Load the class that an entry point names, and return an instance.

    Args:
        point: entry point of the class.
        noun: what it provides, for the error message, such as ``effect``.

    Raises:
        SpecError: the import or the constructor raised anything but an interrupt.
    """
    try:
        return point.load()()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # the code of another package may even raise SystemExit
        words = f"{type(error).__name__}: {error}".removesuffix(": ")
        raise SpecError(
            f"{package_of(point)} cannot be loaded: {words}",
            where=noun,
            value=point.name,
            expected=f"{point.value} to import; repair or uninstall the package",
        ) from error


def package_of(point: EntryPoint) -> str:
    """Name and version of the package of an entry point: ``package 'boxes' 1.0``."""
    if point.dist is None:
        return f"the package of {point.value}"
    return f"package {point.dist.name!r} {point.dist.version}"
