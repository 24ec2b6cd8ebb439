"""Add a floor and a free object to a model, and evaluate the contact of two sets of geoms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import ModelError, SimulationError
from pytest_twin.metrics.pose import rigid
from pytest_twin.realization.engine import geom_distance
from pytest_twin.realization.features.elements import colliding_geoms
from pytest_twin.realization.simulate import geom_name

Vector = NDArray[np.float64]

OBJECT = "object"
FLOOR = "floor"
_PREFIX = "twin:"  # distinguishes the names of the scene from those of the robot
SHAPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
}
"""Shape of an object -> MuJoCo's type of geometry."""
_ALL_GROUPS = 2**31 - 1
"""Collision mask with all 31 bits: the geom can touch every geom with a mask."""
_MAX_DISTANCE = 100.0  # m, largest distance that is computed


@dataclass(frozen=True, slots=True)
class FreeObject:
    """A rigid body with a free joint in the scene.

    Attributes:
        shape: a key of ``SHAPES``.
        size: half sizes, m.
        mass: kg.
        friction: sliding friction coefficient; None: the other geom determines all contact
            parameters.
    """

    shape: str
    size: tuple[float, ...]
    mass: float
    friction: float | None = None


@dataclass(frozen=True, slots=True)
class PairContact:
    """Contact of geoms A with geoms B at one instant.

    Attributes:
        force: (3,) force on A in the world, N.
        normal: (3,) unit normal from B to A, mean weighted by force; zero without contact.
        normal_force, tangential_force: components of ``force`` along and normal to ``normal``, N.
        depth: depth of the deepest contact, m; 0 without penetration.
        point: (3,) contact point in the world, mean weighted by force, m.
        friction: sliding friction coefficient of the deepest contact, from the model.
        is_touching: whether there is a contact.
    """

    force: Vector
    normal: Vector
    normal_force: float
    tangential_force: float
    depth: float
    point: Vector
    friction: float
    is_touching: bool


def scene_of(
    free: FreeObject | None, floor: float | None
) -> Callable[[mujoco.MjSpec], None] | None:
    """Function that adds a free object and a floor to a spec; None if there is neither.

    Args:
        free: the object, or None.
        floor: height of the floor, m, or None.
    """
    if free is None and floor is None:
        return None

    def edit(spec: mujoco.MjSpec) -> None:
        if floor is not None:
            plane = spec.worldbody.add_geom(
                name=_PREFIX + FLOOR,
                type=mujoco.mjtGeom.mjGEOM_PLANE,
                size=[0.0, 0.0, 1.0],
                pos=[0.0, 0.0, floor],
            )
            _collides_with_all(plane)
        if free is not None:
            if spec.compiler.settotalmass > 0.0:
                raise ModelError(
                    "settotalmass would scale the mass of the scene's object too",
                    where="compiler.settotalmass",
                    value=float(spec.compiler.settotalmass),
                    unit="kg",
                    expected="a model without settotalmass: state the masses of its bodies",
                )
            # gravcomp can be changed later only if it is not zero at compilation.
            body = spec.worldbody.add_body(
                name=_PREFIX + OBJECT,
                gravcomp=1.0,
                mass=free.mass,
                inertia=moments(free),
                explicitinertial=True,
            )
            body.add_freejoint(name=_PREFIX + OBJECT)
            geom = body.add_geom(
                name=_PREFIX + OBJECT, type=SHAPES[free.shape], size=[*free.size, 0.0, 0.0][:3]
            )
            _collides_with_all(geom)
            if free.friction is None:
                geom.priority = -1
            else:
                geom.friction = [free.friction, 0.005, 0.0001]

    return edit


def _collides_with_all(geom: mujoco.MjsGeom) -> None:
    geom.contype = _ALL_GROUPS
    geom.conaffinity = _ALL_GROUPS
    # Values of the asset's default classes are reset; the other geom determines the stiffness.
    geom.margin = geom.gap = geom.solmix = 0.0
    geom.priority = 0
    geom.friction = [1.0, 0.005, 0.0001]
    geom.condim = 3


def moments(free: FreeObject) -> Vector:
    """(3,) principal moments of inertia of a homogeneous solid about x, y, z, kg*m^2."""
    a, b, c = (*free.size, 0.0, 0.0)[:3]
    mass = free.mass
    if free.shape == "box":
        return mass / 3.0 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])
    if free.shape == "sphere":
        return np.full(3, 0.4 * mass * a * a)
    if free.shape == "cylinder":
        across = mass * (a * a / 4.0 + b * b / 3.0)
        return np.array([across, across, 0.5 * mass * a * a])
    # A capsule: a cylinder of radius a and half length b with two hemispheres.
    ends = mass * (4.0 / 3.0 * a) / (2.0 * b + 4.0 / 3.0 * a)
    middle = mass - ends
    across = middle * (a * a / 4.0 + b * b / 3.0)
    across += ends * (0.4 * a * a + b * b + 0.75 * a * b)
    along = 0.5 * middle * a * a + 0.4 * ends * a * a
    return np.array([across, across, along])


def geoms_of(model: mujoco.MjModel, name: str, in_scene: bool) -> frozenset[int]:
    """Index of a named geom, or indices of a body's geoms that can collide.

    Args:
        name: name of a geom or body.
        in_scene: whether it is an element of the scene and not of the robot.
    """
    name = _PREFIX + name if in_scene else name
    geom = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name))
    if geom >= 0:
        return frozenset({geom})
    body = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name))
    can_collide = colliding_geoms(model)
    return frozenset(
        i for i in range(model.ngeom) if model.geom_bodyid[i] == body and can_collide[i]
    )


