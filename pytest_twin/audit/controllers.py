"""Controllers and sensors: soft limits, interfaces, mounting and rate of sensors."""

from __future__ import annotations

from collections.abc import Iterator

from pytest_twin.audit.asset import Asset
from pytest_twin.audit.finding import Finding, finding_of


def check(asset: Asset) -> Iterator[Finding]:
    """Yield faults and unknown properties of controllers and sensors."""
    yield from _safety(asset)
    yield from _interfaces(asset)
    yield from _sensors(asset)


def _safety(asset: Asset) -> Iterator[Finding]:
    for joint in asset.joints:
        if joint.soft is None:
            continue
        low, high = joint.soft
        place = joint.soft_place or joint.place
        text = f"{low:.5g} .. {high:.5g}"
        element = f"joint '{joint.name}'"
        if low > high:
            yield finding_of(
                "controllers.soft_limits",
                place,
                element,
                text,
                severity="critical",
                title="the lower soft limit is above the upper one",
                unit=joint.unit,
                expected="soft_lower_limit below soft_upper_limit",
                why="the safety controller allows no position",
            )
        elif low == high and (joint.has_stated_soft_limit or not joint.is_continuous):
            said = (
                "are equal" if joint.has_stated_soft_limit else "are not stated, and 0 by default"
            )
            yield finding_of(
                "controllers.soft_limits_empty",
                place,
                element,
                text,
                title=f"its soft limits {said}: they allow no motion",
                unit=joint.unit,
            )
        elif (
            joint.is_limited
            and joint.lower is not None
            and joint.upper is not None
            and (low < joint.lower - 1e-9 or high > joint.upper + 1e-9)
        ):
            yield finding_of(
                "controllers.soft_limits",
                place,
                element,
                text,
                severity="warning",
                title="its soft limits lie outside the hard limits and never act",
                unit=joint.unit,
                expected=f"within {joint.lower:.5g} .. {joint.upper:.5g}",
                why="nothing slows the joint before its stop",
            )
        if joint.soft_gain == 0.0:
            yield finding_of(
                "controllers.soft_gain",
                place,
                element,
                0.0,
                unit="N*m*s/rad" if joint.kind != "slide" else "N*s/m",
            )


def _interfaces(asset: Asset) -> Iterator[Finding]:
    for item in asset.controlled:
        if item.joint not in asset.joint:
            yield finding_of(
                "controllers.missing_joint",
                item.place,
                f"joint '{item.joint}'",
                item.joint,
                title=f"ros2_control '{item.system}' names a joint that does not exist or is fixed",
            )
        elif not item.states:
            yield finding_of(
                "controllers.no_state",
                item.place,
                f"joint '{item.joint}'",
                title=f"ros2_control '{item.system}' has no state interface for it",
            )
    actuated = bool(asset.actuators or asset.controlled)
    if not actuated and asset.joints:
        yield finding_of("controllers.unknown", asset.place, f"robot '{asset.name}'")


def _sensors(asset: Asset) -> Iterator[Finding]:
    carriers = set(asset.body) | set(asset.joint) | set(asset.sites)
    carriers |= {name for kind, name, _ in asset.named if kind == "joint"}
    for sensor in asset.sensors:
        element = f"sensor '{sensor.name}'"
        if sensor.carrier and sensor.carrier not in carriers and asset.kind == "urdf":
            yield finding_of("controllers.sensor_bearer", sensor.place, element, sensor.carrier)
        if sensor.rate is not None and not 0 <= sensor.rate <= 1e5:
            yield finding_of("controllers.sensor_rate", sensor.place, element, sensor.rate)
    if not asset.sensors and asset.joints and not any(i.states for i in asset.controlled):
        yield finding_of("controllers.sensors_unknown", asset.place, f"robot '{asset.name}'")
