"""The catalogue as people read it: a card for each effect, in Markdown."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping
from typing import Any

from pytest_twin.effects.base import MODES, REFERENCES, Effect, Parameter


def cards(effects: Mapping[str, Effect]) -> str:
    """A table of all effects by where they sit, and a card for each."""
    paths: dict[str, list[Effect]] = {}
    for effect in effects.values():
        paths.setdefault(effect.path, []).append(effect)
    overview = _table(
        ("path", "effects"),
        ((path, ", ".join(f"[`{e.id}`](#{e.id})" for e in paths[path])) for path in sorted(paths)),
    )
    each = [card(e) for path in sorted(paths) for e in sorted(paths[path], key=lambda e: e.id)]
    return "\n".join([overview, *each])


def as_json(effects: Mapping[str, Effect]) -> dict[str, Any]:
    """The catalogue for programs: effect id -> what :func:`card` says of it."""
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
                    "unit": {mode: p.unit("hinge", mode) for mode in MODES},
                    "unit_of_a_slide": {mode: p.unit("slide", mode) for mode in MODES},
                    "absent_at": _absent(p) or None,
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
    """What an effect is, its law, parameters, source, and what it is confused with."""
    where = "the whole robot" if effect.scope == "robot" else "any joint"
    lines = [
        f"## {effect.id}",
        "",
        f"{_summary(effect)} *{effect.path.capitalize()}; {where}; under commands of "
        f"{_listed(effect.modes)}.*",
        "",
        *(f"    {part.strip()}" for part in effect.law.split("; ")),
        "",
        _table(
            ("parameter", "unit", "absent at", "may be"),
            ((f"`{p.reported_name}`", _unit(p), _absent(p), _range(p)) for p in effect.parameters),
        ),
    ]
    if effect.confused_with:
        told_apart = ((f"`{rival}`", by) for rival, by in effect.confused_with.items())
        lines.append(_table(("confused with", "told apart by"), told_apart))
    lines += [f"Source: {effect.source}.", ""]
    return "\n".join(lines)


def _summary(effect: Effect) -> str:
    return (inspect.getdoc(type(effect)) or "").split("\n\n")[0].replace("\n", " ")


def _unit(parameter: Parameter) -> str:
    units = {mode: _both(parameter, mode) for mode in MODES}
    if len(set(units.values())) == 1:
        return units[MODES[0]]
    return _listed([f"{unit} ({mode})" for mode, unit in units.items()])


def _both(parameter: Parameter, servo: str) -> str:
    hinge, slide = (parameter.unit(joint, servo) for joint in ("hinge", "slide"))
    return f"`{hinge}`" if hinge == slide else f"`{hinge}` or `{slide}`"


def _absent(parameter: Parameter) -> str:
    """The neutral value; a parameter without one shapes what another switches on."""
    if parameter.neutral is None:
        return ""
    value = parameter.reported(parameter.neutral)
    return "infinity" if value == float("inf") else f"{value:g}"


def _range(parameter: Parameter) -> str:
    if parameter.choice and parameter.quantity == "wavenumber":
        return f"a whole number, {parameter.lower:g} to {parameter.upper:g}"
    if parameter.choice:
        return _listed([f"{start:g}" for start in parameter.starts])
    of = REFERENCES[parameter.reference]
    scale = f" times {of}" if of else ""
    where = ""
    if parameter.under is not None:
        choice, values = parameter.under
        where = f", in {choice} {_listed([f'{value:g}' for value in values])}"
    if parameter.reciprocal_of is not None:
        return f"at least {parameter.reported(parameter.upper):.3g}{scale}{where}"
    return f"{parameter.lower:g} to {parameter.upper:g}{scale}{where}"


def _listed(words: Iterable[str]) -> str:
    *most, last = words
    return f"{', '.join(most)} or {last}" if most else last


def _table(header: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = (header, tuple("---" for _ in header), *rows)
    # A bar would end a cell.
    cells = (" | ".join(cell.replace("|", "\\|") for cell in line) for line in lines)
    return "".join(f"| {line} |\n" for line in cells)
