"""Sentences about a finding: what is wrong, what the correction gains, what else it may be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pytest_twin.effects import Parameter, catalogue
from pytest_twin.report.text import number

SURE = 0.9
"""Confidence from which no further test is asked for; a rival above the rest of it is named."""
_SMALL = 0.1
"""s, rad or m below which a thousandth of the unit reads better."""
_THOUSANDTHS = {"s": "ms", "rad": "mrad", "m": "mm"}
_PROPER_NAMES = {"coulomb": "Coulomb", "stribeck": "Stribeck"}


def finding_sentence(finding: Mapping[str, Any]) -> str:
    """One sentence: which quantity of which joint, how much, and its 95 % interval.

    Args:
        finding: of ``diagnosis.json``.
    """
    if "law" in finding:
        return law_sentence(finding)
    known = {p.reported_name: p for p in _parameters(finding["effect"])}
    values, forms = [], []
    for key, estimate in finding["parameters"].items():
        parameter = known.get(key)
        if parameter is not None and parameter.choice and parameter.choices:
            forms.append(chosen(parameter, estimate["value"]))
        else:
            values.append((_meaning(key, parameter), _amount(estimate, parameter)))
    form = f" ({', '.join(forms)})" if forms else ""
    of = "" if finding["joint"] is None else f" of joint {finding['joint']}"
    if len(values) == 1:
        ((meaning, amount),) = values
        return f"The {meaning}{form}{of} is {amount}."
    listed = ", ".join(f"{meaning} {amount}" for meaning, amount in values)
    name = place(finding)
    return f"{name[:1].upper()}{name[1:]}{form}: {listed}."


def law_sentence(finding: Mapping[str, Any]) -> str:
    """What a law without a name does, and the known effect of the same shape, if there is one."""
    law = finding["law"]
    text = f"No known effect explains joint {finding['joint']}; a fitted law does: {law['words']}"
    if law["resembles"] is None:
        return f"{text}."
    return f"{text}. It has the shape of {place({'effect': law['resembles'], 'joint': None})}."


def gain(finding: Mapping[str, Any], *, held_out: bool) -> str:
    """What the correction does to the squared error that the other findings leave."""
    share = finding["held_out_gain"]
    verb = "adds {} to" if share < 0.0 else "removes {} of"
    error = "held-out" if held_out else "fitted"
    return f"{verb.format(percent(abs(share)))} the remaining squared {error} error"


def ambiguous(finding: Mapping[str, Any]) -> str:
    """The effects that the recordings do not separate from a finding; empty without any."""
    rivals = [a for a in finding["alternatives"] if a["confidence"] >= 1.0 - SURE]
    listed = " or ".join(f"{place_of_set(a)} ({percent(a['confidence'])})" for a in rivals)
    return f"Ambiguous: it may also be {listed}." if listed else ""


def to_confirm(finding: Mapping[str, Any]) -> str:
    """The next recording to make, as a sentence."""
    test = str(finding["next_test"])
    return f"To confirm: {test}{'' if test.endswith('.') else '.'}"


def place(item: Mapping[str, Any]) -> str:
    """Effect and joint of a finding or an alternative, ``command delay at joint elbow``."""
    words = (_PROPER_NAMES.get(word, word) for word in str(item["effect"]).split("_"))
    name = " ".join(words)
    if "variable" in item:
        name += f" over {item['variable']}, {item['acts']},"
    return name if item["joint"] is None else f"{name} at joint {item['joint']}"


def place_of_set(item: Mapping[str, Any]) -> str:
    """All effects of an alternative and, of a set, the findings that it replaces."""
    names = [place(item), *(place(other) for other in item.get("together_with", ()))]
    replaced = [place(other) for other in item.get("instead_of", ())]
    instead = f" instead of {_listed(replaced)}" if replaced else ""
    return f"{_listed(names)}{instead}"


def _listed(names: Sequence[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last


def table_row(finding: Mapping[str, Any], key: str) -> tuple[str, str, str]:
    """(meaning, value, 95 % interval) of one parameter for a table."""
    known = {p.reported_name: p for p in _parameters(finding["effect"])}
    parameter, estimate = known.get(key), finding["parameters"][key]
    meaning = _meaning(key, parameter)
    if parameter is not None and parameter.choice and parameter.choices:
        return meaning, chosen(parameter, estimate["value"]), ""
    value, interval = _value_and_interval(estimate, parameter)
    return meaning, value, interval


def meaning_of(effect: str, key: str) -> str:
    """What a parameter of ``diagnosis.json`` is, ``servo stiffness``."""
    return _meaning(key, {p.reported_name: p for p in _parameters(effect)}.get(key))


def readable(value: float, unit: str) -> tuple[float, str]:
    """Factor and unit in which a value reads well: 0.012 s as 12 ms."""
    if unit in _THOUSANDTHS and 0.0 < abs(value) < _SMALL:
        return 1e3, _THOUSANDTHS[unit]
    return 1.0, unit


def percent(share: float) -> str:
    """Three significant digits, ``96.5 %``."""
    return f"{100 * share:.3g} %"


def chosen(parameter: Parameter, value: float) -> str:
    """The phrase of a choice's value, the value itself where it has none."""
    for start, words in zip(parameter.starts, parameter.choices, strict=True):
        if start == value:
            return words
    return number(value)


def _parameters(effect: str) -> Sequence[Parameter]:
    # A diagnosis of another environment may name an effect that is not installed here.
    known = catalogue().get(effect)
    return () if known is None else known.parameters


def _meaning(key: str, parameter: Parameter | None) -> str:
    return key.replace("_", " ") if parameter is None or not parameter.meaning else (
        parameter.meaning
    )  # fmt: skip


def _amount(estimate: Mapping[str, Any], parameter: Parameter | None) -> str:
    value, interval = _value_and_interval(estimate, parameter)
    return f"{value} (95 % interval {interval})" if interval else value


def _value_and_interval(
    estimate: Mapping[str, Any], parameter: Parameter | None
) -> tuple[str, str]:
    """The value in relation to the model's own, and the interval; empty for a discrete value."""
    value, unit, (low, high) = estimate["value"], estimate["unit"], estimate["ci95"]
    relation = "" if parameter is None else parameter.relation
    side = f" {'below' if value < 0.0 else 'above'} the model's" if relation else ""
    if relation == "relative":
        factor, unit = 100.0, "%"
    else:
        factor, unit = readable(value, unit)
    shown = factor * (abs(value) if relation else value)
    text = f"{number(shown)}{'' if unit == '1' else f' {unit}'}{side}"
    if low == high:
        return text, ""
    return text, f"{number(factor * low)} to {number(factor * high)}"
