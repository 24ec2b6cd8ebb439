"""Rigid-body terms along a motion: mass matrix and the effort that the motion asks for."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.diagnosis.first_order.along import Along
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import Effect, FloatArray, ModelFields, Values
from pytest_twin.effects.rows import RowSimulator
from pytest_twin.realization.quiet import quiet

_EVERY = 0.02
"""s between samples: rigid-body terms vary no faster than the motion."""
_NUDGE = 1e-4
_PLACES = np.array(
    [[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [1, 1, 0],
     [0, 1, 1], [1, 0, 1]], dtype=float,
)  # fmt: skip
"""m, at which a mass tells its ten moments apart."""
_MAX_ROWS = 4096


@dataclass(frozen=True, slots=True)
class Rigid:
    """Rigid-body terms on a coarser grid of a motion.

    Attributes:
        at: samples of the motion at which they stand.
        mass: (segments, len(at), joints, joints) kg*m^2 and the like, with armature.
        effort: (segments, len(at), joints) N*m or N that the motion asks for.
        bias: its part without acceleration: gravity, Coriolis, centrifugal.
    """

    at: NDArray[np.int64]
    mass: FloatArray
    effort: FloatArray
    bias: FloatArray


def coarse(along: Along) -> NDArray[np.int64]:
    """Samples at which rigid-body terms are taken."""
    every = max(1, round(_EVERY / along.interval))
    samples = along.position.shape[1]
    return np.unique(np.append(np.arange(0, samples, every), samples - 1))


def rigid_terms(
    simulator: RowSimulator,
    along: Along,
    effects: Sequence[tuple[Effect, Values]] = (),
    copies: int = 1,
    nudges: FloatArray | None = None,
) -> list[Rigid]:
    """Terms of ``copies`` variants of the model.

    Args:
        simulator: of the segments.
        along: the motion.
        effects: what changes the variants, values (copies, joints).
        copies: how many variants.
        nudges: (copies, 2, joints) added to positions and velocities; where given, terms are taken
            midway between the measured motion and the predicted one.
    """
    at = coarse(along)
    segments, points = len(along.segments), len(at)
    joints = along.position.shape[2]
    motion = (along.position, along.velocity) if nudges is None else along.midway
    q, v, a = (x[:, at].reshape(-1, joints) for x in (*motion, along.acceleration))
    rows = np.repeat(along.segments, points)
    per = max(1, _MAX_ROWS // len(rows))
    found: list[Rigid] = []
    for first in range(0, copies, per):
        part = np.arange(first, min(first + per, copies))
        owner = np.repeat(part, len(rows))
        values: list[tuple[Effect, Values]] = [
            (e, {n: x[owner] for n, x in p.items()}) for e, p in effects
        ]
        with quiet():
            batch = simulator.written(np.tile(rows, len(part)), values).batch
        many_q, many_v = np.tile(q, (len(part), 1)), np.tile(v, (len(part), 1))
        if nudges is not None:
            many_q, many_v = many_q + nudges[owner, 0], many_v + nudges[owner, 1]
        batch.bind("qpos")[:, simulator.layout.qpos_index] = many_q
        batch.bind("qvel")[:, simulator.layout.dof_index] = many_v
        mass_out, bias = batch.bind("M"), batch.bind("qfrc_bias")
        with quiet():
            batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
        mass = _full_mass(simulator, mass_out)
        still = bias[:, simulator.layout.dof_index]
        effort = still + np.einsum("rij,rj->ri", mass, np.tile(a, (len(part), 1)))
        for i in range(len(part)):
            mine = slice(i * len(rows), (i + 1) * len(rows))
            found.append(
                Rigid(
                    at,
                    mass[mine].reshape(segments, points, joints, joints),
                    effort[mine].reshape(segments, points, joints),
                    still[mine].reshape(segments, points, joints),
                )
            )
    return found


def slopes(
    simulator: RowSimulator, along: Along, effects: Sequence[tuple[Effect, Values]]
) -> tuple[Rigid, FloatArray, FloatArray]:
    """Terms midway between measured and predicted motion, and their effort's derivatives.

    Args:
        effects: what the hypothesis changes, values (1, joints).

    Returns:
        The terms, and (segments, len(at), joints, joints) derivatives by position and velocity.
    """
    n = along.position.shape[2]
    nudges = np.zeros((2 * n + 1, 2, n))
    nudges[1 : n + 1, 0] = nudges[n + 1 :, 1] = _NUDGE * np.eye(n)
    wide = [(e, {k: np.repeat(x, 2 * n + 1, axis=0) for k, x in v.items()}) for e, v in effects]
    middle, *moved = rigid_terms(simulator, along, wide, 2 * n + 1, nudges)
    by_position, by_velocity = (
        np.stack([(m.effort - middle.effort) / _NUDGE for m in part], axis=-1)
        for part in (moved[:n], moved[n:])
    )
    return middle, by_position, by_velocity


def changes_bodies(effect: Effect, values: Values, joints: int) -> bool:
    """Whether an effect changes masses or gravity."""
    changed, tilted = _fields([(effect, values)], len(next(iter(values.values()))), joints)
    return tilted or changed.changes_links


def _fields(
    effects: Sequence[tuple[Effect, Values]], copies: int, joints: int
) -> tuple[ModelFields, bool]:
    """What effects make of the model's fields, and whether gravity comes from elsewhere."""
    down = np.tile([0.0, 0.0, -1.0], (copies, 1))
    fields = ModelFields.neutral(down.copy(), joints)
    for effect, values in effects:
        effect.fields(fields, values)
    return fields, bool((fields.gravity != down).any())


