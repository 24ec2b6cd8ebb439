"""Inverse dynamics of a rigid-body tree as a regressor of inertial parameters (Pinocchio)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import ModelError, SpecError
from pytest_twin.realization import inertia
from pytest_twin.realization.driven_base import BaseStates
from pytest_twin.realization.named_model import NamedModel
from pytest_twin.realization.patch import suggest
from pytest_twin.realization.reference import Reference
from pytest_twin.realization.rigid_model import moments

_PINOCCHIO_ORDER = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
INERTIAL = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mx", "my", "mz", "m")
"""Inertial parameters of a link: second moments about the joint's origin [kg*m^2], first moments
[kg*m], mass [kg], all in the joint's frame. Second moments come first, so that a base parameter is
named after them where masses are regrouped into it."""
_ORDER = np.array([_PINOCCHIO_ORDER.index(name) for name in INERTIAL])
_MASS = INERTIAL.index("m")
_FREE = 6
"""Degrees of freedom of a free joint."""
_LEAST_MASS = 1e-6
"""kg. Below it, the centre of mass (first moment divided by mass) is not accurate."""


class InverseDynamics:
    """Joint efforts of a rigid-body tree for a given motion: regressor times inertial parameters.

    Joints that are not named stay at the model's reference, except a floating base whose motion is
    given. Bodies that are fixed to a link belong to the link.

    Attributes:
        joints: (joints,) names, each with one degree of freedom; the order of all columns.
        links: names of the joints whose links the named joints move; 10 parameters each.
        slides: (joints,) whether a joint is a slide (m, N) instead of a hinge (rad, N*m).
        armature: (joints,) armature of the model, kg*m^2 or kg.

    Raises:
        SpecError: a joint that the model lacks.
        ModelError: a joint with more than one degree of freedom, or an element that Pinocchio
            cannot express.
    """

    def __init__(self, realization: NamedModel, joints: Sequence[str]) -> None:
        reference = Reference(realization)
        self._model: pin.Model = reference.model
        self._data = self._model.createData()
        self._world: pin.SE3 = reference.world
        self._neutral = reference.configuration({})
        self.joints = tuple(joints)
        self._ids = [_scalar_joint_id(realization, reference, name) for name in self.joints]
        self._offsets = np.array([reference.zero_of(name) for name in self.joints])
        slide = mujoco.mjtJoint.mjJNT_SLIDE
        self.slides = tuple(
            bool(realization.model.jnt_type[realization.joint_index(name)] == slide)
            for name in self.joints
        )
        self.armature = np.array([reference.armature_of(name) for name in self.joints])
        self._base = _floating_base(self._model, self._ids)
        self._base_turn = np.eye(3)
        if self._base is not None:
            self._base_turn = reference.free_joint_turn(self._base)
        moved = {below for joint in self._ids for below in self._model.subtrees[joint].tolist()}
        self._links = sorted(moved)
        self.links = tuple(self._model.names[index] for index in self._links)
        self._bodies = _bodies_of(realization, reference)

    @property
    def link_ids(self) -> tuple[int, ...]:
        """Indices of the links' joints in the Pinocchio model."""
        return tuple(self._links)

    def bodies_of(self, joint: int) -> list[LinkBody]:
        """Bodies of the model that belong to the link of a joint, given by its Pinocchio index."""
        return self._bodies.get(joint, [])

    @property
    def parameters(self) -> FloatArray:
        """(links, 10) inertial parameters of the model, in the order of ``INERTIAL``."""
        stated = [self._model.inertias[i].toDynamicParameters() for i in self._links]
        return np.array(stated)[:, _ORDER]

    def regressor(
        self,
        position: FloatArray,
        velocity: FloatArray,
        acceleration: FloatArray,
        base: BaseStates | None = None,
    ) -> FloatArray:
        """(n, joints, links, 10) derivatives of joint efforts with respect to inertial parameters.

        Args:
            position: (n, joints) coordinates of the model, rad or m.
            velocity, acceleration: (n, joints) rad/s, rad/s^2, or m/s, m/s^2.
            base: motion of the floating base that carries the joints; at rest by default.
        """
        model, data = self._model, self._data
        rows = self._rows
        starts = np.array([10 * (i - 1) for i in self._links], dtype=np.intp)
        columns = (starts[:, None] + _ORDER).ravel()
        # One flat index per instant: separate indexing would take longer than the regressor.
        places = (rows[:, None] * (10 * (model.njoints - 1)) + columns).ravel()
        q, v, a = self._states(position, velocity, acceleration, base)
        found = np.empty((len(position), len(places)))
        for at in range(len(position)):
            whole = pin.computeJointTorqueRegressor(model, data, q[at], v[at], a[at])
            found[at] = whole.ravel()[places]
        return found.reshape(len(position), len(rows), len(self._links), 10)

    def change_of(self, bodies: Mapping[str, FloatArray]) -> FloatArray:
        """(links, 10) change of the parameters if bodies have others, in the order of ``INERTIAL``.

        Args:
            bodies: body -> its mass [kg], centre of mass (3,) [m] and inertia about it (3, 3)
                [kg*m^2] in the body's frame, concatenated to (13,).
        """
        change = np.zeros((len(self._links), 10))
        for row, link in enumerate(self._links):
            for body in self.bodies_of(link):
                if (own := bodies.get(body.name)) is not None:
                    tensor = own[4:].reshape(3, 3)
                    new = moments(float(own[0]), own[1:4], tensor, body.placement)
                    change[row] += (new - body.parameters)[_ORDER]
        return change

    def weights(self, position: FloatArray, gravity: FloatArray) -> FloatArray:
        """(n, joints) efforts that balance the weight of all links under another gravity.

        Args:
            position: (n, joints) coordinates of the model, rad or m.
            gravity: (3,) m/s^2 in the world.
        """
        model = self._model.copy()
        model.gravity.linear = self._world.rotation.T @ gravity
        data = model.createData()
        states = self._configurations(position)
        found = [pin.computeGeneralizedGravity(model, data, q)[self._rows] for q in states]
        return np.array(found).reshape(len(position), len(self._ids))

    def derivatives(
        self,
        position: FloatArray,
        velocity: FloatArray,
        acceleration: FloatArray,
        parameters: FloatArray,
        base: BaseStates | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Derivatives of joint efforts with respect to the motion, without armature.

        The algorithm is that of Carpentier and Mansard, Analytical Derivatives of Rigid Body
        Dynamics Algorithms, RSS 2018.

        Args:
            position: (n, joints) coordinates of the model, rad or m.
            velocity, acceleration: (n, joints) rad/s, rad/s^2, or m/s, m/s^2.
            parameters: (links, 10) inertial parameters, which may be physically inconsistent.
            base: motion of the floating base that carries the joints; at rest by default.

        Returns:
            (n, joints, joints) by position, by velocity, and by acceleration; the last index is
            the joint that moves.
        """
        # Pinocchio divides by the mass of links and subtrees; some may be negative, and their sum
        # zero. Efforts are linear in them.
        light = parameters[:, _MASS] < _LEAST_MASS
        added = np.zeros_like(parameters)
        added[light, _MASS] = 1.0 - parameters[light, _MASS]
        states = self._states(position, velocity, acceleration, base)
        by_q, by_v, by_a = self._derivatives(states, parameters + added)
        if added.any():
            own = self._derivatives(states, added)
            by_q, by_v, by_a = by_q - own[0], by_v - own[1], by_a - own[2]
        return by_q, by_v, by_a

    def _derivatives(
        self, states: tuple[FloatArray, FloatArray, FloatArray], parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The same as :meth:`derivatives`; masses are 0 only for links without inertia."""
        model = self._model.copy()
        model.armature = np.zeros(model.nv)
        for at, own in zip(self._links, parameters, strict=True):
            ordered = np.empty(len(own))
            ordered[_ORDER] = own
            model.inertias[at] = (
                pin.Inertia.FromDynamicParameters(ordered) if own.any() else pin.Inertia.Zero()
            )
        data = model.createData()
        rows = self._rows
        square = np.ix_(rows, rows)
        q, v, a = states
        by_q, by_v, by_a = np.empty((3, len(q), len(rows), len(rows)))
        for at in range(len(q)):
            pin.computeRNEADerivatives(model, data, q[at], v[at], a[at])
            by_q[at], by_v[at] = data.dtau_dq[square], data.dtau_dv[square]
            by_a[at] = data.M[square]
        # Pinocchio fills the upper triangle of the mass matrix.
        filled = rows[:, None] <= rows
        return by_q, by_v, np.where(filled, by_a, by_a.transpose(0, 2, 1))

    @property
    def _rows(self) -> NDArray[np.intp]:
        """(joints,) indices of the joints' velocities in Pinocchio."""
        return np.array([self._model.joints[i].idx_v for i in self._ids], dtype=np.intp)

    def _states(
        self,
        position: FloatArray,
        velocity: FloatArray,
        acceleration: FloatArray,
        base: BaseStates | None,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(n, nq) configurations of Pinocchio, (n, nv) velocities, (n, nv) accelerations."""
        v, a = np.zeros((2, len(position), self._model.nv))
        v[:, self._rows], a[:, self._rows] = velocity, acceleration
        q = self._configurations(position)
        if base is not None and self._base is not None:
            self._set_base(base, q, v, a)
        return q, v, a

    def _set_base(self, base: BaseStates, q: FloatArray, v: FloatArray, a: FloatArray) -> None:
        """Set the motion of the floating base, on whose place no effort depends."""
        # Half a second of imports that only recorded bases need.
        from scipy.spatial.transform import Rotation

        assert self._base is not None
        joint = self._model.joints[self._base]
        pose, velocity, acceleration = base
        turn = Rotation.from_quat(pose[:, [4, 5, 6, 3]])
        in_joint = Rotation.from_matrix(self._base_turn.T) * turn
        q[:, joint.idx_q + 3 : joint.idx_q + 7] = in_joint.as_quat()
        linear, angular = turn.inv().apply(velocity[:, :3]), velocity[:, 3:]
        # Pinocchio's linear part is in the axes of the base, which turn.
        v[:, joint.idx_v : joint.idx_v + 6] = np.hstack([linear, angular])
        a[:, joint.idx_v : joint.idx_v + 6] = np.hstack([
            turn.inv().apply(acceleration[:, :3]) - np.cross(angular, linear), acceleration[:, 3:],
        ])  # fmt: skip

    def _configurations(self, position: FloatArray) -> FloatArray:
        """(n, nq) configurations of Pinocchio, which has cosine and sine for unbounded hinges."""
        found = np.tile(self._neutral, (len(position), 1))
        for value, joint in zip((position - self._offsets).T, self._ids, strict=True):
            one = self._model.joints[joint]
            if one.nq == 2:
                found[:, one.idx_q], found[:, one.idx_q + 1] = np.cos(value), np.sin(value)
            else:
                found[:, one.idx_q] = value
        return found


def body_patches(
    dynamics: InverseDynamics, parameters: FloatArray
) -> dict[str, dict[str, float | tuple[float, ...]]]:
    """Body -> ``mass`` [kg], ``com`` (3,) [m], ``inertia`` (6,) [kg*m^2], in the form of a fit.

    The heaviest body of a link gets the change of the link's parameters; the other bodies keep
    their values. If that body would not be physically consistent, it gets all parameters of the
    link, and the other bodies get zero mass.

    Args:
        dynamics: inverse dynamics of the model.
        parameters: (links, 10) of links, in the order of ``INERTIAL``; physically consistent.
    """
    found: dict[str, dict[str, float | tuple[float, ...]]] = {}
    for at, stated, new in zip(dynamics.link_ids, dynamics.parameters, parameters, strict=True):
        bodies = dynamics.bodies_of(at)
        if not bodies:
            continue
        change = np.zeros(10)
        change[_ORDER] = new - stated
        main, *others = sorted(bodies, key=lambda body: -body.parameters[0])
        own = main.parameters + change
        if not _is_body(own):
            own = own + sum((body.parameters for body in others), np.zeros(10))
            for body in others:
                found[body.name] = _patch(np.zeros(10), body.placement)
        found[main.name] = _patch(own, main.placement)
    return found


def _is_body(parameters: FloatArray) -> bool:
    return bool(parameters[0] > 0 and np.linalg.eigvalsh(pseudo_inertia(parameters)).min() > 0)


def pseudo_inertia(parameters: FloatArray) -> FloatArray:
    """(4, 4) pseudo-inertia matrix of (10,) parameters; positive definite for every real body.

    The parameters are in the order of Pinocchio.

    Wensing, Kim, Slotine, IEEE RA-L 3 (2018), eq. 9.
    """
    m, x, y, z, xx, xy, yy, xz, yz, zz = parameters
    half = 0.5 * (xx + yy + zz)
    return np.array(
        [
            [half - xx, -xy, -xz, x],
            [-xy, half - yy, -yz, y],
            [-xz, -yz, half - zz, z],
            [x, y, z, m],
        ]
    )


def _patch(parameters: FloatArray, placement: pin.SE3) -> dict[str, float | tuple[float, ...]]:
    if parameters[0] <= 0:
        return {"mass": 0.0, "com": (0.0, 0.0, 0.0), "inertia": (0.0,) * 6}
    own = placement.actInv(pin.Inertia.FromDynamicParameters(parameters))
    return {
        "mass": float(own.mass),
        "com": tuple(float(v) for v in own.lever),
        "inertia": inertia.six_components(np.asarray(own.inertia)),
    }


@dataclass(frozen=True)
class LinkBody:
    """A body of the model that belongs to a link.

    Attributes:
        placement: pose of the body in the joint's frame.
        parameters: (10,) inertial parameters in the joint's frame, in Pinocchio's order.
    """

    name: str
    placement: pin.SE3
    parameters: FloatArray


def _bodies_of(realization: NamedModel, reference: Reference) -> dict[int, list[LinkBody]]:
    model = realization.model
    found: dict[int, list[LinkBody]] = {}
    for name, (joint, placement) in reference.frames.items():
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        if index <= 0 or joint == 0:
            continue
        axes = pin.Quaternion(*model.body_iquat[index]).matrix()
        tensor = axes @ np.diag(model.body_inertia[index]) @ axes.T
        own = moments(float(model.body_mass[index]), model.body_ipos[index], tensor, placement)
        found.setdefault(joint, []).append(LinkBody(name, placement, own))
    return found


def _floating_base(model: pin.Model, joints: Sequence[int]) -> int | None:
    """Index of the free joint that carries the joints; None without one."""
    for above in model.supports[joints[0]].tolist() if joints else ():
        if model.joints[above].nv == _FREE:
            return int(above)
    return None


def _scalar_joint_id(realization: NamedModel, reference: Reference, name: str) -> int:
    if name not in reference.joints:
        raise SpecError(
            f"the model has no joint {name!r}",
            path=realization.path,
            expected=suggest(name, reference.joints),
        )
    index = reference.model.getJointId(name)
    if reference.model.joints[index].nv != 1:
        raise ModelError(
            f"joint {name!r} has more than one degree of freedom",
            path=realization.path,
            value=int(reference.model.joints[index].nv),
            expected="hinges and slides",
        )
    return int(index)
