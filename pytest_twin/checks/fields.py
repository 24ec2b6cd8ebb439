"""Read fields of a spec: names in the model, and quantities with units."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from typing import Any

from pytest_twin.checks.schemas import Schema, boolean, name_field
from pytest_twin.errors import SpecError
from pytest_twin.golden import Golden
from pytest_twin.units import Quantity, parse_quantity

POSITION_UNIT: Mapping[str, str] = {"hinge": "rad", "slide": "m"}
VELOCITY_UNIT: Mapping[str, str] = {"hinge": "rad/s", "slide": "m/s"}
EFFORT_UNIT: Mapping[str, str] = {"hinge": "N*m", "slide": "N"}
"""Type of a joint -> SI unit of its position, velocity and effort."""

_EXAMPLES: Mapping[str, str] = {
    **{"m": "0.5 mm", "rad": "5 mrad", "s": "2 ms", "kg": "5 g", "1": "2 %"},
    **{"N": "0.1 N", "N*m": "5 mN*m", "J": "1 mJ", "Hz": "0.2 Hz", "dB": "0.5 dB"},
    **{"m/s": "2 mm/s", "rad/s": "1 deg/s"},
}
"""SI unit -> example of a tolerance."""


GRAVITY_SCHEMA = boolean("Whether gravity acts. Default: true.")
CONTACT_SCHEMA = boolean(
    "Whether bodies can touch. Default: true. With false they pass through each other."
)


def tolerance_schema(unit: str) -> Schema:
    """Return the schema of a tolerance in ``unit``; a check of another package may use any unit."""
    example = _EXAMPLES.get(unit, f"1 {unit}")
    return name_field(f"a number with its unit, such as {example!r}", examples=[example])


def spec_error(golden: Golden, field: str, problem: str, **details: Any) -> SpecError:
    """Build a :class:`SpecError` at ``field`` (dotted) of the golden's file, or its parent."""
    place = field
    while place not in golden.lines and "." in place:
        place = place.rpartition(".")[0]
    return SpecError(
        problem, path=golden.path, line=golden.lines.get(place), where=field, **details
    )


def known_name(golden: Golden, field: str, name: str, known: Iterable[str], noun: str) -> str:
    """Return ``name`` if the model has it.

    Raises:
        SpecError: the model lacks it; the error suggests a similar name.
    """
    names = sorted(known)
    if name in names:
        return name
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if close:
        expected = f"did you mean {close[0]!r}?"
    elif names:
        expected = f"one of {', '.join(names[:8])}" + (", ..." if len(names) > 8 else "")
    else:
        expected = f"a model that has a {noun}"
    raise spec_error(golden, field, f"no {noun} of this name", value=name, expected=expected)


def quantity(golden: Golden, field: str, value: object, unit: str) -> float:
    """Convert ``value`` to the SI ``unit``; a number without unit is in SI units.

    Raises:
        SpecError: the value is not finite, or its unit has a different dimension.
    """
    if isinstance(value, int | float) and not isinstance(value, bool):
        if not math.isfinite(value):
            raise spec_error(
                golden,
                field,
                "not a finite number",
                value=value,
                unit=unit,
                expected="a finite number",
            )
        return float(value)
    try:
        return parse_quantity(value, (unit,)).value
    except SpecError as error:
        raise spec_error(
            golden, field, error.problem, value=error.value, expected=error.expected
        ) from None


def seconds(golden: Golden, field: str, value: object, most: float = 60.0) -> float:
    """Convert ``value`` to a duration above 0 s and up to ``most``, s.

    Raises:
        SpecError: it is no such duration.
    """
    duration = quantity(golden, field, value, "s")
    if not 0.0 < duration <= most:
        raise spec_error(
            golden, field, "out of bounds", value=duration, unit="s", expected=f"0 to {most:g} s"
        )
    return duration


def tolerance(golden: Golden, name: str, why: str) -> Quantity:
    """Return the golden's tolerance ``name``, in its SI unit.

    Raises:
        SpecError: the spec states none; ``why`` states what needs it.
    """
    stated = golden.tolerance.get(name)
    if stated is None:
        raise spec_error(
            golden,
            f"tolerance.{name}",
            f"missing: {why}",
            expected="a number with its unit; write what the task allows",
        )
    return stated
