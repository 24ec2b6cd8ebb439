"""Write the report of an identification as text for the terminal and as an HTML page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pytest_twin.effects.sensing import EncoderBias, EncoderScale
from pytest_twin.report.frequency import figures_of, rows_of
from pytest_twin.report.page import Page
from pytest_twin.report.priors import prior_sentences

_VERDICT = {
    "accepted": ("Accepted: every stage that the motion shows lowers the held-out error", "good"),
    "improved": (
        "Improved, and not accepted: a stage is rejected, nothing is held out, or the motion shows "
        "no parameter of the robot",
        "bad",
    ),
    "rejected": ("Rejected: the fitted model predicts no better than the nominal one", "bad"),
}


def render(document: Mapping[str, Any]) -> str:
    """Return ``identification.json`` as one HTML document without external files."""
    headline, mood = _VERDICT[document["verdict"]]
    if any(one.get("fatal") for one in document.get("suspected", ())):
        headline = "Rejected: a mistake of the input is suspected; correct it and identify again"
    return _PAGE.render(
        document=document,
        headline=headline,
        mood=mood,
        errors=error_lines(document),
        priors=prior_sentences(document),
        open=by_motion(document),
        mechanisms=mechanisms(document),
        signals=signal_rows(document),
        encoders=encoder_rows(document),
        spread=spread_rows(document),
        stages=[(stage, _held_out(stage)) for stage in document["stages"]],
        frequency_rows=rows_of(document.get("frequency_response", ())),
        frequency_figures=figures_of(document.get("frequency_response", ())),
    )


def error_lines(document: Mapping[str, Any]) -> list[str]:
    """Return a line for each joint with the errors of the prediction."""
    lines = []
    for joint, error in document["held_out"].items():
        parts = []
        if "effort_relative" in error:
            said = f"effort {100 * error['effort_relative']:.1f} %"
            said += f" ({error['effort_rms']:.3g} {error['effort_unit']} root mean square"
            if "effort_relative_moving" in error:
                said += f"; while it moves {100 * error['effort_relative_moving']:.1f} %"
            if "effort_relative_nominal" in error:
                said += f"; nominal model {100 * error['effort_relative_nominal']:.1f} %"
            parts.append(said + ")")
        if "position_rms" in error:
            scale, unit = (1e3, "m" + error["position_unit"])
            said = f"position {scale * error['position_rms']:.3g} {unit} root mean square"
            if "position_rms_nominal" in error:
                said += f" (nominal model {scale * error['position_rms_nominal']:.3g} {unit})"
            parts.append(said)
        if "sensor_rms" in error:
            parts += [
                f"{axis} {value:.3g} {error['sensor_units'][axis]} "
                f"(an ideal sensor {error['sensor_rms_nominal'][axis]:.3g})"
                for axis, value in error["sensor_rms"].items()
            ]
        if "toss_position" in error:
            parts.append(_toss_words(error))
        lines.append(f"{joint}: {', '.join(parts)}")
    return lines


def signal_rows(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each joint with source and filter of its positions and efforts."""
    rows = []
    for joint, own in document.get("signals", {}).items():
        position = [own["position"]["unit"], f"{own['position']['side']} side of the gear"]
        if own["zero"]:
            position.append(f"zero {own['zero']:g}")
        effort = ["not used: no measurement of a torque"]
        if own["effort_used"]:
            stated = own["effort"]
            effort = [stated["quantity"], f"{stated['side']} side of the gear"]
            if stated["constant"] is not None:
                effort.append(f"constant {stated['constant']:g}")
            elif stated["quantity"] == "current":
                effort.append("constant unknown")
            if stated["limit"] is not None:
                effort.append(f"limit {stated['limit']:g}")
            effort += _signal_description(stated)
        if own["shared_with"] is not None:
            effort.append(f"motor shared with {own['shared_with']}")
        rows.append({
            "joint": joint,
            "position": ", ".join([*position, *_signal_description(own["position"])]),
            "effort": ", ".join(effort),
            "gear": own["gear"],
            "rate": own["rate"],
        })  # fmt: skip
    return rows


