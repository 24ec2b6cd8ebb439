"""Transmissions and hardware interfaces between motors and joints."""

from __future__ import annotations

from collections.abc import Iterator

from pytest_twin.audit.asset import Asset, Transmission
from pytest_twin.audit.finding import Finding

INTERFACES = ("PositionJointInterface", "VelocityJointInterface", "EffortJointInterface")
"""Command interfaces of ros_control; a package name may precede them."""


def check(asset: Asset) -> Iterator[Finding]:
    """Faults and unknown properties of transmissions."""
    for item in asset.transmissions:
        yield from _one(asset, item)
    driven = {joint for item in asset.transmissions for joint in item.joints}
    driven |= {joint for item in asset.actuators for joint in item.joints}
    followers = {mimic.follower for mimic in asset.mimics}
    for joint in asset.joints:
        if joint.name in driven or joint.name in followers or not joint.is_scalar:
            continue
        if asset.kind == "urdf" and joint.effort == 0.0:
            continue
        yield Finding(
            "transmissions.unknown",
            "unknown",
            joint.place,
            f"joint '{joint.name}'",
            "its drive is not described: gear ratio, rotor inertia, efficiency, backlash",
            None,
            None,
            None,
            "reflected rotor inertia (times ratio squared) can exceed the inertia of the link",
            "take ratio and rotor inertia from the data sheet, or identify them from effort chirps",
        )
    for actuator in asset.actuators:
        if not actuator.joints:
            yield Finding(
                "transmissions.drives_nothing",
                "info",
                actuator.place,
                f"actuator '{actuator.name}'",
                "it drives no joint",
                None,
                None,
                None,
                "its command acts on a body, a tendon or nothing",
                "check in the model's documentation that this is intended",
            )
        if actuator.gear == 0.0:
            yield Finding(
                "transmissions.zero_gear",
                "critical",
                actuator.place,
                f"actuator '{actuator.name}'",
                "its gear is 0: commands have no effect",
                0.0,
                "1",
                "the gear ratio",
                "the joint looks driven and is passive",
                "state the gear from the drive's data sheet",
            )


def _one(asset: Asset, item: Transmission) -> Iterator[Finding]:
    element = f"transmission '{item.name}'"
    for joint in item.joints:
        if joint not in asset.joint:
            fixed = any(kind == "joint" and name == joint for kind, name, _ in asset.named)
            yield Finding(
                "transmissions.missing_joint",
                "warning" if fixed else "critical",
                item.place,
                element,
                "it drives a fixed joint" if fixed else "it drives a joint that does not exist",
                joint,
                None,
                "the name of a moving joint",
                "a controller that loads it fails, or drives the wrong joint",
                "correct the name, or remove the transmission",
            )
    if not item.joints:
        yield Finding(
            "transmissions.no_joint",
            "warning",
            item.place,
            element,
            "it names no joint",
            None,
            None,
            "<joint name='...'/>",
            "it drives nothing",
            "name the joint that it drives",
        )
    for reduction in item.reductions:
        if reduction == 0.0:
            yield Finding(
                "transmissions.zero_reduction",
                "critical",
                item.place,
                element,
                "its reduction is 0",
                0.0,
                "1",
                "the gear ratio",
                "a controller that divides by it sends infinite commands",
                "state the gear ratio from the data sheet",
            )
    if item.reductions and all(reduction == 1.0 for reduction in item.reductions):
        yield Finding(
            "transmissions.unit_reduction",
            "unknown",
            item.place,
            element,
            "its reduction is 1: direct drive or placeholder",
            1.0,
            "1",
            "the gear ratio",
            "the reflected rotor inertia grows with the ratio squared",
            "state the ratio from the data sheet, or count motor turns for one turn of the joint",
        )
    for interface in item.interfaces:
        if not any(known in interface for known in (*INTERFACES, "StateInterface")):
            yield Finding(
                "transmissions.interface",
                "info",
                item.place,
                element,
                "its hardware interface is not one of ros_control",
                interface,
                None,
                ", ".join(INTERFACES),
                "the driver of that interface defines what the command means",
                "read the driver's documentation",
            )
