"""Format the catalogue of effects as Markdown: an overview and a card for each effect."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Iterable, Mapping
from typing import Any

from pytest_twin.effects.base import MODES, REFERENCES, Effect, Parameter
from pytest_twin.words import capitalize_first


def cards(effects: Mapping[str, Effect]) -> str:
    """Return Markdown of all effects: a table by position in the signal path, then their cards."""
    paths: dict[str, list[Effect]] = {}
    for effect in effects.values():
        paths.setdefault(effect.path, []).append(effect)
    overview = _table(
        ("part", "effects"),
        ((path, ", ".join(f"[`{e.id}`](#{e.id})" for e in paths[path])) for path in sorted(paths)),
    )
    each = [card(e) for path in sorted(paths) for e in sorted(paths[path], key=lambda e: e.id)]
    return "\n".join([overview, *each])


def as_json(effects: Mapping[str, Effect]) -> dict[str, Any]:
    """Return the catalogue as JSON: effect id -> content of its :func:`card`."""
    return {
        effect.id: {
            "family": effect.family,
            "path": effect.path,
            "scope": effect.scope,
            "summary": _summary(effect),
            "law": effect.law,
            "command_modes": list(effect.modes),
            "parameters": {
                p.reported_name: {
                    "meaning": _describe_parameter(p),
                    "unit": {mode: p.unit("hinge", mode) for mode in MODES},
                    "unit_of_a_slide": {mode: p.unit("slide", mode) for mode in MODES},
                    "absent_at": _neutral_value(p) or None,
                    "range": _range(p),
                }
                for p in effect.parameters
            },
            "confused_with": dict(effect.confused_with),
            "source": effect.source,
        }
        for effect in effects.values()
    }


def card(effect: Effect) -> str:
    """Return Markdown of one effect: law, parameters, confused effects with their tests, source."""
    where = "the whole robot" if effect.scope == "robot" else "one joint"
    lines = [
        f"## {effect.id}",
        "",
        f"{_summary(effect)} *Part: {effect.path}. Acts on {where}. Command modes: "
        f"{', '.join(effect.modes)}.*",
        "",
        *(f"    {part.strip()}" for part in effect.law.split("; ")),
        "",
        _table(
            ("parameter", "meaning", "unit", "absent at", "range of the fit"),
            (
                (_names(same), *shown)
                for shown, same in itertools.groupby(effect.parameters, _parameter_columns)
            ),
        ),
    ]
    if effect.confused_with:
        tests = (
            (f"`{rival}`", f"{capitalize_first(test)}.")
            for rival, test in effect.confused_with.items()
        )
        lines.append(_table(("confused with", "test that separates them"), tests))
    lines += [f"Source: {effect.source}.", ""]
    return "\n".join(lines)


def description(effect: Effect) -> str:
    """Return the content of a :func:`card` as plain text for a terminal."""
    where = "the whole robot" if effect.scope == "robot" else "one joint"
    lines = [
        f"{effect.id}: {_summary(effect)}",
        f"part: {effect.path}; acts on {where}; command modes: {', '.join(effect.modes)}",
        "law:",
        *(f"  {part.strip()}" for part in effect.law.split("; ")),
        "parameters:",
    ]
    for (meaning, unit, neutral, limits), same in itertools.groupby(
        effect.parameters, _parameter_columns
    ):
        absent = f"absent at {neutral}; " * bool(neutral)
        lines.append(f"  {_names(same)} [{unit}]: {meaning}; {absent}fitted within: {limits}")
    if effect.confused_with:
        lines.append("confused with, and the test that separates them:")
        lines += [f"  {rival}: {test}" for rival, test in effect.confused_with.items()]
    return "\n".join([*lines, f"source: {effect.source}"]).replace("`", "")


def _parameter_columns(parameter: Parameter) -> tuple[str, str, str, str]:
    """Return meaning, unit, neutral value and range of a parameter."""
    return (
        _describe_parameter(parameter),
        _unit(parameter),
        _neutral_value(parameter),
        _range(parameter),
    )


def _names(parameters: Iterable[Parameter]) -> str:
    """Return names of parameters with equal meaning, such as knots of a table: first and last."""
    first, *others = (f"`{p.reported_name}`" for p in parameters)
    return f"{first} to {others[-1]}" if others else first


def _summary(effect: Effect) -> str:
    return (inspect.getdoc(type(effect)) or "").split("\n\n")[0].replace("\n", " ")


def _describe_parameter(parameter: Parameter) -> str:
    meaning = parameter.meaning or parameter.reported_name.replace("_", " ")
    if parameter.relation == "relative":
        return f"relative error of: {meaning}"
    return f"{meaning}, added to the model's" if parameter.relation == "added" else meaning


def _unit(parameter: Parameter) -> str:
    units = {mode: _units_of_joint_types(parameter, mode) for mode in MODES}
    if len(set(units.values())) == 1:
        return units[MODES[0]]
    return _listed([f"{unit} ({mode})" for mode, unit in units.items()])


def _units_of_joint_types(parameter: Parameter, servo: str) -> str:
    hinge, slide = (parameter.unit(joint, servo) for joint in ("hinge", "slide"))
    return f"`{hinge}`" if hinge == slide else f"`{hinge}` or `{slide}`"


def _neutral_value(parameter: Parameter) -> str:
    """Return the neutral value; empty if the parameter only shapes the effect."""
    if parameter.neutral is None:
        return ""
    value = parameter.reported(parameter.neutral)
    return "infinity" if value == float("inf") else f"{value:g}"


def _range(parameter: Parameter) -> str:
    if parameter.choice and parameter.quantity == "wavenumber":
        return f"integer, {parameter.lower:g} to {parameter.upper:g}"
    if parameter.choice and parameter.choices:
        pairs = zip(parameter.starts, parameter.choices, strict=True)
        return "; ".join(f"{value:g}: {words}" for value, words in pairs)
    if parameter.choice:
        return _listed([f"{start:g}" for start in parameter.starts])
    of = REFERENCES[parameter.reference]
    scale = f" {of[2:]}" if of.startswith("1 ") else f" times {of}" if of else ""
    where = ""
    if parameter.under is not None:
        choice, values = parameter.under
        where = f", only with `{choice}` {_listed([f'{value:g}' for value in values])}"
    if parameter.reciprocal_of is not None:
        return f"at least {parameter.reported(parameter.upper):.3g}{scale}{where}"
    return f"{parameter.lower:g} to {parameter.upper:g}{scale}{where}"


def _listed(words: Iterable[str]) -> str:
    *most, last = words
    return f"{', '.join(most)} or {last}" if most else last


def _table(header: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = (header, tuple("---" for _ in header), *rows)
    # A vertical bar would end a table cell.
    cells = (" | ".join(cell.replace("|", "\\|") for cell in line) for line in lines)
    return "".join(f"| {line} |\n" for line in cells)
