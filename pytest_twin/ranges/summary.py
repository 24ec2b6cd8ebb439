"""Summarize ranges and their check in sentences, with the next steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

MEANING = {
    "useful": "the final recordings lie in the predicted envelope, and it is no wider than it need "
    "be",
    "too_narrow": "the final recordings leave the predicted envelope",
    "too_wide": "the predicted envelope is wider than the final recordings need",
    "not_checked": "not checked by final recordings",
}
"""Verdict -> its meaning."""


def summary_lines(document: Mapping[str, Any]) -> list[str]:
    """Return lines with the verdict, figures of each joint, widening, and next steps.

    Args:
        document: content of ``ranges.json``.
    """
    lines = [MEANING[document["verdict"]]]
    check = document["check"]
    if check is not None:
        low, high = check["coverage_interval"]
        lines.append(
            f"coverage {_percent(check['coverage'])} of {_percent(check['share'])} stated (95 % "
            f"interval {_percent(low)} to {_percent(high)}, {check['effective_samples']:.0f} "
            f"effective of {check['samples']} samples); {check['robots']} robots, "
            f"{len(check['recordings'])} final recordings"
        )
        lines += [_joint(name, one) for name, one in check["joints"].items()]
        if check["diverged"]:
            lines.append(f"{check['diverged']} robots diverged and were left out")
    lines += _widening(document["widening"])
    if document["against"] is not None:
        lines += [f"against {document['against']['file']}:"]
        lines += [one["words"] for one in document["against"]["entries"]]
        lines += [f"not varied by the file: {one}" for one in document["against"]["not_given"]]
    return [*lines, *_advice(document)]


def _joint(name: str, one: Mapping[str, Any]) -> str:
    unit = "mm" if one["unit"] == "m" else "mrad"
    even = "" if one["uneven_chance"] > 0.05 else (
        f"; its probability integral is more uneven than that of "
        f"{_percent(1.0 - one['uneven_chance'])} of the simulated robots"
    )  # fmt: skip
    return (
        f"{name}: coverage {_percent(one['coverage'])} ({_percent(one['coverage_interval'][0])} to "
        f"{_percent(one['coverage_interval'][1])}), envelope {1e3 * one['width']:.3g} {unit} wide "
        f"on average, {one['width_over_tightest']:.2g} times the narrowest band that covers{even}"
    )


def _widening(widening: Mapping[str, Any] | None) -> list[str]:
    if widening is None:
        return []
    lines = [
        f"widened: {joint}: standard deviations of its parameters times {factor:.2f}, because "
        f"held-out recordings deviate {widening['before'][joint]['ratio']:.2g} times as much as "
        "their covariance predicts"
        for joint, factor in widening["factors"].items()
    ]
    return lines or ["not widened: held-out recordings deviate as the covariance predicts"]


def _advice(document: Mapping[str, Any]) -> list[str]:
    """Return the recommended next steps."""
    lines = []
    unexplained = [] if document["widening"] is None else document["widening"]["unexplained"]
    if unexplained:
        lines.append(
            f"to do: {', '.join(unexplained)}: not even the largest widening explains the held-out "
            "recordings, so the model lacks something; pytest-twin diagnose names it"
        )
    check = document["check"]
    if check is None and not document["throughput"]:
        lines.append(
            "to do: record motions of the task that no fit or choice uses, with the role final, "
            "and name them with --final"
        )
    elif check is not None and document["verdict"] == "too_narrow":
        where = ", ".join(check["outside"]) or "all joints together"
        lines.append(
            f"to do ({where}): where no held-out recording was given, name some with "
            "--held-out; otherwise the model lacks something that the final recordings show: run "
            "pytest-twin diagnose on other recordings of these motions, never on the final ones"
        )
    elif check is not None and document["verdict"] == "too_wide":
        where = ", ".join(check["too_wide"]) or "all joints together"
        lines.append(
            f"to do ({where}): identify again with motions that excite these joints (pytest-twin "
            "excite), or remove a tolerance that is larger than what was measured"
        )
    return lines


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %"
