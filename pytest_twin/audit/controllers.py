"""Controllers and sensors: soft limits, interfaces, what bears a sensor and how often it speaks."""

from __future__ import annotations

from collections.abc import Iterator

from pytest_twin.audit.asset import Asset
from pytest_twin.audit.finding import Finding


def check(asset: Asset) -> Iterator[Finding]:
    """What is wrong with, or unknown of, controllers and sensors."""
    yield from _safety(asset)
    yield from _interfaces(asset)
    yield from _sensors(asset)
    for tag, places in sorted(asset.custom.items()):
        yield Finding(
            "controllers.custom_tag",
            "info",
            places[0],
            tag,
            f"{len(places)} elements <{tag.rpartition('/')[2]}> that the format does not define",
            float(len(places)),
            "elements",
            None,
            "what they say is lost in every conversion that does not know them",
            "the documentation of the tool that they are for",
        )


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
                "its soft limits stand the wrong way round",
                text,
                joint.unit,
                "lower below upper",
                "the safety controller holds the joint nowhere",
                "the controller's configuration",
            )
        elif (
            joint.limited
            and joint.lower is not None
            and joint.upper is not None
            and (low < joint.lower - 1e-9 or high > joint.upper + 1e-9)
            and not (low == high == 0.0)
        ):
            yield Finding(
                "controllers.soft_limits",
                "warning",
                place,
                element,
                "its soft limits lie outside the hard ones and never act",
                text,
                joint.unit,
                f"within {joint.lower:.5g} .. {joint.upper:.5g}",
                "nothing slows the joint before the stop",
                "the controller's configuration",
            )


def _interfaces(asset: Asset) -> Iterator[Finding]:
    for item in asset.controlled:
        if item.joint not in asset.joint:
            yield Finding(
                "controllers.missing_joint",
                "critical",
                item.place,
                f"joint '{item.joint}'",
                f"ros2_control '{item.system}' names a joint that is not there or does not move",
                item.joint,
                None,
                "the name of a moving joint",
                "the controller manager refuses to start",
                "the source macro: a misspelt name, or a joint that was renamed",
            )
        elif not item.states:
            yield Finding(
                "controllers.no_state",
                "unknown",
                item.place,
                f"joint '{item.joint}'",
                f"ros2_control '{item.system}' reads no state of it",
                None,
                None,
                "a state interface",
                "a joint that is not sensed cannot be compared with a recording",
                "the driver's documentation: whether it has an encoder, and on which side",
            )
    actuated = bool(asset.actuators or asset.controlled)
    if not actuated and asset.joints:
        yield Finding(
            "controllers.unknown",
            "unknown",
            asset.place,
            f"robot '{asset.name}'",
            "no controller is declared: gains, rates, filters, saturation, watchdogs",
            None,
            None,
            None,
            "most of what a joint does under a command is its controller",
            "the controller's configuration files; steps and chirps where there are none",
        )


def _sensors(asset: Asset) -> Iterator[Finding]:
    bearers = set(asset.body) | set(asset.joint) | set(asset.sites)
    bearers |= {name for kind, name, _ in asset.named if kind == "joint"}
    for sensor in asset.sensors:
        element = f"sensor '{sensor.name}'"
        if sensor.bearer and sensor.bearer not in bearers and asset.kind == "urdf":
            yield Finding(
                "controllers.sensor_bearer",
                "critical",
                sensor.place,
                element,
                "what bears it is not there",
                sensor.bearer,
                None,
                "the name of a link or joint",
                "its readings are of nowhere",
                "the source macro: a misspelt name, or a link that was renamed",
            )
        if sensor.rate is not None and not 0 <= sensor.rate <= 1e5:
            yield Finding(
                "controllers.sensor_rate",
                "warning",
                sensor.place,
                element,
                "its rate is implausible",
                sensor.rate,
                "Hz",
                "0 .. 1e5 Hz",
                "a simulated sensor then floods or starves its readers",
                "the sensor's datasheet",
            )
    if not asset.sensors and asset.joints and not any(i.states for i in asset.controlled):
        yield Finding(
            "controllers.sensors_unknown",
            "unknown",
            asset.place,
            f"robot '{asset.name}'",
            "no sensor is declared: encoders on which side of the gear, their resolution, torque "
            "sensing",
            None,
            None,
            None,
            "motor-side encoders do not see what the gear and the link give way",
            "the datasheet; or the link pushed by hand with the motor held: does the reading move?",
        )
