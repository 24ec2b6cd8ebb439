"""Something to touch, set around a robot without editing it; and what a pair of bodies feels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import ModelError, SimulationError
from pytest_twin.realization.features.elements import felt_geoms
from pytest_twin.realization.simulate import geom_name

Vector = NDArray[np.float64]

OBJECT = "object"
FLOOR = "floor"
_PREFIX = "twin:"  # keeps the scene's names apart from the robot's
_SHAPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
}
SIZES = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2}
"""How many half sizes a shape has, in m: x y z; radius; radius and half length along z."""
_ALL_GROUPS = 2**31 - 1
_FAR = 100.0  # m, beyond which distances are not looked for


@dataclass(frozen=True, slots=True)
class FreeObject:
    """A rigid body that floats free in the scene.

    Attributes:
        shape: a key of ``SIZES``.
        size: half sizes in m.
        mass: kg.
        friction: sliding friction, or None: what it touches decides all contact parameters.
    """

    shape: str
    size: tuple[float, ...]
    mass: float
    friction: float | None = None


@dataclass(frozen=True, slots=True)
class Touch:
    """Contact of geoms A with geoms B at one instant.

    Attributes:
        force: (3,) N on A, in the world.
        normal: (3,) unit, from B into A, weighted by force; zero without contact.
        normal_force, tangential_force: N, parts of ``force`` along and across ``normal``.
        depth: m, of the deepest contact, 0 where none overlaps.
        point: (3,) m, weighted by force.
        friction: sliding friction coefficient of the deepest contact, as the model declares it.
        is_touching: whether any contact is there.
    """

    force: Vector
    normal: Vector
    normal_force: float
    tangential_force: float
    depth: float
    point: Vector
    friction: float
    is_touching: bool


def setting(free: FreeObject | None, floor: float | None) -> Callable[[mujoco.MjSpec], None] | None:
    """What adds a free object and a floor at a height in m to a spec; None for neither."""
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
            # gravcomp has to be there when the model is compiled to be switched later.
            body = spec.worldbody.add_body(
                name=_PREFIX + OBJECT,
                gravcomp=1.0,
                mass=free.mass,
                inertia=moments(free),
                explicitinertial=True,
            )
            body.add_freejoint(name=_PREFIX + OBJECT)
            geom = body.add_geom(
                name=_PREFIX + OBJECT, type=_SHAPES[free.shape], size=[*free.size, 0.0, 0.0][:3]
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
    # The asset's default classes hold for the asset; stiffness is that of what is touched.
    geom.margin = geom.gap = geom.solmix = 0.0
    geom.priority = 0
    geom.friction = [1.0, 0.005, 0.0001]
    geom.condim = 3


def moments(free: FreeObject) -> Vector:
    """Principal moments (3,) in kg m^2 of a solid of even density, about x, y, z."""
    a, b, c = (*free.size, 0.0, 0.0)[:3]
    mass = free.mass
    if free.shape == "box":
        return mass / 3.0 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])
    if free.shape == "sphere":
        return np.full(3, 0.4 * mass * a * a)
    if free.shape == "cylinder":
        across = mass * (a * a / 4.0 + b * b / 3.0)
        return np.array([across, across, 0.5 * mass * a * a])
    # A capsule: a cylinder of radius a and half length b with two half balls on its ends.
    ends = mass * (4.0 / 3.0 * a) / (2.0 * b + 4.0 / 3.0 * a)
    middle = mass - ends
    across = middle * (a * a / 4.0 + b * b / 3.0)
    across += ends * (0.4 * a * a + b * b + 0.75 * a * b)
    along = 0.5 * middle * a * a + 0.4 * ends * a * a
    return np.array([across, across, along])


def geoms_of(model: mujoco.MjModel, name: str, in_scene: bool) -> frozenset[int]:
    """Geoms that collide of a geom or of a body; of the scene's own where ``in_scene``."""
    name = _PREFIX + name if in_scene else name
    geom = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name))
    if geom >= 0:
        return frozenset({geom})
    body = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name))
    felt = felt_geoms(model)
    return frozenset(i for i in range(model.ngeom) if model.geom_bodyid[i] == body and felt[i])


