"""Write what changed since earlier recordings, as text for the terminal and as an HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pytest_twin.report.change_plots import difference_figure
from pytest_twin.report.diagnosis import spans_in_words
from pytest_twin.report.finding_words import (
    SURE,
    ambiguity_sentence,
    beside_the_model,
    meaning_of,
    percent,
    place,
    place_of_set,
    to_confirm,
)
from pytest_twin.report.page import Page, svg_uri
from pytest_twin.report.text import number, quantity
from pytest_twin.words import capitalize_first, list_names

_VERDICT = {
    "no_change": "Nothing changed that these recordings show",
    "changed": "Changed: {}",
    "changed_unnamed": "Changed, and no single law of the catalogue explains it",
}
_AS_USUAL = 1.5
"""RMS residual, relative to the usual one, up to which it is no sign of a further change: both are
estimates."""
_LIKELIER_THAN_ALL_OTHERS = 0.5
"""Probability above which a name is likelier than all others together."""
_MOST_NAMES = 6
"""Largest number of recordings that are named at the top of the page."""
_MOOD = {"no_change": "good", "changed": "bad", "changed_unnamed": "bad"}


def words(document: Mapping[str, Any]) -> list[str]:
    """Return lines for a terminal.

    Args:
        document: content of ``diagnosis.json`` of ``diagnose --before``.
    """
    lines = [headline(document), *(f"  {line}" for line in _undecided(document))]
    lines.append(f"  {alarm_sentence(document)}")
    for finding in document["findings"]:
        lines += [f"  {line}" for line in _before_and_after(finding)]
        lines.append(f"    Confidence: {percent(finding['confidence'])}. {_gain(finding)}")
        if rivals := ambiguity_sentence(finding):
            lines += [f"    {rivals}", f"    {to_confirm(finding)}"]
    lines += [f"  {line}" for line in _declared(document)]
    lines += [f"  {line}" for line in _repeated(document)]
    lines += [f"  {line}" for line in _undone(document)]
    signal, errors = _residuals(document)
    lines.append(f"  RMS residual of the {signal}, usual, now, and with the changes:")
    width = max(len(joint) for joint in errors)
    for joint, error in errors.items():
        usual, before, after = _errors(error)
        lines.append(f"    {joint:<{width}}  {usual}, {before}, {after}")
    lines += [f"  {line}" for line in model_lines(document)]
    lines += [f"  Note: {note}" for note in document["notes"]]
    return lines


def _undecided(document: Mapping[str, Any]) -> list[str]:
    """Return lines with the likeliest laws where none is named, and how to decide."""
    candidates = _candidates(document)
    if not candidates:
        return []
    laws = ", ".join(f"{name} ({share})" for name, share in candidates)
    return [f"Likeliest laws: {laws}.", *_what_is_open(document)]


def _what_is_open(document: Mapping[str, Any]) -> list[str]:
    """Return sentences on what the likeliest law leaves, and how to decide."""
    lines = []
    if (document.get("explained") or 0.0) < SURE:
        lines.append(
            f"The first explains {percent(document['explained'])} of what is new where it acts: "
            "it is not the law, or not the only one."
        )
    if "next_test" in document:
        lines.append(f"To decide: {document['next_test']}")
    return lines


def _candidates(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return names and probabilities of the likeliest laws where none is named."""
    return [
        (
            place_of_set(one) if one["motor"] is None else f"{place(one)} {_where(one)}",
            percent(one["confidence"]),
        )
        for one in document.get("candidates", [])
    ]


def _where(place: Mapping[str, Any]) -> str:
    """Return the joint, the motor type or the robot, with its preposition."""
    if place["motor"] is not None:
        return f"in all motors of the type {place['motor']}"
    return "in the whole robot" if place["joint"] is None else f"at joint {place['joint']}"


def model_lines(document: Mapping[str, Any]) -> list[str]:
    """Return a line for each part of the model that changed since the release."""
    return [
        f"Changed in the model since the release: {change['part']}"
        + (
            ""
            if change["share"] is None
            else f"; its released value removes {percent(change['share'])} of the squared error "
            "that the model has gained in the earlier recordings"
        )
        for change in document["model_changes"]
    ]


def _declared(document: Mapping[str, Any]) -> list[str]:
    """Return a line for each declared difference."""
    return [
        f"Declared: {each['what']} {_stated(each['before'])} before, {_stated(each['now'])} now; "
        f"{'it is in the model' if each['in_model'] else 'no value for the model is stated'}"
        for each in document.get("declared", [])
    ]


