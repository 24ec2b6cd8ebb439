"""Coupling: independent, following, passive and sensed degrees of freedom."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from pytest_twin.audit.asset import Asset, Mimic
from pytest_twin.audit.finding import Finding, finding_of


@dataclass(frozen=True, slots=True)
class DegreesOfFreedom:
    """Numbers of degrees of freedom.

    Attributes:
        total: degrees of freedom of all joints.
        independent: degrees of freedom that remain with all followers and constraints.
        constrained: degrees of freedom that closed chains and other constraints remove, besides
            those of followers.
        follower: names of joints that follow another.
        passive: names of joints that are neither driven nor followers.
        sensed: names of joints whose state an interface or a sensor measures.
    """

    total: int
    independent: int
    constrained: int
    follower: tuple[str, ...]
    passive: tuple[str, ...]
    sensed: tuple[str, ...]


def degrees_of_freedom(asset: Asset) -> DegreesOfFreedom:
    """Count the degrees of freedom of an asset."""
    followers = tuple(dict.fromkeys(m.follower for m in asset.mimics if m.follower in asset.joint))
    driven = {joint for actuator in asset.actuators for joint in actuator.joints}
    driven |= {joint for item in asset.transmissions for joint in item.joints}
    driven |= {item.joint for item in asset.controlled if item.commands}
    if asset.kind == "urdf":
        # URDF has no element for a drive: a stated effort is the only sign of one.
        driven |= {joint.name for joint in asset.joints if joint.effort}
    sensed = {item.joint for item in asset.controlled if item.states}
    sensed |= {sensor.carrier for sensor in asset.sensors if sensor.carrier in asset.joint}
    total = sum(joint.dof for joint in asset.joints)
    moved = driven | set(followers)
    following = sum(asset.joint[name].dof for name in followers)
    removed = following if asset.constrained is None else max(asset.constrained, 0)
    return DegreesOfFreedom(
        total,
        total - removed,
        max(removed - following, 0),
        followers,
        tuple(joint.name for joint in asset.joints if joint.is_scalar and joint.name not in moved),
        tuple(joint.name for joint in asset.joints if joint.name in sensed),
    )


def check(asset: Asset) -> Iterator[Finding]:
    """Yield faults and unknown properties of couplings."""
    yield from _chains(asset)
    for mimic in asset.mimics:
        yield from _mimic(asset, mimic)
    found = degrees_of_freedom(asset)
    for name in found.passive:
        joint = asset.joint[name]
        yield finding_of(
            "coupling.passive",
            joint.place,
            f"joint '{name}'",
            severity="unknown" if asset.kind == "urdf" else "info",
        )
    yield from _closures(asset)


def _chains(asset: Asset) -> Iterator[Finding]:
    """Yield findings of chains and loops of mimic joints; each joint is visited once."""
    leader_of: dict[str, Mimic] = {}
    for mimic in asset.mimics:
        leader_of.setdefault(mimic.follower, mimic)
    done: set[str] = set()
    for mimic in leader_of.values():
        way: dict[str, None] = {}
        at = mimic.follower
        while at in leader_of and at not in done and at not in way:
            way[at] = None
            at = leader_of[at].leader
        done.update(way)
        if at in way:
            circle = list(way)[list(way).index(at) :]
            yield finding_of(
                "coupling.mimic_loop", leader_of[at].place, f"joint '{at}'", _arrows([*circle, at])
            )
    for mimic in leader_of.values():
        if mimic.leader in leader_of and mimic.leader != mimic.follower:
            further = leader_of[mimic.leader].leader
            yield finding_of(
                "coupling.mimic_chain",
                mimic.place,
                f"joint '{mimic.follower}'",
                _arrows([mimic.follower, mimic.leader, further]),
            )


def _arrows(joints: list[str]) -> str:
    shown = joints if len(joints) < 9 else [*joints[:4], "...", *joints[-3:]]
    return " -> ".join(shown)


def _mimic(asset: Asset, mimic: Mimic) -> Iterator[Finding]:
    element = f"joint '{mimic.follower}'"
    if mimic.leader not in asset.joint:
        fixed = any(kind == "joint" and name == mimic.leader for kind, name, _ in asset.named)
        yield finding_of(
            "coupling.mimic_master",
            mimic.place,
            element,
            mimic.leader,
            severity="warning" if fixed else "critical",
            title=f"it follows a fixed joint: it does not move from its offset, {mimic.offset:g}"
            if fixed
            else "it follows a joint that does not exist",
            settle="make the joint fixed, or name the joint that it follows"
            if fixed
            else "correct the name, or remove the <mimic>",
        )
        return
    follower, leader = asset.joint.get(mimic.follower), asset.joint[mimic.leader]
    if follower is None or not follower.is_scalar or not leader.is_scalar:
        return
    if mimic.multiplier == 0.0:
        yield finding_of("coupling.mimic_zero", mimic.place, element, 0.0)
    yield from _ranges(asset, mimic)
    yield finding_of(
        "coupling.mimic_force",
        mimic.place,
        element,
        f"{mimic.multiplier:g} x + {mimic.offset:g}",
        title=f"it follows '{mimic.leader}' "
        + (
            "kinematically"
            if asset.kind == "urdf"
            else "by a constraint with the solver's stiffness"
        )
        + ": force, stiffness and backlash of the coupling are not stated",
        unit=follower.unit,
    )


def _ranges(asset: Asset, mimic: Mimic) -> Iterator[Finding]:
    follower, leader = asset.joint[mimic.follower], asset.joint[mimic.leader]
    ends = (follower.lower, follower.upper, leader.lower, leader.upper)
    if not (follower.is_limited and leader.is_limited) or any(end is None for end in ends):
        return
    lower, upper, low, high = (float(end) for end in ends if end is not None)
    reached = sorted(mimic.multiplier * end + mimic.offset for end in (low, high))
    beyond = max(lower - reached[0], reached[1] - upper)
    if beyond > 1e-3 * max(upper - lower, 1e-6):
        yield finding_of(
            "coupling.mimic_range",
            mimic.place,
            f"joint '{mimic.follower}'",
            f"{reached[0]:.5g} .. {reached[1]:.5g}",
            title=f"following '{leader.name}', it leaves its own range",
            unit=follower.unit,
            expected=f"within {lower:.5g} .. {upper:.5g}",
        )


def _closures(asset: Asset) -> Iterator[Finding]:
    shared: dict[str, list[str]] = {}
    for item in asset.transmissions:
        for joint in item.joints:
            shared.setdefault(joint, []).append(item.name)
        kind = item.kind.casefold()
        if len(item.joints) > 1 or "differential" in kind or "fourbar" in kind:
            yield finding_of(
                "coupling.differential",
                item.place,
                f"transmission '{item.name}'",
                " ".join(item.joints),
                title=f"one transmission ({item.kind or 'no type'}) of {len(item.joints)} joints "
                f"and {len(item.actuators)} actuators: URDF cannot state how they share the force",
            )
    for joint, names in shared.items():
        if len(names) > 1:
            yield finding_of(
                "coupling.shared_joint",
                next(item.place for item in asset.transmissions if joint in item.joints),
                f"joint '{joint}'",
                " ".join(names),
                title=f"it is driven by {len(names)} transmissions",
            )
    for tie in asset.couplings:
        yield finding_of(
            "coupling.constraint",
            tie.place,
            f"{tie.kind} '{tie.name}'",
            " ".join(tie.ties[:12]),
            title=f"a {tie.kind} connects {len(tie.ties)} elements",
        )
    if asset.kind == "urdf":
        yield finding_of("coupling.closed_chains", asset.place, f"robot '{asset.name}'")
