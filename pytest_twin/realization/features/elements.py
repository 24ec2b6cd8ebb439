"""Names of the elements of a compiled model, and the bodies to which they belong."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

OBJ = mujoco.mjtObj
_JOINT_TYPES = {
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
}
QPOS = {"free": 7, "ball": 4, "slide": 1, "hinge": 1}
"""Type of a joint -> number of its coordinates."""
DOFS = {"free": 6, "ball": 3, "slide": 1, "hinge": 1}
"""Type of a joint -> number of its degrees of freedom."""


class Names:
    """Names of all elements of one type; an unnamed element gets a name from its position."""

    def __init__(self, model: mujoco.MjModel, obj: mujoco.mjtObj, places: Sequence[str]) -> None:
        given = [mujoco.mj_id2name(model, obj, i) or "" for i in range(len(places))]
        taken = {name for name in given if name}
        self.all: list[str] = []
        for name, place in zip(given, places, strict=True):
            while not name or (name in taken and name not in given):
                name = name or place
                if name in taken:
                    name, place = "", place + "#"
            taken.add(name)
            self.all.append(name)

    def __getitem__(self, index: int) -> str:
        return self.all[index]


def indexed_names(owners: Iterable[str]) -> list[str]:
    """Names ``owner#0``, ``owner#1``, ... by the position among the elements of an owner."""
    count: dict[str, int] = {}
    places = []
    for owner in owners:
        places.append(f"{owner}#{count.get(owner, 0)}")
        count[owner] = count.get(owner, 0) + 1
    return places


