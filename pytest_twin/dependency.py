"""Parts of a twin, and the parts of a model that a golden's result depends on.

This module uses no simulator and reads no files.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

from pytest_twin.formats import typed

WORLD = "world"


def canonical(content: object) -> bytes:
    """Canonical JSON of ``content``: sorted keys, no spaces, floats to 12 significant digits.

    Raises:
        ValueError: ``content`` holds a number that is not finite.
    """
    return json.dumps(
        _round(content), sort_keys=True, separators=(",", ":"), allow_nan=False
    ).encode()


def _round(content: object) -> object:
    if isinstance(content, float):
        # 12 digits: reformatted or recomputed numbers give the same bytes, and a relative change
        # of 1e-12 moves no result beyond a tolerance.
        return float(f"{content:.12g}") + 0.0
    if isinstance(content, Mapping):
        return {str(key): _round(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_round(value) for value in content]
    return content


@dataclass(frozen=True)
class Part:
    """One thing that the result of a check can depend on.

    Attributes:
        id: ``layer:name``, such as ``inertia:forearm`` or ``simulator:mujoco``; the id of a part
            of a realization begins with its name, ``mujoco/inertia:forearm``.
        content: values of the part, JSON-able; a long array is given by its digest. A key may
            end in its unit, ``mass [kg]``.
    """

    id: str
    content: Mapping[str, Any]

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the canonical content, hex."""
        return hashlib.sha256(canonical(self.content)).hexdigest()


