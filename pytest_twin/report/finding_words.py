"""Sentences about a finding: deviation, gain of the correction, alternatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pytest_twin.effects import Parameter, catalogue
from pytest_twin.report.text import number, quantity
from pytest_twin.words import capitalize_first, join_words

SURE = 0.9
"""Confidence above which no further test is recommended; less likely alternatives are not named."""
_SMALL = 0.1
"""Value in s, rad or m below which thousandths of the unit are used."""
_THOUSANDTHS = {"s": "ms", "rad": "mrad", "m": "mm"}
_PROPER_NAMES = {"coulomb": "Coulomb", "stribeck": "Stribeck"}
_REVERSED, _REVERSED_WITHIN = -2.0, 0.1
"""Relative error of a reading with the opposite sign, and the distance within which it is one."""


def finding_sentence(finding: Mapping[str, Any]) -> str:
    """Return a sentence with the quantity, the joint, the value and its 95 % interval.

    Args:
        finding: of ``diagnosis.json``.
    """
    if "law" in finding:
        words = finding["law"]["words"]
        return f"No known effect explains joint {finding['joint']}; a fitted law does: {words}."
    known = {p.reported_name: p for p in _parameters(finding["effect"])}
    values, forms = [], []
    for key, estimate in finding["parameters"].items():
        parameter = known.get(key)
        if parameter is not None and parameter.choice and parameter.choices:
            forms.append(choice_phrase(parameter, estimate["value"]))
        else:
            values.append((_meaning(key, parameter), _amount(estimate, parameter)))
    form = f" ({', '.join(forms)})" if forms else ""
    of = "" if finding["joint"] is None else f" of joint {finding['joint']}"
    if len(values) == 1:
        ((meaning, amount),) = values
        return f"The {meaning}{form}{of} is {amount}."
    listed = ", ".join(f"{meaning} {amount}" for meaning, amount in values)
    name = place(finding)
    return f"{capitalize_first(name)}{form}: {listed}."


def gain(finding: Mapping[str, Any], *, held_out: bool) -> str:
    """Return the change of the remaining squared error by the correction, as text."""
    share = finding["held_out_gain"]
    verb = "adds {} to" if share < 0.0 else "removes {} of"
    error = "held-out" if held_out else "fitted"
    return f"{verb.format(percent(abs(share)))} the remaining squared {error} error"


def ambiguity_sentence(finding: Mapping[str, Any]) -> str:
    """Return a sentence with the names between which the recordings cannot decide, or ""."""
    stated = finding.get("not_separated")
    if stated is None:
        return ""
    names = [f"{one['name']} ({percent(one['confidence'])})" for one in stated["names"]]
    return f"These recordings do not separate {join_words(names)}."


def to_confirm(finding: Mapping[str, Any]) -> str:
    """Return a sentence with the next recording to make."""
    test = str(finding["next_test"])
    # A full stop after a command would be copied with it.
    is_complete = test.endswith(".") or "command" in finding.get("not_separated", {})
    return f"To confirm: {test}{'' if is_complete else '.'}"


def place(item: Mapping[str, Any]) -> str:
    """Return effect and joint of a finding or an alternative: ``command delay at joint elbow``."""
    words = (_PROPER_NAMES.get(word, word) for word in str(item["effect"]).split("_"))
    name = " ".join(words)
    if "variable" in item:
        name += f" over {item['variable']}, {item['acts']},"
    return name if item["joint"] is None else f"{name} at joint {item['joint']}"


def place_of_set(item: Mapping[str, Any]) -> str:
    """Return all effects of an alternative and the findings that it replaces."""
    names = [place(item), *(place(other) for other in item.get("together_with", ()))]
    replaced = [place(other) for other in item.get("instead_of", ())]
    instead = f" instead of {join_words(replaced)}" if replaced else ""
    return f"{join_words(names)}{instead}"


def table_row(finding: Mapping[str, Any], key: str) -> tuple[str, str, str]:
    """Return (meaning, value, 95 % interval) of one parameter, for a table."""
    known = {p.reported_name: p for p in _parameters(finding["effect"])}
    parameter, estimate = known.get(key), finding["parameters"][key]
    meaning = _meaning(key, parameter)
    if parameter is not None and parameter.choice and parameter.choices:
        return meaning, choice_phrase(parameter, estimate["value"]), ""
    value, interval = _value_and_interval(estimate, parameter)
    return meaning, value, interval


def meaning_of(effect: str, key: str) -> str:
    """Return the meaning of a parameter of ``diagnosis.json``, such as ``servo stiffness``."""
    return _meaning(key, {p.reported_name: p for p in _parameters(effect)}.get(key))


def beside_the_model(effect: str, key: str, value: float, unit: str) -> str:
    """Return a value beside the model: ``0.41 N*m``, or ``85 % of the model's``."""
    parameter = {p.reported_name: p for p in _parameters(effect)}.get(key)
    if parameter is not None and parameter.relation == "relative":
        return f"{percent(1.0 + value)} of the model's"
    return quantity(value, unit)


def readable_unit(value: float, unit: str) -> tuple[float, str]:
    """Return factor and unit for a readable value: 0.012 s as 12 ms."""
    if unit in _THOUSANDTHS and 0.0 < abs(value) < _SMALL:
        return 1e3, _THOUSANDTHS[unit]
    return 1.0, unit


def percent(share: float) -> str:
    """Format a share with three significant digits, ``96.5 %``."""
    return f"{100 * share:.3g} %"


def choice_phrase(parameter: Parameter, value: float) -> str:
    """Return the phrase of a choice's value, or the value itself."""
    for start, words in zip(parameter.starts, parameter.choices, strict=True):
        if start == value:
            return words
    return number(value)


def _parameters(effect: str) -> Sequence[Parameter]:
    # The diagnosis may name an effect that is not installed in this environment.
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
    """Return the value relative to the model's, and the interval; empty for a discrete value."""
    value, unit, (low, high) = estimate["value"], estimate["unit"], estimate["ci95"]
    relation = "" if parameter is None else parameter.relation
    side = f" {'below' if value < 0.0 else 'above'} the model's" if relation else ""
    if relation == "relative":
        factor, unit = 100.0, "%"
    else:
        factor, unit = readable_unit(value, unit)
    shown = factor * (abs(value) if relation else value)
    text = f"{number(shown)}{'' if unit == '1' else f' {unit}'}{side}"
    if relation == "relative" and abs(value - _REVERSED) < _REVERSED_WITHIN:
        text += ": its sign is reversed, so compare the direction in the recording and the model"
    if low == high:
        return text, ""
    low, high = factor * low, factor * high
    if relation and low < 0.0 < high:
        return text, f"{number(-low)} below to {number(high)} above"
    if relation:
        low, high = sorted((abs(low), abs(high)))
    return text, f"{number(low)} to {number(high)}"