def _stated(values: Sequence[str]) -> str:
    """Return declared values: names, or the range of numbers."""
    try:
        numbers = [float(value) for value in values]
    except ValueError:
        return list_names(values)
    low, high = number(min(numbers)), number(max(numbers))
    return low if low == high else f"{low} to {high}"


def _repeated(document: Mapping[str, Any]) -> list[str]:
    """Return a line for each repeated motion, with the joint that differs most."""
    lines = []
    for motion in document.get("repeated", []):
        joint, most = max(motion["difference"].items(), key=lambda item: float(item[1]["rms"]))
        line = (
            f"{motion['new']} repeats {list_names(motion['before'])}: positions differ by "
            f"{quantity(most['rms'], most['unit'])} RMS at {joint}"
        )
        if most["rms_after"] is not None:
            line += f"; {quantity(most['rms_after'], most['unit'])} with the changes"
        lines.append(line)
    return lines


def _undone(document: Mapping[str, Any]) -> list[str]:
    """Return the errors of the earlier recordings with the changes undone; none without changes."""
    counterfactual = document.get("counterfactual")
    if counterfactual is None or not document["findings"]:
        return []
    joint, errors = max(
        counterfactual["joints"].items(), key=lambda item: abs(item[1]["rms_changed"])
    )
    known, undone, changed = (
        quantity(errors[key], errors["unit"]) for key in ("rms_known", "rms_undone", "rms_changed")
    )
    verdict = (
        "as before"
        if counterfactual["holds"]
        else f"not as before ({known}): do not use this model"
    )
    return [
        f"With the changes undone, the earlier recordings are predicted {verdict}: {undone} RMS at "
        f"{joint}; with the changes {changed}"
    ]


def headline(document: Mapping[str, Any]) -> str:
    """Return the verdict as a sentence."""
    names = "; ".join(_likeliest_names(document["findings"]))
    text = _VERDICT[document["verdict"]].format(names)
    likeliest = next(iter(document.get("places", [])), None)
    if likeliest is not None and likeliest["confidence"] > _LIKELIER_THAN_ALL_OTHERS:
        probably = "" if likeliest["confidence"] >= SURE else "probably "
        share = percent(likeliest["confidence"])
        text = f"Changed {probably}{_where(likeliest)} ({share}); the law is not decided"
    larger = _larger(document)
    if document["findings"] and not larger:
        text += "; everything else as before"
    if document["verdict"] == "no_change" and larger:
        text = f"No significant change, but a larger error than before at {list_names(larger)}"
    return text


def _larger(document: Mapping[str, Any]) -> list[str]:
    """Joints whose residual is larger than before, with the changes."""
    return [joint for joint, error in _residuals(document)[1].items() if not _is_usual(error)]


