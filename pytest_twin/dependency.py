"""Parts, what a golden depends on, and the structure of a model. No simulator, no files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

WORLD = "world"


def canonical(content: object) -> bytes:
    """One byte string per meaning: sorted keys, no spaces, floats to 12 significant digits.

    Raises:
        ValueError: ``content`` holds a number that is not finite.
    """
    return json.dumps(
        _rounded(content), sort_keys=True, separators=(",", ":"), allow_nan=False
    ).encode()


def _rounded(content: object) -> object:
    if isinstance(content, float):
        # 12 digits: reformatted or re-derived numbers agree, and no check feels the rest.
        return float(f"{content:.12g}") + 0.0
    if isinstance(content, Mapping):
        return {str(key): _rounded(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_rounded(value) for value in content]
    return content


@dataclass(frozen=True)
class Part:
    """One thing that checks can feel.

    Attributes:
        id: ``layer:name``, such as ``inertia:forearm`` or ``simulator:mujoco``; parts of a
            realization carry its name in front, ``mujoco/inertia:forearm``.
        content: what the part consists of, JSON-able; long arrays as their digest. A key may end
            in its unit, ``mass [kg]``.
    """

    id: str
    content: Mapping[str, Any]

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the canonical content, hex."""
        return hashlib.sha256(canonical(self.content)).hexdigest()