def body_of(model: mujoco.MjModel, geoms: frozenset[int]) -> int:
    """Index of the body to which ``geoms`` belong."""
    return int(model.geom_bodyid[min(geoms)])


def object_body(model: mujoco.MjModel) -> int:
    """Index of the free object's body."""
    return int(model.body(_PREFIX + OBJECT).id)


def free_joint(model: mujoco.MjModel, body: int) -> int | None:
    """The free joint at the root of the body's tree, or None where the tree has none."""
    root = int(model.body_rootid[body])
    joint = int(model.body_jntadr[root])
    if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        return None
    return joint


def set_weight(model: mujoco.MjModel, body: int, weighs: bool) -> None:
    """Turn the weight of a body on, or compensate it."""
    model.body_gravcomp[body] = 0.0 if weighs else 1.0


def distance(
    model: mujoco.MjModel, data: mujoco.MjData, first: frozenset[int], second: frozenset[int]
) -> tuple[float, Vector]:
    """Smallest distance of two sets of geoms, m, and unit direction (3,) from first to second.

    ``data`` contains the positions of geoms. The direction is zero in penetration and beyond 100 m.
    """
    best, direction = _MAX_DISTANCE, np.zeros(3)
    ends: Vector = np.zeros(6)
    for a in first:
        for b in second:
            found = geom_distance(model, data, (a, b), _MAX_DISTANCE, ends)
            if found < best:
                best = found
                span = ends[3:] - ends[:3]
                length = float(np.linalg.norm(span))
                direction = span / length if found > 0.0 and length > 0.0 else np.zeros(3)
    return best, direction


def set_free_joint(model: mujoco.MjModel, data: mujoco.MjData, joint: int, pose: Vector) -> None:
    """Set a free joint to a pose (4, 4) in the world, m."""
    at = int(model.jnt_qposadr[joint])
    data.qpos[at : at + 3] = pose[:3, 3]
    mujoco.mju_mat2Quat(data.qpos[at + 3 : at + 7], pose[:3, :3].ravel())
    mujoco.mj_kinematics(model, data)


def lift_above(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    joint: int,
    first: frozenset[int],
    second: frozenset[int],
    gap: float,
) -> None:
    """Move a free body vertically until its distance to ``second`` is ``gap``, m.

    The body starts high above and is lowered repeatedly by the remaining distance, which cannot
    overshoot.

    Raises:
        SimulationError: no geom of ``second`` is below the body.
    """
    at = int(model.jnt_qposadr[joint]) + 2
    data.qpos[at] += 0.5 * _MAX_DISTANCE
    for _ in range(2000):
        mujoco.mj_kinematics(model, data)
        left = distance(model, data, first, second)[0] - gap
        if abs(left) < 1e-9:
            return
        data.qpos[at] -= left
        if not abs(data.qpos[at]) < 2.0 * _MAX_DISTANCE:
            break
    raise SimulationError(
        "no body is below the released body",
        where="target.pair",
        expected="a second body of the pair straight below the first",
    )


def penetrated_geom(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> str | None:
    """Name of a geom that ``body`` penetrates by more than 1 um, or None."""
    for i in np.flatnonzero(data.contact.dist < -1e-6):
        one, two = (int(geom) for geom in data.contact.geom[i])
        if body in model.geom_bodyid[[one, two]]:
            return geom_name(model, one if model.geom_bodyid[two] == body else two)
    return None


def pair_contact(
    model: mujoco.MjModel, data: mujoco.MjData, first: frozenset[int], second: frozenset[int]
) -> PairContact:
    """Evaluate the contacts of ``first`` (A) with ``second`` (B) in ``data``."""
    force, normal, point = np.zeros(3), np.zeros(3), np.zeros(3)
    deepest, friction, weight = np.inf, 0.0, 0.0
    local: Vector = np.zeros(6)
    for i in range(data.ncon):
        one, two = (int(geom) for geom in data.contact.geom[i])
        if one in first and two in second:
            sign = -1.0  # MuJoCo's contact force acts on the second geom
        elif one in second and two in first:
            sign = 1.0
        else:
            continue
        frame = data.contact.frame[i].reshape(3, 3)
        mujoco.mj_contactForce(model, data, i, local)
        force += sign * local[:3] @ frame
        normal += sign * local[0] * frame[0]
        point += local[0] * data.contact.pos[i]
        weight += float(local[0])
        if data.contact.dist[i] < deepest:
            deepest = float(data.contact.dist[i])
            friction = float(data.contact.friction[i, 0])
    length = float(np.linalg.norm(normal))
    if length > 0.0:
        normal /= length
        point /= weight
    along = float(force @ normal)
    return PairContact(
        force=force,
        normal=normal,
        normal_force=along,
        tangential_force=float(np.linalg.norm(force - along * normal)),
        depth=max(0.0, -deepest) if np.isfinite(deepest) else 0.0,
        point=point,
        friction=friction,
        is_touching=bool(np.isfinite(deepest)),
    )


def body_pose(data: mujoco.MjData, body: int) -> Vector:
    """Pose (4, 4) of a body in the world after the last kinematics, m."""
    return rigid(data.xmat[body].reshape(3, 3), data.xpos[body])


def velocity_of(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> tuple[float, ...]:
    """(3,) velocity of a body's centre of mass in the world after the last forward step, m/s."""
    found: Vector = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, found, 0)
    return tuple(float(v) for v in found[3:])


def push(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, force: Vector, point: Vector
) -> None:
    """Add a force on a body to the generalized forces of ``data``.

    Args:
        data: its ``qfrc_applied`` is changed.
        force: (3,) in the world, N.
        point: (3,) point of application in the world, m.
    """
    mujoco.mj_applyFT(model, data, force, np.zeros(3), point, body, data.qfrc_applied)