def _likeliest_names(findings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the likeliest name for each finding: its own, or that of a likelier alternative.

    A search keeps the law that predicts best, and a law that is much likelier may predict as well.
    One alternative may explain several findings. Its name is then given once, and the findings that
    it explains are left out.
    """
    likelier = [_likelier(finding) for finding in findings]
    replaced = [
        (other["effect"], other["joint"])
        for one in likelier if one is not None
        for other in one.get("instead_of", ())
    ]  # fmt: skip
    names = [
        _from_to(finding)
        if one is None
        else f"{_with_doubt(place_of_set(one), one['confidence'])} ({percent(one['confidence'])})"
        for finding, one in zip(findings, likelier, strict=True)
        if one is not None or (finding["effect"], finding["joint"]) not in replaced
    ]
    return list(dict.fromkeys(names))


def _likelier(finding: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the likeliest alternative if it is likelier than the finding."""
    best = max(
        finding.get("alternatives", ()), key=lambda one: float(one["confidence"]), default=None
    )
    return best if best is not None and best["confidence"] > finding["confidence"] else None


def _with_doubt(name: str, confidence: float) -> str:
    if confidence >= SURE:
        return name
    return f"{'probably' if confidence > _LIKELIER_THAN_ALL_OTHERS else 'could be'} {name}"


def _from_to(finding: Mapping[str, Any]) -> str:
    """Effect, joint, and the largest change of its values: ``at joint elbow, 0.41 to 0.78 N*m``.

    An uncertain effect is preceded by "probably" or "could be".
    """
    text = _with_doubt(place(finding), finding["confidence"])
    if not finding["change"]:
        return text
    key = max(finding["change"], key=lambda name: abs(finding["change"][name]["value"]))
    before, now = (
        beside_the_model(finding["effect"], key, each[key]["value"], each[key]["unit"])
        for each in (finding["known_before"], finding["parameters"])
    )
    unit = finding["change"][key]["unit"]
    return f"{text}, {before.removesuffix(f' {unit}')} to {now}"


def _is_usual(error: Mapping[str, Any]) -> bool:
    """Whether the residual of a joint is as usual with the changes."""
    return bool(error["rms_after"] <= _AS_USUAL * error["rms_usual"])


def alarm_sentence(document: Mapping[str, Any]) -> str:
    """Return the score, its threshold, and where the threshold is from."""
    alarm = document["alarm"]
    repeated = alarm.get("repeated")
    if repeated is not None and repeated["probability"] < alarm["level"] and (
        alarm["score"] <= alarm["threshold"]
    ):  # fmt: skip
        return (
            f"{repeated['recording']} differs at {repeated['joint']} from the motion that it "
            f"repeats as {percent(repeated['probability'])} of unchanged recordings would at most; "
            f"alarm below {percent(alarm['level'])}."
        )
    freedom = alarm["degrees_of_freedom"]
    law = "a quantile" if freedom is None else f"a t law with {freedom} degrees of freedom"
    return (
        f"Score {number(alarm['score'])}; alarm above {number(alarm['threshold'])}, which "
        f"{percent(alarm['level'])} of unchanged sessions exceed: {law} of {alarm['sessions']} "
        "before, each compared with the others."
    )


def render(document: Mapping[str, Any]) -> str:
    """Return the report as one HTML document without external files."""
    return _PAGE.render(
        document=document,
        headline=headline(document),
        mood=_MOOD[document["verdict"]],
        alarm=alarm_sentence(document),
        candidates=_candidates(document),
        open_questions=_what_is_open(document) if document.get("candidates") else [],
        model_changes=model_lines(document),
        declared=_declared(document),
        new=_listed(document["new"]),
        old=_listed(document["before"]["recordings"]),
        repeated=[*_repeated(document), *_undone(document)],
        findings=[
            {
                **finding,
                "name": place(finding),
                "compared_with": "value" if finding["effect"] == "payload" else "beside the model",
                "rows": _rows(finding),
                "gain": _gain(finding),
                "ambiguous": ambiguity_sentence(finding),
                "spans": [(n, spans_in_words(w)) for n, w in finding["where"]["windows"].items()],
                "figure": svg_uri(difference_figure(finding["difference"], _residuals(document)[0]))
                if "difference" in finding
                else None,
            }
            for finding in document["findings"]
        ],
        signal=_residuals(document)[0],
        errors=[
            (joint, *_errors(error), "as before" if _is_usual(error) else "more than before")
            for joint, error in _residuals(document)[1].items()
        ],
    )


def _listed(names: Sequence[str]) -> str:
    """Return the first names, and how many follow."""
    more = len(names) - _MOST_NAMES
    return ", ".join(names[:_MOST_NAMES]) + (f" and {more} more" if more > 0 else "")


def _residuals(document: Mapping[str, Any]) -> tuple[str, Mapping[str, Any]]:
    """The compared signal and its residual at each joint."""
    signal = "effort" if "effort" in document else "position"
    return signal, document[signal]


def _rows(finding: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """Meaning, value before, value now, and change with its interval, of each amplitude."""
    rows = []
    for key, change in finding["change"].items():
        before, now = finding["known_before"][key], finding["parameters"][key]
        low, high = (number(bound) for bound in change["ci95"])
        rows.append((
            meaning_of(finding["effect"], key),
            beside_the_model(finding["effect"], key, before["value"], before["unit"]),
            beside_the_model(finding["effect"], key, now["value"], now["unit"]),
            f"{change['value']:+.4g} ({low} to {high})",
        ))  # fmt: skip
    return rows


def _before_and_after(finding: Mapping[str, Any]) -> list[str]:
    name = place(finding)
    if finding.get("motor") is not None:
        name += f" (all motors of the type {finding['motor']} changed)"
    lines = [f"{capitalize_first(name)}, beside the model:"]
    lines += [
        f"  {meaning}: {before} before, {now} now; change {change}"
        for meaning, before, now, change in _rows(finding)
    ]
    return lines


def _gain(finding: Mapping[str, Any]) -> str:
    held_out = finding["held_out_gain"]
    if held_out is None:
        share = percent(finding["residual_gain"])
        return f"It explains {share} of the squared residual; nothing is held out to test it."
    return f"All changes together remove {percent(held_out)} of the squared held-out residual."


def _errors(error: Mapping[str, Any]) -> tuple[str, str, str]:
    usual, before, after = (
        quantity(error[key], error["unit"]) for key in ("rms_usual", "rms_before", "rms_after")
    )
    return usual, before, after


_PAGE = Page("changes.html.j2", "diagnosis.css", percent=percent, capitalize_first=capitalize_first)
