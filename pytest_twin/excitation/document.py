"""Build ``excitation.json`` and ``abort.json``: motions, margins and predictions."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pytest_twin.excitation.approved_limits import ApprovedLimits
from pytest_twin.excitation.closed_loop import WORSE, servo_modes
from pytest_twin.excitation.find_safe import RejectedDesign, SafeMotion
from pytest_twin.excitation.prediction import PredictedAccuracy
from pytest_twin.formats.digest import bytes_sha256
from pytest_twin.realization.encoders import Encoders, calibration_of

if TYPE_CHECKING:
    from pytest_twin.excitation.excite import Excitation

SCHEMA = 1
"""Version of ``excitation.json`` and ``abort.json``."""
NOTICE = (
    "These files are a proposal. A qualified person compares them with the real cell, approves "
    "them, and supervises every run. pytest-twin never sends a command to a robot."
)
_DRAWN_SAMPLES = 500
"""Largest number of samples of a motion in the figures."""
_TRACKING_FACTOR = 2.0
"""Abort at this multiple of the largest simulated tracking error."""
_LEAST_TRACKING = 0.01
"""Smallest tracking error that causes an abort, as a share of the approved range."""
_KINDS = ("position", "velocity", "acceleration", "effort", "power", "stop", "workspace:",
          "clearance")  # fmt: skip


def document_of(found: Excitation, written: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """Return the content of ``excitation.json``, without the model's digests."""
    approved = found.approved
    reached = {one.mechanism for one in found.predicted}
    without = [name for name in approved.mechanisms if name not in reached]
    open_ = [one for one in found.predicted if not one.is_identifiable]
    complete = not open_ and not without and not found.refused
    return {
        "schema": SCHEMA,
        "verdict": "identifiable" if complete else "not_identifiable",
        "notice": NOTICE,
        "approved_by": approved.approved_by,
        "limits_sha256": _digest(approved.source),
        "seed": found.seed,
        "margin": approved.margin,
        "closed_loop": _closed_loop(found),
        "mechanisms": list(approved.mechanisms),
        "trajectories": [_trajectory(one, written) for one in found.safe],
        "refused": [_refusal(one) for one in found.refused],
        "noise": _noise(found),
        "predicted": [_parameter(one) for one in found.predicted],
        "covariance": _summary(found),
        "unidentifiable": _unidentifiable(open_, without),
        "only_in_combination": [
            f"{expression}: {words}"
            for expression, words in zip(found.base.expressions, found.base.words, strict=True)
            if " " in expression
        ]
        if "inertia" in approved.mechanisms
        else [],
        "notes": _notes(found),
    }


def on_abort(found: Excitation) -> dict[str, Any]:
    """Return the content of ``abort.json``: when and how to stop, in encoder readings."""
    approved = found.approved
    encoders = Encoders.of(calibration_of(found.realization), approved.names)
    ends = np.sort(
        encoders.read_position(np.array([approved.array("lower"), approved.array("upper")])),
        axis=0,
    )
    return {
        "schema": SCHEMA,
        "notice": NOTICE,
        "approved_by": approved.approved_by,
        "stop": {
            "category": approved.stop.category,
            "reaction": {"value": approved.stop.reaction, "unit": "s"},
            "plan": approved.stop.plan,
        },
        "abort_when": {
            "no_state_for": {"value": approved.stop.reaction, "unit": "s"},
            "power_above": {"value": approved.power, "unit": "W"},
            "joints": {
                joint.name: {
                    "position_outside": [float(ends[0, at]), float(ends[1, at])],
                    "speed_above": joint.velocity,
                    "effort_above": joint.effort,
                    "units": [joint.unit, f"{joint.unit}/s", joint.effort_unit],
                }
                for at, joint in enumerate(approved.joints)
            },
        },
        "distance_from_command_above": {
            one.motion.name: {
                joint.name: {
                    "value": max(
                        _TRACKING_FACTOR * float(one.verdict.tracking[at]),
                        _LEAST_TRACKING * (joint.upper - joint.lower),
                    ),
                    "unit": joint.unit,
                }
                for at, joint in enumerate(approved.joints)
            }
            for one in found.safe
        },
    }


def courses(one: SafeMotion, approved: ApprovedLimits) -> dict[str, Any]:
    """Return position, speed and effort over time as shares of their limits, for a plot.

    Positions are 1 at the highest approved position and -1 at the lowest.
    """
    motion = one.motion
    keep = np.unique(np.linspace(0, len(motion.time) - 1, _DRAWN_SAMPLES).round().astype(int))
    lower, upper = approved.array("lower"), approved.array("upper")
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    shares = {
        "position": (motion.position - middle) / half,
        "speed": motion.velocity / approved.array("velocity"),
        "effort": one.response.effort / approved.array("effort"),
    }
    columns = [approved.names.index(name) for name in motion.moved]
    return {
        "time": np.round(motion.time[keep], 4).tolist(),
        "joints": list(motion.moved),
        **{
            name: np.round(values[keep][:, columns], 4).T.tolist()
            for name, values in shares.items()
        },
    }


