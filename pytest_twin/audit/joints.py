"""Joints: axis, origin, range, velocity, effort, damping, and degrees that stand for radians."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from pytest_twin.audit.asset import Asset, Edge, Joint
from pytest_twin.audit.evidence import Evidence
from pytest_twin.audit.finding import Finding

_TURNS = 4 * math.pi
"""rad: two turns either way; few robot joints go farther."""
_ROUNDED = (1e-6, 2e-3)
"""rad: how far a right angle stands off where its digits were cut, 1.57 say."""
_LONG = 100.0
"""m: no robot is larger."""
_FAST = 100.0
"""rad/s or m/s: no output shaft of a robot's joint is faster."""
_DATASHEET = "the datasheet or manual of this joint"


def check(asset: Asset, evidence: Evidence) -> Iterator[Finding]:
    """What is wrong with, or unknown of, each joint."""
    followers = {mimic.follower for mimic in asset.mimics}
    for edge in asset.edges:
        yield from _origin(asset, edge)
    for joint in asset.joints:
        if asset.kind == "urdf":
            # The other formats normalize by definition.
            yield from _axis(joint)
        if joint.scalar:
            yield from _range(asset, joint)
            yield from _bounds(asset, joint, passive=joint.name in followers)
            yield from _friction(joint)
            if joint.name not in followers:
                yield from _sign_and_zero(joint, evidence)


def _element(joint: Joint) -> str:
    return f"joint '{joint.name}'"


def _axis(joint: Joint) -> Iterator[Finding]:
    if joint.kind in ("ball", "free"):
        return
    if joint.axis_stated is None:
        if joint.kind != "planar":
            yield Finding(
                "joints.axis_left_out",
                "warning",
                joint.place,
                _element(joint),
                "no axis is stated: it is x of the joint's frame by default",
                "1 0 0",
                None,
                "an axis that is stated",
                "a forgotten axis moves the joint about x without a word",
                "the kinematic drawing, or a photograph of this joint moved by hand",
            )
        return
    length = float(np.linalg.norm(joint.axis_stated))
    if abs(length - 1.0) > 1e-3:
        yield Finding(
            "joints.axis_not_unit",
            "critical",
            joint.place,
            _element(joint),
            "its axis is no unit vector",
            length,
            "1",
            "length 1",
            "a parser that does not normalize it scales every angle, torque and speed by it",
            "the kinematic drawing: the direction alone counts, or a factor was meant",
        )
    elif abs(length - 1.0) > 1e-6:
        yield Finding(
            "joints.axis_rounded",
            "info",
            joint.place,
            _element(joint),
            "its axis has few digits",
            length,
            "1",
            "length 1 to 1e-6",
            "normalized or not, the joint moves a little otherwise",
            "the exact angle from CAD",
        )