def _moments(at: FloatArray) -> list[FloatArray]:
    """Of 1 kg at (n, 3) m: (n,) mass, first and second moments."""
    x, y, z = at.T
    return [np.ones(len(at)), x, y, z, x * x, y * y, z * z, x * y, y * z, z * x]


class Efforts:
    """What a motion asks for of variants of the bodies: linear in their masses and first and second
    moments (Atkeson, An, Hollerbach, IJRR 5, 1986), so that a few give all. What moves with the
    motors is as the model has it: that is a law of theirs.
    """

    def __init__(self, simulator: RowSimulator, along: Along) -> None:
        """Along a motion of the segments of ``simulator``."""
        self._simulator = simulator
        self._along = along
        self._bare = rigid_terms(simulator, along)[0].effort
        self._parts: dict[tuple[str, int], FloatArray] = {}

    def of(self, effects: Sequence[tuple[Effect, Values]], copies: int) -> list[FloatArray]:
        """(segments, len(at), joints) N*m or N that each of ``copies`` variants asks for.

        Args:
            effects: what changes them, values (copies, joints).
            copies: how many variants.
        """
        joints = self._bare.shape[2]
        fields, tilted = _fields(effects, copies, joints)
        # Two joints of one body would change it twice.
        bodies = self._simulator.layout.body_index
        anew = np.asarray(fields.center_moves.any(axis=1))
        if tilted or len(set(bodies)) < len(bodies):
            anew[:] = True
        whole = iter(self._worked_out_anew(effects, np.flatnonzero(anew), joints))
        load, at = fields.added_mass[:, -1], fields.added_at[:, -1]
        sizes = {("mass", j): fields.mass_scale[:, j] - 1.0 for j in range(joints)}
        sizes |= {("inertia", j): fields.inertia_scale[:, j] - 1.0 for j in range(joints)}
        sizes |= {("load", k): load * moment for k, moment in enumerate(_moments(at))}
        sizes = {part: x for part, x in sizes.items() if x[~anew].any()}
        self._work_out(sizes)
        out = []
        for k in range(copies):
            if anew[k]:
                out.append(next(whole))
                continue
            total = self._bare.copy()
            for part, x in sizes.items():
                if x[k]:
                    total += x[k] * self._parts[part]
            out.append(total)
        return out

    def _worked_out_anew(
        self, effects: Sequence[tuple[Effect, Values]], copies: NDArray[np.int64], joints: int
    ) -> list[FloatArray]:
        """Efforts of some of the variants, from their own models."""
        if not len(copies):
            return []
        heavy = [
            (e, {n: x[copies] for n, x in v.items()}) for e, v in effects
            if changes_bodies(e, v, joints)
        ]  # fmt: skip
        found = rigid_terms(self._simulator, self._along, heavy, len(copies))
        return [f.effort for f in found]

    def _work_out(self, wanted: Iterable[tuple[str, int]]) -> None:
        """Parts that are not known yet: a link of twice the mass, or of twice the inertia, and the
        moments of 1 kg, from as many places.
        """
        missing = {(name, 0 if name == "load" else k) for name, k in wanted} - self._parts.keys()
        if not missing:
            return
        scaled = sorted(part for part in missing if part[0] != "load")
        places = _PLACES if ("load", 0) in missing else np.zeros((0, 3))
        joints = self._bare.shape[2]
        copies = len(scaled) + len(places)
        heavier, wider, mass = np.zeros((3, copies, joints))
        for row, (name, j) in enumerate(scaled):
            (heavier if name == "mass" else wider)[row, j] = 1.0
        mass[len(scaled) :] = 1.0
        link, payload = catalogue()["inertial_parameters"], catalogue()["payload"]
        neutral = {p.name: np.zeros_like(mass) for p in (*link.parameters, *payload.parameters)}
        at = {}
        for name, column in zip(("distance", "sideways", "across"), places.T, strict=True):
            at[name] = np.zeros_like(mass)
            at[name][len(scaled) :] = column[:, None]
        effects: list[tuple[Effect, Values]] = [
            (link, {**neutral, "mass_error": heavier, "inertia_error": wider}),
            (payload, {**neutral, **at, "mass": mass}),
        ]
        found = rigid_terms(self._simulator, self._along, effects, copies)
        more = [f.effort - self._bare for f in found]
        self._parts |= dict(zip(scaled, more, strict=False))
        if len(places):
            of_moments = np.linalg.solve(np.stack(_moments(places), axis=1), np.eye(len(places)))
            loads = np.stack(more[len(scaled) :])
            parts = np.tensordot(of_moments, loads, axes=1)
            self._parts |= {("load", k): part for k, part in enumerate(parts)}


