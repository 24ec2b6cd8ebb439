"""Read ``excitation:`` of a twin and compare it with the model; missing values are errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from pytest_twin.errors import ModelError, SpecError
from pytest_twin.excitation.approved_limits import (
    DEFAULT_MARGIN,
    MECHANISMS,
    NO_CLEARANCE,
    ApprovedLimits,
    Box,
    Clearance,
    JointLimits,
    Stop,
    missing_lines,
)
from pytest_twin.excitation.fourier import REST
from pytest_twin.realization.collision import Shapes
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.realization.joint_limits import model_effort, model_range
from pytest_twin.realization.model import Realization
from pytest_twin.realization.patch import suggest
from pytest_twin.twin import Twin

MOST_COMMANDS = 200_000
"""Largest number of commands in one trajectory: 33 minutes at 100 Hz."""
COMMANDS_PER_PERIOD = 10.0
"""Smallest number of commands per period of the task's highest frequency."""
_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def movable_joints(realization: Realization) -> tuple[str, ...]:
    """Return hinges and slides that follow no other joint, in the model's order."""
    model = realization.model
    followers = {
        int(model.eq_obj1id[i])
        for i in range(model.neq)
        if model.eq_type[i] == mujoco.mjtEq.mjEQ_JOINT and model.eq_obj2id[i] >= 0
    }
    return tuple(
        name
        for name in realization.joints
        if int(model.jnt_type[realization.joint_index(name)]) in _SCALAR
        and realization.joint_index(name) not in followers
    )


def read_approved(realization: Realization, twin: Twin) -> ApprovedLimits:
    """Read the approved limits of a twin.

    Raises:
        SpecError: lines are missing, or a value is invalid; with line, value and unit.
        ModelError: the robot's base floats.
    """
    section: Mapping[str, Any] = twin.excitation or {}
    joints = movable_joints(realization)
    refuse_floating_base(realization)
    missing = missing_lines(section, joints)
    if missing:
        raise missing_error(twin.path, missing, twin)
    refuse = twin.error
    for name in (*section["joints"], *(section.get("hold") or ())):
        if name not in joints:
            where = "joints" if name in section["joints"] else "hold"
            raise refuse(
                f"excitation.{where}.{name}" if where == "joints" else "excitation.hold",
                f"the model has no joint {name!r} that can be moved",
                expected=suggest(name, joints),
            )
    held = section.get("hold") or ()
    both = [name for name in section["joints"] if name in held]
    if both:
        raise refuse(
            f"excitation.joints.{both[0]}",
            "a joint that moves and is held",
            expected="it under joints: or under hold:",
        )
    band = _band(section, twin)
    found = ApprovedLimits(
        approved_by=str(section["approved_by"]),
        mechanisms=tuple(one for one in MECHANISMS if one in section["mechanisms"]),
        duration=float(section["duration"]),
        rate=float(section["rate"]),
        band=band,
        margin=DEFAULT_MARGIN if section.get("margin") is None else float(section["margin"]),
        joints=tuple(
            _joint(realization, name, section["joints"][name], twin)
            for name in joints
            if name in section["joints"]
        ),
        workspace=tuple(
            _box(realization, at, box, twin) for at, box in enumerate(section["workspace"])
        ),
        clearance=_clearance(realization, section["clearance"], twin),
        power=_power(section["supply"], twin),
        stop=Stop(
            int(section["stop"]["category"]),
            float(section["stop"]["reaction"]),
            str(section["stop"]["plan"]),
        ),
        source=section,
    )
    if not found.joints:
        raise refuse("excitation.joints", "no joint moves", expected="at least one joint")
    return found


def missing_error(path: Path, missing: Sequence[str], twin: Twin | None) -> SpecError:
    """Build the error for missing lines of ``excitation:``."""
    shown = ", ".join(f"excitation.{name}" for name in missing)
    line = None if twin is None else twin.lines.get("excitation")
    return MissingApprovalError(
        f"no motion without approved limits; missing: {shown}",
        path=path,
        line=line,
        where="excitation",
        expected="a qualified person fills in these lines",
    )


