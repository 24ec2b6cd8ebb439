"""Coupling: independent, following, passive and sensed degrees of freedom."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from pytest_twin.audit.asset import Asset, Mimic
from pytest_twin.audit.finding import Finding

_WHY_MIMIC = "tools resolve the mimic differently, or refuse the file"


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
        yield Finding(
            "coupling.passive",
            "unknown" if asset.kind == "urdf" else "info",
            joint.place,
            f"joint '{name}'",
            "nothing drives it, and it follows no other joint",
            None,
            None,
            None,
            "a passive joint swings under gravity, a driven one holds its position",
            "look up in the manual whether it has a motor, or move it by hand with the power off",
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
            yield Finding(
                "coupling.mimic_loop",
                "critical",
                leader_of[at].place,
                f"joint '{at}'",
                "joints follow each other in a loop",
                _arrows([*circle, at]),
                None,
                "one joint of the loop without <mimic>",
                _WHY_MIMIC,
                "remove the <mimic> of the joint that has the motor",
            )
    for mimic in leader_of.values():
        if mimic.leader in leader_of and mimic.leader != mimic.follower:
            further = leader_of[mimic.leader].leader
            yield Finding(
                "coupling.mimic_chain",
                "warning",
                mimic.place,
                f"joint '{mimic.follower}'",
                "it follows a joint that itself follows another",
                _arrows([mimic.follower, mimic.leader, further]),
                None,
                "a <mimic> of the first joint of the chain",
                "some parsers resolve one step only",
                "let it follow the first joint, with the product of the multipliers",
            )


def _arrows(joints: list[str]) -> str:
    shown = joints if len(joints) < 9 else [*joints[:4], "...", *joints[-3:]]
    return " -> ".join(shown)


def _mimic(asset: Asset, mimic: Mimic) -> Iterator[Finding]:
    element = f"joint '{mimic.follower}'"
    if mimic.leader not in asset.joint:
        fixed = any(kind == "joint" and name == mimic.leader for kind, name, _ in asset.named)
        yield Finding(
            "coupling.mimic_master",
            # MuJoCo and Pinocchio keep such a follower at its offset.
            "warning" if fixed else "critical",
            mimic.place,
            element,
            f"it follows a fixed joint: it does not move from its offset, {mimic.offset:g}"
            if fixed
            else "it follows a joint that does not exist",
            mimic.leader,
            None,
            "the name of a moving joint",
            _WHY_MIMIC,
            "make the joint fixed, or name the joint that it follows"
            if fixed
            else "correct the name, or remove the <mimic>",
        )
        return
    follower, leader = asset.joint.get(mimic.follower), asset.joint[mimic.leader]
    if follower is None or not follower.is_scalar or not leader.is_scalar:
        return
    if mimic.multiplier == 0.0:
        yield Finding(
            "coupling.mimic_zero",
            "warning",
            mimic.place,
            element,
            "its multiplier is 0, so it does not move",
            0.0,
            "1",
            "the gear ratio, or type 'fixed'",
            "the simulated mechanism does not move like the real one",
            "state the gear ratio from the mechanism's drawing",
        )
    yield from _ranges(asset, mimic)
    yield Finding(
        "coupling.mimic_force",
        "unknown",
        mimic.place,
        element,
        f"it follows '{mimic.leader}' "
        + (
            "kinematically"
            if asset.kind == "urdf"
            else "by a constraint with the solver's stiffness"
        )
        + ": force, stiffness and backlash of the coupling are not stated",
        f"{mimic.multiplier:g} x + {mimic.offset:g}",
        follower.unit,
        None,
        "a simulator chooses the stiffness itself, or transmits no force",
        "hold the leader, load the follower with a known force, and measure its deflection",
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
        yield Finding(
            "coupling.mimic_range",
            "warning",
            mimic.place,
            f"joint '{mimic.follower}'",
            f"following '{leader.name}', it leaves its own range",
            f"{reached[0]:.5g} .. {reached[1]:.5g}",
            follower.unit,
            f"within {lower:.5g} .. {upper:.5g}",
            "in a simulator, limit and coupling work against each other",
            "state both ranges as in the mechanism's drawing",
        )


def _closures(asset: Asset) -> Iterator[Finding]:
    shared: dict[str, list[str]] = {}
    for item in asset.transmissions:
        for joint in item.joints:
            shared.setdefault(joint, []).append(item.name)
        kind = item.kind.casefold()
        if len(item.joints) > 1 or "differential" in kind or "fourbar" in kind:
            yield Finding(
                "coupling.differential",
                "unknown",
                item.place,
                f"transmission '{item.name}'",
                f"one transmission ({item.kind or 'no type'}) of {len(item.joints)} joints and "
                f"{len(item.actuators)} actuators: URDF cannot state how they share the force",
                " ".join(item.joints),
                None,
                None,
                "the limits of the motors are not those of the joints, and friction is shared",
                "derive the transmission matrix from the drawing, and check it one motor at a time",
            )
    for joint, names in shared.items():
        if len(names) > 1:
            yield Finding(
                "coupling.shared_joint",
                "unknown",
                next(item.place for item in asset.transmissions if joint in item.joints),
                f"joint '{joint}'",
                f"it is driven by {len(names)} transmissions",
                " ".join(names),
                None,
                None,
                "URDF cannot state how several motors share the load of one joint",
                "derive the transmission matrix from the drawing",
            )
    for tie in asset.couplings:
        yield Finding(
            "coupling.constraint",
            "info",
            tie.place,
            f"{tie.kind} '{tie.name}'",
            f"a {tie.kind} connects {len(tie.ties)} elements",
            " ".join(tie.ties[:12]),
            None,
            None,
            "a URDF cannot carry it: a conversion loses or replaces it",
            "state the same constraint in every realization",
        )
    if asset.kind == "urdf":
        yield Finding(
            "coupling.closed_chains",
            "unknown",
            asset.place,
            f"robot '{asset.name}'",
            "URDF cannot state closed chains, differentials or tendons: it is unknown whether the "
            "robot has any",
            None,
            None,
            None,
            "an open loop transmits no force",
            "look for parallel rods, belts and cables in the mechanism's drawing",
        )
