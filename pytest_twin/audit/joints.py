"""Joints: axis, origin, range, velocity, effort, damping; degrees instead of radians."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from pytest_twin.audit.asset import Asset, Edge, Joint
from pytest_twin.audit.evidence import Evidence
from pytest_twin.audit.finding import Finding

_TURNS = 4 * math.pi
"""rad: two turns in each direction; few robot joints turn farther."""
_ROUNDED = (1e-6, 2e-3)
"""rad: error of a right angle stated with few digits, such as 1.57."""
_LONG = 100.0
"""m: no robot has a larger distance between two links."""
_FAST = 100.0
"""rad/s or m/s: no robot joint is faster."""
_DATASHEET = "the data sheet or manual of this joint"


def check(asset: Asset, evidence: Evidence) -> Iterator[Finding]:
    """Yield faults and unknown properties of each joint."""
    followers = {mimic.follower for mimic in asset.mimics}
    for edge in asset.edges:
        yield from _origin(asset, edge)
    for joint in asset.joints:
        if asset.kind == "urdf":
            # The other formats normalize the axis by definition.
            yield from _axis(joint)
        if joint.is_scalar:
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
                "its axis is not stated: x of the joint's frame by default",
                "1 0 0",
                None,
                '<axis xyz="..."/>',
                "a forgotten axis makes the joint turn about x",
                "state the axis as in the kinematic drawing",
            )
        return
    length = float(np.linalg.norm(joint.axis_stated))
    if abs(length - 1.0) > 1e-3:
        yield Finding(
            "joints.axis_not_unit",
            "critical",
            joint.place,
            _element(joint),
            "its axis is not a unit vector",
            length,
            "1",
            "length 1",
            "a parser that does not normalize it scales angles, torques and speeds by its length",
            "normalize the axis; if the length is a gear ratio, state it in a transmission",
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
            "parsers that do not normalize it move the joint by a slightly different amount",
            "state the axis with 9 digits",
        )


def _origin(asset: Asset, edge: Edge) -> Iterator[Finding]:
    element = f"joint '{edge.name}'" if asset.kind == "urdf" else f"body '{edge.child}'"
    distance = float(np.linalg.norm(edge.position))
    if distance > _LONG:
        # A scene may place a body that far; no link of a robot is that far from its parent.
        in_scene = asset.kind == "mjcf" and edge.parent == "world"
        yield Finding(
            "joints.origin_far",
            "warning" if in_scene else "critical",
            edge.place,
            element,
            "its distance to its parent is larger than any robot; millimetres taken for metres?",
            distance,
            "m",
            f"less than {_LONG:g} m",
            "every frame after it is displaced",
            "compare one length with the kinematic drawing, and correct the unit",
        )
    if edge.rpy is None:
        return
    largest = float(np.abs(edge.rpy).max())
    if largest > 2 * math.pi + 1e-6:
        degrees = _looks_like_degrees(edge.rpy[np.abs(edge.rpy) > 2 * math.pi])
        yield Finding(
            "joints.origin_degrees",
            "critical" if degrees else "warning",
            edge.place,
            element,
            "its roll, pitch and yaw look like degrees"
            if degrees
            else "its roll, pitch or yaw exceeds one turn",
            " ".join(f"{value:g}" for value in edge.rpy),
            "rad",
            f"{_radians(edge.rpy)} rad" if degrees else "angles between -6.28 and 6.28 rad",
            "read as radians, the frame has another orientation",
            "convert the angles to radians, and look at the frame in a viewer",
        )
        return
    off = edge.rpy - np.round(edge.rpy / (math.pi / 2)) * (math.pi / 2)
    # A right angle stated with few digits; small angles may be intended.
    cut = [
        abs(float(o))
        for o, v in zip(off, edge.rpy, strict=True)
        if _ROUNDED[0] < abs(o) < _ROUNDED[1] and abs(v) > 1.0
    ]
    if cut:
        effect = max(cut) * asset.subtrees.get(edge.child, (0.0, 0.0))[1]
        yield Finding(
            "joints.origin_rounded",
            "warning" if effect > 5e-4 else "info",
            edge.place,
            element,
            f"a right angle has few digits: {effect * 1e3:.2g} mm at the farthest frame after it",
            max(cut),
            "rad",
            "pi/2 to 1e-6 rad",
            "a calibration later finds this error as the offset of a joint",
            "state the exact angle: 1.5707963267948966 for a right angle",
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
            "a continuous joint states a range: simulators ignore it, and some planners use it",
            f"{low:g} .. {high:g}",
            unit,
            "type 'revolute' with this range, or a continuous joint without one",
            "simulated, the joint turns past its stops; planned, it stops where it could turn",
            f"look up in {_DATASHEET} whether it has hard stops",
        )
    if not joint.has_stated_limit and not joint.is_continuous:
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
    if joint.lower is None or joint.upper is None or not joint.is_limited:
        if not joint.is_continuous and asset.kind != "mjcf":
            yield Finding(
                "joints.no_range",
                "warning",
                joint.place,
                element,
                "its range is not stated",
                None,
                unit,
                "lower and upper",
                "some tools lock the joint at 0, others let it turn without limit",
                f"state lower and upper from {_DATASHEET}, or move the joint to both stops by hand",
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
            "its range is empty, so the joint cannot move",
            text,
            unit,
            "lower below upper, or type 'fixed'",
            "a joint held by its limit is stiff in one simulator and springy in another",
            f"state the range from {_DATASHEET}, or make the joint fixed",
        )
    if joint.kind == "hinge" and max(abs(lower), abs(upper)) > _TURNS and upper < 1e6:
        degrees = _looks_like_degrees(np.array([lower, upper]))
        yield Finding(
            "joints.range_degrees",
            "critical" if degrees else "warning",
            joint.place,
            element,
            "its range looks like degrees"
            if degrees
            else "its range exceeds two turns to one side",
            text,
            unit,
            f"{_radians(np.array([lower, upper]))} rad"
            if degrees
            else "a range within two turns to either side",
            "planners and simulators let it turn past its stops",
            f"state the range from {_DATASHEET} in rad",
        )
    if joint.kind == "slide" and max(abs(lower), abs(upper)) > 10.0 and upper < 1e6:
        yield Finding(
            "joints.range_millimetres",
            "warning",
            joint.place,
            element,
            "its travel is longer than a robot; millimetres taken for metres?",
            text,
            unit,
            "a travel within 10 m",
            "planners and simulators let it slide past its stops",
            f"state the range from {_DATASHEET} in m",
        )
    if not lower - 1e-9 <= 0.0 <= upper + 1e-9:
        yield Finding(
            "joints.zero_outside",
            "info",
            joint.place,
            element,
            "0 is outside its range",
            text,
            unit,
            "a start pose within the ranges",
            "simulators start at 0 and push the joint into its range in the first step",
            "give the simulator a keyframe with the home pose of the manual",
        )


def _bounds(asset: Asset, joint: Joint, *, passive: bool) -> Iterator[Finding]:
    if asset.kind != "urdf":
        # MJCF and USD have no speed limits, and state force limits at actuators.
        return
    element = _element(joint)
    for name, value, unit in (
        ("velocity", joint.velocity, f"{joint.unit}/s"),
        ("effort", joint.effort, joint.effort_unit),
    ):
        if value is None or value == 0.0:
            if passive or not (joint.has_stated_limit or joint.is_continuous):
                continue
            said = "0" if value == 0.0 else "not stated"
            yield Finding(
                f"joints.no_{name}",
                "warning",
                joint.place,
                element,
                f"its {name} limit is {said}",
                value,
                unit,
                f"a {name} limit above 0 {unit}",
                "with a limit of 0 the joint cannot move; without a limit nothing limits a command",
                f"state the limit from {_DATASHEET}; a joint without a motor keeps 0",
            )
    if joint.velocity is not None and _FAST < joint.velocity < 1e4:
        degrees = joint.kind == "hinge" and _looks_like_degrees(np.array([joint.velocity]))
        yield Finding(
            "joints.velocity_units",
            "warning",
            joint.place,
            element,
            "its velocity limit looks like degrees per second"
            if degrees
            else "its velocity limit is implausibly high",
            joint.velocity,
            f"{joint.unit}/s",
            f"{math.radians(joint.velocity):.4g} rad/s" if degrees else f"less than {_FAST:g}",
            "nothing limits a command",
            f"state the limit from {_DATASHEET} in {joint.unit}/s",
        )


def _friction(joint: Joint) -> Iterator[Finding]:
    if not joint.damping and not joint.friction:
        said = "0" if joint.damping == 0.0 else "not stated"
        yield Finding(
            "joints.friction_unknown",
            "unknown",
            joint.place,
            _element(joint),
            f"damping and friction are {said}",
            None,
            joint.effort_unit,
            None,
            "every real drive has friction: simulated motion needs less force than the real one",
            "record slow reversals at several speeds; `pytest-twin diagnose` fits both",
        )


def _sign_and_zero(joint: Joint, evidence: Evidence) -> Iterator[Finding]:
    known = evidence.joints.get(joint.name)
    if known is None or not known.direction:
        yield Finding(
            "joints.sign_unknown",
            "unknown",
            joint.place,
            _element(joint),
            "no second source confirms its positive direction",
            " ".join(f"{value:.4g}" for value in joint.axis),
            None,
            None,
            "a flipped axis looks right at 0 and makes a feedback loop unstable",
            "jog the joint by +0.05 rad or +10 mm, and declare the direction in the evidence file",
        )
    if known is None or not known.zero:
        yield Finding(
            "joints.zero_unknown",
            "unknown",
            joint.place,
            _element(joint),
            "no second source confirms the pose at which its encoder reads 0",
            None,
            joint.unit,
            None,
            "a zero offset displaces every pose and changes the gravity torque",
            "compare the zero pose with the manual, or calibrate the joint offsets",
        )


def _looks_like_degrees(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> bool:
    """Whether numbers are multiples of 0.5, up to 720, as angles in degrees usually are."""
    rounded = np.round(values * 2) / 2
    return bool(
        np.all(np.abs(values - rounded) < 1e-9)
        and np.abs(values).max() <= 720.0
        and np.abs(values).max() >= 15.0
    )


def _radians(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    return " ".join(f"{math.radians(value):.5g}" for value in values)
