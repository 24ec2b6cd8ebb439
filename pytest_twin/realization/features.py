"""What checks can feel of a compiled model: parts by name, and how they hang together.

Everything is read from the compiled model, so that comments, default classes, includes, the way
an angle is written, and what is only seen change nothing.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.dependency import Part, Structure
from pytest_twin.formats.digest import file_sha256
from pytest_twin.realization.feature_fields import CUSTOM, FLEX, layer_of, model_fields

if TYPE_CHECKING:
    from pytest_twin.realization.model import Realization

_OBJ = mujoco.mjtObj
_JOINT_TYPES = {
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
}
_QPOS = {"free": 7, "ball": 4, "slide": 1, "hinge": 1}
_DOFS = {"free": 6, "ball": 3, "slide": 1, "hinge": 1}
_LAYOUT_BYTES = 2**20


def parts(realization: Realization) -> dict[str, Part]:
    """Part id -> part of a realization, ids with the realization's name in front."""
    found = model_parts(realization.model, realization.name, realization.velocity_limit)
    more = {"additions": additions(realization.spec)}
    if realization.source.effects is not None:
        more["effects"] = {"sha256": file_sha256(realization.source.effects)}
    idents = ((f"{realization.name}/{key}", content) for key, content in more.items())
    return {**found, **{ident: Part(ident, content) for ident, content in idents}}


def structure(realization: Realization) -> Structure:
    """How a realization hangs together."""
    return model_structure(realization.model, realization.name, realization.parts)


def model_parts(
    model: mujoco.MjModel, name: str, velocity_limit: Mapping[str, float] | None = None
) -> dict[str, Part]:
    """Part id -> part of a compiled model.

    Args:
        model: the model.
        name: the realization's name, in front of every id.
        velocity_limit: joint -> rad/s or m/s, where the source states it.
    """
    content = _Content(model, velocity_limit or {}).layers()
    return {f"{name}/{key}": Part(f"{name}/{key}", value) for key, value in content.items()}


def model_structure(model: mujoco.MjModel, name: str, part_ids: Iterable[str]) -> Structure:
    """How a compiled model hangs together; ``part_ids`` as :func:`model_parts` gives them."""
    return _structure(model, name, frozenset(part_ids))


def additions(spec: mujoco.MjSpec) -> dict[str, Any]:
    """What a body that is added to a scene, or a payload, would get from this model's file.

    The main default class and the compiler's bounds leave no trace in what is compiled already.
    """
    probe = spec.copy()
    geom = probe.worldbody.add_body().add_geom()
    content = {
        f"geom {name}": _value(getattr(geom, name))
        for name in (
            "contype",
            "conaffinity",
            "condim",
            "priority",
            "friction",
            "solmix",
            "solref",
            "solimp",
            "margin",
            "gap",
            "adhesion",
            "surfacevel",
            "density",
            "mass",
            "typeinertia",
            "fluid_ellipsoid",
            "fluid_coefs",
            "size",
            "pos",
            "quat",
        )
    }
    bounds = ("boundmass", "boundinertia", "balanceinertia", "settotalmass", "inertiafromgeom")
    layout = ("inertiagrouprange", "fusestatic", "alignfree", "autolimits", "discardvisual")
    return content | {name: _value(getattr(spec.compiler, name)) for name in (*bounds, *layout)}


class _Names:
    """Names of all elements of one type; those without one are known by their place."""

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


def _counted(owners: Iterable[str]) -> list[str]:
    """``owner#0``, ``owner#1``, ...: the place of each element among those of its owner."""
    count: dict[str, int] = {}
    places = []
    for owner in owners:
        places.append(f"{owner}#{count.get(owner, 0)}")
        count[owner] = count.get(owner, 0) + 1
    return places


