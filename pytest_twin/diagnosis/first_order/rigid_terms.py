"""Rigid-body terms along a motion: mass matrix and inverse dynamics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.measured_trajectory import MeasuredTrajectory
from pytest_twin.diagnosis.first_order.settings import FIRST_ORDER
from pytest_twin.effects.base import Effect, ModelFields, Values
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.rigid_body import InertialParameters, Payload
from pytest_twin.realization.executor import Forks
from pytest_twin.realization.forks import free_cores
from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings

# Finite-difference step of positions (rad or m) and velocities (rad/s or m/s).
_STEP = 1e-4
_PROBE_POSITIONS = np.array(
    [[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [1, 1, 0],
     [0, 1, 1], [1, 0, 1]], dtype=float,
)  # fmt: skip
"""Positions in m of a point mass from which its ten inertial parameters are determined."""
_PROBE_SHIFTS = np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1]], dtype=float)
"""Shifts in m of a centre of mass from which the change of its moments is determined."""
# A batch with fewer models than this evaluates several points at once.
_FEW_MODELS = 64
# Largest number of models in a batch.
_MAX_MODELS = 256
# Number of terms from which several processes are used.
_MIN_TERMS_FOR_FORKS = 2048


@dataclass(frozen=True, slots=True)
class RigidTerms:
    """Rigid-body terms on a coarser grid of a motion.

    Attributes:
        at: indices of the samples of the motion at which the terms are evaluated.
        mass: (segments, len(at), joints, joints) mass matrix with armature, kg*m^2, kg*m or kg.
        effort: (segments, len(at), joints) inverse dynamics, N*m or N.
        bias: (segments, len(at), joints) its part without acceleration: gravity, Coriolis and
            centrifugal effort.
    """

    at: NDArray[np.int64]
    mass: FloatArray
    effort: FloatArray
    bias: FloatArray


def coarse_samples(trajectory: MeasuredTrajectory) -> NDArray[np.int64]:
    """Indices of the samples at which rigid-body terms are evaluated."""
    every = max(1, round(FIRST_ORDER.rigid_interval / trajectory.interval))
    samples = trajectory.position.shape[1]
    return np.unique(np.append(np.arange(0, samples, every), samples - 1))


def rigid_terms(
    simulator: BatchSimulator,
    trajectory: MeasuredTrajectory,
    effects: Sequence[tuple[Effect, Values]] = (),
    copies: int = 1,
    increments: FloatArray | None = None,
) -> list[RigidTerms]:
    """Rigid-body terms of ``copies`` variants of the model.

    Args:
        effects: effects that change the variants, values (copies, joints).
        copies: number of variants.
        increments: (copies, 2, joints) increments of positions and velocities. With them, terms are
            evaluated midway between the measured and the predicted motion.
    """
    at = coarse_samples(trajectory)
    segments, points = len(trajectory.segments), len(at)
    joints = trajectory.position.shape[2]
    motion = (trajectory.position, trajectory.velocity) if increments is None else trajectory.midway
    q, v, a = (x[:, at] for x in (*motion, trajectory.acceleration))
    rows = np.asarray(trajectory.segments)
    base = _base_states(simulator, trajectory, at)
    cores = free_cores(simulator.threads) if copies * q[..., 0].size > _MIN_TERMS_FOR_FORKS else 1
    per = min(max(1, _MAX_MODELS // segments), -(-copies // cores))

    def terms(first: int) -> list[RigidTerms]:
        part = np.arange(first, min(first + per, copies))
        # Writing a variant's inertias takes longer than evaluating one point, so each variant is
        # written once and evaluated at all points. With few variants several points share a batch.
        at_once = min(points, -(-_FEW_MODELS // (len(part) * segments)))
        owner = np.repeat(part, segments * at_once)
        values: list[tuple[Effect, Values]] = [
            (e, {n: x[owner] for n, x in p.items()}) for e, p in effects
        ]
        increment = np.zeros((len(part), 2, joints)) if increments is None else increments[part]
        shape = (len(part), segments, at_once)
        with suppress_mujoco_warnings():
            of_part = np.tile(np.repeat(rows, at_once), len(part))
            batch = simulator.models.prepare(of_part, values, threads=1).batch
            qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
            mass_out, bias_out = batch.bind("M"), batch.bind("qfrc_bias")
            packed = np.empty((len(part), segments, points, mass_out.shape[1]))
            bias = np.empty((len(part), segments, points, joints))
            for k in range(0, points, at_once):
                some = np.minimum(np.arange(k, k + at_once), points - 1)
                many_q, many_v = (
                    x[:, some] + increment[:, i, None, None] for i, x in enumerate((q, v))
                )
                if base is not None:
                    pose, speed = (
                        np.tile(of[:, some], (len(part), 1, 1)).reshape(len(qpos), -1)
                        for of in (base.position, base.velocity)
                    )
                    qpos[:, base.qpos], qvel[:, base.dof] = pose, speed
                qpos[:, simulator.layout.qpos_index] = many_q.reshape(-1, joints)
                qvel[:, simulator.layout.dof_index] = many_v.reshape(-1, joints)
                batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
                packed[:, :, some] = mass_out.reshape(*shape, -1)
                bias[:, :, some] = bias_out[:, simulator.layout.dof_index].reshape(*shape, -1)
        mass = _mass_block(simulator, packed, simulator.layout.dof_index)
        effort = bias + np.einsum("cskij,skj->cski", mass, a)
        if base is not None:
            coupled = _mass_block(simulator, packed, np.arange(base.dof.start, base.dof.stop))
            effort += np.einsum("cskij,skj->cski", coupled, base.acceleration)
        return [RigidTerms(at, *each) for each in zip(mass, effort, bias, strict=True)]

    if cores > 1:
        simulator.models.precompute(rows, effects)
    return list(chain(*Forks(cores).map(terms, range(0, copies, per))))


def rigid_derivatives(
    simulator: BatchSimulator,
    trajectory: MeasuredTrajectory,
    effects: Sequence[tuple[Effect, Values]],
) -> tuple[RigidTerms, FloatArray, FloatArray]:
    """Rigid-body terms midway between measured and predicted motion, with derivatives of effort.

    Args:
        effects: effects of the hypothesis, values (1, joints).

    Returns:
        The terms, and the derivatives of the inverse dynamics with respect to position and to
        velocity, (segments, len(at), joints, joints) each.
    """
    n = trajectory.position.shape[2]
    increments = np.zeros((2 * n + 1, 2, n))
    increments[1 : n + 1, 0] = increments[n + 1 :, 1] = _STEP * np.eye(n)
    wide = [(e, {k: np.repeat(x, 2 * n + 1, axis=0) for k, x in v.items()}) for e, v in effects]
    middle, *moved = rigid_terms(simulator, trajectory, wide, 2 * n + 1, increments)
    by_position, by_velocity = (
        np.stack([(m.effort - middle.effort) / _STEP for m in part], axis=-1)
        for part in (moved[:n], moved[n:])
    )
    return middle, by_position, by_velocity


def changes_bodies(effect: Effect, values: Values, joints: int) -> bool:
    """Whether an effect changes masses or gravity."""
    changed, tilted = _model_fields([(effect, values)], len(next(iter(values.values()))), joints)
    return tilted or changed.has_changed_links


def changes_gravity(effect: Effect, values: Values, joints: int) -> bool:
    """Whether an effect changes gravity; efforts are then not linear in inertial parameters."""
    return _model_fields([(effect, values)], len(next(iter(values.values()))), joints)[1]


def _model_fields(
    effects: Sequence[tuple[Effect, Values]], copies: int, joints: int
) -> tuple[ModelFields, bool]:
    """Model fields under effects, and whether the direction of gravity changes."""
    down = np.tile([0.0, 0.0, -1.0], (copies, 1))
    fields = ModelFields.neutral(down.copy(), joints)
    for effect, values in effects:
        effect.fields(fields, values)
    return fields, bool((fields.gravity != down).any())


def _moments(at: FloatArray) -> list[FloatArray]:
    """Mass, first and second moments, (n,) each, of 1 kg at (n, 3) positions in m."""
    x, y, z = at.T
    return [np.ones(len(at)), x, y, z, x * x, y * y, z * z, x * y, y * z, z * x]


def _moment_changes(by: FloatArray) -> list[FloatArray]:
    """Changes of the first and second moments, (n,) each, for shifts (n, 2) of the centre in m."""
    x, y = by.T
    return [x, y, x * x, y * y, x * y]


def _only_column(x: FloatArray) -> list[FloatArray]:
    """The only column of (n, 1) values."""
    return [x[:, 0]]


@dataclass(frozen=True, slots=True)
class _Family:
    """Parts of an effort that are determined together from the same probes.

    Attributes:
        effect, parameters: the effect and the names of its parameters that the probes change.
        probes: (n, parameters) values in SI units from which the n parts are determined.
        amounts: (k, parameters) values -> coefficients of the n parts, (k,) each.
    """

    effect: Effect
    parameters: tuple[str, ...]
    probes: FloatArray
    amounts: Callable[[FloatArray], list[FloatArray]]


_ONE = np.ones((1, 1))
_LINK, _LOAD = InertialParameters(), Payload()
_FAMILIES = {
    "mass": _Family(_LINK, ("mass_error",), _ONE, _only_column),
    "inertia": _Family(_LINK, ("inertia_error",), _ONE, _only_column),
    "moved": _Family(_LINK, ("radial", "tangential"), _PROBE_SHIFTS, _moment_changes),
    "load": _Family(_LOAD, ("distance", "sideways", "across"), _PROBE_POSITIONS, _moments),
}


class InverseDynamics:
    """Inverse dynamics along a motion for variants of the inertial parameters.

    Efforts are linear in masses and in first and second moments (Atkeson, An, Hollerbach, IJRR 5,
    1986), so a few evaluations give all variants. Motor inertias stay at the model's values; they
    are part of the motors' laws.
    """

    def __init__(self, simulator: BatchSimulator, trajectory: MeasuredTrajectory) -> None:
        self._simulator = simulator
        self._at_trajectory = trajectory
        self._nominal = rigid_terms(simulator, trajectory)[0].effort
        self._parts: dict[tuple[str, int, int], FloatArray] = {}

    def of(self, effects: Sequence[tuple[Effect, Values]], copies: int) -> list[FloatArray]:
        """Inverse dynamics of each variant, (segments, len(at), joints), N*m or N.

        Args:
            effects: effects that change the variants, values (copies, joints).
            copies: number of variants.
        """
        sizes = self.precompute_parts(effects, copies)
        if sizes is None:
            joints = self._nominal.shape[2]
            heavy = [(e, v) for e, v in effects if changes_bodies(e, v, joints)]
            found = rigid_terms(self._simulator, self._at_trajectory, heavy, copies)
            return [f.effort for f in found]
        out = []
        for copy in range(copies):
            total = self._nominal.copy()
            for part, x in sizes.items():
                if x[copy]:
                    total += x[copy] * self._parts[part]
            out.append(total)
        return out

    def precompute_parts(
        self, effects: Sequence[tuple[Effect, Values]], copies: int
    ) -> dict[tuple[str, int, int], FloatArray] | None:
        """Compute and keep the parts of which the efforts of variants are composed.

        Args:
            effects: effects that change the variants, values (copies, joints).
            copies: number of variants.

        Returns:
            Part -> (copies,) coefficients; None if the efforts are not a linear combination.
        """
        joints = self._nominal.shape[2]
        fields, tilted = _model_fields(effects, copies, joints)
        # If two joints move the same body, their changes of it would be added twice.
        bodies = self._simulator.layout.body_index
        if tilted or len(set(bodies)) < len(bodies):
            return None
        sizes: dict[tuple[str, int, int], FloatArray] = {}
        for j in range(joints):
            sizes["mass", j, 0] = fields.mass_scale[:, j] - 1.0
            sizes["inertia", j, 0] = fields.inertia_scale[:, j] - 1.0
            by = np.stack([fields.center_radial[:, j], fields.center_tangential[:, j]], axis=1)
            for k, amount in enumerate(_moment_changes(by)):
                sizes["moved", j, k] = fields.mass_scale[:, j] * amount
        for k, amount in enumerate(_moments(fields.added_at[:, -1])):
            sizes["load", joints - 1, k] = fields.added_mass[:, -1] * amount
        sizes = {part: x for part, x in sizes.items() if x.any()}
        self._compute_parts(dict.fromkeys((name, j) for name, j, _ in sizes))
        return sizes

    def _compute_parts(self, needed: Iterable[tuple[str, int]]) -> None:
        """Compute the parts of (family, joint) pairs that are not known yet."""
        missing = [each for each in needed if (*each, 0) not in self._parts]
        if not missing:
            return
        joints = self._nominal.shape[2]
        copies = sum(len(_FAMILIES[name].probes) for name, _ in missing)
        values = {
            effect: {p.name: np.zeros((copies, joints)) for p in effect.parameters}
            for effect in dict.fromkeys(f.effect for f in _FAMILIES.values())
        }
        rows: dict[tuple[str, int], slice] = {}
        first = 0
        for name, j in missing:
            family = _FAMILIES[name]
            here = rows[name, j] = slice(first, first + len(family.probes))
            for parameter, column in zip(family.parameters, family.probes.T, strict=True):
                values[family.effect][parameter][here, j] = column
            if name == "load":
                values[family.effect]["mass"][here] = 1.0
            first = here.stop
        found = rigid_terms(self._simulator, self._at_trajectory, list(values.items()), copies)
        more = np.stack([f.effort - self._nominal for f in found])
        for (name, j), here in rows.items():
            family = _FAMILIES[name]
            amounts = np.stack(family.amounts(family.probes), axis=1)
            parts = np.tensordot(np.linalg.inv(amounts), more[here], axes=1)
            self._parts |= {(name, j, k): part for k, part in enumerate(parts)}


def upsample(values: FloatArray, at: NDArray[np.int64], samples: int) -> FloatArray:
    """(segments, len(at), ...) values, interpolated linearly at all ``samples``."""
    if len(at) == 1:
        return np.repeat(values, samples, axis=1)
    t = np.arange(samples)
    right = np.clip(np.searchsorted(at, t, side="left"), 1, len(at) - 1)
    left = right - 1
    part = ((t - at[left]) / (at[right] - at[left])).reshape(1, -1, *([1] * (values.ndim - 2)))
    out: FloatArray = values[:, left] * (1.0 - part) + values[:, right] * part
    return out


def _mass_block(
    simulator: BatchSimulator, packed: FloatArray, columns: NDArray[np.int64]
) -> FloatArray:
    """(..., joints, columns) block of a symmetric matrix from MuJoCo's compressed lower triangle.

    Args:
        columns: degrees of freedom of the columns.
    """
    model = simulator.segments[0].model
    rows = simulator.layout.dof_index
    row_of, column_of = np.full((2, model.nv), -1)
    row_of[rows], column_of[columns] = np.arange(len(rows)), np.arange(len(columns))
    block = np.zeros((*packed.shape[:-1], len(rows), len(columns)))
    for row in range(model.nv):
        start = model.M_rowadr[row]
        for k in range(start, start + model.M_rownnz[row]):
            for one, other in ((row, model.M_colind[k]), (model.M_colind[k], row)):
                i, j = row_of[one], column_of[other]
                if i >= 0 and j >= 0:
                    block[..., i, j] = packed[..., k]
    return block


@dataclass(frozen=True, slots=True)
class _BaseStates:
    """Recorded motion of a floating base.

    Attributes:
        qpos, dof: its places in the model's coordinates and velocities.
        position: (segments, n, 7) coordinates.
        velocity, acceleration: (segments, n, 6).
    """

    qpos: slice
    dof: slice
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


def _base_states(
    simulator: BatchSimulator, trajectory: MeasuredTrajectory, at: NDArray[np.int64]
) -> _BaseStates | None:
    """The motion of the base at samples of a motion; None if it does not move."""
    bases = [simulator.segments[s].base for s in trajectory.segments]
    moving = [base for base in bases if base is not None]
    if len(moving) < len(bases):
        return None
    states = [base.states(time[at]) for base, time in zip(moving, trajectory.time, strict=True)]
    position, velocity, acceleration = (np.array(of_all) for of_all in zip(*states, strict=True))
    return _BaseStates(moving[0].qpos, moving[0].dof, position, velocity, acceleration)