def upsampled(values: FloatArray, at: NDArray[np.int64], samples: int) -> FloatArray:
    """(segments, len(at), ...) values on every sample, linear in between."""
    if len(at) == 1:
        return np.repeat(values, samples, axis=1)
    t = np.arange(samples)
    right = np.clip(np.searchsorted(at, t, side="left"), 1, len(at) - 1)
    left = right - 1
    part = ((t - at[left]) / (at[right] - at[left])).reshape(1, -1, *([1] * (values.ndim - 2)))
    out: FloatArray = values[:, left] * (1.0 - part) + values[:, right] * part
    return out


def _full_mass(simulator: RowSimulator, packed: FloatArray) -> FloatArray:
    """(rows, joints, joints) of MuJoCo's lower triangle in compressed rows."""
    model = simulator.segments[0].model
    of = np.full(model.nv, -1)
    of[simulator.layout.dof_index] = np.arange(len(simulator.layout.dof_index))
    n = len(simulator.layout.dof_index)
    full = np.zeros((len(packed), n, n))
    for row in range(model.nv):
        start = model.M_rowadr[row]
        for k in range(start, start + model.M_rownnz[row]):
            i, j = of[row], of[model.M_colind[k]]
            if i >= 0 and j >= 0:
                full[:, i, j] = full[:, j, i] = packed[:, k]
    return full
