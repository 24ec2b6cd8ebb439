"""One finding of the audit: what is wrong where, why it matters, and what to do next."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from pytest_twin.errors import TwinError

Severity = Literal["critical", "warning", "info", "unknown"]
SEVERITIES: tuple[Severity, ...] = get_args(Severity)
LAYERS: tuple[str, ...] = (
    "tree",
    "joints",
    "coupling",
    "transmissions",
    "meshes",
    "inertia",
    "frames",
    "commands",
    "controllers",
)
PLANNING = "planning"
"""The layer of an SRDF, which is audited alone."""
_LAYER_RANKS = {layer: rank for rank, layer in enumerate((*LAYERS, PLANNING))}


@dataclass(frozen=True, slots=True)
class Place:
    """Where in which file."""

    path: Path
    line: int | None = None


@dataclass(frozen=True, slots=True)
class Finding:
    """A fault, a doubt, a fact, or a property that the file does not state.

    Attributes:
        code: ``layer.what``, the same for every element with the same fault.
        severity: ``critical`` no robot can have it, or it misleads every simulator; ``warning``
            it is seldom intended; ``info`` a fact; ``unknown`` the file does not state it.
        place: file and line.
        element: as people name it, ``link 'wrist'``.
        title: what is found there, one sentence without a final stop.
        value: as stated or computed, with ``unit``.
        expected: the right value, or the values that are plausible.
        why: what goes wrong with it.
        settle: what to do next: the correction, or the source or test that gives the value.
    """

    code: str
    severity: Severity
    place: Place | None
    element: str
    title: str
    value: float | str | None = None
    unit: str | None = None
    expected: str | None = None
    why: str = ""
    settle: str = ""

    @property
    def layer(self) -> str:
        """The layer that found it."""
        return self.code.partition(".")[0]

    def to_json(self, identifier: str) -> dict[str, Any]:
        """Plain data; ``identifier`` is unique within one audit."""
        return {
            "id": identifier,
            "code": self.code,
            "layer": self.layer,
            "severity": self.severity,
            "file": None if self.place is None else str(self.place.path),
            "line": None if self.place is None else self.place.line,
            "element": self.element,
            "title": self.title,
            "value": _plain(self.value),
            "unit": self.unit,
            "expected": self.expected,
            "why": self.why,
            "settle": self.settle,
        }


def _plain(value: float | str | None) -> float | str | None:
    """JSON has no infinity."""
    if isinstance(value, int | float) and not math.isfinite(value):
        return str(value)
    return value


def from_error(
    error: TwinError,
    code: str,
    element: str,
    *,
    severity: Severity = "critical",
    why: str = "",
    settle: str = "",
) -> Finding:
    """The finding that reports an error of a reader."""
    value = error.value
    return Finding(
        code,
        severity,
        None if error.path is None else Place(error.path, error.line),
        element,
        error.problem if error.where in (None, element) else f"{error.where}: {error.problem}",
        value if isinstance(value, int | float | str | None) else str(value),
        error.unit,
        error.expected,
        why or "the element cannot be read, so no model can be built from it",
        settle or "correct the value, or ask the supplier for the original file",
    )


def to_json(findings: Iterable[Finding]) -> list[dict[str, Any]]:
    """Findings by severity, layer and place, each with an id of its own."""
    ordered = sorted(
        findings,
        key=lambda f: (
            SEVERITIES.index(f.severity),
            _LAYER_RANKS.get(f.layer, len(_LAYER_RANKS)),
            f.layer,
            f.code,
            -1 if f.place is None or f.place.line is None else f.place.line,
            f.element,
        ),
    )
    seen: dict[str, int] = {}
    rows = []
    for finding in ordered:
        name = f"{finding.code}:{finding.element}"
        seen[name] = seen.get(name, 0) + 1
        rows.append(finding.to_json(name if seen[name] == 1 else f"{name}#{seen[name]}"))
    return rows