def body_of(model: mujoco.MjModel, geoms: frozenset[int]) -> int:
    """The body that carries ``geoms``."""
    return int(model.geom_bodyid[min(geoms)])


def object_body(model: mujoco.MjModel) -> int:
    """The free object's body."""
    return int(model.body(_PREFIX + OBJECT).id)


def free_joint(model: mujoco.MjModel, body: int) -> int | None:
    """The free joint at the root of the body's tree, or None where the tree has none."""
    root = int(model.body_rootid[body])
    joint = int(model.body_jntadr[root])
    if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        return None
    return joint


def set_weight(model: mujoco.MjModel, body: int, weighs: bool) -> None:
    """Let gravity act on a body, or compensate it."""
    model.body_gravcomp[body] = 0.0 if weighs else 1.0


def distance(
    model: mujoco.MjModel, data: mujoco.MjData, first: frozenset[int], second: frozenset[int]
) -> tuple[float, Vector]:
    """Least distance in m of two sets of geoms, and the unit direction from first to second.

    ``data`` holds positions of geoms. The direction is zero where they overlap or are too far.
    """
    best, direction = _FAR, np.zeros(3)
    ends: Vector = np.zeros(6)
    for a in first:
        for b in second:
            found = float(mujoco.mj_geomDistance(model, data, a, b, _FAR, ends))
            if found < best:
                best = found
                span = ends[3:] - ends[:3]
                length = float(np.linalg.norm(span))
                direction = span / length if found > 0.0 and length > 0.0 else np.zeros(3)
    return best, direction


def put(model: mujoco.MjModel, data: mujoco.MjData, joint: int, pose: Vector) -> None:
    """Set a free joint to a (4, 4) pose in the world."""
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
    """Put a free tree straight above ``second``, ``gap`` m between the two sets of geoms.

    It comes down from far above by the distance that is left, which never overshoots.

    Raises:
        SimulationError: the tree has nothing below it.
    """
    at = int(model.jnt_qposadr[joint]) + 2
    data.qpos[at] += 0.5 * _FAR
    for _ in range(2000):
        mujoco.mj_kinematics(model, data)
        left = distance(model, data, first, second)[0] - gap
        if abs(left) < 1e-9:
            return
        data.qpos[at] -= left
        if not abs(data.qpos[at]) < 2.0 * _FAR:
            break
    raise SimulationError(
        "nothing lies below the body that is let go",
        where="target.pair",
        expected="a second body of the pair straight below the first",
    )


def overlapped(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> str | None:
    """Name of a geom that ``body`` overlaps by more than 1 um, None where it is free."""
    for i in np.flatnonzero(data.contact.dist < -1e-6):
        one, two = (int(geom) for geom in data.contact.geom[i])
        if body in model.geom_bodyid[[one, two]]:
            return geom_name(model, one if model.geom_bodyid[two] == body else two)
    return None


def touch(
    model: mujoco.MjModel, data: mujoco.MjData, first: frozenset[int], second: frozenset[int]
) -> Touch:
    """What ``first`` feels of ``second`` in the contacts of ``data``."""
    force, normal, point = np.zeros(3), np.zeros(3), np.zeros(3)
    deepest, friction, weight = np.inf, 0.0, 0.0
    local: Vector = np.zeros(6)
    for i in range(data.ncon):
        one, two = (int(geom) for geom in data.contact.geom[i])
        if one in first and two in second:
            sign = -1.0  # MuJoCo's force acts on the second geom
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
    return Touch(
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
    """``transform_world_to_body`` (4, 4) at the last kinematics."""
    pose = np.eye(4)
    pose[:3, :3] = data.xmat[body].reshape(3, 3)
    pose[:3, 3] = data.xpos[body]
    return pose


def velocity_of(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> tuple[float, ...]:
    """Velocity (3,) in m/s of a body's centre of mass in the world, at the last forward step."""
    found: Vector = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, found, 0)
    return tuple(float(v) for v in found[3:])


def push(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, force: Vector, point: Vector
) -> None:
    """Add a force (3,) in N at a world point to the generalized forces of ``data``."""
    mujoco.mj_applyFT(model, data, force, np.zeros(3), point, body, data.qfrc_applied)
