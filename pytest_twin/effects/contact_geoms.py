"""Geoms of the robot and its surroundings that may touch, and changes of their contacts."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import ModelFields

CONTACT_DISTANCE = 0.05
"""Distance in m below which two geoms of a recording may touch."""
_MAX_POSES = 3000
"""Largest number of recorded poses at which distances are computed."""
_MASK_BITS = 15
"""Number of bits of a collision mask for each of the robot and its surroundings."""
_FLAT = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)

Ids = NDArray[np.int64]


def _no_ids() -> Ids:
    return np.empty(0, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class ContactGeoms:
    """Geoms that come close to each other in recordings.

    Attributes:
        world: fixed geoms, without those of the robot's own base.
        normal: (world, 3) outward unit normals, in the frames of their bodies.
        robot: geoms that move with the joints.
        pairs: explicit contact pairs between the two, which have parameters of their own.
        has_friction: whether any of these contacts has friction.
    """

    world: Ids = field(default_factory=_no_ids)
    normal: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    robot: Ids = field(default_factory=_no_ids)
    pairs: Ids = field(default_factory=_no_ids)
    has_friction: bool = False

    def has(self, effect: str) -> bool:
        """Whether a contact effect can act on these geoms."""
        return bool(self.world.size) and (self.has_friction or effect != "contact_friction")

    @property
    def geoms(self) -> Ids:
        """Geoms of both sides, because MuJoCo mixes the parameters of both.

        The mix is a weighted mean, a minimum or a maximum. The same factor or offset on both sides
        therefore appears in the mix.
        """
        return np.concatenate([self.world, self.robot])

    def write(
        self, expand: Callable[[str], FloatArray], fields: ModelFields, least_time: float
    ) -> None:
        """Write contact effects into the model fields of the rows.

        Args:
            expand: returns the (rows, ...) array of a model field.
            least_time: s, see :func:`scaled_solref`.
        """
        if not self.world.size:
            return
        if fields.contact_offset.any():
            moved = fields.contact_offset[:, None, None] * self.normal
            expand("geom_pos")[:, self.world] += moved
        if fields.contact_stiffness.any() or fields.contact_damping.any():
            stiffness = 1.0 + np.atleast_1d(fields.contact_stiffness)[:, None]
            damping = 1.0 + np.atleast_1d(fields.contact_damping)[:, None]
            for name, which in (("geom_solref", self.geoms), ("pair_solref", self.pairs)):
                if which.size:
                    array = expand(name)
                    array[:, which] = scaled_solref(array[:, which], stiffness, damping, least_time)
        if fields.contact_friction.any():
            added = np.atleast_1d(fields.contact_friction)[:, None]
            array = expand("geom_friction")
            array[:, self.geoms, 0] = np.maximum(array[:, self.geoms, 0] + added, 0.0)
            if self.pairs.size:
                array = expand("pair_friction")
                both = array[:, self.pairs, :2] + added[:, :, None]
                array[:, self.pairs, :2] = np.maximum(both, 0.0)


def least_time_constant(model: mujoco.MjModel, timestep: float) -> float:
    """Smallest time constant of a contact that MuJoCo accepts, s."""
    free = model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_REFSAFE)
    return 0.0 if free else 2.0 * timestep


def scaled_solref(
    solref: FloatArray, stiffness: FloatArray, damping: FloatArray, least_time: float
) -> FloatArray:
    """(..., 2) ``solref`` with stiffness and damping scaled by (...) factors.

    ``solref`` is (time constant T, damping ratio Z) with b = 2 / T and k = 1 / (T Z)^2, T at least
    ``least_time``; or (-k, -b) directly (MuJoCo documentation, Modeling, Solver parameters).
    """
    first, second = solref[..., 0], solref[..., 1]
    standard = first > 0.0
    time = np.maximum(first, least_time)
    new_time = np.maximum(time / damping, least_time)
    ratio = second * time / (np.where(standard, new_time, 1.0) * np.sqrt(stiffness))
    # A time constant below the minimum stays as written.
    written = np.where(new_time == time, first, new_time)
    return np.stack(
        [
            np.where(standard, written, first * stiffness),
            np.where(standard, ratio, second * damping),
        ],
        axis=-1,
    )


def find_contact_geoms(
    model: mujoco.MjModel, joint_ids: Ids, poses: Iterable[FloatArray]
) -> ContactGeoms:
    """Geoms that come close to each other in measured poses.

    Args:
        joint_ids: (joints,) of the poses' columns; other joints keep the model's position.
        poses: (n, joints) arrays, rad or m.
    """
    robot, world = _robot_and_world(model, joint_ids)
    if not _may_touch(model, robot, world):
        return ContactGeoms()
    everywhere = np.concatenate(list(poses))
    everywhere = everywhere[:: max(1, -(-len(everywhere) // _MAX_POSES))]
    data = mujoco.MjData(model)
    found: dict[tuple[int, int], tuple[int, FloatArray, int]] = {}
    for data in _collisions_at(model, joint_ids, robot, world, everywhere):
        seen: set[tuple[int, int]] = set()
        for k in np.flatnonzero(data.contact.dist < CONTACT_DISTANCE):
            one, two = (int(g) for g in data.contact.geom[k])
            if min(one, two) < 0:
                continue
            sign = 1.0 if world[one] else -1.0
            key = (one, two) if world[one] else (two, one)
            if not (world[key[0]] and robot[key[1]]):
                continue
            count, normal, dim = found.get(key, (0, np.zeros(3), 1))
            # Deep penetrations have less weight: their normal may point to the far side.
            weight = max(CONTACT_DISTANCE - abs(float(data.contact.dist[k])), 0.0)
            normal = normal + sign * weight * data.contact.frame[k, :3]
            dim = max(dim, int(data.contact.dim[k]))
            found[key] = (count + (key not in seen), normal, dim)
            seen.add(key)
    for key, (count, _, _) in list(found.items()):
        if count == len(everywhere) and _is_own_base(model, *key):
            del found[key]
    return _merge_contacts(model, data, found)


def with_distant_contacts(
    model: mujoco.MjModel, world: NDArray[np.bool_] | Ids, reach: float
) -> mujoco.MjModel:
    """A copy that reports contacts of the world's geoms within ``reach`` m, without force."""
    near = copy.copy(model)
    near.geom_gap[world] += reach
    near.pair_gap[:] += reach
    # Bounding volumes of static bodies do not include the gap.
    near.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    return near


