"""The drive of one joint of a diagnosis as an entry of the library of servos."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

from pytest_twin.effects.actuation import ControllerGain, TorqueSaturation
from pytest_twin.effects.friction import CoulombFriction, ViscousFriction
from pytest_twin.effects.rigid_body import Armature
from pytest_twin.errors import SpecError
from pytest_twin.export.drive_table import DRIVE_EFFECTS, DriveRow, drive_table
from pytest_twin.export.source import DIAGNOSIS_FILE, ExportSource
from pytest_twin.formats.digest import bytes_sha256
from pytest_twin.servos.library import PARAMETERS, Estimate, Servo

_LAW = (
    "effort = stiffness (setpoint - q) - damping v within +-effort_limit; at the output shaft dry "
    "friction, viscous friction and armature"
)
_MODEL_VALUE = "the diagnosed model, not changed by a finding"


def servo_entry(
    source: ExportSource, joint: str | None, name: str, conditions: Mapping[str, str]
) -> Servo:
    """The servo that drives a joint.

    Raises:
        SpecError: the source is no diagnosis, or the joint has no such drive.
    """
    if not source.findings:
        raise SpecError("no finding to add", path=source.path, expected="a diagnosis with findings")
    table = drive_table(source.loaded.realization, source.patched)
    rows = {row.joint: row for row in table.rows}
    if joint is None and len(rows) == 1:
        (joint,) = rows
    if joint is None or joint not in rows:
        why = table.omitted.get(joint or "", "")
        raise SpecError(
            "no drive to add" + (f": {why}" if why else ""), path=source.path, where="--joint",
            value=joint, expected=f"one of {', '.join(rows)}",
        )  # fmt: skip
    findings = [f for f in source.findings if f.get("joint") in (joint, None)]
    document = json.loads((source.path / DIAGNOSIS_FILE).read_text("utf-8"))
    errors = document.get("held_out", {}).get(joint, {})
    return Servo(
        id=name,
        maker="",
        model=name,
        law=_LAW,
        conditions={"robot": source.path.name, **conditions},
        drive=_drive(rows[joint], findings),
        evidence=_evidence(document),
        findings=[
            {key: f[key] for key in ("effect", "confidence", "parameters")} for f in findings
        ],
        held_out=(
            f"RMS error of {joint} {errors['rms_before']:.4g} -> {errors['rms_after']:.4g} "
            f"{errors['unit']}"
            if {"rms_before", "rms_after", "unit"} <= set(errors)
            else ""
        ),
        notes=list(source.notes),
    )


_OF_DRIVE: Mapping[str, tuple[str, str, bool]] = {
    # parameter -> (effect, its parameter, whether it is a factor of the model's value)
    "stiffness": (ControllerGain.id, "stiffness_error", True),
    "damping": (ControllerGain.id, "damping_error", True),
    "effort_limit": (TorqueSaturation.id, "limit", False),
    "armature": (Armature.id, "inertia", False),
    "friction": (CoulombFriction.id, "coulomb", False),
    "viscous": (ViscousFriction.id, "coefficient", False),
}


def _drive(row: DriveRow, findings: list[Mapping[str, Any]]) -> dict[str, Estimate]:
    """Each parameter of a drive, with the interval of the finding that changed it."""
    parts = {"stiffness": "gains", "damping": "gains"}
    changed: dict[str | None, list[Mapping[str, Any]]] = {}
    for finding in findings:
        changed.setdefault(DRIVE_EFFECTS.get(finding["effect"]), []).append(finding)
    drive = {}
    for name, (unit, _) in PARAMETERS.items():
        value = getattr(row, name)
        if value is None or value < 0.0:
            continue
        of = changed.get(parts.get(name, name), [])
        how = f"finding {' and '.join(f['effect'] for f in of)}" if of else _MODEL_VALUE
        drive[name] = Estimate(value + 0.0, unit, _interval(name, value, of), how)
    return drive


def _interval(name: str, value: float, findings: list[Mapping[str, Any]]) -> tuple[float, ...]:
    """95 % interval of a parameter; empty if not one finding alone changed it."""
    effect, parameter, is_factor = _OF_DRIVE[name]
    if len(findings) != 1 or findings[0]["effect"] != effect:
        return ()
    estimate = findings[0]["parameters"].get(parameter)
    if estimate is None or (is_factor and estimate["value"] <= -1.0):
        return ()
    scale = value / (1.0 + estimate["value"]) if is_factor else 1.0
    low, high = (value + scale * (end - estimate["value"]) for end in estimate["ci95"])
    return max(low, 0.0), high


def _evidence(document: Mapping[str, Any]) -> dict[str, str]:
    files = document.get("basis", {}).get("files", {})
    digests = sorted(str(item.get("digest")) for item in files.values())
    return {
        "recordings": ", ".join(sorted(files)) or "not stated by the diagnosis",
        "digest": bytes_sha256("\n".join(digests).encode()),
        "command": f"pytest-twin diagnose, verdict {document.get('verdict')}",
        "version": f"pytest-twin {version('pytest-twin')}",
    }