def _signal_description(signal: Mapping[str, Any]) -> list[str]:
    """Return the stated source, filter, clock and rate."""
    words = ["inferred from commands"] if signal["source"] == "inferred" else []
    words += [f"{key}: {signal[key]}" for key in ("filter", "clock") if signal[key]]
    if signal["rate"] is not None:
        words.append(f"rate {signal['rate']:g} Hz")
    return words


def encoder_rows(document: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return a row for each calibrated encoder: error, and calibration before and after."""
    changes = document.get("encoders", {})
    joints: dict[str, list[str]] = {joint: [] for joint in changes}
    for name, one in document["parameters"].items():
        joint, _, kind = name.rpartition(".")
        if kind in (EncoderBias.id, EncoderScale.id) and one.get("ci95") is not None:
            scale, unit = (100.0, "%") if kind == EncoderScale.id else (1e3, f"m{one['unit']}")
            half = (one["ci95"][1] - one["ci95"][0]) / 2.0
            joints.setdefault(joint, []).append(
                f"{kind.removeprefix('encoder_')} {scale * one['value']:+.3g} "
                f"(± {scale * half:.2g}) {unit}"
            )
    return [
        {
            "joint": joint,
            "found": ", ".join(found) or "corrected by an earlier record",
            "before": _relation(changes[joint]["before"]) if joint in changes else "",
            "after": _relation(changes[joint]["after"]) if joint in changes else "unchanged",
        }
        for joint, found in joints.items()
    ]


def _relation(one: Mapping[str, float]) -> str:
    return f"sign {one['sign']:+.0f}, scale {one['scale']:.5g}, offset {one['offset']:+.5g}"


def by_motion(document: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return motion -> parameters that it would identify and the recordings do not."""
    found: dict[str, list[str]] = {}
    for one in document.get("unobservable", ()):
        found.setdefault(one["motion"], []).append(one["expression"])
    return found


def mechanisms(document: Mapping[str, Any]) -> list[str]:
    """Return the mechanisms for which ``pytest-twin excite`` designs the missing motions."""
    named = [one.get("mechanism") for one in document.get("unobservable", ())]
    return [name for name in dict.fromkeys(named) if name]


def spread_rows(document: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """Return the contact estimates of each changed simulation option, one row each."""
    rows = []
    for one in document.get("contact", {}).get("spread", ()):
        cells = [f"{name} {value:.4g}" for name, value in one["parameters"].items()]
        held = one["held_out"]
        if held is not None:
            cells.append(
                f"position {1e3 * held['toss_position']:.3g} mm, "
                f"rotation {1e3 * held['toss_rotation']:.3g} mrad"
            )
        rows.append((one["simulation"], cells))
    return rows


def _toss_words(error: Mapping[str, Any]) -> str:
    """Return mean errors over whole tosses, with those of the nominal model."""
    said = (
        f"position {1e3 * error['toss_position']:.3g} mm "
        f"({100 * error['toss_position_widths']:.3g} % of its width)"
    )
    turned = f"rotation {1e3 * error['toss_rotation']:.3g} mrad"
    if "toss_position_nominal" in error:
        said += f" (nominal model {1e3 * error['toss_position_nominal']:.3g} mm)"
        turned += f" (nominal model {1e3 * error['toss_rotation_nominal']:.3g} mrad)"
    return f"{said}, {turned}, mean over {error['tosses']} whole tosses"


def _held_out(stage: Mapping[str, Any]) -> str:
    held = stage.get("held_out")
    if held is None:
        return ""
    return f"{held['before']:.4g} to {held['after']:.4g} {held['unit']}"


_PAGE = Page("identification.html.j2", "diagnosis.css")
