"""Transmissions and hardware interfaces between motors and joints."""

from __future__ import annotations

from collections.abc import Iterator

from pytest_twin.audit.asset import Asset, Transmission
from pytest_twin.audit.finding import Finding, finding_of

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
        yield finding_of("transmissions.unknown", joint.place, f"joint '{joint.name}'")
    for actuator in asset.actuators:
        if not actuator.joints:
            yield finding_of(
                "transmissions.drives_nothing", actuator.place, f"actuator '{actuator.name}'"
            )
        if actuator.gear == 0.0:
            yield finding_of(
                "transmissions.zero_gear", actuator.place, f"actuator '{actuator.name}'", 0.0
            )


def _one(asset: Asset, item: Transmission) -> Iterator[Finding]:
    element = f"transmission '{item.name}'"
    for joint in item.joints:
        if joint not in asset.joint:
            fixed = any(kind == "joint" and name == joint for kind, name, _ in asset.named)
            yield finding_of(
                "transmissions.missing_joint",
                item.place,
                element,
                joint,
                severity="warning" if fixed else "critical",
                title="it drives a fixed joint"
                if fixed
                else "it drives a joint that does not exist",
            )
    if not item.joints:
        yield finding_of("transmissions.no_joint", item.place, element)
    for reduction in item.reductions:
        if reduction == 0.0:
            yield finding_of("transmissions.zero_reduction", item.place, element, 0.0)
    if item.reductions and all(reduction == 1.0 for reduction in item.reductions):
        yield finding_of("transmissions.unit_reduction", item.place, element, 1.0)
    for interface in item.interfaces:
        if not any(known in interface for known in (*INTERFACES, "StateInterface")):
            yield finding_of(
                "transmissions.interface",
                item.place,
                element,
                interface,
                expected=", ".join(INTERFACES),
            )
