"""Transmissions and hardware interfaces: what stands between a motor and its joint."""

from __future__ import annotations

from collections.abc import Iterator

from pytest_twin.audit.asset import Asset, Transmission
from pytest_twin.audit.finding import Finding

INTERFACES = ("PositionJointInterface", "VelocityJointInterface", "EffortJointInterface")
"""Command interfaces of ros_control; state interfaces and names of packages may stand in front."""


def check(asset: Asset) -> Iterator[Finding]:
    """What is wrong with, or unknown of, transmissions."""
    for item in asset.transmissions:
        yield from _one(asset, item)
    driven = {joint for item in asset.transmissions for joint in item.joints}
    driven |= {joint for item in asset.actuators for joint in item.joints}
    followers = {mimic.follower for mimic in asset.mimics}
    for joint in asset.joints:
        if joint.name in driven or joint.name in followers or not joint.scalar:
            continue
        if asset.kind == "urdf" and joint.effort == 0.0:
            continue
        yield Finding(
            "transmissions.unknown",
            "unknown",
            joint.place,
            f"joint '{joint.name}'",
            "nothing says how a motor drives it: gear ratio, rotor inertia, efficiency, play",
            None,
            None,
            None,
            "reflected rotor inertia (ratio squared) can exceed the link's own, and gears rub",
            "the drive's datasheet: ratio and rotor inertia; or chirps of effort with the arm free",
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
                "its command moves a body, a tendon or nothing",
                "the model's documentation",
            )
        if actuator.gear == 0.0:
            yield Finding(
                "transmissions.zero_gear",
                "critical",
                actuator.place,
                f"actuator '{actuator.name}'",
                "its gear is 0: no command moves anything",
                0.0,
                "1",
                "the gear ratio",
                "the joint is passive and looks driven",
                "the drive's datasheet",
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
                "it drives a fixed joint" if fixed else "it drives a joint that is not there",
                joint,
                None,
                "the name of a moving joint",
                "a controller that loads it fails, or drives another joint",
                "the source macro: a misspelt name, or a joint that was renamed",
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
            "nothing is driven by it",
            "the source macro",
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
                "a division by it makes every command infinite",
                "the gear's datasheet",
            )
    if item.reductions and all(reduction == 1.0 for reduction in item.reductions):
        yield Finding(
            "transmissions.unit_reduction",
            "unknown",
            item.place,
            element,
            "its reduction is 1: a direct drive, or a placeholder",
            1.0,
            "1",
            "the gear ratio",
            "reflected rotor inertia goes with the ratio squared",
            "the gear's datasheet, or marks on motor and output after one turn",
        )
    for interface in item.interfaces:
        if not any(known in interface for known in (*INTERFACES, "StateInterface")):
            yield Finding(
                "transmissions.interface",
                "info",
                item.place,
                element,
                "its hardware interface is none of ros_control's own",
                interface,
                None,
                ", ".join(INTERFACES),
                "what the command means rests on that interface's driver",
                "the driver's documentation",
            )
