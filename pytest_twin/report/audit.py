"""Format the findings of an audit as text for the terminal and as an HTML page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pytest_twin.report.page import Page
from pytest_twin.report.text import number, printable
from pytest_twin.words import counted

MARKS: Mapping[str, str] = {"critical": "X", "warning": "!", "unknown": "?", "info": "."}
"""Mark of each severity, most severe first."""
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
    "planning": "Planning groups, poses and disabled pairs",
    "simready": "SimReady profile",
}
MAX_ROWS = 200
"""Largest number of findings of one kind on the page; the JSON file has all."""
_NAMES = 4
"""Largest number of names in a line."""
_CRITICAL = 5
"""Largest number of critical findings of one kind in the terminal."""


@dataclass(frozen=True, slots=True)
class Group:
    """Findings of one kind and severity."""

    code: str
    severity: str
    findings: tuple[Mapping[str, Any], ...]

    @property
    def first(self) -> Mapping[str, Any]:
        """Return the first finding."""
        return self.findings[0]

    @property
    def elements(self) -> str:
        """Return the names of the affected elements."""
        names = list(dict.fromkeys(str(row["element"]) for row in self.findings))
        more = f" and {len(names) - _NAMES} more" if len(names) > _NAMES else ""
        return ", ".join(names[:_NAMES]) + more


def groups(findings: Iterable[Mapping[str, Any]]) -> list[Group]:
    """Group findings by code and severity, most severe first."""
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
    """Return text for the terminal: critical findings, warnings, and unstated properties.

    Critical findings are printed in full, warnings by kind, and unstated properties by the source
    that resolves them. With ``every``, all findings are printed in full.
    """
    lines = [headline(audit)]
    for group in groups(audit["findings"]):
        if every:
            lines += ["", *(line for row in group.findings for line in _full(row))]
        elif group.severity == "critical":
            lines.append("")
            for row in group.findings[:_CRITICAL]:
                lines += _full(row)
            if len(group.findings) > _CRITICAL:
                lines.append(f"    and {len(group.findings) - _CRITICAL} more {group.code}")
        elif group.severity == "warning":
            lines += ["", *_kind(group)]
    if not every:
        lines += _not_stated(audit)
    lines += ["", *_layers(audit), "", summary(audit)]
    return "\n".join(printable(line) for line in lines)


def summary(audit: Mapping[str, Any]) -> str:
    """Return a line with the content of the file."""
    facts = audit["facts"]
    if audit["kind"] == "srdf":
        return (
            f"{counted(facts['groups'], 'group')}, {counted(facts['states'], 'state')}, "
            f"{counted(facts['end_effectors'], 'end effector')}, "
            f"{counted(facts['disabled_pairs'], 'disabled pair')}"
        )
    removed = facts["constrained"]
    by = f", {removed} removed by closed chains and other constraints" if removed else ""
    return (
        f"{facts['bodies']} bodies, {facts['joints']} joints, "
        f"{facts['degrees_of_freedom']} degrees of freedom "
        f"({facts['independent']} independent{by}), "
        f"{number(facts['mass']['value'])} kg"
    )


def _kind(group: Group) -> list[str]:
    """Return lines on a kind of finding: title, count, first place and next step."""
    first = group.first
    if len(group.findings) == 1:
        return _full(first)
    lines = [f"{MARKS[group.severity]} {group.code} ({len(group.findings)}): {first['title']}"]
    lines.append(f"    {group.elements}")
    lines.append(f"    first: {place(first)}" + (f"; got {value(first)}" if value(first) else ""))
    if first["expected"]:
        lines[-1] += f"; expected {first['expected']}"
    if first["settle"]:
        lines.append(f"    next: {first['settle']}")
    return lines


def _not_stated(audit: Mapping[str, Any]) -> list[str]:
    """Return lines on properties that the file does not state, by the source that resolves them."""
    sources = audit["sources"]
    if not sources:
        return []
    total = audit["counts"]["unknown"]
    lines = [
        "",
        f"{total} properties are not stated in the file (--all lists each). Their sources:",
    ]
    for source in sources:
        count = source["count"]
        lines.append(f"{MARKS['unknown']} {count:>4}  {source['what']}")
        codes = ", ".join(f"{code} ({many})" for code, many in source["codes"].items())
        lines.append(f"        {codes}")
        lines.append(f"        next: {source['next_step']}")
    return lines


def _layers(audit: Mapping[str, Any]) -> list[str]:
    """Return a line for each layer, with a column for each severity."""
    width = max(len(layer) for layer in audit["layers"])
    lines = [" " * width + "".join(f"{severity:>10}" for severity in MARKS)]
    for layer, counts in audit["layers"].items():
        cells = "".join(f"{counts[severity] or '-':>10}" for severity in MARKS)
        lines.append(f"{layer:<{width}}{cells}")
    return lines


def headline(audit: Mapping[str, Any]) -> str:
    """Return a line with the verdict and the counts."""
    counts = audit["counts"]
    verdict = {"critical": "CRITICAL"}.get(audit["verdict"], audit["verdict"])
    return f"{audit['asset']}: {verdict}: " + ", ".join(
        f"{counts[severity]} {severity}" for severity in MARKS
    )


def place(row: Mapping[str, Any]) -> str:
    """Return file name and line."""
    if row["file"] is None:
        return ""
    name = Path(str(row["file"])).name
    return name if row["line"] is None else f"{name}:{row['line']}"


def value(row: Mapping[str, Any]) -> str:
    """Return the value with its unit."""
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
        lines.append(f"    next: {row['settle']}")
    return lines


def render(audit: Mapping[str, Any], renders: Sequence[Mapping[str, str]]) -> str:
    """Return the audit as an HTML page.

    Args:
        audit: content of the JSON file.
        renders: ``title``, ``caption`` and ``png`` (base64) of each picture.
    """
    kinds = groups(audit["findings"])
    unknown = [kind for kind in kinds if kind.severity == "unknown"]
    sources = [
        (source, [kind for kind in unknown if kind.code in source["codes"]])
        for source in audit["sources"]
    ]
    return _PAGE.render(
        audit=audit,
        # Layers of installed packages have no title of ours.
        layers=[
            (name, _TITLES.get(name) or name.replace("_", " ").capitalize())
            for name in audit["layers"]
        ],
        faults=[kind for kind in kinds if kind.severity in ("critical", "warning")],
        sources=sources,
        facts=[kind for kind in kinds if kind.severity == "info"],
        marks=MARKS,
        renders=renders,
        file=Path(str(audit["asset"])).name,
        summary=summary(audit),
        max_rows=MAX_ROWS,
    )


_PAGE = Page("audit.html.j2", "audit.css", number=number, place=place, value=value)