class MissingApprovalError(SpecError):
    """Lines of ``excitation:`` are missing."""


def refuse_floating_base(realization: Realization) -> None:
    """Raise ModelError if the robot's base floats: its motion needs more than joint limits."""
    model = realization.model
    floating = (model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)) & (
        model.body_parentid[model.jnt_bodyid] == 0
    )
    # A free body without joints is an object, not the robot.
    for joint in np.flatnonzero(floating):
        root = int(model.jnt_bodyid[joint])
        own = (model.body_rootid[model.jnt_bodyid] == root) & (np.arange(model.njnt) != joint)
        if own.any():
            raise ModelError(
                "the robot's base floats",
                path=realization.path,
                where=f"body '{model.body(root).name}'",
                expected="a robot that is fixed to its base",
            )


def _band(section: Mapping[str, Any], twin: Twin) -> tuple[float, float]:
    low, high = (float(value) for value in section["task_band"])
    where = "excitation.task_band"
    if not 0.0 < low < high:
        raise twin.error(
            where, "no band of frequencies", value=f"{low:g} to {high:g}", unit="Hz",
            expected="a lower frequency above 0 Hz, then a higher one",
        )  # fmt: skip
    duration, rate = float(section["duration"]), float(section["rate"])
    if rate < COMMANDS_PER_PERIOD * high:
        raise twin.error(
            "excitation.rate", "too few commands for the task's highest frequency", value=rate,
            unit="Hz", expected=f"at least {COMMANDS_PER_PERIOD * high:g} Hz",
        )  # fmt: skip
    least = 1.0 / low + 2.0 * REST
    if duration < least:
        raise twin.error(
            "excitation.duration", "shorter than one period of the task's lowest frequency",
            value=duration, unit="s", expected=f"at least {least:g} s",
        )  # fmt: skip
    periods = duration - 2.0 * REST
    if math.floor(high * periods) - math.ceil(low * periods) < 1:
        raise twin.error(
            "excitation.task_band", "no two harmonics of the duration lie in the band",
            value=f"{low:g} to {high:g}", unit="Hz",
            expected="a wider band, or a longer duration:",
        )  # fmt: skip
    if duration * rate > MOST_COMMANDS:
        raise twin.error(
            "excitation.duration", "too many commands in one trajectory",
            value=round(duration * rate), expected=f"at most {MOST_COMMANDS}",
        )  # fmt: skip
    return low, high


