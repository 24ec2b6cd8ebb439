"""Write a template of missing lines of ``excitation:``, for a qualified person to complete."""

from __future__ import annotations

import json
from collections.abc import Sequence

import mujoco

from pytest_twin.errors import ModelError
from pytest_twin.excitation.approved_limits import MECHANISMS, missing_lines
from pytest_twin.excitation.read_limits import movable_joints, refuse_floating_base
from pytest_twin.realization.joint_limits import model_effort, model_range
from pytest_twin.realization.model import Realization

_COMMENTS = {
    "approved_by": "who approves these limits",
    "mechanisms": "what to identify: " + ", ".join(MECHANISMS),
    "duration": "s, longest time of one trajectory",
    "rate": "Hz, commands per second",
    "task_band": "Hz, [lowest, highest] frequency of the task's motion",
    "workspace": "boxes that frames stay in: - {frame: NAME, min: [x, y, z], max: [x, y, z]}, m; "
    "or []",
}
_TABLES = {
    "clearance": (
        ("self", "m, least distance between two links"),
        ("environment", "m, least distance between a link and fixed objects"),
    ),
    "supply": (("voltage", "V"), ("current", "A, continuous current")),
    "stop": (
        ("category", "0, 1 or 2 of IEC 60204-1"),
        ("reaction", "s, from the abort to the start of braking"),
        ("plan", "who stops the robot, and how"),
    ),
}


def blank_section(realization: Realization) -> str:
    """Return the whole section ``excitation:`` without values; empty if no motion can be designed.

    That is so for a robot without a movable joint, and for one whose base floats.
    """
    try:
        refuse_floating_base(realization)
    except ModelError:
        return ""
    joints = movable_joints(realization)
    return template(realization, missing_lines({}, joints)) if joints else ""


def template(realization: Realization, missing: Sequence[str]) -> str:
    """Return YAML with empty missing lines; comments state the limits of the model."""
    lines = ["excitation:"]
    for name, comment in _COMMENTS.items():
        if name in missing:
            lines.append(f"  {name}:   # {comment}")
    lines += _of_joints(realization, missing)
    if any(name.startswith("workspace.") for name in missing):
        lines.append("  # workspace: every box needs min: [x, y, z] and max: [x, y, z], m")
    for table, fields in _TABLES.items():
        own = [(name, words) for name, words in fields if f"{table}.{name}" in missing]
        if own:
            lines.append(f"  {table}:")
            lines += [f"    {name}:   # {words}" for name, words in own]
    return "\n".join(lines) + "\n"


def _of_joints(realization: Realization, missing: Sequence[str]) -> list[str]:
    of_joint: dict[str, list[str]] = {}
    for name in missing:
        if name.startswith("joints."):
            joint, _, field = name.removeprefix("joints.").rpartition(".")
            of_joint.setdefault(joint, []).append(field)
    if not of_joint:
        return []
    lines = ["  # For joints that must not move: hold: [NAME, ...] instead of their lines."]
    lines.append("  joints:")
    for joint, fields in of_joint.items():
        lines.append(f"    {_text(joint)}:")
        lines += [
            f"      {field}:   # {_model_limit(realization, joint, field)}" for field in fields
        ]
    return lines


def _model_limit(realization: Realization, joint: str, field: str) -> str:
    index = realization.joint_index(joint)
    slide = int(realization.model.jnt_type[index]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
    unit, effort_unit = ("m", "N") if slide else ("rad", "N*m")
    if field == "position":
        own = model_range(realization.model, index)
        said = "the model has no range" if own is None else f"the model: {own[0]:g} to {own[1]:g}"
        return f"{unit}, [lowest, highest]; {said}"
    if field == "velocity":
        speed = realization.velocity_limit.get(joint)
        return f"{unit}/s" + ("" if speed is None else f"; the model: at most {speed:g}")
    if field == "acceleration":
        return f"{unit}/s^2"
    if field == "effort":
        most = model_effort(realization, joint)
        return effort_unit + (
            "" if most is None else f"; the model: at most {min(-most[0], most[1]):g}"
        )
    return f"{unit}, where every trajectory begins and ends"


def _text(name: str) -> str:
    plain = name.replace("_", "").isalnum() and not name[0].isdigit() and name.isascii()
    return name if plain else json.dumps(name, ensure_ascii=False)
