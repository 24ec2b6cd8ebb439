"""The drive of one joint of a diagnosis as an entry of the library of servos."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

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
        evidence=_evidence(document, source),
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


def _drive(row: DriveRow, findings: list[Mapping[str, Any]]) -> dict[str, Estimate]:
    values = {
        "stiffness": row.stiffness,
        "damping": row.damping,
        "effort_limit": row.effort_limit,
        "armature": row.armature,
        "friction": row.friction,
        "viscous": row.viscous,
    }
    parts = {"stiffness": "gains", "damping": "gains"}
    found = {DRIVE_EFFECTS.get(f["effect"]): f["effect"] for f in findings}
    return {
        name: Estimate(
            value + 0.0, PARAMETERS[name][0], (),
            f"finding {found[parts.get(name, name)]}" if parts.get(name, name) in found
            else _MODEL_VALUE,
        )
        for name, value in values.items()
        if value is not None and value >= 0.0
    }  # fmt: skip


def _evidence(document: Mapping[str, Any], source: ExportSource) -> dict[str, str]:
    files = document.get("basis", {}).get("files", {})
    digests = sorted(str(item.get("digest")) for item in files.values())
    return {
        "recordings": ", ".join(sorted(files)) or "not stated by the diagnosis",
        "digest": bytes_sha256("\n".join(digests).encode()),
        "command": f"pytest-twin diagnose, verdict {document.get('verdict')}",
        "version": f"pytest-twin {version('pytest-twin')}",
    }