def _origin(asset: Asset, edge: Edge) -> Iterator[Finding]:
    element = f"joint '{edge.name}'" if asset.kind == "urdf" else f"body '{edge.child}'"
    distance = float(np.linalg.norm(edge.position))
    if distance > _LONG:
        # A scene may place a body that far; no robot has a link that far from the one before.
        in_scene = asset.kind == "mjcf" and edge.parent == "world"
        yield Finding(
            "joints.origin_far",
            "warning" if in_scene else "critical",
            edge.place,
            element,
            "its origin is farther off than any robot is long: millimetres taken for metres?",
            distance,
            "m",
            f"less than {_LONG:g} m",
            "every frame beyond it is displaced",
            "one length from the kinematic drawing, with its unit",
        )
    if edge.rpy is None:
        return
    largest = float(np.abs(edge.rpy).max())
    if largest > 2 * math.pi + 1e-6:
        degrees = _like_degrees(edge.rpy[np.abs(edge.rpy) > 2 * math.pi])
        yield Finding(
            "joints.origin_degrees",
            "critical" if degrees else "warning",
            edge.place,
            element,
            "its roll, pitch, yaw look like degrees"
            if degrees
            else "its roll, pitch, yaw go beyond a turn",
            " ".join(f"{value:g}" for value in edge.rpy),
            "rad",
            f"{_radians(edge.rpy)} rad" if degrees else "angles within a turn",
            "read as radians the frame points somewhere else",
            "the kinematic drawing, or the frame shown in a viewer",
        )
        return
    off = edge.rpy - np.round(edge.rpy / (math.pi / 2)) * (math.pi / 2)
    # A right angle stated with few digits; small angles may be meant.
    cut = [
        abs(float(o))
        for o, v in zip(off, edge.rpy, strict=True)
        if _ROUNDED[0] < abs(o) < _ROUNDED[1] and abs(v) > 1.0
    ]
    if cut:
        effect = max(cut) * asset.beyond.get(edge.child, (0.0, 0.0))[1]
        yield Finding(
            "joints.origin_rounded",
            "warning" if effect > 5e-4 else "info",
            edge.place,
            element,
            f"a right angle with few digits: {effect * 1e3:.2g} mm at the farthest frame beyond",
            max(cut),
            "rad",
            "pi/2 to 1e-6 rad",
            "an error of the frame that calibration will later find as bias of a joint",
            "the exact angle from CAD; pi/2 if it is a right angle",
        )


def _range(asset: Asset, joint: Joint) -> Iterator[Finding]:
    element, unit = _element(joint), joint.unit
    if joint.idle_range is not None:
        low, high = joint.idle_range
        yield Finding(
            "joints.continuous_range",
            "warning",
            joint.place,
            element,
            "a continuous joint states a range: it binds in no simulator, and some planners use it",
            f"{low:g} .. {high:g}",
            unit,
            "type 'revolute' with this range, or a continuous joint without one",
            "simulated, the joint turns past its stops; planned, it stops where it could turn",
            f"look up in {_DATASHEET} whether it has hard stops",
        )
    if not joint.limit_stated and not joint.continuous:
        yield Finding(
            "joints.no_limit",
            "warning",
            joint.place,
            element,
            f"a {'prismatic' if joint.kind == 'slide' else 'revolute'} joint without <limit>",
            None,
            unit,
            '<limit lower="..." upper="..." effort="..." velocity="..."/>',
            "URDF requires it: parsers built on urdfdom (Pinocchio, RViz, MoveIt) refuse the file",
            f"add the element with the values of {_DATASHEET}",
        )
        return
    if joint.lower is None or joint.upper is None or not joint.limited:
        if not joint.continuous and asset.kind != "mjcf":
            yield Finding(
                "joints.no_range",
                "warning",
                joint.place,
                element,
                "no range is stated",
                None,
                unit,
                "lower and upper",
                "some tools lock the joint at 0, others let it turn without end",
                f"{_DATASHEET}, or the two hard stops found by hand with the power off",
            )
        return
    lower, upper = joint.lower, joint.upper
    text = f"{lower:g} .. {upper:g}"
    if upper - lower < 1e-9:
        yield Finding(
            "joints.empty_range",
            "warning",
            joint.place,
            element,
            "its range is empty: it cannot move",
            text,
            unit,
            "lower below upper, or a fixed joint",
            "a joint that is held by a limit is stiff in one simulator and springy in another",
            f"{_DATASHEET}; a fixed joint if it is one",
        )
    if joint.kind == "hinge" and max(abs(lower), abs(upper)) > _TURNS and upper < 1e6:
        degrees = _like_degrees(np.array([lower, upper]))
        yield Finding(
            "joints.range_degrees",
            "critical" if degrees else "warning",
            joint.place,
            element,
            "its range looks like degrees" if degrees else "its range is of many turns",
            text,
            unit,
            f"{_radians(np.array([lower, upper]))} rad" if degrees else "a few turns",
            "planners and simulators let it turn past every stop",
            f"{_DATASHEET}, with its unit",
        )
    if joint.kind == "slide" and max(abs(lower), abs(upper)) > 10.0 and upper < 1e6:
        yield Finding(
            "joints.range_millimetres",
            "warning",
            joint.place,
            element,
            "its travel is longer than a robot: millimetres taken for metres?",
            text,
            unit,
            "metres",
            "planners and simulators let it slide past every stop",
            f"{_DATASHEET}, with its unit",
        )
    if not lower - 1e-9 <= 0.0 <= upper + 1e-9:
        yield Finding(
            "joints.zero_outside",
            "info",
            joint.place,
            element,
            "zero is outside its range",
            text,
            unit,
            "a start pose other than all zeros",
            "simulators start at zero and push the joint back in the first step",
            "the home pose from the manual",
        )


