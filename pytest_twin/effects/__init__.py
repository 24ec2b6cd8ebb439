"""Effects: physics that a model can have or lack, one file per family."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from importlib.metadata import entry_points

from pytest_twin.effects.base import (
    JOINT_FIELDS,
    Effect,
    ModelFields,
    Parameter,
    PoseShift,
    RegressorColumn,
    Values,
    World,
)
from pytest_twin.effects.checked import checked
from pytest_twin.effects.proposal import JointFit, Start
from pytest_twin.errors import SpecError
from pytest_twin.installed import load_plugin, package_of, refuse_stale_installation

__all__ = [
    "Effect",
    "JointFit",
    "ModelFields",
    "Parameter",
    "PoseShift",
    "RegressorColumn",
    "Start",
    "Values",
    "World",
    "catalogue",
    "effect_of_field",
    "in_order_of_fields",
    "mjcf_fields",
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
        effect = checked(load_plugin(point, "effect"), point.name, package_of(point))
        same = [
            other.id for other in effects.values()
            if effect.mjcf_field and other.mjcf_field == effect.mjcf_field
        ]  # fmt: skip
        if same:
            raise SpecError(
                "two effects are added to one field of the model",
                where=f"{effect.id}.mjcf_field and {same[0]}.mjcf_field",
                value=effect.mjcf_field,
                expected="one effect for each field; uninstall the package of the other",
            )
        effects[point.name] = effect
    return effects


def mjcf_fields() -> Mapping[str, str]:
    """Return effect id -> attribute of an MJCF joint to which its parameter is added."""
    return {effect.id: effect.mjcf_field for effect in catalogue().values() if effect.mjcf_field}


def effect_of_field(field: str) -> Effect:
    """Return the effect whose parameter is added to an attribute of an MJCF joint."""
    return next(effect for effect in catalogue().values() if effect.mjcf_field == field)


def in_order_of_fields(effects: Iterable[Effect]) -> list[Effect]:
    """Sort effects: armature, damping and dry friction of the model first, in this order.

    The order does not depend on that in which packages are installed.
    """
    last = len(JOINT_FIELDS)
    return sorted(
        effects,
        key=lambda e: (JOINT_FIELDS.index(e.mjcf_field) if e.mjcf_field else last, e.id),
    )
