"""Meaning of a CSV file's headings, also those that PlotJuggler writes."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from pytest_twin.formats.ros_serialization import QUANTITIES

TIME = "time"
FIELDS = (*QUANTITIES, "command")
PLOTJUGGLER_TIME = "__time"
_HEADING_CHARS = 1024
_UNIT = re.compile(r"(?P<name>.*\S)\s*[\[(](?P<unit>[^\[\]()]*[^\d\s\[\]()][^\[\]()]*)[\])]")
_DEGREE = math.pi / 180.0
_UNITS: Mapping[str, tuple[str, float]] = {
    "rad": ("position", 1.0), "rad/s": ("velocity", 1.0),
    "m": ("position", 1.0), "m/s": ("velocity", 1.0),
    "mm": ("position", 1e-3), "mm/s": ("velocity", 1e-3),
    "deg": ("position", _DEGREE), "deg/s": ("velocity", _DEGREE),
    "°": ("position", _DEGREE), "°/s": ("velocity", _DEGREE),
    "degree": ("position", _DEGREE), "degrees": ("position", _DEGREE),
    "mrad": ("position", 1e-3), "mrad/s": ("velocity", 1e-3),
    "rpm": ("velocity", math.pi / 30.0), "mnm": ("effort", 1e-3), "n*mm": ("effort", 1e-3),
    "nm": ("effort", 1.0), "n*m": ("effort", 1.0), "n·m": ("effort", 1.0), "n": ("effort", 1.0),
}  # fmt: skip
"""Unit in a heading -> quantity, and factor to SI units."""
_SERIES = (
    re.compile(r"(?P<joint>[^/]+)/(?P<field>position|velocity|effort)"),
    re.compile(
        r"(?P<field>position|velocity|effort|data)(?:\[(?P<joint>[^\]/]+)\]|[./](?P<at>\d+))"
    ),
)
_TOPIC = re.compile(r"(?P<topic>/.+?)/(?:[^/]+/(?:position|velocity|effort)|(?:position|velocity|"
                    r"effort|data)(?:\[[^\]/]+\]|[./]\d+))")  # fmt: skip


class UnitError(ValueError):
    """A heading states a unit that is not known, or of another quantity; the text is the unit."""


@dataclass(frozen=True)
class Column:
    """Meaning of one column.

    Attributes:
        joint: the joint, as recorded.
        role: ``state`` or ``command``.
        quantity: ``position``, ``velocity`` or ``effort``; None for a command that may be any.
        scale: SI units per recorded unit, None where the heading states no unit.
    """

    joint: str
    role: str
    quantity: str | None
    scale: float | None = None

    @property
    def key(self) -> tuple[str, str, str | None]:
        """What only one column may contain."""
        return self.joint, self.role, self.quantity


def column_of(heading: str, unit_heading: str, topics: Mapping[str, str]) -> Column | None:
    """Return the meaning of a heading or mapped meaning; None for another column.

    Args:
        heading: the meaning, such as ``elbow.position``, or ``/joint_states/elbow/position``.
        unit_heading: the heading as written, which may end in a unit such as ``[deg]``.
        topics: role -> topic, for the headings of PlotJuggler.

    Raises:
        UnitError: the unit is not known.
    """
    name, _ = split_unit(heading)
    _, unit = split_unit(unit_heading)
    for role, topic in topics.items():
        rest = name.removeprefix(topic + "/")
        matches = [form.fullmatch(rest) for form in _SERIES] if rest != name else []
        for match in filter(None, matches):
            groups = match.groupdict()
            field = groups["field"]
            if field == "data" and role == "state":
                continue
            joint = groups["joint"] or groups["at"]
            quantity = None if field == "data" else field
            return _column(joint, role, quantity, unit)
    joint, dot, field = name.rpartition(".")
    if not dot or field not in FIELDS or not joint:
        return None
    if field == "command":
        return _column(joint, "command", None, unit)
    return _column(joint, "state", field, unit)


def _column(joint: str, role: str, quantity: str | None, unit: str) -> Column:
    """The column, whose unit also says what a command is.

    Raises:
        UnitError: the unit is not known, or is one of another quantity.
    """
    if not unit:
        return Column(joint, role, quantity)
    of, scale = _UNITS.get(unit.lower(), ("", 0.0))
    if not of or quantity not in (None, of):
        raise UnitError(unit)
    return Column(joint, role, of, scale)


def topics_in(headings: list[str]) -> list[str]:
    """Return the topics of headings that PlotJuggler writes."""
    short = (heading for heading in headings if len(heading) <= _HEADING_CHARS)
    matches = (_TOPIC.fullmatch(heading) for heading in short)
    return sorted({match["topic"] for match in matches if match is not None})


def split_unit(heading: str) -> tuple[str, str]:
    """Return a heading without its unit, and the unit, such as ``q1 [deg]``."""
    # A longer heading is no usable name, and would take long.
    match = None if len(heading) > _HEADING_CHARS else _UNIT.fullmatch(heading.strip())
    # position[elbow] is a name of PlotJuggler and no unit.
    if match is None or (match["name"].endswith(QUANTITIES) and "/" in match["name"]):
        return heading, ""
    return match["name"], match["unit"].strip()