class _Elements:
    """Names and owners of a model's elements."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        bodies: list[str] = []
        for i in range(model.nbody):
            parent = bodies[model.body_parentid[i]] if i else ""
            bodies.append(mujoco.mj_id2name(model, _OBJ.mjOBJ_BODY, i) or f"{parent}/#")
        self.body = _Names(model, _OBJ.mjOBJ_BODY, _counted(bodies))
        self.joint = self._of_bodies(_OBJ.mjOBJ_JOINT, model.jnt_bodyid)
        self.site = self._of_bodies(_OBJ.mjOBJ_SITE, model.site_bodyid)
        self.camera = self._of_bodies(_OBJ.mjOBJ_CAMERA, model.cam_bodyid)
        self.felt = felt_geoms(model)
        self._geoms: dict[int, list[int]] = {}
        for geom in np.flatnonzero(self.felt):
            self._geoms.setdefault(int(model.geom_bodyid[geom]), []).append(int(geom))
        # Only those that can be felt are counted: one that is only seen moves no place.
        owners = [
            f"{self.body[b]}" if felt else f"{self.body[b]}~"
            for b, felt in zip(model.geom_bodyid, self.felt, strict=True)
        ]
        self.geom = _Names(model, _OBJ.mjOBJ_GEOM, _counted(owners))
        self.mesh = self._plain(_OBJ.mjOBJ_MESH, model.nmesh)
        self.hfield = self._plain(_OBJ.mjOBJ_HFIELD, model.nhfield)
        self.tendon = self._plain(_OBJ.mjOBJ_TENDON, model.ntendon, "tendon")
        self.equality = self._plain(_OBJ.mjOBJ_EQUALITY, model.neq, "equality")
        self.actuator = self._plain(_OBJ.mjOBJ_ACTUATOR, model.nactuator)
        self.sensor = self._plain(_OBJ.mjOBJ_SENSOR, model.nsensor)
        self.key = self._plain(_OBJ.mjOBJ_KEY, model.nkey)
        self.flex = self._plain(_OBJ.mjOBJ_FLEX, model.nflex)
        self.joint_type = [_JOINT_TYPES[int(kind)] for kind in model.jnt_type]

    def _of_bodies(self, obj: mujoco.mjtObj, owner: NDArray[np.int32]) -> _Names:
        return _Names(self.model, obj, _counted(self.body[b] for b in owner))

    def _plain(self, obj: mujoco.mjtObj, count: int, prefix: str = "") -> _Names:
        return _Names(self.model, obj, _counted([prefix] * count))

    def object(self, obj: int, index: int) -> str | None:
        """Name of any element that an equality, a sensor or an actuator may point at."""
        names = {
            int(_OBJ.mjOBJ_BODY): self.body,
            int(_OBJ.mjOBJ_XBODY): self.body,
            int(_OBJ.mjOBJ_JOINT): self.joint,
            int(_OBJ.mjOBJ_GEOM): self.geom,
            int(_OBJ.mjOBJ_SITE): self.site,
            int(_OBJ.mjOBJ_CAMERA): self.camera,
            int(_OBJ.mjOBJ_MESH): self.mesh,
            int(_OBJ.mjOBJ_HFIELD): self.hfield,
            int(_OBJ.mjOBJ_TENDON): self.tendon,
            int(_OBJ.mjOBJ_EQUALITY): self.equality,
            int(_OBJ.mjOBJ_ACTUATOR): self.actuator,
            int(_OBJ.mjOBJ_SENSOR): self.sensor,
            int(_OBJ.mjOBJ_FLEX): self.flex,
        }.get(int(obj))
        if index < 0:
            return None
        return str(index) if names is None else names[index]

    def geoms_of(self, body: int) -> list[int]:
        """Geoms of a body that can be felt."""
        return self._geoms.get(body, [])

    def equality_ends(self, equality: int) -> tuple[int, list[int]]:
        """(object type, indices) of what an equality ties; MuJoCo states the type for some only."""
        model, kinds = self.model, mujoco.mjtEq
        kind = int(model.eq_type[equality])
        stated = {
            int(kinds.mjEQ_JOINT): _OBJ.mjOBJ_JOINT,
            int(kinds.mjEQ_TENDON): _OBJ.mjOBJ_TENDON,
            int(kinds.mjEQ_FLEX): _OBJ.mjOBJ_FLEX,
            int(kinds.mjEQ_FLEXVERT): _OBJ.mjOBJ_FLEX,
            int(kinds.mjEQ_FLEXSTRAIN): _OBJ.mjOBJ_FLEX,
            int(kinds.mjEQ_DISTANCE): _OBJ.mjOBJ_GEOM,
        }
        ends = [int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])]
        return int(stated.get(kind, model.eq_objtype[equality])), ends

    def body_of(self, obj: int, index: int) -> list[int]:
        """Bodies that an element touches; all of them where it is of a type not known here."""
        model = self.model
        if index < 0:
            return []
        if obj in (int(_OBJ.mjOBJ_BODY), int(_OBJ.mjOBJ_XBODY)):
            return [index]
        if obj == int(_OBJ.mjOBJ_JOINT):
            return [int(model.jnt_bodyid[index])]
        if obj == int(_OBJ.mjOBJ_SITE):
            return [int(model.site_bodyid[index])]
        if obj == int(_OBJ.mjOBJ_GEOM):
            return [int(model.geom_bodyid[index])]
        if obj == int(_OBJ.mjOBJ_TENDON):
            return self.tendon_bodies(index)
        if obj == int(_OBJ.mjOBJ_FLEX):
            return self.flex_bodies()
        return list(range(model.nbody))

    def tendon_joints(self, tendon: int) -> list[int]:
        """Joints of a fixed tendon, and joints of the bodies that a spatial one runs over."""
        model = self.model
        found = []
        for kind, index in self.wraps(tendon):
            if kind == int(mujoco.mjtWrap.mjWRAP_JOINT):
                found.append(index)
        if found:
            return found
        bodies = set(self.tendon_bodies(tendon))
        above = {a for body in bodies for a in _above(model, body)}
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
        model, wrap = self.model, mujoco.mjtWrap
        owner = {
            int(wrap.mjWRAP_JOINT): model.jnt_bodyid,
            int(wrap.mjWRAP_SITE): model.site_bodyid,
            int(wrap.mjWRAP_SPHERE): model.geom_bodyid,
            int(wrap.mjWRAP_CYLINDER): model.geom_bodyid,
        }
        return [int(owner[kind][i]) for kind, i in self.wraps(tendon) if kind in owner]

    def flex_bodies(self) -> list[int]:
        model = self.model
        return sorted({int(b) for b in (*model.flex_vertbodyid, *model.flex_nodebodyid) if b >= 0})

    def actuator_reach(self, actuator: int) -> tuple[list[int], list[int]]:
        """(joints, bodies) that an actuator drives."""
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
            # A transmission that is not known here may pull on anything.
            bodies = list(range(model.nbody))
        else:
            bodies = []
        above = {a for body in bodies for a in _above(model, body)}
        return [j for j in range(model.njnt) if int(model.jnt_bodyid[j]) in above], bodies


def felt_geoms(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """(ngeom,) whether a geom can be in a contact: by its masks or in an explicit pair."""
    felt: NDArray[np.bool_] = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    felt[model.pair_geom1] = True
    felt[model.pair_geom2] = True
    return felt


class _Content:
    """The contents of all parts of a model."""

    def __init__(self, model: mujoco.MjModel, velocity_limit: Mapping[str, float]) -> None:
        self.model = model
        self.names = _Elements(model)
        self.velocity_limit = velocity_limit

    def layers(self) -> dict[str, dict[str, Any]]:
        model, names = self.model, self.names
        found: dict[str, dict[str, Any]] = {}
        for body in range(1, model.nbody):
            found[f"kinematics:{names.body[body]}"] = self.kinematics(body)
            found[f"inertia:{names.body[body]}"] = self.inertia(body)
        for body in range(model.nbody):
            if names.geoms_of(body):
                found[f"collision:{names.body[body]}"] = self.collision(body)
        for joint in range(model.njnt):
            found[f"joint:{names.joint[joint]}"] = self.joint(joint)
            found[f"limit:{names.joint[joint]}"] = self.limit(joint)
        for tree in range(model.ntree):
            root = names.body[int(model.tree_bodyadr[tree])]
            found[f"tree:{root}"] = self.tree(tree)
        for mesh in sorted(self.felt_data({"mesh", "sdf"})):
            found[f"mesh:{names.mesh[mesh]}"] = self.mesh(mesh)
        for hfield in sorted(self.felt_data({"hfield"})):
            found[f"hfield:{names.hfield[hfield]}"] = self.hfield(hfield)
        for geom in range(model.ngeom):
            name = mujoco.mj_id2name(model, _OBJ.mjOBJ_GEOM, geom)
            if name and not names.felt[geom]:
                found[f"geom:{name}"] = self.seen(geom)
        found["contact:pairs"] = self.pairs()
        found["contact:filter"] = self.filtered()
        for coupling, value in self.couplings():
            # An equality and a tendon may bear one name.
            found.setdefault(f"coupling:{coupling}", {}).update(value)
        if model.nflex:
            found["flex:all"] = {name: _value(getattr(model, name)) for name in sorted(FLEX)}
        for actuator in range(model.nactuator):
            found[f"actuator:{names.actuator[actuator]}"] = self.actuator(actuator)
        for site in range(model.nsite):
            found[f"frame:{names.site[site]}"] = self.site(site)
        for sensor in range(model.nsensor):
            found[f"sensor:{names.sensor[sensor]}"] = self.sensor(sensor)
        for key in range(model.nkey):
            found[f"keyframe:{names.key[key]}"] = self.keyframe(key)
        found["option:gravity"] = {
            "gravity [m/s^2]": _list(model.opt.gravity),
            "disabled": bool(model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY),
        }
        found["option:integration"] = self.options()
        found["custom"] = self.custom()
        found["other"] = self.other()
        return found

    # -- bodies and joints

    def kinematics(self, body: int) -> dict[str, Any]:
        model, names = self.model, self.names
        joints = []
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            kind = names.joint_type[joint]
            at = int(model.jnt_qposadr[joint])
            joints.append(
                {
                    "name": names.joint[joint],
                    "type": kind,
                    "anchor [m]": _placed(model.jnt_pos[joint]),
                    "axis": _placed(model.jnt_axis[joint]),
                    "reference": _placed(model.qpos0[at : at + _QPOS[kind]]),
                }
            )
        return {
            "parent": names.body[int(model.body_parentid[body])],
            "position [m]": _placed(model.body_pos[body]),
            "quaternion": _rotation(model.body_quat[body]),
            "mocap": bool(model.body_mocapid[body] >= 0),
            "joints": joints,
        }

    def inertia(self, body: int) -> dict[str, Any]:
        model = self.model
        content: dict[str, Any] = {
            "mass [kg]": float(model.body_mass[body]),
            "centre of mass [m]": _placed(model.body_ipos[body]),
            "inertia [kg*m^2]": _tensor(model.body_iquat[body], model.body_inertia[body]),
            "gravity compensation": float(model.body_gravcomp[body]),
        }
        start = int(model.body_geomadr[body])
        fluid = [
            {"fluid": _list(model.geom_fluid[g]), **self.shape(g)}
            for g in range(start, start + int(model.body_geomnum[body]))
            if np.any(model.geom_fluid[g])
        ]
        if fluid:
            content["fluid"] = fluid
        return content

    def joint(self, joint: int) -> dict[str, Any]:
        model = self.model
        kind = self.names.joint_type[joint]
        dof, at = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
        dofs = slice(dof, dof + _DOFS[kind])
        torque = {"hinge": "N*m", "ball": "N*m", "slide": "N"}.get(kind)
        rate = {"hinge": "N*m*s/rad", "ball": "N*m*s/rad", "slide": "N*s/m"}.get(kind)
        spring = {"hinge": "N*m/rad", "ball": "N*m/rad", "slide": "N/m"}.get(kind)
        inertia = {"hinge": "kg*m^2", "ball": "kg*m^2", "slide": "kg"}.get(kind)
        forces = bool(model.jnt_actfrclimited[joint])
        return {
            _unit("damping", rate): _one(model.dof_damping[dofs]),
            "damping polynomial": _list(model.dof_dampingpoly[dofs]),
            _unit("friction loss", torque): _one(model.dof_frictionloss[dofs]),
            _unit("armature", inertia): _one(model.dof_armature[dofs]),
            "friction solref": _list(model.dof_solref[dofs]),
            "friction solimp": _list(model.dof_solimp[dofs]),
            _unit("stiffness", spring): float(model.jnt_stiffness[joint]),
            "stiffness polynomial": _list(model.jnt_stiffnesspoly[joint]),
            "spring reference": _placed(model.qpos_spring[at : at + _QPOS[kind]]),
            "spring yield": _number(model.jnt_springyield[joint]),
            "limit solref": _list(model.jnt_solref[joint]),
            "limit solimp": _list(model.jnt_solimp[joint]),
            "limit margin": float(model.jnt_margin[joint]),
            _unit("actuator force range", torque): _list(model.jnt_actfrcrange[joint])
            if forces
            else None,
            "gravity compensation by actuators": bool(model.jnt_actgravcomp[joint]),
        }

    def limit(self, joint: int) -> dict[str, Any]:
        model = self.model
        slide = self.names.joint_type[joint] == "slide"
        limited = bool(model.jnt_limited[joint])
        unit = "m" if slide else "rad"
        content: dict[str, Any] = {
            f"range [{unit}]": _placed(model.jnt_range[joint]) if limited else None
        }
        speed = self.velocity_limit.get(self.names.joint[joint])
        if speed is not None:
            content[f"velocity [{unit}/s]"] = _number(speed)
        return content

    def tree(self, tree: int) -> dict[str, Any]:
        """The order of the bodies, by which the solver meets contacts and limits."""
        model, names = self.model, self.names
        start = int(model.tree_bodyadr[tree])
        bodies = range(start, start + int(model.tree_bodynum[tree]))
        return {
            "bodies": [names.body[body] for body in bodies],
            "sleep policy": int(model.tree_sleep_policy[tree]),
        }

    # -- contact

    def shape(self, geom: int) -> dict[str, Any]:
        model = self.model
        kind = mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()
        content: dict[str, Any] = {
            "type": kind,
            "position [m]": _placed(model.geom_pos[geom]),
            "quaternion": _rotation(model.geom_quat[geom]),
        }
        data = int(model.geom_dataid[geom])
        if kind in ("mesh", "sdf") and data >= 0:
            content["mesh"] = self.names.mesh[data]
        elif kind == "hfield" and data >= 0:
            content["height field"] = self.names.hfield[data]
        elif kind != "plane":
            # The size of a plane is only how much of it is drawn.
            content["size [m]"] = _placed(model.geom_size[geom])
        return content

    def collision(self, body: int) -> dict[str, Any]:
        model, names = self.model, self.names
        return {
            "geoms": [
                {
                    "name": names.geom[g],
                    **self.shape(g),
                    "contype": int(model.geom_contype[g]),
                    "conaffinity": int(model.geom_conaffinity[g]),
                    "condim": int(model.geom_condim[g]),
                    "priority": int(model.geom_priority[g]),
                    "friction": _list(model.geom_friction[g]),
                    "solmix": float(model.geom_solmix[g]),
                    "solref": _list(model.geom_solref[g]),
                    "solimp": _list(model.geom_solimp[g]),
                    "margin [m]": float(model.geom_margin[g]),
                    "gap [m]": float(model.geom_gap[g]),
                    "surface velocity": _list(model.geom_surfacevel[g]),
                    "adhesion [N]": float(model.geom_adhesion[g]),
                }
                for g in names.geoms_of(body)
            ]
        }

    def seen(self, geom: int) -> dict[str, Any]:
        """A geom that never collides: its distance can be asked for all the same."""
        data = int(self.model.geom_dataid[geom])
        content = {"body": self.names.body[int(self.model.geom_bodyid[geom])], **self.shape(geom)}
        return content | (self.mesh(data) if "mesh" in content else {})

    def filtered(self) -> dict[str, Any]:
        """What is welded to what: neighbours are not tested for contact."""
        model, body = self.model, self.names.body
        found = {}
        for b in range(model.nbody):
            if self.names.geoms_of(b):
                weld = int(model.body_weldid[b])
                above = int(model.body_weldid[model.body_parentid[weld]])
                found[body[b]] = [body[weld], body[above]]
        return found

    def felt_data(self, kinds: set[str]) -> set[int]:
        """Meshes or height fields of geoms that can be felt, in a contact or in a fluid."""
        model = self.model
        found = set()
        for geom in range(model.ngeom):
            kind = mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()
            if kind in kinds and self.names.felt[geom] and model.geom_dataid[geom] >= 0:
                found.add(int(model.geom_dataid[geom]))
        return found

    def mesh(self, mesh: int) -> dict[str, Any]:
        model = self.model
        vertices = _slice(model.mesh_vert, model.mesh_vertadr, model.mesh_vertnum, mesh)
        faces = _slice(model.mesh_face, model.mesh_faceadr, model.mesh_facenum, mesh)
        content: dict[str, Any] = {
            "vertices": len(vertices),
            "faces": len(faces),
            "vertex positions": _digest(vertices),
            "face indices": _digest(faces),
            "hull": _digest(self._hull(mesh)),
        }
        if model.mesh_octnum[mesh] > 0:
            for name in ("oct_depth", "oct_child", "oct_aabb", "oct_coeff"):
                array = getattr(model, name)
                content[name] = _digest(_slice(array, model.mesh_octadr, model.mesh_octnum, mesh))
        return content

    def _hull(self, mesh: int) -> NDArray[Any]:
        model = self.model
        start = int(model.mesh_graphadr[mesh])
        if start < 0:
            return np.empty(0, dtype=np.int32)
        later = [int(a) for a in model.mesh_graphadr if a > start]
        return np.asarray(model.mesh_graph[start : min(later, default=len(model.mesh_graph))])

    def hfield(self, hfield: int) -> dict[str, Any]:
        model = self.model
        rows, columns = int(model.hfield_nrow[hfield]), int(model.hfield_ncol[hfield])
        start = int(model.hfield_adr[hfield])
        return {
            "size [m]": _list(model.hfield_size[hfield]),
            "rows": rows,
            "columns": columns,
            "elevation": _digest(model.hfield_data[start : start + rows * columns]),
        }

    def pairs(self) -> dict[str, Any]:
        model, names = self.model, self.names
        return {
            "declared": [
                {
                    "geoms": [names.geom[model.pair_geom1[p]], names.geom[model.pair_geom2[p]]],
                    "condim": int(model.pair_dim[p]),
                    "friction": _list(model.pair_friction[p]),
                    "solref": _list(model.pair_solref[p]),
                    "solref friction": _list(model.pair_solreffriction[p]),
                    "solimp": _list(model.pair_solimp[p]),
                    "margin [m]": float(model.pair_margin[p]),
                    "gap [m]": float(model.pair_gap[p]),
                    "adhesion [N]": float(model.pair_adhesion[p]),
                }
                for p in range(model.npair)
            ],
            "disabled": [
                [names.body[int(s) >> 16], names.body[int(s) & 0xFFFF]]
                for s in model.exclude_signature
            ],
        }

    # -- couplings

    def couplings(self) -> Iterable[tuple[str, dict[str, Any]]]:
        model, names = self.model, self.names
        for eq in range(model.neq):
            obj, ends = names.equality_ends(eq)
            yield (
                names.equality[eq],
                {
                    "equality": mujoco.mjtEq(int(model.eq_type[eq])).name.removeprefix("mjEQ_"),
                    "of": [names.object(obj, i) for i in ends],
                    "object type": obj,
                    "sites": [self.site(i) for i in ends if obj == int(_OBJ.mjOBJ_SITE) and i >= 0],
                    "active": bool(model.eq_active0[eq]),
                    "data": _list(model.eq_data[eq]),
                    "solref": _list(model.eq_solref[eq]),
                    "solimp": _list(model.eq_solimp[eq]),
                },
            )
        for tendon in range(model.ntendon):
            yield names.tendon[tendon], self.tendon(tendon)

    def tendon(self, tendon: int) -> dict[str, Any]:
        model, names, wrap = self.model, self.names, mujoco.mjtWrap
        path = []
        start = int(model.tendon_adr[tendon])
        for w in range(start, start + int(model.tendon_num[tendon])):
            kind, index = int(model.wrap_type[w]), int(model.wrap_objid[w])
            prm = float(model.wrap_prm[w])
            step: dict[str, Any] = {"type": wrap(kind).name.removeprefix("mjWRAP_")}
            if kind == int(wrap.mjWRAP_JOINT):
                step |= {"joint": names.joint[index], "coefficient": prm}
            elif kind == int(wrap.mjWRAP_SITE):
                step |= {"site": names.site[index], **self.site(index)}
            elif kind in (int(wrap.mjWRAP_SPHERE), int(wrap.mjWRAP_CYLINDER)):
                body = names.body[int(model.geom_bodyid[index])]
                step |= {"geom": names.geom[index], "body": body, **self.shape(index)}
                if prm >= 0:
                    side = round(prm)
                    step |= {"side": names.site[side], "side frame": self.site(side)}
            else:
                step["divisor"] = prm
            path.append(step)
        limited = bool(model.tendon_limited[tendon])
        forces = bool(model.tendon_actfrclimited[tendon])
        return {
            "path": path,
            "tendon type": int(model.tendon_type[tendon]),
            "range": _list(model.tendon_range[tendon]) if limited else None,
            "actuator force range": _list(model.tendon_actfrcrange[tendon]) if forces else None,
            "spring length": _placed(model.tendon_lengthspring[tendon]),
            **{
                name: _value(getattr(model, f"tendon_{name}")[tendon])
                for name in (
                    "solref_lim",
                    "solimp_lim",
                    "solref_fri",
                    "solimp_fri",
                    "margin",
                    "stiffness",
                    "stiffnesspoly",
                    "damping",
                    "dampingpoly",
                    "armature",
                    "frictionloss",
                    "springyield",
                )
            },
        }

    # -- actuators, frames, sensors, keyframes

    def actuator(self, actuator: int) -> dict[str, Any]:
        model, names, trn = self.model, self.names, mujoco.mjtTrn
        kind = int(model.actuator_trntype[actuator])
        targets = {
            int(trn.mjTRN_JOINT): _OBJ.mjOBJ_JOINT,
            int(trn.mjTRN_JOINTINPARENT): _OBJ.mjOBJ_JOINT,
            int(trn.mjTRN_TENDON): _OBJ.mjOBJ_TENDON,
            int(trn.mjTRN_SITE): _OBJ.mjOBJ_SITE,
            int(trn.mjTRN_SLIDERCRANK): _OBJ.mjOBJ_SITE,
            int(trn.mjTRN_BODY): _OBJ.mjOBJ_BODY,
        }
        obj = int(targets.get(kind, _OBJ.mjOBJ_UNKNOWN))
        ends = [int(i) for i in model.actuator_trnid[actuator]]
        if obj not in (int(_OBJ.mjOBJ_SITE), int(_OBJ.mjOBJ_UNKNOWN)):
            ends = ends[:1]
        controls = slice(
            int(model.actuator_ctrladr[actuator]),
            int(model.actuator_ctrladr[actuator]) + int(model.actuator_ctrlnum[actuator]),
        )
        outputs = slice(
            int(model.actuator_outadr[actuator]),
            int(model.actuator_outadr[actuator]) + int(model.actuator_outnum[actuator]),
        )
        return {
            "transmission": trn(kind).name.removeprefix("mjTRN_").lower(),
            "target": [names.object(obj, i) for i in ends],
            "sites": [self.site(i) for i in ends if obj == int(_OBJ.mjOBJ_SITE) and i >= 0],
            "gear": _list(model.actuator_gear[outputs]),
            "length range": _list(model.actuator_lengthrange[outputs]),
            "control range": [
                _list(limits) if limited else None
                for limited, limits in zip(
                    model.actuator_ctrllimited[controls],
                    model.actuator_ctrlrange[controls],
                    strict=True,
                )
            ],
            "force range": _list(model.actuator_forcerange[actuator])
            if model.actuator_forcelimited[actuator]
            else None,
            "activation range": _list(model.actuator_actrange[actuator])
            if model.actuator_actlimited[actuator]
            else None,
            "delay [s]": _number(model.actuator_delay[actuator]),
            **{
                name: _value(getattr(model, f"actuator_{name}")[actuator])
                for name in (
                    "dyntype",
                    "gaintype",
                    "biastype",
                    "ctrlspec",
                    "actnum",
                    "cranklength",
                    "dynprm",
                    "gainprm",
                    "biasprm",
                    "actearly",
                    "history",
                    "damping",
                    "dampingpoly",
                    "armature",
                    "group",
                )
            },
        }

    def site(self, site: int) -> dict[str, Any]:
        model = self.model
        return {
            "body": self.names.body[int(model.site_bodyid[site])],
            "position [m]": _placed(model.site_pos[site]),
            "quaternion": _rotation(model.site_quat[site]),
        }

    def sensor(self, sensor: int) -> dict[str, Any]:
        model, names = self.model, self.names
        obj, index = int(model.sensor_objtype[sensor]), int(model.sensor_objid[sensor])
        ref, other = int(model.sensor_reftype[sensor]), int(model.sensor_refid[sensor])
        kind = int(model.sensor_type[sensor])
        content: dict[str, Any] = {
            "type": mujoco.mjtSensor(kind).name.removeprefix("mjSENS_").lower(),
            "of": [obj, names.object(obj, index)],
            "in": [ref, names.object(ref, other)],
            **{
                name: _value(getattr(model, f"sensor_{name}")[sensor])
                for name in (
                    "datatype",
                    "needstage",
                    "intprm",
                    "dim",
                    "cutoff",
                    "noise",
                    "history",
                    "delay",
                    "interval",
                )
            },
        }
        for target, at in ((obj, index), (ref, other)):
            if target == int(_OBJ.mjOBJ_SITE) and at >= 0:
                shape = [int(model.site_type[at]), _placed(model.site_size[at])]
                content.setdefault("sites", []).append([self.site(at), shape])
                content["site meshes"] = [int(model.site_dataid[at])]
            if target == int(_OBJ.mjOBJ_GEOM) and at >= 0:
                content.setdefault("geoms", []).append(self.shape(at))
        if kind == int(mujoco.mjtSensor.mjSENS_RANGEFINDER):
            # A ray meets what is only seen, too.
            shapes = [_value(model.geom_type), _value(model.geom_dataid), _value(model.mesh_vert)]
            places = [_value(model.geom_pos), _value(model.geom_quat), _value(model.geom_size)]
            content["all geoms"] = [*shapes, *places, _value(model.geom_rgba[:, 3] == 0)]
        return content

    def keyframe(self, key: int) -> dict[str, Any]:
        model, names = self.model, self.names
        positions, velocities = {}, {}
        for joint in range(model.njnt):
            kind, name = names.joint_type[joint], names.joint[joint]
            at, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            positions[name] = _one(np.round(model.key_qpos[key, at : at + _QPOS[kind]], 12))
            velocities[name] = _one(model.key_qvel[key, dof : dof + _DOFS[kind]])
        controls, activations = {}, {}
        for actuator in range(model.nactuator):
            at, count = model.actuator_ctrladr[actuator], model.actuator_ctrlnum[actuator]
            controls[names.actuator[actuator]] = _one(model.key_ctrl[key, at : at + count])
            at, count = model.actuator_actadr[actuator], model.actuator_actnum[actuator]
            if at >= 0:
                activations[names.actuator[actuator]] = _one(model.key_act[key, at : at + count])
        return {
            "time [s]": float(model.key_time[key]),
            "positions": positions,
            "velocities": velocities,
            "controls": controls,
            "activations": activations,
            "mocap positions": _list(model.key_mpos[key]),
            "mocap quaternions": _list(model.key_mquat[key]),
            "plastic state": _list(model.key_plastic[key]),
        }

    # -- the rest

    def options(self) -> dict[str, Any]:
        """Every option by name, whatever options this MuJoCo has."""
        model = self.model
        content = {
            name: _value(getattr(model.opt, name))
            for name in dir(model.opt)
            if not name.startswith("_")
            and not callable(getattr(model.opt, name))
            and name != "gravity"
        }
        content["timestep [s]"] = content.pop("timestep")
        content["contact limits"] = [int(model.nconmax), int(model.njmax)]
        # A small arena drops contacts; MuJoCo's own choice grows with what is only seen as well.
        if model.narena < _LAYOUT_BYTES:
            content["arena [bytes]"] = int(model.narena)
        # Solvers end by it. Where nobody states it, it follows from the masses.
        mean = float(model.dof_M0.mean()) if model.nv else 0.0
        stated = float(model.stat.meaninertia)
        if model.nv and not math.isclose(stated, mean, rel_tol=1e-6):
            content["mean inertia"] = stated
        return content

    def custom(self) -> dict[str, Any]:
        """What MuJoCo carries for others and does not feel itself."""
        model = self.model
        content = {
            name: _value(array)
            for name in sorted(CUSTOM)
            if isinstance(array := getattr(model, name), np.ndarray) and array.size
        }
        if model.text_data:
            content["text_data"] = _value(model.text_data)
        return content

    def other(self) -> dict[str, Any]:
        """Fields that no layer claims, plugins among them."""
        model = self.model
        content = {}
        for name in model_fields(model):
            if layer_of(name, model) == "other":
                value = getattr(model, name)
                # -1 is 'none' throughout: plugin ids of elements without a plugin.
                if not isinstance(value, np.ndarray) or np.any(value != -1):
                    content[name] = _value(value)
        return content


def _above(model: mujoco.MjModel, body: int) -> list[int]:
    found = [body]
    while body:
        body = int(model.body_parentid[body])
        found.append(body)
    return found


def _structure(model: mujoco.MjModel, name: str, part_ids: frozenset[str]) -> Structure:
    names = _Elements(model)
    body = names.body

    def bodies(indices: Iterable[int]) -> tuple[str, ...]:
        return tuple(sorted({body[i] for i in indices}))

    couplings: dict[str, tuple[str, ...]] = {}
    equalities, loops = set(), set()
    for eq in range(model.neq):
        obj, ends = names.equality_ends(eq)
        part = f"{name}/coupling:{names.equality[eq]}"
        couplings[part] = bodies(b for i in ends for b in names.body_of(obj, i))
        equalities.add(part)
        if int(model.eq_type[eq]) != int(mujoco.mjtEq.mjEQ_JOINT):
            loops.add(part)
    for tendon in range(model.ntendon):
        part = f"{name}/coupling:{names.tendon[tendon]}"
        found = bodies(names.tendon_bodies(tendon))
        couplings[part] = tuple(sorted({*couplings.get(part, ()), *found}))
    if model.nflex:
        couplings[f"{name}/flex:all"] = bodies(names.flex_bodies())

    colliding = [b for b in range(model.nbody) if names.geoms_of(b)]
    masks, meshes = {}, {}
    for b in colliding:
        geoms = names.geoms_of(b)
        contype = int(np.bitwise_or.reduce(model.geom_contype[geoms]))
        conaffinity = int(np.bitwise_or.reduce(model.geom_conaffinity[geoms]))
        masks[body[b]] = (contype, conaffinity)
        used = set()
        for g in geoms:
            data, kind = int(model.geom_dataid[g]), int(model.geom_type[g])
            if data >= 0 and kind == int(mujoco.mjtGeom.mjGEOM_HFIELD):
                used.add(f"{name}/hfield:{names.hfield[data]}")
            elif data >= 0:
                used.add(f"{name}/mesh:{names.mesh[data]}")
        if used:
            meshes[body[b]] = tuple(sorted(used))

    reach = [names.actuator_reach(a) for a in range(model.nactuator)]
    frames = {body[b]: body[b] for b in range(model.nbody)}
    frames |= {names.site[s]: body[int(model.site_bodyid[s])] for s in range(model.nsite)}
    return Structure(
        realization=name,
        body_parent={body[b]: body[int(model.body_parentid[b])] for b in range(1, model.nbody)},
        joint_body={names.joint[j]: body[int(model.jnt_bodyid[j])] for j in range(model.njnt)},
        joint_range={
            names.joint[j]: (float(model.jnt_range[j, 0]), float(model.jnt_range[j, 1]))
            if model.jnt_limited[j]
            else None
            for j in range(model.njnt)
        },
        joint_type={names.joint[j]: names.joint_type[j] for j in range(model.njnt)},
        frame_body=frames,
        actuator_joints={
            names.actuator[a]: tuple(names.joint[j] for j in joints)
            for a, (joints, _) in enumerate(reach)
        },
        collision_bodies=frozenset(body[b] for b in colliding),
        couplings=couplings,
        part_ids=part_ids,
        body_tree={
            body[b]: body[int(model.tree_bodyadr[model.body_treeid[b]])]
            for b in range(model.nbody)
            if model.body_treeid[b] >= 0
        },
        actuator_bodies={names.actuator[a]: bodies(pulled) for a, (_, pulled) in enumerate(reach)},
        equalities=frozenset(equalities),
        loops=frozenset(loops),
        contact_masks=masks,
        contact_pairs=tuple(
            (body[int(model.geom_bodyid[a])], body[int(model.geom_bodyid[b])])
            for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)
        ),
        body_meshes=meshes,
        geom_body={
            names.geom[g]: body[int(model.geom_bodyid[g])]
            for g in range(model.ngeom)
            if mujoco.mj_id2name(model, _OBJ.mjOBJ_GEOM, g)
        },
    )


# -- canonical values


def _unit(name: str, unit: str | None) -> str:
    return name if unit is None else f"{name} [{unit}]"


def _number(value: Any) -> float | str:
    """JSON knows no infinity."""
    number = float(value)
    return number if math.isfinite(number) else str(number)


def _list(array: Any) -> Any:
    array = np.asarray(array)
    if array.ndim > 1:
        return [_list(row) for row in array]
    return [_number(value) for value in array]


def _one(array: Any) -> Any:
    """The number itself where there is one."""
    values = _list(array)
    return values[0] if len(values) == 1 else values


def _placed(array: Any) -> Any:
    """Positions in m, axes, joint values: what is under 1e-12 comes from how it was written."""
    return _list(np.round(np.asarray(array, dtype=np.float64), 12) + 0.0)


def _rotation(quaternion: NDArray[np.float64]) -> Any:
    """One of the two quaternions of a rotation."""
    rounded = np.round(quaternion, 12)
    first = rounded[np.flatnonzero(rounded)[:1]]
    return _list(rounded * (-1.0 if first.size and first[0] < 0 else 1.0) + 0.0)


def _tensor(quaternion: NDArray[np.float64], diagonal: NDArray[np.float64]) -> Any:
    """xx yy zz xy xz yz in the body's axes: principal axes may be written in many ways."""
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, quaternion)
    rotation = flat.reshape(3, 3)
    tensor = rotation @ np.diag(diagonal) @ rotation.T
    scale = float(np.abs(tensor).max()) or 1.0
    values = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return _list((np.round(values / scale, 10) + 0.0) * scale)


def _slice(
    array: NDArray[Any], starts: NDArray[Any], counts: NDArray[Any], index: int
) -> NDArray[Any]:
    start = int(starts[index])
    return np.asarray(array[start : start + int(counts[index])])


def _digest(array: Any) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def _value(value: Any) -> Any:
    """Any field: short ones as they are, long ones as their digest."""
    if isinstance(value, bytes | str):
        data = value.encode() if isinstance(value, str) else value
        return hashlib.sha256(data).hexdigest()
    if isinstance(value, np.ndarray):
        if value.size > 16 or value.dtype.kind not in "fiub":
            return {"shape": list(value.shape), "sha256": _digest(value)}
        return _list(value)
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    return _number(value) if isinstance(value, float | np.floating) else str(value)
