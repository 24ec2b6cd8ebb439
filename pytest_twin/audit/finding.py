"""Data class of an audit finding: fault, place, consequence and next step."""

from __future__ import annotations

import math
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal, get_args

from pytest_twin.errors import TwinError

SCHEMA = 1
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
LAYER_GROUP = "pytest_twin.audit_layers"
"""Entry points of layers of other packages."""
SIMREADY = "simready"
"""The layer of what NVIDIA's validator found, where that is given as evidence."""
PLANNING = "planning"
"""The layer of findings in an SRDF, which is audited separately."""
_LAYER_RANKS = {layer: rank for rank, layer in enumerate((*LAYERS, SIMREADY, PLANNING))}


@dataclass(frozen=True, slots=True)
class Place:
    """A file and a line in it."""

    path: Path
    line: int | None = None

    def __str__(self) -> str:
        """File name and line, ``arm.urdf:12``."""
        return self.path.name if self.line is None else f"{self.path.name}:{self.line}"


@dataclass(frozen=True, slots=True)
class Finding:
    """A fault, a suspicious value, a fact, or a property that the file does not state.

    Attributes:
        code: ``layer.what``, the same for every element with the same fault.
        severity: ``critical``: physically impossible, or every simulator misinterprets it;
            ``warning``: rarely intended; ``info``: a fact; ``unknown``: the file does not state it.
        element: description of the element, such as ``link 'wrist'``.
        title: the fault, one sentence without a final full stop.
        value: stated or computed value, in ``unit``.
        expected: correct value, or range of plausible values.
        settle: next step: the correction, or the source or test that gives the value.
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
        """Return the audit layer of the finding."""
        return self.code.partition(".")[0]

    def to_json(self, identifier: str) -> dict[str, Any]:
        """Return the finding as JSON data; ``identifier`` is unique within one audit."""
        return {
            "id": identifier,
            "code": self.code,
            "layer": self.layer,
            "severity": self.severity,
            "file": None if self.place is None else str(self.place.path),
            "line": None if self.place is None else self.place.line,
            "element": self.element,
            "title": self.title,
            "value": _finite_or_text(self.value),
            "unit": self.unit,
            "expected": self.expected,
            "why": self.why,
            "settle": self.settle,
        }


@cache
def catalogue() -> Mapping[str, Mapping[str, Mapping[str, str]]]:
    """Layer -> name of a finding -> its fields that are the same for every robot."""
    return tomllib.loads(resources.files(__package__).joinpath("findings.toml").read_text("utf-8"))


def finding_of(
    code: str, place: Place | None, element: str, value: float | str | None = None, **stated: Any
) -> Finding:
    """Build a finding of the catalogue; ``stated`` has the fields that depend on the robot."""
    layer, _, name = code.partition(".")
    fields: dict[str, Any] = {**catalogue()[layer][name], **stated}
    return Finding(code, place=place, element=element, value=value, **fields)


def _finite_or_text(value: float | str | None) -> float | str | None:
    """Replace infinity, which JSON cannot represent."""
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
    """Build the finding for a reader's error."""
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


def verdict(counts: Mapping[str, int]) -> str:
    """Return the verdict for the numbers of findings: critical, warnings or clean."""
    if counts["critical"]:
        return "critical"
    return "warnings" if counts["warning"] else "clean"


def by_id(findings: Iterable[Finding]) -> dict[str, Finding]:
    """Return unique id -> finding, sorted by severity, layer and place."""
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
    identified = {}
    for finding in ordered:
        name = f"{finding.code}:{finding.element}"
        seen[name] = seen.get(name, 0) + 1
        identified[name if seen[name] == 1 else f"{name}#{seen[name]}"] = finding
    return identified


def report_of(
    path: Path, kind: str, robot: str, findings: Iterable[Finding], layers: Sequence[str]
) -> dict[str, Any]:
    """Return the report of an audit as JSON data, without facts and what a kind of file adds.

    Args:
        path: the audited file; ``kind``: its format; ``robot``: the robot's name in it.
        layers: the audited layers.
    """
    rows = to_json(findings)

    def counts(layer: str | None = None) -> dict[str, int]:
        counts = Counter(row["severity"] for row in rows if layer in (None, row["layer"]))
        return {severity: counts[severity] for severity in SEVERITIES}

    return {
        "schema": SCHEMA,
        "asset": str(path),
        "kind": kind,
        "robot": robot,
        "verdict": verdict(counts()),
        "counts": counts(),
        "layers": {layer: counts(layer) for layer in layers},
        "findings": rows,
        "sources": [],
        "bodies": [],
        "meshes": [],
    }


def to_json(findings: Iterable[Finding]) -> list[dict[str, Any]]:
    """Return findings as JSON data, sorted by severity, layer and place, with unique ids."""
    return [finding.to_json(name) for name, finding in by_id(findings).items()]
