"""Validate the declaration of an installed effect."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from typing import NoReturn, get_args

from pytest_twin.effects.base import (
    JOINT_FIELDS,
    MODES,
    REFERENCES,
    SIGNAL_PATHS,
    Effect,
    Parameter,
    Quantity,
    Scope,
    StageOfEffect,
)
from pytest_twin.errors import SpecError


def checked(effect: object, name: str, package: str) -> Effect:
    """Return the effect of an entry point, after validating its class attributes.

    Args:
        effect: an instance of the entry point's class.
        name: the entry point's name.
        package: the package that defines it, for the error.

    Raises:
        SpecError: it is not an effect, or an attribute is missing or invalid.
    """
    try:
        return _checked(effect, name)
    except SpecError as error:
        error.problem = f"{package} defines an invalid effect"
        raise


def _checked(effect: object, name: str) -> Effect:
    if not isinstance(effect, Effect):
        _refuse(name, "class", type(effect).__name__, "a subclass of pytest_twin.effects.Effect")
    for field in ("id", "family", "law", "source", "parameters"):
        if not getattr(effect, field, None):
            _refuse(name, field, None, "a value, set by the class")
    _one_of(name, "id", effect.id, (name,))
    _one_of(name, "family", effect.family, SIGNAL_PATHS)
    _one_of(name, "scope", effect.scope, get_args(Scope))
    for mode in effect.modes:
        _one_of(name, "modes", mode, MODES)
    _one_of(name, "stage", effect.stage, get_args(StageOfEffect))
    for mode in effect.basic_modes:
        _one_of(name, "basic_modes", mode, effect.modes)
    if effect.mjcf_field:
        _one_of(name, "mjcf_field", effect.mjcf_field, JOINT_FIELDS)
    for trait in ("mjcf_field", "regressor_symbol"):
        if getattr(effect, trait) and (len(effect.parameters) > 1 or effect.scope != "joint"):
            _refuse(name, trait, getattr(effect, trait), "an effect of a joint with one parameter")
    if bool(effect.regressor_symbol) != effect.overrides("regressor_column"):
        _refuse(name, "regressor_symbol", effect.regressor_symbol,
                "a symbol together with a method regressor_column")  # fmt: skip
    for parameter in effect.parameters:
        _check_parameter(name, parameter, effect.parameters)
    if all(p.neutral is None for p in effect.parameters):
        _refuse(name, "parameters", None, "one with a neutral value (effect absent)")
    if effect.dry_friction_level is not None:
        names = [p.name for p in effect.parameters]
        _one_of(name, "dry_friction_level", effect.dry_friction_level, names)
    for p in effect.parameters if effect.is_limit else ():
        # The search extends the starts geometrically.
        ends = (0.0, *p.starts)
        if p.neutral is not None and any(a >= b for a, b in itertools.pairwise(ends)):
            _refuse(name, f"parameters.{p.name}.starts", p.starts, "positive, increasing: a limit")
    return effect


def _check_parameter(name: str, parameter: Parameter, parameters: Sequence[Parameter]) -> None:
    here = f"parameters.{parameter.name}"
    _one_of(name, f"{here}.quantity", parameter.quantity, get_args(Quantity))
    _one_of(name, f"{here}.reference", parameter.reference, REFERENCES)
    lower, upper = parameter.lower, parameter.upper
    if not lower < upper:
        _refuse(name, f"{here}.lower", lower, f"below upper ({upper:g})")
    if parameter.choices and len(parameter.choices) != len(parameter.starts):
        _refuse(name, f"{here}.choices", len(parameter.choices), "as many as starts")
    if not parameter.starts:
        _refuse(name, f"{here}.starts", None, "at least one value")
    if parameter.under is not None:
        choices = {p.name: p.starts for p in parameters if p.choice}
        _one_of(name, f"{here}.under", parameter.under[0], choices)
        for value in parameter.under[1]:
            _one_of(name, f"{here}.under", value, choices[parameter.under[0]])
    known = () if parameter.neutral is None else (parameter.neutral,)
    for value in (*known, *parameter.starts):
        if not lower <= value <= upper:
            _refuse(name, here, value, f"neutral value and starts between {lower:g} and {upper:g}")


def _one_of(name: str, field: str, value: object, choices: Collection[object]) -> None:
    if value not in choices:
        _refuse(name, field, value, ", ".join(map(str, choices)))


def _refuse(name: str, field: str, value: object, expected: str) -> NoReturn:
    raise SpecError(
        "an installed effect has a wrong declaration",
        where=f"{name}.{field}", value=value, expected=expected,
    )  # fmt: skip
