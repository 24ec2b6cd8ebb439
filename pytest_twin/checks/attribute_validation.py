"""Validate the class attributes of a check from any package."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from functools import partial
from typing import NoReturn

from pytest_twin.checks.base import Check
from pytest_twin.errors import SpecError
from pytest_twin.units import SI_UNITS


def validate_check(check: object, name: str, package: str) -> Check:
    """Return the check of an entry point, after validating its class attributes.

    Args:
        check: an instance of the entry point's class.
        name: the entry point's name.
        package: the package that defines it, for the error.

    Raises:
        SpecError: it is not a check, or an attribute is missing or invalid.
    """
    refuse = partial(_refuse, package)
    if not isinstance(check, Check):
        refuse("class", type(check).__name__, "a subclass of pytest_twin.checks.Check")
    for field in ("kind", "tolerances", "schema"):
        if not hasattr(check, field):
            refuse(field, "nothing", "a class attribute")
    if check.kind != name:
        refuse("kind", check.kind, f"{name!r}, as the entry point says")
    if not isinstance(check.version, int):
        refuse("version", check.version, "an integer")
    if not isinstance(check.libraries, Sequence) or isinstance(check.libraries, str):
        refuse("libraries", check.libraries, "a tuple of distributions")
    _check_tolerances(check, refuse)
    if not isinstance(check.schema, Mapping):
        refuse("schema", check.schema, "a mapping with the JSON Schemas of target and stimulus")
    for part, schema in check.schema.items():
        if not isinstance(schema, Mapping):
            refuse(f"schema.{part}", schema, "a JSON Schema")
    return check


def _check_tolerances(check: Check, refuse: Callable[[str, object, str], NoReturn]) -> None:
    if not isinstance(check.tolerances, Mapping):
        refuse("tolerances", check.tolerances, "a mapping from names to SI units")
    for tolerance, unit in check.tolerances.items():
        if unit not in SI_UNITS:
            refuse(f"tolerances.{tolerance}", unit, ", ".join(SI_UNITS))
    if not isinstance(check.required_tolerances, Set):
        refuse("required_tolerances", check.required_tolerances, "a frozenset of names")
    if unknown := sorted(map(str, check.required_tolerances - check.tolerances.keys())):
        refuse("required_tolerances", ", ".join(unknown), "names in tolerances")


def _refuse(package: str, field: str, value: object, expected: str) -> NoReturn:
    raise SpecError(
        f"{package} defines an invalid check: its {field}",
        where="kind",
        value=value if isinstance(value, int | float | str) else type(value).__name__,
        expected=expected,
    )