def _trajectory(one: SafeMotion, written: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    motion = one.motion
    margins = {}
    for kind in _KINDS:
        worst = one.verdict.of_kind(kind)
        if worst is not None:
            margins[kind.rstrip(":")] = {
                "what": worst.what,
                "value": worst.value,
                "limit": worst.limit,
                "unit": worst.unit,
                "share": worst.share,
            }
    return {
        "name": motion.name,
        "mechanisms": list(motion.mechanisms),
        "kind": motion.kind,
        "role": motion.role,
        "moved": list(motion.moved),
        "payload": motion.payload,
        "seed": motion.seed,
        "scale": motion.scale,
        "duration": {"value": float(motion.time[-1]), "unit": "s"},
        "samples": len(motion.time),
        "files": list(written.get(motion.name, ())),
        "margins": margins,
        "settings": dict(motion.settings),
    }


def _refusal(one: RejectedDesign) -> dict[str, Any]:
    return {
        "name": one.design.name,
        "kind": one.design.kind,
        "role": one.design.role,
        "mechanisms": list(one.design.mechanisms),
        "attempts": one.attempts,
        "why": list(one.why),
    }


def _parameter(one: PredictedAccuracy) -> dict[str, Any]:
    finite = math.isfinite(one.std)
    return {
        "mechanism": one.mechanism,
        "name": one.name,
        "expression": one.expression,
        "words": one.words,
        "unit": one.unit,
        "nominal": one.nominal,
        "std": one.std if finite else None,
        "relative_std": one.relative_std if finite else None,
        "identifiable": one.is_identifiable,
        "small": one.is_small,
        "why": one.why,
    }


def _noise(found: Excitation) -> dict[str, Any]:
    noise = found.noise
    return {
        joint.name: {
            "effort": {
                "value": float(noise.effort[at]),
                "unit": joint.effort_unit,
                "source": noise.effort_source[at],
            },
            "position": {
                "value": float(noise.position[at]),
                "unit": joint.unit,
                "source": noise.position_source[at],
            },
        }
        for at, joint in enumerate(found.approved.joints)
    }


def _summary(found: Excitation) -> dict[str, Any]:
    """Return the worst relative deviation of each mechanism's parameters with nominal values."""
    summary: dict[str, Any] = {}
    for mechanism in found.approved.mechanisms:
        own = [one for one in found.predicted if one.mechanism == mechanism]
        stated = [
            one for one in own if one.relative_std is not None and math.isfinite(one.std)
            and not one.is_small
        ]  # fmt: skip
        worst = max(stated, key=lambda one: one.relative_std or 0.0, default=None)
        summary[mechanism] = {
            "parameters": len(own),
            "identifiable": sum(one.is_identifiable for one in own),
            "worst_relative_std": None if worst is None else worst.relative_std,
            "worst": None if worst is None else worst.expression,
        }
    return summary


def _unidentifiable(open_: Sequence[PredictedAccuracy], without: Sequence[str]) -> list[str]:
    lines = [
        f"{one.mechanism}: {one.words} ({one.expression}): {_why(one)}"
        if one.expression != one.name
        else f"{one.mechanism}: {one.words}: {_why(one)}"
        for one in open_
    ]
    lines += [f"{name}: no safe trajectory identifies it" for name in without]
    return lines


def _why(one: PredictedAccuracy) -> str:
    if one.why:
        return one.why
    return (
        f"predicted standard deviation {one.std:.3g} {one.unit} against a nominal value of "
        f"{one.nominal or 0.0:.3g} {one.unit}"
    )


def _closed_loop(found: Excitation) -> str:
    modes = servo_modes(found.realization, found.approved.names)
    if modes is None:
        return (
            "computed: the model has no servo on every joint, so that each is taken to follow "
            "its command exactly"
        )
    return "simulated with the model's servos: " + ", ".join(
        f"{joint} {mode}" for joint, mode in zip(found.approved.names, modes, strict=True)
    )


def _notes(found: Excitation) -> list[str]:
    notes = [
        f"efforts and motion are checked on the nominal model and on one with {WORSE:g} times its "
        "masses, inertias, friction and armature",
        "predicted deviations take one independent noise sample for each command",
    ]
    noise = found.noise
    if "assumed" in noise.effort_source:
        notes.append(
            "no effort noise is declared: 1 % of the approved effort is assumed, and deviations "
            "scale with it (effort_noise: under joints)"
        )
    if "assumed" in noise.position_source:
        notes.append(
            "no position noise is declared: 1e-4 rad (m) is assumed, and deviations scale with it "
            "(position_noise: under joints)"
        )
    if found.approved.clearance is None:
        notes.append("clearance: none was approved: no distance was checked")
    free = [
        column.words
        for at, column in enumerate(found.regressor.columns)
        if column.is_inertial and not np.any(found.base.combination[:, at])
    ]
    if free and "inertia" in found.approved.mechanisms:
        notes.append(f"without influence on the efforts: {', '.join(free)}")
    notes += found.realization.notes
    return notes


def _digest(section: Mapping[str, Any]) -> str:
    text = json.dumps(section, sort_keys=True, separators=(",", ":"))
    return bytes_sha256(text.encode())
