"""Effects: physics that a model can have or lack, one file per family."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from importlib.metadata import entry_points

from pytest_twin.effects.base import Effect, ModelFields, Parameter, Values, World
from pytest_twin.effects.checked import checked
from pytest_twin.effects.proposal import JointFit, Start
from pytest_twin.errors import SpecError
from pytest_twin.installed import load_plugin, package_of, refuse_stale_installation

__all__ = [
    "Effect",
    "JointFit",
    "ModelFields",
    "Parameter",
    "Start",
    "Values",
    "World",
    "catalogue",
]


@functools.cache
def catalogue() -> Mapping[str, Effect]:
    """Return id -> installed effect, in the order of the entry points ``pytest_twin.effects``.

    Raises:
        SpecError: an effect cannot be loaded, has a wrong declaration, or has the id of
            another; or pytest-twin's own effects are not registered.
    """
    group = "pytest_twin.effects"
    points = entry_points(group=group)
    refuse_stale_installation(points, group)
    effects: dict[str, Effect] = {}
    for point in points:
        if point.name in effects:
            raise SpecError(
                f"{package_of(point)} defines an effect that another package also defines",
                where="effect",
                value=point.name,
                expected="one package for each effect; uninstall the other",
            )
        effects[point.name] = checked(load_plugin(point, "effect"), point.name, package_of(point))
    return effects
