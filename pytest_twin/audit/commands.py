"""Command semantics: the quantity, unit and sign of what is sent to a joint."""

from __future__ import annotations

from collections.abc import Iterator

from pytest_twin.audit.asset import Asset
from pytest_twin.audit.evidence import Evidence
from pytest_twin.audit.finding import Finding

_INTERFACES = {
    "position": "position setpoint",
    "velocity": "velocity setpoint",
    "effort": "torque or force",
}


def check(asset: Asset, evidence: Evidence) -> Iterator[Finding]:
    """Yield findings about the meaning of each command: declared, implied or unknown."""
    interfaces = {item.joint: item for item in asset.controlled if item.commands}
    for name in evidence.commands:
        if name not in asset.joint and name not in {a.name for a in asset.actuators}:
            yield Finding(
                "commands.evidence_unused",
                "warning",
                None if evidence.path is None else asset.place,
                f"command '{name}'",
                "the evidence names a joint or actuator that the asset does not have",
                name,
                None,
                "the name of a joint or actuator",
                "evidence under a wrong name is not used",
                "correct the name in the evidence file",
            )
    actuated: set[str] = set()
    for actuator in asset.actuators:
        actuated.update(actuator.joints)
        declared = evidence.commands.get(actuator.name)
        unclear = actuator.means is None
        yield Finding(
            "commands.unknown" if unclear and declared is None else "commands.declared",
            "unknown" if unclear and declared is None else "info",
            actuator.place,
            f"actuator '{actuator.name}'",
            f"its command is a {actuator.means}"
            if actuator.means is not None and declared is None
            else f"its command is declared: {declared}"
            if declared is not None
            else "gain and bias do not determine the meaning of its command",
            None,
            None,
            None,
            "a position sent where a torque is expected makes the joint run away",
            "command a small step at rest: the joint settles at it (position), moves on (velocity) "
            "or accelerates (effort)",
        )
    followers = {mimic.follower for mimic in asset.mimics}
    for joint in asset.joints:
        if joint.name in actuated or joint.name in followers or not joint.is_scalar:
            continue
        declared = evidence.commands.get(joint.name)
        element = f"joint '{joint.name}'"
        if declared is None and joint.name in interfaces:
            item = interfaces[joint.name]
            known = [_INTERFACES.get(name, name) for name in item.commands]
            yield Finding(
                "commands.interface",
                "info",
                item.place,
                element,
                f"ros2_control accepts: {', '.join(known)}",
                " ".join(item.commands),
                None,
                None,
                "gains, filters and limits of the driver act between the command and the motor",
                "read the driver's documentation",
            )
        elif declared is None:
            yield Finding(
                "commands.unknown",
                "unknown",
                joint.place,
                element,
                "the meaning of its command is not declared: position, velocity or effort, unit, "
                "sign and zero",
                None,
                None,
                None,
                "a position sent where a torque is expected makes the joint run away",
                "look it up in the manual of the SDK, or command a small step at rest: the joint "
                "settles at it (position), moves on (velocity) or accelerates (effort)",
            )
        else:
            yield Finding(
                "commands.declared",
                "info",
                joint.place,
                element,
                f"its command is declared: {declared}",
                None,
                None,
                None,
                "replay and goldens use this declaration",
                "confirm it by a replay of one recorded step",
            )
