"""What an audit found: a table for the terminal and a page that needs nothing but itself."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from pytest_twin.report.text import number, printable

MARKS: Mapping[str, str] = {"critical": "X", "warning": "!", "unknown": "?", "info": "."}
"""By severity, the gravest first."""
_TITLES: Mapping[str, str] = {
    "tree": "Tree",
    "joints": "Joints",
    "coupling": "Coupling",
    "transmissions": "Transmissions and hardware interfaces",
    "meshes": "Visual and collision shapes",
    "inertia": "Mass and inertia",
    "frames": "Frames",
    "commands": "Command semantics",
    "controllers": "Controllers and sensors",
}
MAX_ROWS = 200
"""Findings of one kind that the page lists; all are in the JSON."""
_NAMES = 4
_CRITICAL = 5


@dataclass(frozen=True, slots=True)
class Group:
    """Findings of one kind and severity."""

    code: str
    severity: str
    findings: tuple[Mapping[str, Any], ...]

    @property
    def first(self) -> Mapping[str, Any]:
        """The first of them."""
        return self.findings[0]

    @property
    def elements(self) -> str:
        """Whom it concerns."""
        names = list(dict.fromkeys(str(row["element"]) for row in self.findings))
        more = f" and {len(names) - _NAMES} more" if len(names) > _NAMES else ""
        return ", ".join(names[:_NAMES]) + more


def groups(findings: Iterable[Mapping[str, Any]]) -> list[Group]:
    """Findings of the same code and severity together, the gravest first."""
    found: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in findings:
        found.setdefault((str(row["severity"]), str(row["code"])), []).append(row)
    order = list(MARKS)
    return [
        Group(code, severity, tuple(rows))
        for (severity, code), rows in sorted(
            found.items(), key=lambda item: order.index(item[0][0])
        )
    ]


def table(audit: Mapping[str, Any], *, every: bool = False) -> str:
    """What a terminal shows: layers and counts, what is critical in full, the rest by kind.

    ``every`` finding in full, where asked for.
    """
    lines = [headline(audit), "", *_layers(audit), ""]
    for group in groups(audit["findings"]):
        if group.severity == "info" and not every:
            continue
        if every or group.severity == "critical":
            shown = group.findings if every else group.findings[:_CRITICAL]
            for row in shown:
                lines += _full(row)
            if len(shown) < len(group.findings):
                lines.append(f"    and {len(group.findings) - len(shown)} more {group.code}")
        else:
            count = f" ({len(group.findings)})" if len(group.findings) > 1 else ""
            lines.append(f"{MARKS[group.severity]} {group.code}{count}: {group.first['title']}")
            lines.append(f"    {group.elements}")
    facts = audit["facts"]
    lines += [
        "",
        f"{facts['bodies']} bodies, {facts['joints']} joints, "
        f"{facts['degrees_of_freedom']} degrees of freedom, {facts['independent']} independent, "
        f"{number(facts['mass']['value'])} kg",
    ]
    return "\n".join(printable(line) for line in lines)


def _layers(audit: Mapping[str, Any]) -> list[str]:
    """One line for each layer, one column for each severity."""
    width = max(len(layer) for layer in audit["layers"])
    lines = [" " * width + "".join(f"{severity:>10}" for severity in MARKS)]
    for layer, counts in audit["layers"].items():
        cells = "".join(f"{counts[severity] or '-':>10}" for severity in MARKS)
        lines.append(f"{layer:<{width}}{cells}")
    return lines


def headline(audit: Mapping[str, Any]) -> str:
    """One line: the verdict and the counts."""
    counts = audit["counts"]
    said = "CRITICAL" if counts["critical"] else "clean"
    return f"{audit['asset']}: {said}: " + ", ".join(
        f"{counts[severity]} {severity}" for severity in MARKS
    )


def place(row: Mapping[str, Any]) -> str:
    """File and line, short."""
    if row["file"] is None:
        return ""
    name = Path(str(row["file"])).name
    return name if row["line"] is None else f"{name}:{row['line']}"


def value(row: Mapping[str, Any]) -> str:
    """Value with its unit."""
    found, unit = row["value"], row["unit"]
    if found is None:
        return ""
    text = number(float(found)) if isinstance(found, int | float) else str(found)
    return text if unit in (None, "1") else f"{text} {unit}"


def _full(row: Mapping[str, Any]) -> list[str]:
    lines = [f"{MARKS[str(row['severity'])]} {row['code']}: {row['element']}: {row['title']}"]
    details = [place(row)]
    if row["value"] is not None:
        details.append(f"got {value(row)}")
    if row["expected"]:
        details.append(f"expected {row['expected']}")
    lines.append("    " + "; ".join(detail for detail in details if detail))
    if row["settle"]:
        lines.append(f"    settled by {row['settle']}")
    return lines


def render(audit: Mapping[str, Any], renders: Sequence[Mapping[str, str]]) -> str:
    """The page.

    Args:
        audit: what stands in the JSON.
        renders: ``title``, ``caption`` and ``png`` (base64) of each picture.
    """
    folder = resources.files(__package__)
    style = folder.joinpath("report.css").read_text("utf-8")
    style += folder.joinpath("audit.css").read_text("utf-8")
    style_hash = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    by_layer: dict[str, list[Group]] = {layer: [] for layer in audit["layers"]}
    for group in groups(audit["findings"]):
        by_layer[str(group.first["layer"])].append(group)
    return _template().render(
        audit=audit,
        good=not audit["counts"]["critical"],
        style=style,
        style_hash=style_hash,
        layers=[(name, _TITLES[name], by_layer[name]) for name in by_layer],
        titles=_TITLES,
        marks=MARKS,
        renders=renders,
        file=Path(str(audit["asset"])).name,
        max_rows=MAX_ROWS,
    )


def _printable(found: object) -> object:
    return printable(found) if type(found) is str else found


@cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_printable,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.PackageLoader("pytest_twin.report", "."),
    )
    environment.filters.update(number=number, place=place, value=value)
    return environment.get_template("audit.html.j2")