@dataclass(frozen=True, slots=True)
class Structure:
    """Kinematic tree, actuators, couplings and contact masks of a realization, by name.

    It determines which parts of the model the result of a check depends on. All names are those
    of the realization; ``world`` is the root body and has no parent. A *tree* is a moving body
    whose parent is fixed to the world, together with its descendants; its name is that of this
    body. The methods return sets of part ids. For a name that the model lacks, the set contains the
    id of the missing part, so that the golden is reported as stale.

    Attributes:
        realization: its name, the prefix of the part ids.
        body_parent: body -> parent body.
        joint_body: joint -> body that it moves.
        joint_range: joint -> (lower, upper) in rad or m, or None where unlimited.
        joint_type: joint -> ``hinge``, ``slide``, ``ball`` or ``free``.
        frame_body: named frame (site or body) -> body; a site takes precedence over a body.
        actuator_joints: actuator -> joints that it drives, directly or through a tendon.
        collision_bodies: bodies with a geom that can collide.
        couplings: part id of an equality, tendon or flex -> bodies that it connects.
        part_ids: ids of all parts of the realization.
        body_tree: moving body -> its tree; fixed bodies are left out.
        actuator_bodies: actuator -> bodies on which it exerts a force.
        equalities: those of ``couplings`` that are equality constraints.
        loops: those of ``equalities`` that close a kinematic loop (all but the mimic of one joint
            by another); every pose is computed with all loops closed.
        contact_masks: collision body -> (contype, conaffinity), over all its geoms.
        contact_pairs: bodies of explicit contact pairs.
        body_meshes: collision body -> part ids of the meshes and height fields of its geoms.
        geom_body: named geom -> body.
        joint_inputs: joint -> commands that its actuators take: position, velocity, effort.
        leaders: joint -> joint that it follows by an equality or mimic.
        loose: joints without a range that no actuator, spring, joint equality or tendon moves.
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
    leaders: Mapping[str, str] = field(default_factory=dict)
    loose: frozenset[str] = frozenset()
    _cache: dict[object, frozenset[str]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    # -- parts that a result depends on

    def chain(self, frames: Iterable[str]) -> frozenset[str]:
        """Ids of the parts that determine the pose of ``frames`` (sites or bodies).

        These are the kinematics from the world to the frames, the equality constraints on the
        bodies between them with the bodies at the other end, and every closed loop: constraints
        move the frame, or make the pose impossible.
        """
        wanted = frozenset(frames)
        return self._cached(("chain", wanted), lambda: self._chain(wanted))

    def carried(self, joints: Iterable[str]) -> frozenset[str]:
        """Ids of inertia and kinematics (from the world) of all bodies below ``joints``."""
        wanted = frozenset(joints)
        return self._cached(("carried", wanted), lambda: self._carried(wanted))

    def dynamics(self, joints: Iterable[str] | None = None) -> frozenset[str]:
        """Ids of the parts that determine the motion of ``joints`` (all joints by default).

        These are kinematics, inertia, joints, actuators, couplings and collision geometry of all
        bodies of the same trees, and of every tree that couplings, actuators, possible contacts
        or a common base connect to them; gravity and the other options. Where a contact is
        possible, it is the whole model: the solver treats all contacts together, and a contact
        amplifies rounding errors. Keyframes are not included.
        """
        if joints is None:
            return self._cached("dynamics", lambda: self._dynamics(frozenset(self._trees())))
        wanted = frozenset(joints)
        return self._cached(("dynamics", wanted), lambda: self._dynamics_of(wanted))

    def contact(self, names: Iterable[str] | None = None) -> frozenset[str]:
        """Ids of the parts that determine contacts of bodies or geoms (all bodies by default).

        These are the kinematics, shapes, meshes and contact parameters of the bodies, the contact
        pairs that are declared, disabled or filtered, and the options.
        """
        wanted = self.collision_bodies if names is None else frozenset(names)
        return self._cached(("contact", wanted), lambda: self._contact(wanted))

    def actuation(self, joints: Iterable[str]) -> frozenset[str]:
        """Ids of passive forces, limits, actuators and couplings of ``joints``."""
        wanted = frozenset(joints)
        return self._cached(("actuation", wanted), lambda: self._actuation(wanted))

    def limits(self, joints: Iterable[str]) -> frozenset[str]:
        """Ids of the declared ranges of ``joints``."""
        return frozenset(self._id(f"limit:{joint}") for joint in joints)

    def keyframe(self, name: str) -> frozenset[str]:
        """Id of a keyframe."""
        return frozenset({self._id(f"keyframe:{name}")})

    def additions(self) -> frozenset[str]:
        """Id of the model's defaults for bodies and payloads that are added; empty without any."""
        return frozenset(self._existing({self._id("additions")}))

    def effects(self) -> frozenset[str]:
        """Id of the effects that a diagnosis added to the model; empty without any."""
        return frozenset(self._existing({self._id("effects")}))

    def stage(self) -> frozenset[str]:
        """Id of the file that another simulator loads itself; empty without one."""
        return frozenset(self._existing({self._id("stage")}))

    def elements(self) -> frozenset[str]:
        """Id of the elements of the model's file, compiled or not; empty where they are unknown."""
        return frozenset(self._existing({self._id("elements")}))

    def everything(self) -> frozenset[str]:
        """Ids of all parts but visual shapes and elements that are not compiled: for checks that
        may use any of the model's values."""
        shape = self._id("geom:")
        return self._cached(
            "everything",
            lambda: (
                frozenset(i for i in self.part_ids if not i.startswith(shape)) - self.elements()
            ),
        )

    # -- kinematic tree

    def ancestors(self, body: str) -> tuple[str, ...]:
        """``body`` and its ancestors up to the root, without the world."""
        found: list[str] = []
        while body in self.body_parent and body not in found:
            found.append(body)
            body = self.body_parent[body]
        return tuple(found)

    def _chain(self, frames: frozenset[str]) -> frozenset[str]:
        bodies: set[str] = set()
        parts: set[str] = set()
        for frame in frames:
            # A site and a body may have the same name; the set then contains both.
            found = [b for b in (self.frame_body.get(frame), frame) if b in self.body_parent]
            for body in found:
                bodies.update(self.ancestors(str(body)))
            site = self._id(f"frame:{frame}")
            if site in self.part_ids or (not found and frame != WORLD):
                parts.add(site)
        return frozenset(parts | self._kinematics(bodies)) | self.stage()

    def _kinematics(self, bodies: set[str]) -> set[str]:
        """Kinematics of ``bodies`` and of the bodies that equality constraints connect to them."""
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
        return frozenset(parts | self._kinematics(above) | self._layer("inertia", load))

    def _dynamics_of(self, joints: frozenset[str]) -> frozenset[str]:
        missing = {self._id(f"joint:{joint}") for joint in joints if joint not in self.joint_body}
        bodies = (self.joint_body[joint] for joint in joints if joint in self.joint_body)
        trees = frozenset(self.body_tree[body] for body in bodies if body in self.body_tree)
        reached = self._connected_trees(trees)
        if self._may_collide({body for body, tree in self.body_tree.items() if tree in reached}):
            reached = frozenset(self._trees())
        return self._dynamics(reached) | missing

    def _dynamics(self, trees: frozenset[str]) -> frozenset[str]:
        moving = {body for body, tree in self.body_tree.items() if tree in trees}
        touchable = self._touchable_fixed_bodies(moving)
        bodies = moving | touchable
        joints = {joint for joint, body in self.joint_body.items() if body in moving}
        placed = {b for body in bodies for b in self.ancestors(body)}
        # MuJoCo computes about the centre of mass of each subtree of the world. Its fixed bodies
        # therefore change the rounding error, which a contact amplifies.
        roots = {self.ancestors(body)[-1] for body in moving}
        rooted = {body for body in self.body_parent if self.ancestors(body)[-1] in roots}
        parts = self._kinematics(placed | rooted) | self._layer("inertia", rooted)
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
            parts |= self._existing({self._id("contact:pairs")})
        return frozenset(parts) | self.stage()

    def _contact(self, names: frozenset[str]) -> frozenset[str]:
        bodies = {self.geom_body.get(name, name) for name in names}
        # A geom and a body may have the same name; the set then contains both.
        bodies |= {name for name in names if name in self.body_parent}
        parts = self._layer("geom", names) | self._layer("collision", bodies)
        parts |= {mesh for body in bodies for mesh in self.body_meshes.get(body, ())}
        parts |= self._existing({self._id("contact:pairs"), self._id("contact:filter")})
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

    def _connected_trees(self, trees: frozenset[str]) -> frozenset[str]:
        """``trees`` and every tree that couplings, actuators or contacts connect to them."""
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
            # Excluded pairs are ignored: other bodies of the two trees may touch.
            reached |= {tree for tree, (c, a) in masks.items() if c & conaffinity or a & contype}
            grown = len(reached) > before
        return frozenset(reached)

    def _may_collide(self, moving: set[str]) -> bool:
        """Whether contact masks or explicit pairs let one of ``moving`` touch another body."""
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

    def _touchable_fixed_bodies(self, moving: set[str]) -> set[str]:
        """Fixed bodies that ``moving`` may touch or are coupled to."""
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
        return self._existing({self._id(f"{layer}:{name}") for name in names})

    def _existing(self, ids: set[str]) -> set[str]:
        return ids & self.part_ids

    def _cached(self, key: object, make: Callable[[], frozenset[str]]) -> frozenset[str]:
        if key not in self._cache:
            self._cache[key] = make()
        return self._cache[key]

    # -- JSON

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON-able values."""
        return {
            item.name: sorted(value) if isinstance(value, frozenset) else value
            for item in fields(self)
            if item.init and (value := getattr(self, item.name)) is not None
        }

    @classmethod
    def from_json(cls, data: object) -> Structure:
        """Build a structure from what :meth:`to_json` returned.

        Raises:
            ValueError: fields missing, unknown or of another shape.
        """
        expected = {item.name for item in fields(cls) if item.init}
        if not isinstance(data, Mapping) or set(data) != expected:
            raise ValueError("not the fields of a structure")
        return typed.build(data, cls)