def _joint(realization: Realization, name: str, own: Mapping[str, Any], twin: Twin) -> JointLimits:
    where = f"excitation.joints.{name}"
    index = realization.joint_index(name)
    slide = int(realization.model.jnt_type[index]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
    unit, effort_unit = ("m", "N") if slide else ("rad", "N*m")
    low, high = (float(value) for value in own["position"])
    if not low < high:
        raise twin.error(
            f"{where}.position", "the lowest position is not below the highest",
            value=f"{low:g} to {high:g}", unit=unit, expected="the lowest, then the highest",
        )  # fmt: skip
    own_range = model_range(realization.model, index)
    encoder = Encoders.of(calibration_of(realization), [name])
    # Limits are encoder readings; below they are in the model's zero and sign.
    lower, upper = sorted(float(encoder.model_position(np.array([v]))[0]) for v in (low, high))
    start = float(encoder.model_position(np.array([float(own["start"])]))[0])
    if own_range is not None and (lower < own_range[0] or upper > own_range[1]):
        raise twin.error(
            f"{where}.position", "beyond the joint's range", value=f"{low:g} to {high:g}",
            unit=unit, expected=f"within {own_range[0]:.6g} to {own_range[1]:.6g} {unit}",
        )  # fmt: skip
    if not lower < start < upper:
        raise twin.error(
            f"{where}.start", "starts outside the approved positions", value=own["start"],
            unit=unit, expected=f"between {low:g} and {high:g} {unit}",
        )  # fmt: skip
    effort = model_effort(realization, name)
    most = {
        "velocity": (realization.velocity_limit.get(name), f"{unit}/s"),
        "acceleration": (None, f"{unit}/s^2"),
        "effort": (None if effort is None else min(-effort[0], effort[1]), effort_unit),
    }
    for key, (bound, of_unit) in most.items():
        value = float(own[key])
        if not value > 0.0:
            raise twin.error(
                f"{where}.{key}", "not a positive limit", value=value, unit=of_unit,
                expected="a limit above 0",
            )  # fmt: skip
        if bound is not None and value > bound:
            raise twin.error(
                f"{where}.{key}", "above the limit of the model's joint", value=value,
                unit=of_unit, expected=f"at most {bound:.6g} {of_unit}",
            )  # fmt: skip
    return JointLimits(
        name=name,
        lower=lower,
        upper=upper,
        velocity=float(own["velocity"]),
        acceleration=float(own["acceleration"]),
        effort=float(own["effort"]),
        start=start,
        is_slide=slide,
        effort_noise=own.get("effort_noise"),
        position_noise=own.get("position_noise"),
        stop_lower=-math.inf if own_range is None else own_range[0],
        stop_upper=math.inf if own_range is None else own_range[1],
    )


def _box(realization: Realization, at: int, box: Mapping[str, Any], twin: Twin) -> Box:
    where = f"excitation.workspace.{at}"
    frame = str(box["frame"])
    try:
        realization.frame_index(frame)
    except SpecError as error:
        raise twin.error(f"{where}.frame", error.problem, expected=error.expected) from None
    lower, upper = np.array(box["min"], dtype=float), np.array(box["max"], dtype=float)
    for axis, least, most in zip("xyz", lower, upper, strict=True):
        if not least < most:
            raise twin.error(
                f"{where}.max", f"an empty box along {axis}", value=float(most), unit="m",
                expected=f"more than {least:g} m",
            )  # fmt: skip
    return Box(frame, lower, upper)


def _clearance(realization: Realization, own: Any, twin: Twin) -> Clearance | None:
    if own == NO_CLEARANCE:
        return None
    shapes = Shapes(realization)
    if len(shapes.bodies) < 2:
        raise twin.error(
            "excitation.clearance",
            "the model has no two bodies with shapes that can collide",
            expected="collision shapes in the model, or 'clearance: none' if a person approves "
            "motion without a check of distances",
        )
    pairs = {}
    for at, pair in enumerate(own.get("pairs", ())):
        first, second = (
            _shape_name(shapes, name, f"excitation.clearance.pairs.{at}.links", twin)
            for name in pair["links"]
        )
        pairs[first, second] = float(pair["distance"])
    ignored = frozenset(
        frozenset(
            _shape_name(shapes, name, f"excitation.clearance.ignore.{at}", twin) for name in two
        )
        for at, two in enumerate(own.get("ignore", ()))
    )
    return Clearance(float(own["self"]), float(own["environment"]), pairs, frozenset(ignored))


def _shape_name(shapes: Shapes, name: str, where: str, twin: Twin) -> str:
    if name not in shapes.names:
        raise twin.error(
            where, "the model has no body or geom of this name with a collision shape", value=name,
            expected=suggest(name, shapes.names),
        )  # fmt: skip
    return name


def _power(own: Mapping[str, Any], twin: Twin) -> float:
    for name, unit in (("voltage", "V"), ("current", "A")):
        if not float(own[name]) > 0.0:
            raise twin.error(
                f"excitation.supply.{name}", "no supply", value=own[name], unit=unit,
                expected="a value above 0",
            )  # fmt: skip
    return float(own["voltage"]) * float(own["current"])
