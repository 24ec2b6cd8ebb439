"""Coupling: which degrees of freedom are independent, follow, are passive, are sensed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from pytest_twin.audit.asset import Asset, Mimic
from pytest_twin.audit.finding import Finding

_WHY_MIMIC = "every tool that follows the chain gets another robot, or refuses the file"


@dataclass(frozen=True, slots=True)
class Freedom:
    """Degrees of freedom, counted.

    Attributes:
        total: of all joints.
        follower: names of joints that follow another.
        passive: names of joints that nothing drives and that follow none.
        sensed: names of joints whose state an interface or a sensor reads.
    """

    total: int
    independent: int
    follower: tuple[str, ...]
    passive: tuple[str, ...]
    sensed: tuple[str, ...]


def freedom(asset: Asset) -> Freedom:
    """The degrees of freedom of an asset."""
    followers = tuple(dict.fromkeys(m.follower for m in asset.mimics if m.follower in asset.joint))
    driven = {joint for actuator in asset.actuators for joint in actuator.joints}
    driven |= {joint for item in asset.transmissions for joint in item.joints}
    driven |= {item.joint for item in asset.controlled if item.commands}
    if asset.kind == "urdf":
        # URDF states no drive: an effort is as much as it can say of one.
        driven |= {joint.name for joint in asset.joints if joint.effort}
    sensed = {item.joint for item in asset.controlled if item.states}
    sensed |= {sensor.bearer for sensor in asset.sensors if sensor.bearer in asset.joint}
    total = sum(joint.dof for joint in asset.joints)
    moved = driven | set(followers)
    return Freedom(
        total,
        total - sum(asset.joint[name].dof for name in followers),
        followers,
        tuple(joint.name for joint in asset.joints if joint.scalar and joint.name not in moved),
        tuple(joint.name for joint in asset.joints if joint.name in sensed),
    )


def check(asset: Asset) -> Iterator[Finding]:
    """What is wrong with, or unknown of, couplings."""
    yield from _chains(asset)
    for mimic in asset.mimics:
        yield from _mimic(asset, mimic)
    found = freedom(asset)
    for name in found.passive:
        joint = asset.joint[name]
        yield Finding(
            "coupling.passive",
            "unknown" if asset.kind == "urdf" else "info",
            joint.place,
            f"joint '{name}'",
            "nothing drives it and it follows no other",
            None,
            None,
            None,
            "a passive joint swings under gravity; a driven one holds",
            "whether it has a motor: the manual, or the joint moved by hand with the power off",
        )
    yield from _closures(asset)


def _chains(asset: Asset) -> Iterator[Finding]:
    """Joints that follow followers, and circles of them; each joint is passed once."""
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
                "joints follow each other in a circle",
                _arrows([*circle, at]),
                None,
                "one joint of the circle that follows none",
                _WHY_MIMIC,
                "the mechanism's drawing: which joint has the motor",
            )
    for mimic in leader_of.values():
        if mimic.leader in leader_of and mimic.leader != mimic.follower:
            further = leader_of[mimic.leader].leader
            yield Finding(
                "coupling.mimic_chain",
                "warning",
                mimic.place,
                f"joint '{mimic.follower}'",
                "it follows a joint that follows another",
                _arrows([mimic.follower, mimic.leader, further]),
                None,
                "following the first of the chain itself",
                "some parsers follow one step only and leave it behind",
                "the products of the multipliers along the chain, from the mechanism",
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
            "critical",
            mimic.place,
            element,
            "it follows a joint that does not move"
            if fixed
            else "it follows a joint that is not there",
            mimic.leader,
            None,
            "the name of a moving joint",
            _WHY_MIMIC,
            "the source macro: a misspelt name, or a joint that was renamed",
        )
        return
    follower, leader = asset.joint.get(mimic.follower), asset.joint[mimic.leader]
    if follower is None or not follower.scalar or not leader.scalar:
        return
    if mimic.multiplier == 0.0:
        yield Finding(
            "coupling.mimic_zero",
            "warning",
            mimic.place,
            element,
            "it follows with a multiplier of 0, and so stands still",
            0.0,
            "1",
            "the gear ratio, or a fixed joint",
            "the mechanism does not move as it does",
            "the gear ratio from the mechanism's drawing",
        )
    yield from _ranges(asset, mimic)
    yield Finding(
        "coupling.mimic_force",
        "unknown",
        mimic.place,
        element,
        f"it follows '{mimic.leader}' by "
        + ("geometry alone" if asset.kind == "urdf" else "a constraint as stiff as the solver's")
        + ": what force passes, how stiffly, with what play, is not said",
        f"{mimic.multiplier:g} x + {mimic.offset:g}",
        follower.unit,
        None,
        "a mimic is no force model: a simulator invents the stiffness, or the force is lost",
        "load the follower by a known force with the leader held, and measure how far it gives",
    )


def _ranges(asset: Asset, mimic: Mimic) -> Iterator[Finding]:
    follower, leader = asset.joint[mimic.follower], asset.joint[mimic.leader]
    ends = (follower.lower, follower.upper, leader.lower, leader.upper)
    if not (follower.limited and leader.limited) or any(end is None for end in ends):
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
            f"following '{leader.name}' takes it beyond its own range",
            f"{reached[0]:.5g} .. {reached[1]:.5g}",
            follower.unit,
            f"within {lower:.5g} .. {upper:.5g}",
            "the limit and the coupling fight each other in a simulator",
            "both ranges from the mechanism's drawing",
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
                f"{len(item.actuators)} actuators: URDF cannot say how they share the force",
                " ".join(item.joints),
                None,
                None,
                "limits of the motors are not limits of the joints, and friction is shared",
                "the transmission's matrix from the mechanism, and one motor moved at a time",
            )
    for joint, names in shared.items():
        if len(names) > 1:
            yield Finding(
                "coupling.shared_joint",
                "unknown",
                next(item.place for item in asset.transmissions if joint in item.joints),
                f"joint '{joint}'",
                f"{len(names)} transmissions drive it",
                " ".join(names),
                None,
                None,
                "motors that pull on one joint share its load in a way that URDF cannot say",
                "the transmission's matrix from the mechanism",
            )
    for tie in asset.couplings:
        yield Finding(
            "coupling.constraint",
            "info",
            tie.place,
            f"{tie.kind} '{tie.name}'",
            f"a {tie.kind} ties {len(tie.ties)} elements",
            " ".join(tie.ties[:12]),
            None,
            None,
            "URDF cannot carry it: a conversion loses it or states it otherwise",
            "the same constraint in every realization",
        )
    if asset.kind == "urdf":
        yield Finding(
            "coupling.closed_chains",
            "unknown",
            asset.place,
            f"robot '{asset.name}'",
            "closed chains, differentials and tendons have no place in URDF: whether the robot has "
            "any, this file does not say",
            None,
            None,
            None,
            "a loop that is left open carries no force",
            "the mechanism's drawing; parallel rods, belts and cables on a photograph",
        )
