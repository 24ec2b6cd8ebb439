"""Describe an MJCF by its compiled model and simulated behaviour."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import combinations, product

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.asset.loss import shapes
from pytest_twin.asset.loss.description import Description, JointFacts, LinkFacts
from pytest_twin.asset.loss.shapes import Shape
from pytest_twin.metrics.pose import inverse, rigid
from pytest_twin.realization.collision_filter import (
    are_excluded,
    are_one_or_linked,
    have_matching_masks,
)
from pytest_twin.realization.inertia import compiled_inertia

Vector = NDArray[np.float64]
_KINDS = {
    mujoco.mjtJoint.mjJNT_HINGE: "hinge",
    mujoco.mjtJoint.mjJNT_SLIDE: "slide",
    mujoco.mjtJoint.mjJNT_BALL: "ball",
    mujoco.mjtJoint.mjJNT_FREE: "free",
}
_OVERDRIVEN = 1e9
"""A control that exceeds the limits of every actuator. An effort of this order shows that the
actuator has no limit."""


class MujocoDynamics:
    """Kinematics and dynamics of a compiled model, without contacts, indexed by name."""

    def __init__(self, model: mujoco.MjModel, root: str) -> None:
        self.model = model
        self._root = root
        self._data = mujoco.MjData(model)
        self._joints = {
            _name(model, mujoco.mjtObj.mjOBJ_JOINT, i): i
            for i in range(model.njnt)
            if int(model.jnt_type[i])
            in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
        }
        self._bodies = {_name(model, mujoco.mjtObj.mjOBJ_BODY, i): i for i in range(model.nbody)}
        if root != "world":
            del self._bodies["world"]

    @property
    def joints(self) -> tuple[str, ...]:
        """Return hinges and slides, in model order."""
        return tuple(self._joints)

    @property
    def frames(self) -> tuple[str, ...]:
        """Return the bodies."""
        return tuple(self._bodies)

    def _at(self, q: Mapping[str, float]) -> mujoco.MjData:
        data = self._data
        data.qpos[:] = self.model.qpos0
        for name, value in q.items():
            data.qpos[self.model.jnt_qposadr[self._joints[name]]] = value
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        return data

    def _pose(self, data: mujoco.MjData, body: int) -> Vector:
        return rigid(data.xmat[body].reshape(3, 3), data.xpos[body])

    def poses(self, q: Mapping[str, float]) -> dict[str, Vector]:
        """Return ``transform_root_to_frame`` (4, 4) of every body."""
        data = self._at(q)
        back = inverse(self._pose(data, self._bodies[self._root]))
        return {name: back @ self._pose(data, body) for name, body in self._bodies.items()}

    def mass(self) -> float:
        """Return the total mass, static bodies included, kg."""
        return float(self.model.body_mass.sum())

    def center_of_mass(self, q: Mapping[str, float]) -> Vector:
        """Return the (3,) centre of mass, static bodies included, m."""
        data, total = self._at(q), self.mass()
        moment = self.model.body_mass @ data.xipos
        world = moment / total if total > 0 else np.zeros(3)
        return np.asarray((inverse(self._pose(data, self._bodies[self._root])) @ [*world, 1.0])[:3])

    def _columns(self) -> list[int]:
        return [int(self.model.jnt_dofadr[i]) for i in self._joints.values()]

    def gravity_torque(self, q: Mapping[str, float]) -> Vector:
        """Return the (n,) bias forces at rest, N*m or N."""
        data = self._at(q)
        data.qvel[:] = 0.0
        mujoco.mj_fwdVelocity(self.model, data)
        return np.array(data.qfrc_bias[self._columns()])

    def mass_matrix(self, q: Mapping[str, float]) -> Vector:
        """Return the (n, n) mass matrix, armature included."""
        data = self._at(q)
        mujoco.mj_crb(self.model, data)
        full = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, data, full)
        columns = self._columns()
        return np.asarray(full[np.ix_(columns, columns)])


def describe(model: mujoco.MjModel, root: str) -> Description:
    """Describe a compiled model.

    Args:
        root: the link that is fixed to the world.
    """
    actuators = _actuators(model)
    effort = _saturated_effort(model)
    joints = {}
    for index in range(model.njnt):
        name = _name(model, mujoco.mjtObj.mjOBJ_JOINT, index)
        dof, limited = int(model.jnt_dofadr[index]), bool(model.jnt_limited[index])
        kind = _KINDS[mujoco.mjtJoint(model.jnt_type[index])]
        joints[name] = JointFacts(
            kind,
            (float(model.jnt_range[index, 0]), float(model.jnt_range[index, 1]))
            if limited
            else None,
            None,
            effort.get(name),
            float(model.dof_damping[dof]),
            float(model.dof_frictionloss[dof]),
            float(model.qpos0[model.jnt_qposadr[index]]) if kind in ("hinge", "slide") else 0.0,
        )
    mimics, rank, others = _equalities(model)
    geoms = _colliding_geoms(model)
    return Description(
        name="MJCF",
        engine=f"MuJoCo {mujoco.__version__}",
        dynamics=MujocoDynamics(model, root),
        links=_links(model, root),
        joints=joints,
        independent=int(model.nv) - rank,
        actuators=actuators,
        drives=_drives(model),
        mimics=mimics,
        constraints=others,
        shapes={
            body: shapes.in_order([_shape(model, g) for g in of]) for body, of in geoms.items()
        },
        disabled_pairs=_disabled_pairs(model, geoms),
        contact=dict(
            Counter(
                "friction " + " ".join(f"{value:g}" for value in model.geom_friction[geom])
                for of in geoms.values()
                for geom in of
            )
        ),
        sensors=_sensors(model),
        transmissions={joint: f"reduction {gear:g}" for joint, gear, _ in actuators.values()},
    )


def _name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    return mujoco.mj_id2name(model, kind, index) or f"{kind.name[6:].lower()}#{index}"


def _links(model: mujoco.MjModel, root: str) -> dict[str, LinkFacts]:
    links = {}
    for body in range(model.nbody):
        name = _name(model, mujoco.mjtObj.mjOBJ_BODY, body)
        if body == 0 and root != "world":
            continue
        links[name] = LinkFacts(*compiled_inertia(model, body))
    return links


def _actuators(
    model: mujoco.MjModel,
) -> dict[str, tuple[str, float, tuple[float, float] | None]]:
    found = {}
    for index in range(model.nu):
        if model.actuator_trntype[index] != mujoco.mjtTrn.mjTRN_JOINT:
            continue
        joint = _name(model, mujoco.mjtObj.mjOBJ_JOINT, int(model.actuator_trnid[index, 0]))
        bound = None
        if model.actuator_forcelimited[index]:
            lower, upper = (float(value) for value in model.actuator_forcerange[index])
            bound = (lower, upper)
        gear = float(model.actuator_gear[index, 0])
        found[_name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, index)] = (joint, gear, bound)
    return found


def _saturated_effort(model: mujoco.MjModel) -> dict[str, float]:
    """Return joint -> largest force of its actuators, with every control beyond its limits."""
    data = mujoco.MjData(model)
    found: dict[str, float] = {}
    for sign in (1.0, -1.0):
        data.ctrl[:] = sign * _OVERDRIVEN
        with _without_contact(model):
            mujoco.mj_forward(model, data)
        for joint, _, _ in _actuators(model).values():
            index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
            force = abs(float(data.qfrc_actuator[model.jnt_dofadr[index]]))
            if force < _OVERDRIVEN / 2:
                found[joint] = max(found.get(joint, 0.0), force)
    return found


def _sensors(model: mujoco.MjModel) -> dict[str, str]:
    """Return site -> its sensors; ``site`` if it has none."""
    found: dict[str, list[str]] = {
        _name(model, mujoco.mjtObj.mjOBJ_SITE, site): [] for site in range(model.nsite)
    }
    for index in range(model.nsensor):
        if model.sensor_objtype[index] == mujoco.mjtObj.mjOBJ_SITE:
            site = _name(model, mujoco.mjtObj.mjOBJ_SITE, int(model.sensor_objid[index]))
            kind = mujoco.mjtSensor(model.sensor_type[index]).name
            found[site].append(kind.removeprefix("mjSENS_").lower())
    return {site: ", ".join(kinds) or "site" for site, kinds in found.items()}


def _drives(model: mujoco.MjModel) -> dict[str, str]:
    """Return joint -> feedback of its actuator on position or velocity."""
    found = {}
    for name, (joint, _, _) in _actuators(model).items():
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)
        if model.actuator_biastype[index] != mujoco.mjtBias.mjBIAS_NONE:
            values = " ".join(f"{value:g}" for value in model.actuator_biasprm[index][:3])
            found[joint] = f"bias {values}"
    return found


@contextmanager
def _without_contact(model: mujoco.MjModel) -> Iterator[None]:
    """Disable contacts inside a ``with`` block."""
    flags = int(model.opt.disableflags)
    model.opt.disableflags = flags | int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    try:
        yield
    finally:
        model.opt.disableflags = flags


def _equalities(
    model: mujoco.MjModel,
) -> tuple[dict[str, tuple[str, float, float]], int, tuple[str, ...]]:
    """Return mimics from constraint residuals, rank of all equalities, and other constraints."""
    mimics: dict[str, tuple[str, float, float]] = {}
    others = []
    if not model.neq:
        return {}, 0, tuple(f"tendon {i}" for i in range(model.ntendon))
    data = mujoco.MjData(model)

    def residual(joint: int | None) -> Vector:
        data.qpos[:] = model.qpos0
        if joint is not None:
            data.qpos[model.jnt_qposadr[joint]] += 1.0
        mujoco.mj_fwdPosition(model, data)
        found = np.zeros(model.neq)
        rows = np.flatnonzero(data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY))
        for row in rows:
            found[data.efc_id[row]] = data.efc_pos[row]
        return found

    with _without_contact(model):
        jacobian = int(model.opt.jacobian)
        model.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
        at_rest = residual(None)
        rows = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        dense = np.array(data.efc_J).reshape(len(data.efc_type), model.nv)[rows]
        rank = int(np.linalg.matrix_rank(dense)) if dense.size else 0
        for index in range(model.neq):
            kind = mujoco.mjtEq(model.eq_type[index])
            follower, leader = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
            if kind != mujoco.mjtEq.mjEQ_JOINT or leader < 0 or not data.eq_active[index]:
                others.append(f"equality {kind.name.removeprefix('mjEQ_').lower()}")
                continue
            names = [_name(model, mujoco.mjtObj.mjOBJ_JOINT, i) for i in (follower, leader)]
            multiplier = -(residual(leader)[index] - at_rest[index])
            mimics[names[0]] = (names[1], float(multiplier), float(-at_rest[index]))
        model.opt.jacobian = jacobian
    others += [f"tendon {i}" for i in range(model.ntendon)]
    return mimics, rank, tuple(others)


def _colliding_geoms(model: mujoco.MjModel) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    ground = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
    for geom in range(model.ngeom):
        if model.geom_type[geom] in ground:
            continue
        if model.geom_contype[geom] or model.geom_conaffinity[geom]:
            body = _name(model, mujoco.mjtObj.mjOBJ_BODY, int(model.geom_bodyid[geom]))
            found.setdefault(body, []).append(geom)
    return found


def _shape(model: mujoco.MjModel, geom: int) -> Shape:
    kind = mujoco.mjtGeom(model.geom_type[geom])
    size = np.array(model.geom_size[geom])
    pose, axes = np.eye(4), np.empty(9)
    mujoco.mju_quat2Mat(axes, model.geom_quat[geom])
    pose[:3, :3], pose[:3, 3] = axes.reshape(3, 3), model.geom_pos[geom]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return shapes.of_box(2 * size, pose)
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return shapes.of_sphere(size[0], pose)
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return shapes.of_ellipsoid(size, pose)
    if kind in (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE):
        word = kind.name.removeprefix("mjGEOM_").lower()
        return shapes.of_round(word, size[0], 2 * size[1], pose)
    mesh = int(model.geom_dataid[geom])
    start, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    points = np.array(model.mesh_vert[start : start + count], dtype=np.float64)
    convex = int(model.mesh_graphadr[mesh]) >= 0
    return shapes.of_points("convex hull" if convex else "mesh", points, pose)


def _disabled_pairs(
    model: mujoco.MjModel, geoms: Mapping[str, list[int]]
) -> frozenset[frozenset[str]]:
    """Return pairs of bodies with shapes whose collision MuJoCo disables."""
    found = set()
    index = {name: mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) for name in geoms}
    for first, second in combinations(geoms, 2):
        bodies = index[first], index[second]
        pairs = np.transpose(list(product(geoms[first], geoms[second])))
        if (
            are_one_or_linked(model, *bodies)
            or are_excluded(model, *bodies)
            or not have_matching_masks(model, *pairs).any()
        ):
            found.add(frozenset((first, second)))
    return frozenset(found)
