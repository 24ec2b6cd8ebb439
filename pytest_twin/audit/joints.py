"""Joints: axis, origin, range, velocity, effort, damping; degrees instead of radians."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from pytest_twin.audit.asset import Asset, Edge, Joint, Vector
from pytest_twin.audit.evidence import Evidence
from pytest_twin.audit.finding import Finding, Place, finding_of

_TURNS = 4 * math.pi
"""rad: two turns in each direction; few robot joints turn farther."""
_ROUNDED = (1e-6, 2e-3)
"""rad: error of a right angle stated with few digits, such as 1.57."""
_LONG = 100.0
"""m: no robot has a larger distance between two links."""
_FAST = 100.0
"""rad/s or m/s: no robot joint is faster."""
_FAST_IN_RANGE = 45.0
"""rad/s: of 68 public robots, only joints with a placeholder of 100, or with 52.4 or 59.9, have a
range and are faster."""
_DATASHEET = "the data sheet or manual of this joint"


def check(asset: Asset, evidence: Evidence) -> Iterator[Finding]:
    """Yield faults and unknown properties of each joint."""
    followers = {mimic.follower for mimic in asset.mimics}
    for edge in asset.edges:
        yield from _origin(asset, edge)
    for placed in asset.placements:
        yield from _degrees(placed.place, placed.element, placed.rpy)
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
            yield finding_of("joints.axis_left_out", joint.place, _element(joint), "1 0 0")
        return
    length = float(np.linalg.norm(joint.axis_stated))
    if abs(length - 1.0) > 1e-3:
        yield finding_of("joints.axis_not_unit", joint.place, _element(joint), length)
    elif abs(length - 1.0) > 1e-6:
        yield finding_of("joints.axis_rounded", joint.place, _element(joint), length)


def _origin(asset: Asset, edge: Edge) -> Iterator[Finding]:
    element = f"joint '{edge.name}'" if asset.kind == "urdf" else f"body '{edge.child}'"
    distance = float(np.linalg.norm(edge.position))
    if distance > _LONG:
        # A scene may place a body that far; no link of a robot is that far from its parent.
        in_scene = asset.kind == "mjcf" and edge.parent == "world"
        yield finding_of(
            "joints.origin_far",
            edge.place,
            element,
            distance,
            severity="warning" if in_scene else "critical",
            expected=f"less than {_LONG:g} m",
        )
    if edge.rpy is None:
        return
    degrees = list(_degrees(edge.place, element, edge.rpy))
    yield from degrees
    if degrees:
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
        yield finding_of(
            "joints.origin_rounded",
            edge.place,
            element,
            max(cut),
            severity="warning" if effect > 5e-4 else "info",
            title=f"a right angle has few digits: {effect * 1e3:.2g} mm at the farthest frame "
            "after it",
        )


def _degrees(place: Place, element: str, rpy: Vector) -> Iterator[Finding]:
    """Yield a finding of roll, pitch and yaw (3,) that are not angles in rad."""
    size = np.abs(rpy)
    most = float(size.max())
    beyond_turn = most > 2 * math.pi + 1e-6
    looks = _looks_like_degrees(rpy[size > 2 * math.pi]) if beyond_turn else False
    if not beyond_turn and not (_is_whole(rpy[size > math.pi]) and most > math.pi + 1e-2):
        return
    yield finding_of(
        "joints.origin_degrees",
        place,
        element,
        " ".join(f"{value:g}" for value in rpy),
        severity="critical" if looks else "warning",
        title="its roll, pitch and yaw look like degrees"
        if looks or not beyond_turn
        else "its roll, pitch or yaw exceeds one turn",
        expected=f"{_radians(rpy)} rad"
        if looks or not beyond_turn
        else "angles between -6.28 and 6.28 rad",
    )


def _range(asset: Asset, joint: Joint) -> Iterator[Finding]:
    element, unit = _element(joint), joint.unit
    if joint.idle_range is not None:
        low, high = joint.idle_range
        yield finding_of(
            "joints.continuous_range", joint.place, element, f"{low:g} .. {high:g}", unit=unit
        )
    if not joint.has_stated_limit and not joint.is_continuous:
        yield finding_of(
            "joints.no_limit",
            joint.place,
            element,
            title=f"a {'prismatic' if joint.kind == 'slide' else 'revolute'} joint without <limit>",
            unit=unit,
        )
        return
    if joint.lower is None or joint.upper is None or not joint.is_limited:
        if not joint.is_continuous and asset.kind != "mjcf":
            yield finding_of("joints.no_range", joint.place, element, unit=unit)
        return
    lower, upper = joint.lower, joint.upper
    text = f"{lower:g} .. {upper:g}"
    if upper - lower < 1e-9:
        yield finding_of("joints.empty_range", joint.place, element, text, unit=unit)
    ends = np.array([lower, upper])
    farthest = float(np.abs(ends).max())
    beyond_turn = ends[np.abs(ends) > 2 * math.pi + 1e-2]
    if joint.kind == "hinge" and 2 * math.pi + 1e-2 < farthest <= _TURNS and _is_whole(beyond_turn):
        yield finding_of(
            "joints.range_degrees",
            joint.place,
            element,
            text,
            severity="warning",
            title="its range exceeds one turn and has whole numbers; degrees taken for radians?",
            unit=unit,
            expected=f"{_radians(ends)} rad, if it is in degrees",
        )
    if joint.kind == "hinge" and farthest > _TURNS and upper < 1e6:
        degrees = _looks_like_degrees(ends)
        yield finding_of(
            "joints.range_degrees",
            joint.place,
            element,
            text,
            severity="critical" if degrees else "warning",
            title="its range looks like degrees"
            if degrees
            else "its range exceeds two turns to one side",
            unit=unit,
            expected=f"{_radians(ends)} rad"
            if degrees
            else "a range within two turns to either side",
        )
    if joint.kind == "slide" and farthest > 10.0 and upper < 1e6:
        yield finding_of("joints.range_millimetres", joint.place, element, text, unit=unit)
    elif joint.kind == "slide" and asset.kind == "urdf" and upper - lower > 2 * asset.span > 0:
        yield finding_of(
            "joints.range_millimetres",
            joint.place,
            element,
            text,
            title=f"its travel is {(upper - lower) / asset.span:.2g} times as long as the robot; "
            "a revolute joint, or another unit?",
            unit=unit,
        )
    if not lower - 1e-9 <= 0.0 <= upper + 1e-9:
        yield finding_of("joints.zero_outside", joint.place, element, text, unit=unit)


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
    if joint.velocity is not None and (_FAST < joint.velocity < 1e4 or _whole_and_fast(joint)):
        degrees = joint.kind == "hinge" and _looks_like_degrees(np.array([joint.velocity]))
        yield finding_of(
            "joints.velocity_units",
            joint.place,
            element,
            joint.velocity,
            title="its velocity limit looks like degrees per second"
            if degrees
            else "its velocity limit is implausibly high",
            unit=f"{joint.unit}/s",
            expected=f"{math.radians(joint.velocity):.4g} rad/s"
            if degrees
            else f"less than {_FAST:g}",
            settle=f"state the limit from {_DATASHEET} in {joint.unit}/s",
        )


def _whole_and_fast(joint: Joint) -> bool:
    """Whether a joint with a range has a speed limit such as 60, 90 or 100."""
    speed = joint.velocity or 0.0
    return (
        joint.kind == "hinge"
        and joint.is_limited
        and _FAST_IN_RANGE <= speed <= _FAST
        and speed % 5 == 0
    )


def _friction(joint: Joint) -> Iterator[Finding]:
    if joint.friction and joint.effort and joint.friction >= joint.effort:
        yield finding_of(
            "joints.friction_above_effort",
            joint.place,
            _element(joint),
            joint.friction,
            unit=joint.effort_unit,
            expected=f"less than its effort limit, {joint.effort:g} {joint.effort_unit}",
        )
    if not joint.damping and not joint.friction:
        said = "0" if joint.damping == 0.0 else "not stated"
        yield finding_of(
            "joints.friction_unknown",
            joint.place,
            _element(joint),
            title=f"damping and friction are {said}",
            unit=joint.effort_unit,
        )


def _sign_and_zero(joint: Joint, evidence: Evidence) -> Iterator[Finding]:
    known = evidence.joints.get(joint.name)
    if known is None or not known.direction:
        yield finding_of(
            "joints.sign_unknown",
            joint.place,
            _element(joint),
            " ".join(f"{value:.4g}" for value in joint.axis),
        )
    if known is None or not known.zero:
        yield finding_of("joints.zero_unknown", joint.place, _element(joint), unit=joint.unit)


def _looks_like_degrees(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> bool:
    """Whether numbers are multiples of 0.5, up to 720, as angles in degrees usually are."""
    rounded = np.round(values * 2) / 2
    return bool(
        np.all(np.abs(values - rounded) < 1e-9)
        and np.abs(values).max() <= 720.0
        and np.abs(values).max() >= 15.0
    )


def _is_whole(values: Vector) -> bool:
    """Whether numbers are multiples of 0.5 and none is within 1 % of a multiple of pi / 2."""
    right = np.round(values / (math.pi / 2)) * (math.pi / 2)
    return bool(
        np.all(np.abs(values - np.round(values * 2) / 2) < 1e-9)
        and np.all(np.abs(values - right) > 0.01 * np.abs(values))
    )


def _radians(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    return " ".join(f"{math.radians(value):.5g}" for value in values)
