"""Kinds of goldens, one file each, found through the entry points ``pytest_twin.checks``."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from importlib.metadata import entry_points

from pytest_twin.checks.base import Check, Measure, Observation, Progress, Trace
from pytest_twin.errors import SpecError

__all__ = ["Check", "Measure", "Observation", "Progress", "Trace", "check_of", "kinds"]


@functools.cache
def _entry_points() -> Mapping[str, object]:
    return {point.name: point for point in entry_points(group="pytest_twin.checks")}


def kinds() -> tuple[str, ...]:
    """Names of all installed kinds, sorted."""
    return tuple(sorted(_entry_points()))


@functools.cache
def check_of(kind: str) -> Check:
    """The check that runs goldens of ``kind``.

    Raises:
        SpecError: no such kind is installed, or what brings it cannot be loaded.
    """
    point = _entry_points().get(kind)
    if point is None:
        raise SpecError("unknown kind", where="kind", value=kind, expected=", ".join(kinds()))
    try:
        check: Check = point.load()()  # type: ignore[attr-defined]
    except Exception as error:  # an installed package's own code
        raise SpecError(
            f"the package that brings this kind cannot be loaded: {type(error).__name__}: {error}",
            where="kind",
            value=kind,
        ) from error
    return check
