"""Controllers and sensors: soft limits, interfaces, mounting and rate of sensors."""

from __future__ import annotations

from collections.abc import Iterator

from pytest_twin.audit.asset import Asset
from pytest_twin.audit.finding import Finding


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
            yield Finding(
                "controllers.soft_limits",
                "critical",
                place,
                element,
                "the lower soft limit is above the upper one",
                text,
                joint.unit,
                "soft_lower_limit below soft_upper_limit",
                "the safety controller allows no position",
                "take both limits from the controller's configuration",
            )
        elif low == high and (joint.has_stated_soft_limit or not joint.is_continuous):
            said = (
                "are equal" if joint.has_stated_soft_limit else "are not stated, and 0 by default"
            )
            yield Finding(
                "controllers.soft_limits_empty",
                "warning",
                place,
                element,
                f"its soft limits {said}: they allow no motion",
                text,
                joint.unit,
                "soft limits within the range of the joint, or no <safety_controller>",
                "MoveIt and joint sliders lock the joint at this position",
                "take both limits from the controller's configuration, or remove the element",
            )
        elif (
            joint.is_limited
            and joint.lower is not None
            and joint.upper is not None
            and (low < joint.lower - 1e-9 or high > joint.upper + 1e-9)
        ):
            yield Finding(
                "controllers.soft_limits",
                "warning",
                place,
                element,
                "its soft limits lie outside the hard limits and never act",
                text,
                joint.unit,
                f"within {joint.lower:.5g} .. {joint.upper:.5g}",
                "nothing slows the joint before its stop",
                "take both limits from the controller's configuration",
            )
        if joint.soft_gain == 0.0:
            yield Finding(
                "controllers.soft_gain",
                "warning",
                place,
                element,
                "k_velocity of its safety controller is 0",
                0.0,
                "N*m*s/rad" if joint.kind != "slide" else "N*s/m",
                "k_velocity above 0",
                "the effort that the controller allows is k_velocity times a speed: 0 at any speed",
                "take the gain from the controller's configuration, or remove the element",
            )


def _interfaces(asset: Asset) -> Iterator[Finding]:
    for item in asset.controlled:
        if item.joint not in asset.joint:
            yield Finding(
                "controllers.missing_joint",
                "critical",
                item.place,
                f"joint '{item.joint}'",
                f"ros2_control '{item.system}' names a joint that does not exist or is fixed",
                item.joint,
                None,
                "the name of a moving joint",
                "the controller manager refuses to start",
                "correct the name in the <ros2_control> element",
            )
        elif not item.states:
            yield Finding(
                "controllers.no_state",
                "unknown",
                item.place,
                f"joint '{item.joint}'",
                f"ros2_control '{item.system}' has no state interface for it",
                None,
                None,
                "a state interface",
                "a joint without a measured state cannot be compared with a recording",
                "look up whether it has an encoder, and on which side of the gear",
            )
    actuated = bool(asset.actuators or asset.controlled)
    if not actuated and asset.joints:
        yield Finding(
            "controllers.unknown",
            "unknown",
            asset.place,
            f"robot '{asset.name}'",
            "the controller is not described: gains, rates, filters, saturation, watchdogs",
            None,
            None,
            None,
            "the controller shapes most of the response to a command",
            "state the controller in twin.yaml from its configuration files, or identify it from "
            "steps and chirps",
        )


def _sensors(asset: Asset) -> Iterator[Finding]:
    carriers = set(asset.body) | set(asset.joint) | set(asset.sites)
    carriers |= {name for kind, name, _ in asset.named if kind == "joint"}
    for sensor in asset.sensors:
        element = f"sensor '{sensor.name}'"
        if sensor.carrier and sensor.carrier not in carriers and asset.kind == "urdf":
            yield Finding(
                "controllers.sensor_bearer",
                "critical",
                sensor.place,
                element,
                "the link or joint that carries it does not exist",
                sensor.carrier,
                None,
                "the name of a link or joint",
                "its readings belong to no frame",
                "correct the name of the link or joint",
            )
        if sensor.rate is not None and not 0 <= sensor.rate <= 1e5:
            yield Finding(
                "controllers.sensor_rate",
                "warning",
                sensor.place,
                element,
                "its update rate is implausible",
                sensor.rate,
                "Hz",
                "0 .. 1e5 Hz",
                "a simulated sensor sends far too much or too little",
                "state the rate from the sensor's data sheet",
            )
    if not asset.sensors and asset.joints and not any(i.states for i in asset.controlled):
        yield Finding(
            "controllers.sensors_unknown",
            "unknown",
            asset.place,
            f"robot '{asset.name}'",
            "no sensor is described: side and resolution of the encoders, torque sensing",
            None,
            None,
            None,
            "an encoder on the motor side does not see the deflection of gear and link",
            "look it up in the data sheet, or hold the motor, push the link and watch the reading",
        )
