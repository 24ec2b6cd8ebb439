"""Command semantics: the quantity, unit and sign of what is sent to a joint."""

from __future__ import annotations

from collections.abc import Iterator

from pytest_twin.audit.asset import Asset
from pytest_twin.audit.evidence import Evidence
from pytest_twin.audit.finding import Finding, finding_of

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
            yield finding_of(
                "commands.evidence_unused",
                None if evidence.path is None else asset.place,
                f"command '{name}'",
                name,
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
            yield finding_of(
                "commands.interface",
                item.place,
                element,
                " ".join(item.commands),
                title=f"ros2_control accepts: {', '.join(known)}",
            )
        elif declared is None:
            yield finding_of("commands.unknown", joint.place, element)
        else:
            yield finding_of(
                "commands.declared",
                joint.place,
                element,
                title=f"its command is declared: {declared}",
            )