def is_near_surface(data: mujoco.MjData, contact: ContactGeoms, reach: float) -> bool:
    """Whether the robot is within ``reach`` m of the surfaces.

    The data must be of a model from :func:`with_distant_contacts`.
    """
    close = data.contact.geom[data.contact.dist < reach]
    one, two = close[:, 0], close[:, 1]
    here = np.isin(one, contact.world) & np.isin(two, contact.robot)
    there = np.isin(two, contact.world) & np.isin(one, contact.robot)
    return bool((here | there).any())


def is_far_from_surfaces(
    model: mujoco.MjModel, joint_ids: Ids, contact: ContactGeoms, poses: FloatArray
) -> NDArray[np.bool_]:
    """(n,) whether the robot is farther than :data:`CONTACT_DISTANCE` from all surfaces.

    Args:
        joint_ids: (joints,) of the columns of ``poses``.
        contact: the surfaces, and the geoms of the robot that may touch them.
        poses: (n, joints) rad or m.
    """
    robot, _ = _robot_and_world(model, joint_ids)
    is_surface = np.isin(np.arange(model.ngeom), contact.world)
    seen = _collisions_at(model, joint_ids, robot, is_surface, poses)
    return np.array(
        [not is_near_surface(data, contact, CONTACT_DISTANCE) for data in seen], dtype=bool
    )


def _collisions_at(
    model: mujoco.MjModel,
    joint_ids: Ids,
    robot: NDArray[np.bool_],
    world: NDArray[np.bool_],
    poses: FloatArray,
) -> Iterator[mujoco.MjData]:
    """Collision data of (n, joints) poses, with contacts within :data:`CONTACT_DISTANCE`."""
    near = with_distant_contacts(model, world, CONTACT_DISTANCE)
    _disable_other_pairs(near, robot, world)
    data = mujoco.MjData(near)
    index = model.jnt_qposadr[joint_ids]
    for pose in poses:
        data.qpos[index] = pose
        mujoco.mj_kinematics(near, data)
        mujoco.mj_collision(near, data)
        yield data


