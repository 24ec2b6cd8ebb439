"""Parse quantities of a spec: ``0.5 mm``, ``2 deg``, ``3 %``."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from pytest_twin.errors import SpecError

# unit as written -> (SI unit, factor to it)
_UNITS: dict[str, tuple[str, float]] = {
    "m": ("m", 1.0),
    "mm": ("m", 1e-3),
    "um": ("m", 1e-6),
    "rad": ("rad", 1.0),
    "mrad": ("rad", 1e-3),
    "deg": ("rad", math.pi / 180.0),
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "Hz": ("Hz", 1.0),
    "kg": ("kg", 1.0),
    "g": ("kg", 1e-3),
    "N": ("N", 1.0),
    "N*m": ("N*m", 1.0),
    "Nm": ("N*m", 1.0),
    "mN*m": ("N*m", 1e-3),
    "J": ("J", 1.0),
    "mJ": ("J", 1e-3),
    "m/s": ("m/s", 1.0),
    "mm/s": ("m/s", 1e-3),
    "rad/s": ("rad/s", 1.0),
    "deg/s": ("rad/s", math.pi / 180.0),
    "": ("1", 1.0),
    "%": ("1", 1e-2),
    "dB": ("dB", 1.0),
}

SI_UNITS: tuple[str, ...] = tuple(dict.fromkeys(si for si, _ in _UNITS.values()))

_QUANTITY = re.compile(
    r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([A-Za-z%][A-Za-z%/*]*)?\s*"
)


@dataclass(frozen=True, slots=True)
class Quantity:
    """A finite number in SI units."""

    value: float
    unit: str

    def __str__(self) -> str:
        return f"{self.value:.6g}" + ("" if self.unit == "1" else f" {self.unit}")


def parse_quantity(text: object, units: tuple[str, ...]) -> Quantity:
    """Parse ``text`` and return it in SI units.

    Args:
        text: number with unit, as written.
        units: allowed SI units; ``1`` for a dimensionless quantity.

    Raises:
        SpecError: no number, no unit, not finite, or a unit of another dimension.
    """
    examples = (f"'1 {name}'" if name else "'1'" for name, (si, _) in _UNITS.items() if si in units)
    expected = "a number and a unit, such as " + " or ".join(examples)
    if isinstance(text, int | float) and not isinstance(text, bool):
        text = repr(text)
    match = _QUANTITY.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise SpecError("not a quantity with a unit", value=text, expected=expected)
    written = match[2] or ""
    unit = _UNITS.get(written)
    if unit is None or unit[0] not in units:
        problem = f"unit {written!r} does not fit" if written else "the unit is missing"
        raise SpecError(problem, value=text, expected=expected)
    value = float(match[1]) * unit[1]
    if not math.isfinite(value):
        raise SpecError("not a finite number", value=text, expected=expected)
    return Quantity(value, unit[0])