def _bounds(asset: Asset, joint: Joint, *, passive: bool) -> Iterator[Finding]:
    if asset.kind != "urdf":
        # The others have no place for a speed, and state forces at actuators.
        return
    element = _element(joint)
    for name, value, unit in (
        ("velocity", joint.velocity, f"{joint.unit}/s"),
        ("effort", joint.effort, joint.effort_unit),
    ):
        if value is None or value == 0.0:
            if passive or not (joint.limit_stated or joint.continuous):
                continue
            said = "0" if value == 0.0 else "not stated"
            yield Finding(
                f"joints.no_{name}",
                "warning",
                joint.place,
                element,
                f"its largest {name} is {said}",
                value,
                unit,
                f"the largest {name} in {unit}",
                "taken literally it cannot move; left out, nothing bounds a command",
                f"{_DATASHEET}; 0 if it is passive, and then a passive joint declared so",
            )
    if joint.velocity is not None and _FAST < joint.velocity < 1e4:
        degrees = joint.kind == "hinge" and _like_degrees(np.array([joint.velocity]))
        yield Finding(
            "joints.velocity_units",
            "warning",
            joint.place,
            element,
            "its speed looks like degrees per second" if degrees else "it is implausibly fast",
            joint.velocity,
            f"{joint.unit}/s",
            f"{math.radians(joint.velocity):.4g} rad/s" if degrees else f"less than {_FAST:g}",
            "nothing bounds a command",
            f"{_DATASHEET}, with its unit",
        )


def _friction(joint: Joint) -> Iterator[Finding]:
    if not joint.damping and not joint.friction:
        said = "stated as none" if joint.damping == 0.0 else "not stated"
        yield Finding(
            "joints.friction_unknown",
            "unknown",
            joint.place,
            _element(joint),
            f"damping and friction are {said}",
            None,
            joint.effort_unit,
            None,
            "no drive is without friction: simulated motion needs less force than the real one",
            "slow reversals at several speeds, effort recorded: `pytest-twin diagnose` fits both",
        )


def _sign_and_zero(joint: Joint, evidence: Evidence) -> Iterator[Finding]:
    known = evidence.joints.get(joint.name)
    if known is None or not known.direction:
        yield Finding(
            "joints.sign_unknown",
            "unknown",
            joint.place,
            _element(joint),
            "which way is positive is not declared by anything but this file",
            " ".join(f"{value:.4g}" for value in joint.axis),
            None,
            None,
            "a flipped axis looks right at zero and runs away under feedback",
            "jog it by +0.05 rad (or 10 mm) slowly and watch; or the manual's figure of the axes",
        )
    if known is None or not known.zero:
        yield Finding(
            "joints.zero_unknown",
            "unknown",
            joint.place,
            _element(joint),
            "where the encoder reads zero is not declared by anything but this file",
            None,
            joint.unit,
            None,
            "an offset of the zero displaces every pose and the gravity torque",
            "the manual's zero pose, or a calibration of the joint offsets",
        )


def _like_degrees(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> bool:
    """Whether numbers are whole or half degrees of at most two turns."""
    rounded = np.round(values * 2) / 2
    return bool(
        np.all(np.abs(values - rounded) < 1e-9)
        and np.abs(values).max() <= 720.0
        and np.abs(values).max() >= 15.0
    )


def _radians(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    return " ".join(f"{math.radians(value):.5g}" for value in values)