def _robot_and_world(
    model: mujoco.MjModel, joint_ids: Ids
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(geoms,) masks of geoms that move with the joints, and of fixed geoms of the surroundings."""
    moves = np.zeros(model.nbody, dtype=bool)
    moves[model.jnt_bodyid[joint_ids]] = True
    base = np.zeros(model.nbody, dtype=bool)
    for body in range(1, model.nbody):
        moves[body] |= moves[model.body_parentid[body]]
    for body in range(model.nbody - 1, 0, -1):
        if moves[body] or base[body]:
            base[model.body_parentid[body]] = True
    base[0] = False
    still = (model.body_weldid == 0) & ~base
    owner = model.geom_bodyid
    return moves[owner], still[owner]


def _disable_other_pairs(
    model: mujoco.MjModel, robot: NDArray[np.bool_], world: NDArray[np.bool_]
) -> None:
    """Disable other geom pairs in ``model``: meshes of neighbouring links are expensive."""
    types, affinities = model.geom_contype.copy(), model.geom_conaffinity.copy()
    if (
        max(types.max(), affinities.max()) >= 1 << _MASK_BITS
        or min(types.min(), affinities.min()) < 0
    ):
        return
    model.geom_contype[:] = np.where(world, types | affinities << _MASK_BITS, 0)
    model.geom_conaffinity[:] = np.where(robot, affinities | types << _MASK_BITS, 0)


def _may_touch(model: mujoco.MjModel, robot: NDArray[np.bool_], world: NDArray[np.bool_]) -> bool:
    def bits(name: str, which: NDArray[np.bool_]) -> int:
        return int(np.bitwise_or.reduce(getattr(model, name)[which], initial=0))

    if not (robot.any() and world.any()):
        return False
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
        return False
    masks = bits("geom_contype", robot) & bits("geom_conaffinity", world)
    masks |= bits("geom_contype", world) & bits("geom_conaffinity", robot)
    return bool(masks) or bool(_pairs_between(model, robot, world).any())


def _pairs_between(
    model: mujoco.MjModel, robot: NDArray[np.bool_], world: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """(pairs,) mask of explicit pairs between robot and world."""
    one, two = model.pair_geom1, model.pair_geom2
    between: NDArray[np.bool_] = (world[one] & robot[two]) | (world[two] & robot[one])
    return between


def _is_own_base(model: mujoco.MjModel, world: int, robot: int) -> bool:
    """Whether a fixed geom that is always close to a link may belong to the robot's base.

    A URDF import that fuses fixed bodies leaves the base's geoms in the world.
    """
    first = model.body_weldid[model.body_parentid[model.geom_bodyid[robot]]] == 0
    return bool(first) and int(model.geom_type[world]) not in _FLAT


def _merge_contacts(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    found: dict[tuple[int, int], tuple[int, FloatArray, int]],
) -> ContactGeoms:
    if not found:
        return ContactGeoms()
    world = np.array(sorted({w for w, _ in found}), dtype=np.int64)
    robot = np.array(sorted({r for _, r in found}), dtype=np.int64)
    normal = np.empty((len(world), 3))
    for i, geom in enumerate(world):
        out = np.sum([n for (w, _), (_, n, _) in found.items() if w == geom], axis=0)
        body = data.xmat[model.geom_bodyid[geom]].reshape(3, 3)
        axes = data.geom_xmat[geom].reshape(3, 3)
        if int(model.geom_type[geom]) in _FLAT:
            out = axes[:, 2]
        elif int(model.geom_type[geom]) == _BOX:
            along = axes.T @ out
            face = int(np.argmax(np.abs(along)))
            out = np.sign(along[face]) * axes[:, face]
        normal[i] = body.T @ (out / max(float(np.linalg.norm(out)), 1e-12))
    sides = [np.isin(np.arange(model.ngeom), ids) for ids in (robot, world)]
    return ContactGeoms(
        world=world,
        normal=normal,
        robot=robot,
        pairs=np.flatnonzero(_pairs_between(model, *sides)).astype(np.int64),
        has_friction=any(dim > 1 for _, _, dim in found.values()),
    )