@dataclass(frozen=True, slots=True)
class Structure:
    """How a realization hangs together: enough to say which parts a check can feel.

    All names are the realization's own; ``world`` is the root body and has no parent. A *tree* is
    the bodies that move with or below one body whose parent stands still; it bears that body's
    name. The methods return sets of part ids and take names that the model lacks: the part that
    they would be is then in the set, and is found missing.

    Attributes:
        realization: the name in front of the part ids.
        body_parent: body -> parent body.
        joint_body: joint -> body that it moves.
        joint_range: joint -> (lower, upper) in rad or m, or None where unlimited.
        joint_type: joint -> ``hinge``, ``slide``, ``ball`` or ``free``.
        frame_body: named frame (site or body) -> body; a site goes before a body.
        actuator_joints: actuator -> joints that it drives (through tendons too).
        collision_bodies: bodies with a geom that can collide.
        couplings: part id of an equality, tendon, flex -> bodies that it ties.
        part_ids: every part of the realization.
        body_tree: moving body -> its tree; bodies that stand still are left out.
        actuator_bodies: actuator -> bodies that it pulls on.
        equalities: those of ``couplings`` that constrain poses.
        loops: those of ``equalities`` that are no mimic of one joint by another: a pose of any
            joint is looked for with all of them closed.
        contact_masks: collision body -> (contype, conaffinity), over all its geoms.
        contact_pairs: bodies of explicit contact pairs.
        body_meshes: collision body -> part ids of the meshes and height fields of its geoms.
        geom_body: named geom -> body.
        joint_inputs: joint -> commands that its actuators take: position, velocity, effort.
    """

    realization: str
    body_parent: Mapping[str, str]
    joint_body: Mapping[str, str]
    joint_range: Mapping[str, tuple[float, float] | None]
    joint_type: Mapping[str, str]
    frame_body: Mapping[str, str]
    actuator_joints: Mapping[str, tuple[str, ...]]
    collision_bodies: frozenset[str]
    couplings: Mapping[str, tuple[str, ...]]
    part_ids: frozenset[str] = field(repr=False)
    body_tree: Mapping[str, str] = field(default_factory=dict)
    actuator_bodies: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    equalities: frozenset[str] = frozenset()
    loops: frozenset[str] = frozenset()
    contact_masks: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    contact_pairs: tuple[tuple[str, str], ...] = ()
    body_meshes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    geom_body: Mapping[str, str] = field(default_factory=dict)
    joint_inputs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    _memo: dict[object, frozenset[str]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    # -- what a check can feel

    def chain(self, frames: Iterable[str]) -> frozenset[str]:
        """Where ``frames`` (sites or bodies) are at a pose: kinematics from the world to them.

        Equality constraints of the bodies on the way count, with the bodies at their other end,
        and every closed loop: they move the frame too, or leave no such pose.
        """
        wanted = frozenset(frames)
        return self._remember(("chain", wanted), lambda: self._chain(wanted))

    def carried(self, joints: Iterable[str]) -> frozenset[str]:
        """What ``joints`` carry: inertia of every body that they carry, and its kinematics
        from the world on."""
        wanted = frozenset(joints)
        return self._remember(("carried", wanted), lambda: self._carried(wanted))

    def gravity_load(self, joints: Iterable[str]) -> frozenset[str]:
        """Torque of gravity about ``joints``: what they carry, and gravity."""
        return self.carried(joints) | {self._id("option:gravity")}

    def dynamics(self, joints: Iterable[str] | None = None) -> frozenset[str]:
        """All that moves ``joints`` (all of them by default).

        Kinematics, inertia, joints, actuators, couplings, collision of every body of the same
        trees and of those that couplings, actuators, possible contacts or a common base tie to
        them; gravity and the other options. Where a contact is possible at all, it is the whole
        model: contacts amplify the last digits of the solver, which sees everything at once.
        Keyframes are not in it.
        """
        if joints is None:
            return self._remember("dynamics", lambda: self._dynamics(frozenset(self._trees())))
        wanted = frozenset(joints)
        return self._remember(("dynamics", wanted), lambda: self._dynamics_of(wanted))

    def contact(self, names: Iterable[str] | None = None) -> frozenset[str]:
        """Geometry of contact of bodies or geoms (all bodies by default) at a pose: their chains,
        shapes, meshes, contact parameters, the pairs that are declared, disabled or filtered, and
        options."""
        wanted = self.collision_bodies if names is None else frozenset(names)
        return self._remember(("contact", wanted), lambda: self._contact(wanted))

    def actuation(self, joints: Iterable[str]) -> frozenset[str]:
        """``joints`` themselves: passive terms, limits, their actuators, and what couples them."""
        wanted = frozenset(joints)
        return self._remember(("actuation", wanted), lambda: self._actuation(wanted))

    def limits(self, joints: Iterable[str]) -> frozenset[str]:
        """The declared ranges of ``joints``."""
        return frozenset(self._id(f"limit:{joint}") for joint in joints)

    def keyframe(self, name: str) -> frozenset[str]:
        """A named pose."""
        return frozenset({self._id(f"keyframe:{name}")})

    def additions(self) -> frozenset[str]:
        """What the model's file gives to a body that is added to the scene, or to a payload."""
        return frozenset(self._known({self._id("additions")}))

    def effects(self) -> frozenset[str]:
        """What a diagnosis put beside the model, for checks that step it."""
        return frozenset(self._known({self._id("effects")}))

    def stage(self) -> frozenset[str]:
        """The file that another simulator reads itself, for checks that it steps."""
        return frozenset(self._known({self._id("stage")}))

    def everything(self) -> frozenset[str]:
        """All parts but shapes that are only seen: for checks that may look at anything."""
        seen = self._id("geom:")
        return self._remember(
            "everything", lambda: frozenset(i for i in self.part_ids if not i.startswith(seen))
        )

    # -- walks over the model

    def ancestors(self, body: str) -> tuple[str, ...]:
        """``body`` and all above it, the world left out."""
        found: list[str] = []
        while body in self.body_parent and body not in found:
            found.append(body)
            body = self.body_parent[body]
        return tuple(found)

    def descendants(self, body: str) -> frozenset[str]:
        """``body`` and all below it."""
        return frozenset(b for b in self.body_parent if body in self.ancestors(b))

    def _chain(self, frames: frozenset[str]) -> frozenset[str]:
        bodies: set[str] = set()
        parts: set[str] = set()
        for frame in frames:
            # A site may bear a body's name: both count.
            found = [b for b in (self.frame_body.get(frame), frame) if b in self.body_parent]
            for body in found:
                bodies.update(self.ancestors(str(body)))
            site = self._id(f"frame:{frame}")
            if site in self.part_ids or (not found and frame != WORLD):
                parts.add(site)
        return frozenset(parts | self._placed(bodies)) | self.stage()

    def _placed(self, bodies: set[str]) -> set[str]:
        """Kinematics of ``bodies`` and of what equalities tie to them."""
        bodies = set(bodies)
        tied: set[str] = set(self.loops)
        for loop in tied:
            for body in self.couplings[loop]:
                bodies.update(self.ancestors(body))
        moving = set(self.body_tree)
        grown = True
        while grown:
            grown = False
            for coupling in self.equalities - tied:
                ends = [b for b in self.couplings[coupling] if b in self.body_parent]
                if bodies & moving & set(ends):
                    tied.add(coupling)
                    for body in ends:
                        bodies.update(self.ancestors(body))
                    grown = True
        return tied | self._layer("kinematics", bodies)

    def _carried(self, joints: frozenset[str]) -> frozenset[str]:
        parts = {self._id(f"joint:{joint}") for joint in joints if joint not in self.joint_body}
        roots = {self.joint_body[joint] for joint in joints if joint in self.joint_body}
        load = {b for b in self.body_parent if not roots.isdisjoint(self.ancestors(b))}
        above = {b for body in load for b in self.ancestors(body)}
        return frozenset(parts | self._placed(above) | self._layer("inertia", load))

    def _dynamics_of(self, joints: frozenset[str]) -> frozenset[str]:
        missing = {self._id(f"joint:{joint}") for joint in joints if joint not in self.joint_body}
        bodies = (self.joint_body[joint] for joint in joints if joint in self.joint_body)
        trees = frozenset(self.body_tree[body] for body in bodies if body in self.body_tree)
        reached = self._reached(trees)
        if self._may_touch({body for body, tree in self.body_tree.items() if tree in reached}):
            reached = frozenset(self._trees())
        return self._dynamics(reached) | missing

    def _dynamics(self, trees: frozenset[str]) -> frozenset[str]:
        moving = {body for body, tree in self.body_tree.items() if tree in trees}
        standing = self._touched(moving)
        bodies = moving | standing
        joints = {joint for joint, body in self.joint_body.items() if body in moving}
        placed = {b for body in bodies for b in self.ancestors(body)}
        # MuJoCo reckons about the centre of mass of all that stands on one body of the world:
        # what stands still there shifts the last digits, and a contact makes much of them.
        roots = {self.ancestors(body)[-1] for body in moving}
        rooted = {body for body in self.body_parent if self.ancestors(body)[-1] in roots}
        parts = self._placed(placed | rooted) | self._layer("inertia", rooted)
        parts |= self._layer("joint", joints) | self._layer("limit", joints)
        parts |= self._layer("tree", trees) | self._layer("collision", bodies)
        parts |= {mesh for body in bodies for mesh in self.body_meshes.get(body, ())}
        parts |= {c for c, ends in self.couplings.items() if not moving.isdisjoint(ends)}
        parts |= self._layer(
            "actuator",
            {a for a, ends in self.actuator_bodies.items() if not moving.isdisjoint(ends)},
        )
        parts |= {self._id("option:gravity"), self._id("option:integration")}
        if not moving.isdisjoint(self.collision_bodies):
            parts |= self._known({self._id("contact:pairs")})
        return frozenset(parts) | self.stage()

    def _contact(self, names: frozenset[str]) -> frozenset[str]:
        bodies = {self.geom_body.get(name, name) for name in names}
        # A geom may bear a body's name: both count.
        bodies |= {name for name in names if name in self.body_parent}
        parts = self._layer("geom", names) | self._layer("collision", bodies)
        parts |= {mesh for body in bodies for mesh in self.body_meshes.get(body, ())}
        parts |= self._known({self._id("contact:pairs"), self._id("contact:filter")})
        return self.chain(bodies) | parts | {self._id("option:integration")}

    def _actuation(self, joints: frozenset[str]) -> frozenset[str]:
        bodies = {self.joint_body[joint] for joint in joints if joint in self.joint_body}
        driving = {a for a, driven in self.actuator_joints.items() if joints & set(driven)}
        parts = {self._id(f"{layer}:{joint}") for layer in ("joint", "limit") for joint in joints}
        parts |= self._layer("actuator", driving)
        parts |= {c for c, ends in self.couplings.items() if not bodies.isdisjoint(ends)}
        return frozenset(parts)

    # -- trees

    def _trees(self) -> set[str]:
        return set(self.body_tree.values())

    def _reached(self, trees: frozenset[str]) -> frozenset[str]:
        """``trees`` and every tree that couplings, actuators or contacts tie to them."""
        links = [
            {self.body_tree[body] for body in ends if body in self.body_tree}
            for ends in (
                *self.couplings.values(),
                *self.actuator_bodies.values(),
                *self.contact_pairs,
            )
        ]
        rooted: dict[str, set[str]] = {}
        for tree in self._trees():
            rooted.setdefault(self.ancestors(tree)[-1], set()).add(tree)
        links += rooted.values()
        masks = {tree: [0, 0] for tree in self._trees()}
        for body, (contype, conaffinity) in self.contact_masks.items():
            if body in self.body_tree:
                mask = masks[self.body_tree[body]]
                mask[0] |= contype
                mask[1] |= conaffinity
        reached = set(trees)
        grown = bool(reached)
        while grown:
            before = len(reached)
            for link in links:
                if not reached.isdisjoint(link):
                    reached |= link
            contype = conaffinity = 0
            for tree in reached:
                contype |= masks[tree][0]
                conaffinity |= masks[tree][1]
            # Exclusions are not looked at: two bodies of the trees may touch all the same.
            reached |= {tree for tree, (c, a) in masks.items() if c & conaffinity or a & contype}
            grown = len(reached) > before
        return frozenset(reached)

    def _may_touch(self, moving: set[str]) -> bool:
        """Whether one of ``moving`` and another body have geoms that may touch, by their masks."""
        if any(not moving.isdisjoint(pair) for pair in self.contact_pairs):
            return True
        bodies: dict[tuple[int, int], set[str]] = {}
        for body, mask in self.contact_masks.items():
            bodies.setdefault(mask, set()).add(body)
        for (c, a), ours in bodies.items():
            for (contype, conaffinity), others in bodies.items():
                if (c & conaffinity or a & contype) and ours & moving and len(ours | others) > 1:
                    return True
        return False

    def _touched(self, moving: set[str]) -> set[str]:
        """Bodies that stand still and that ``moving`` may touch or are coupled to."""
        contype = conaffinity = 0
        for body in moving & self.contact_masks.keys():
            contype |= self.contact_masks[body][0]
            conaffinity |= self.contact_masks[body][1]
        touched = {
            body
            for body, (c, a) in self.contact_masks.items()
            if body not in self.body_tree and (c & conaffinity or a & contype)
        }
        ties = (*self.contact_pairs, *self.couplings.values(), *self.actuator_bodies.values())
        for ends in ties:
            if not moving.isdisjoint(ends):
                touched |= {body for body in ends if body not in self.body_tree}
        return touched

    # -- ids

    def _id(self, name: str) -> str:
        return f"{self.realization}/{name}"

    def _layer(self, layer: str, names: Iterable[str]) -> set[str]:
        return self._known({self._id(f"{layer}:{name}") for name in names})

    def _known(self, ids: set[str]) -> set[str]:
        return ids & self.part_ids

    def _remember(self, key: object, make: Callable[[], frozenset[str]]) -> frozenset[str]:
        if key not in self._memo:
            self._memo[key] = make()
        return self._memo[key]

    # -- JSON

    def to_json(self) -> dict[str, Any]:
        """JSON-able fields."""
        return {
            item.name: sorted(value) if isinstance(value, frozenset) else value
            for item in fields(self)
            if item.init and (value := getattr(self, item.name)) is not None
        }

    @classmethod
    def from_json(cls, data: object) -> Structure:
        """The inverse of ``to_json``.

        Raises:
            ValueError: fields missing, unknown or of another shape.
        """
        table = _strings(data, object)
        expected = {item.name for item in fields(cls) if item.init}
        if set(table) != expected:
            raise ValueError("not the fields of a structure")
        ranges = _strings(table["joint_range"], object)
        return cls(
            realization=_text(table["realization"]),
            body_parent=_strings(table["body_parent"], str),
            joint_body=_strings(table["joint_body"], str),
            joint_range={
                joint: None if pair is None else _pair(pair, float)
                for joint, pair in ranges.items()
            },
            joint_type=_strings(table["joint_type"], str),
            frame_body=_strings(table["frame_body"], str),
            actuator_joints=_lists(table["actuator_joints"]),
            collision_bodies=frozenset(_texts(table["collision_bodies"])),
            couplings=_lists(table["couplings"]),
            part_ids=frozenset(_texts(table["part_ids"])),
            body_tree=_strings(table["body_tree"], str),
            actuator_bodies=_lists(table["actuator_bodies"]),
            equalities=frozenset(_texts(table["equalities"])),
            loops=frozenset(_texts(table["loops"])),
            contact_masks={
                body: _pair(pair, int)
                for body, pair in _strings(table["contact_masks"], object).items()
            },
            contact_pairs=tuple(_pair(pair, str) for pair in _list(table["contact_pairs"])),
            body_meshes=_lists(table["body_meshes"]),
            geom_body=_strings(table["geom_body"], str),
            joint_inputs=_lists(table["joint_inputs"]),
        )


def _list(data: object) -> list[Any]:
    if not isinstance(data, list | tuple):
        raise ValueError("not a list")
    return list(data)


def _text(data: object) -> str:
    if not isinstance(data, str):
        raise ValueError("not a text")
    return data


def _texts(data: object) -> tuple[str, ...]:
    return tuple(_text(item) for item in _list(data))


def _strings(data: object, kind: type) -> dict[str, Any]:
    if not isinstance(data, Mapping) or not all(
        isinstance(key, str) and isinstance(value, kind) for key, value in data.items()
    ):
        raise ValueError("not a table")
    return dict(data)


def _lists(data: object) -> dict[str, tuple[str, ...]]:
    return {key: _texts(value) for key, value in _strings(data, object).items()}


def _pair(data: object, kind: type) -> tuple[Any, Any]:
    items = _list(data)
    kinds = (int, float) if kind is float else (kind,)
    if len(items) != 2 or not all(
        isinstance(item, kinds) and not isinstance(item, bool) for item in items
    ):
        raise ValueError("not a pair")
    return kind(items[0]), kind(items[1])
