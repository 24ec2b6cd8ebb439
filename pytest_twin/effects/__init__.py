"""Effects: the physics that a model can have or lack, one file per family."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from importlib.metadata import entry_points

from pytest_twin.effects.base import Effect, ModelFields, Parameter, Values, World

__all__ = ["Effect", "ModelFields", "Parameter", "Values", "World", "catalogue"]


@functools.cache
def catalogue() -> Mapping[str, Effect]:
    """Every installed effect by id, in the order of the entry points ``pytest_twin.effects``."""
    return {point.name: point.load()() for point in entry_points(group="pytest_twin.effects")}