class Elements:
    """Names of a model's elements, and the bodies to which they belong."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        bodies: list[str] = []
        for i in range(model.nbody):
            parent = bodies[model.body_parentid[i]] if i else ""
            bodies.append(mujoco.mj_id2name(model, OBJ.mjOBJ_BODY, i) or f"{parent}/#")
        self.body = Names(model, OBJ.mjOBJ_BODY, indexed_names(bodies))
        self.joint = self._of_bodies(OBJ.mjOBJ_JOINT, model.jnt_bodyid)
        self.site = self._of_bodies(OBJ.mjOBJ_SITE, model.site_bodyid)
        self.camera = self._of_bodies(OBJ.mjOBJ_CAMERA, model.cam_bodyid)
        self.can_collide = colliding_geoms(model)
        self._geoms: dict[int, list[int]] = {}
        for geom in np.flatnonzero(self.can_collide):
            self._geoms.setdefault(int(model.geom_bodyid[geom]), []).append(int(geom))
        # Visual geoms are numbered separately, so that they do not change the names of the others.
        owners = [
            f"{self.body[b]}" if can_collide else f"{self.body[b]}~"
            for b, can_collide in zip(model.geom_bodyid, self.can_collide, strict=True)
        ]
        self.geom = Names(model, OBJ.mjOBJ_GEOM, indexed_names(owners))
        self.mesh = self._plain(OBJ.mjOBJ_MESH, model.nmesh)
        self.hfield = self._plain(OBJ.mjOBJ_HFIELD, model.nhfield)
        self.tendon = self._plain(OBJ.mjOBJ_TENDON, model.ntendon, "tendon")
        self.equality = self._plain(OBJ.mjOBJ_EQUALITY, model.neq, "equality")
        self.actuator = self._plain(OBJ.mjOBJ_ACTUATOR, model.nactuator)
        self.sensor = self._plain(OBJ.mjOBJ_SENSOR, model.nsensor)
        self.key = self._plain(OBJ.mjOBJ_KEY, model.nkey)
        self.flex = self._plain(OBJ.mjOBJ_FLEX, model.nflex)
        self.joint_type = [_JOINT_TYPES[int(kind)] for kind in model.jnt_type]

    def _of_bodies(self, obj: mujoco.mjtObj, owner: NDArray[np.int32]) -> Names:
        return Names(self.model, obj, indexed_names(self.body[b] for b in owner))

    def _plain(self, obj: mujoco.mjtObj, count: int, prefix: str = "") -> Names:
        return Names(self.model, obj, indexed_names([prefix] * count))

    def object(self, obj: int, index: int) -> str | None:
        """Name of an element by MuJoCo's object type and index; None for a negative index."""
        names = {
            int(OBJ.mjOBJ_BODY): self.body,
            int(OBJ.mjOBJ_XBODY): self.body,
            int(OBJ.mjOBJ_JOINT): self.joint,
            int(OBJ.mjOBJ_GEOM): self.geom,
            int(OBJ.mjOBJ_SITE): self.site,
            int(OBJ.mjOBJ_CAMERA): self.camera,
            int(OBJ.mjOBJ_MESH): self.mesh,
            int(OBJ.mjOBJ_HFIELD): self.hfield,
            int(OBJ.mjOBJ_TENDON): self.tendon,
            int(OBJ.mjOBJ_EQUALITY): self.equality,
            int(OBJ.mjOBJ_ACTUATOR): self.actuator,
            int(OBJ.mjOBJ_SENSOR): self.sensor,
            int(OBJ.mjOBJ_FLEX): self.flex,
        }.get(int(obj))
        if index < 0:
            return None
        return str(index) if names is None else names[index]

    def geoms_of(self, body: int) -> list[int]:
        """Indices of the geoms of a body that can be in a contact."""
        return self._geoms.get(body, [])

    def equality_ends(self, equality: int) -> tuple[int, list[int]]:
        """(object type, indices) of the elements that an equality connects.

        MuJoCo states the object type only for some equalities.
        """
        model, kinds = self.model, mujoco.mjtEq
        kind = int(model.eq_type[equality])
        stated = {
            int(kinds.mjEQ_JOINT): OBJ.mjOBJ_JOINT,
            int(kinds.mjEQ_TENDON): OBJ.mjOBJ_TENDON,
            int(kinds.mjEQ_FLEX): OBJ.mjOBJ_FLEX,
            int(kinds.mjEQ_FLEXVERT): OBJ.mjOBJ_FLEX,
            int(kinds.mjEQ_FLEXSTRAIN): OBJ.mjOBJ_FLEX,
            int(kinds.mjEQ_DISTANCE): OBJ.mjOBJ_GEOM,
        }
        ends = [int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])]
        return int(stated.get(kind, model.eq_objtype[equality])), ends

    def body_of(self, obj: int, index: int) -> list[int]:
        """Bodies to which an element belongs; all bodies for an unknown type of element."""
        model = self.model
        if index < 0:
            return []
        if obj in (int(OBJ.mjOBJ_BODY), int(OBJ.mjOBJ_XBODY)):
            return [index]
        if obj == int(OBJ.mjOBJ_JOINT):
            return [int(model.jnt_bodyid[index])]
        if obj == int(OBJ.mjOBJ_SITE):
            return [int(model.site_bodyid[index])]
        if obj == int(OBJ.mjOBJ_GEOM):
            return [int(model.geom_bodyid[index])]
        if obj == int(OBJ.mjOBJ_TENDON):
            return self.tendon_bodies(index)
        if obj == int(OBJ.mjOBJ_FLEX):
            return self.flex_bodies()
        return list(range(model.nbody))

    def tendon_joints(self, tendon: int) -> list[int]:
        """Joints of a fixed tendon, or joints that move the bodies of a spatial tendon."""
        model = self.model
        found = []
        for kind, index in self.wraps(tendon):
            if kind == int(mujoco.mjtWrap.mjWRAP_JOINT):
                found.append(index)
        if found:
            return found
        bodies = set(self.tendon_bodies(tendon))
        above = {a for body in bodies for a in ancestors(model, body)}
        return [j for j in range(model.njnt) if int(model.jnt_bodyid[j]) in above]

    def wraps(self, tendon: int) -> list[tuple[int, int]]:
        """(type, object) along a tendon's path."""
        start = int(self.model.tendon_adr[tendon])
        stop = start + int(self.model.tendon_num[tendon])
        return [
            (int(self.model.wrap_type[w]), int(self.model.wrap_objid[w]))
            for w in range(start, stop)
        ]

    def tendon_bodies(self, tendon: int) -> list[int]:
        """Bodies on which a tendon acts."""
        model, wrap = self.model, mujoco.mjtWrap
        owner = {
            int(wrap.mjWRAP_JOINT): model.jnt_bodyid,
            int(wrap.mjWRAP_SITE): model.site_bodyid,
            int(wrap.mjWRAP_SPHERE): model.geom_bodyid,
            int(wrap.mjWRAP_CYLINDER): model.geom_bodyid,
        }
        return [int(owner[kind][i]) for kind, i in self.wraps(tendon) if kind in owner]

    def flex_bodies(self) -> list[int]:
        """Bodies to which flexible elements are attached."""
        model = self.model
        return sorted({int(b) for b in (*model.flex_vertbodyid, *model.flex_nodebodyid) if b >= 0})

    def actuator_reach(self, actuator: int) -> tuple[list[int], list[int]]:
        """Indices of the joints and bodies on which an actuator acts."""
        model, trn = self.model, mujoco.mjtTrn
        kind = int(model.actuator_trntype[actuator])
        first, second = (int(i) for i in model.actuator_trnid[actuator])
        if kind in (int(trn.mjTRN_JOINT), int(trn.mjTRN_JOINTINPARENT)):
            return [first], [int(model.jnt_bodyid[first])]
        if kind == int(trn.mjTRN_TENDON):
            return self.tendon_joints(first), self.tendon_bodies(first)
        if kind == int(trn.mjTRN_BODY):
            bodies = [first]
        elif kind in (int(trn.mjTRN_SITE), int(trn.mjTRN_SLIDERCRANK)):
            bodies = [int(model.site_bodyid[s]) for s in (first, second) if s >= 0]
        elif model.nbody and kind != int(trn.mjTRN_UNDEFINED):
            # An unknown type of transmission may act on any body.
            bodies = list(range(model.nbody))
        else:
            bodies = []
        above = {a for body in bodies for a in ancestors(model, body)}
        return [j for j in range(model.njnt) if int(model.jnt_bodyid[j]) in above], bodies


def colliding_geoms(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """(ngeom,) whether a geom can be in a contact: by its masks or in an explicit pair."""
    can_collide: NDArray[np.bool_] = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    can_collide[model.pair_geom1] = True
    can_collide[model.pair_geom2] = True
    return can_collide


def ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """A body and its ancestors up to the world."""
    found = [body]
    while body:
        body = int(model.body_parentid[body])
        found.append(body)
    return found
