"""Simulate many motions of one free body in parallel, each with its own contact parameters."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import ModelError
from pytest_twin.realization.forks import usable_cores
from pytest_twin.realization.named_model import NamedModel

_ROLLOUTS_PER_CALL = 256
"""Rollouts per call, sorted by length. With fewer, threads are idle; with more, the short rollouts
are simulated longer than needed."""


@dataclass(frozen=True)
class FreeBody:
    """A body with a free joint.

    Attributes:
        qpos, dof: index of its pose in ``qpos`` and of its velocity in ``qvel``.
        geoms: indices of its geoms that can collide; of those in ``pairs`` if there are any.
        others: indices of all other geoms that can collide; likewise.
        pairs: indices of the contact pairs that the model declares between the body and others.
    """

    name: str
    body: int
    qpos: int
    dof: int
    geoms: tuple[int, ...]
    others: tuple[int, ...]
    pairs: tuple[int, ...] = ()


def free_body(realization: NamedModel, name: str | None = None) -> FreeBody:
    """Find the free body of a model.

    Args:
        name: name of the body; needed where the model has several free bodies.

    Raises:
        ModelError: no free body, several and no name, or a body that cannot touch anything.
    """
    model = realization.model
    free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    names = {model.body(int(model.jnt_bodyid[j])).name: j for j in free}
    if name is not None:
        free = [names[name]] if name in names else []
    if len(free) != 1:
        raise ModelError(
            "no free body of this name" if name else "the model needs one free body",
            path=realization.path,
            value=name or f"{len(free)} free bodies",
            expected=f"--body with one of {', '.join(names)}"
            if names
            else "a body with <freejoint/>, the object that was tossed",
        )
    joint = free[0]
    body = int(model.jnt_bodyid[joint])
    root = int(model.body_rootid[body])
    touching = [g for g in range(model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]
    own = tuple(g for g in touching if _root(model, g) == root)
    others = tuple(g for g in touching if g not in own)
    pairs = _declared_pairs(model, root)
    if pairs:
        both = [{int(model.pair_geom1[p]), int(model.pair_geom2[p])} for p in pairs]
        declared = set().union(*both)
        own = tuple(g for g in sorted(declared) if _root(model, g) == root)
        others = tuple(g for g in sorted(declared) if g not in own)
    if not own or not others:
        raise ModelError(
            "the free body can touch nothing",
            path=realization.path,
            where=f"body {model.body(body).name!r}",
            expected="a geom of the body and a geom of the surroundings, both with contact, or a "
            "pair of them under <contact>",
        )
    return FreeBody(
        model.body(body).name,
        body,
        int(model.jnt_qposadr[joint]),
        int(model.jnt_dofadr[joint]),
        own,
        others,
        pairs,
    )


def _root(model: mujoco.MjModel, geom: int) -> int:
    return int(model.body_rootid[model.geom_bodyid[geom]])


def _declared_pairs(model: mujoco.MjModel, root: int) -> tuple[int, ...]:
    """Return the declared pairs of which exactly one geom belongs to a body."""
    return tuple(
        p
        for p in range(model.npair)
        if (_root(model, int(model.pair_geom1[p])) == root)
        != (_root(model, int(model.pair_geom2[p])) == root)
    )


AppliedWrench = tuple[FloatArray, FloatArray]
"""(k,) times, s from the first state, and (k, 6) wrench on the body, N and N*m, in world axes about
its centre of mass. It is interpolated linearly, and constant before the first and after the last
time."""


def poses_of(
    models: Sequence[mujoco.MjModel],
    body: FreeBody,
    states: FloatArray,
    times: FloatArray,
    pushes: Sequence[AppliedWrench | None] | None = None,
) -> FloatArray:
    """Simulate the poses of a free body, for each model and each initial state.

    Poses between two steps are interpolated: positions linearly, quaternions linearly with
    normalization.

    Args:
        models: models that differ in parameters only.
        body: the free body.
        states: (t, 13) x y z (m), quaternion w x y z, velocity in the world (m/s), angular velocity
            in the body's axes (rad/s).
        times: (t, n) times of the poses, s from the first state; NaN after the last.
        pushes: applied wrench for each initial state; None for none.

    Returns:
        (m, t, n, 7) positions (m) and quaternions (w x y z); NaN where the time is NaN, and after
        a rollout diverged.
    """
    last = np.nanmax(times, axis=1)
    order = np.argsort(last)
    found = np.full((len(models), *times.shape, 7), np.nan)
    width = max(1, _ROLLOUTS_PER_CALL // len(models))
    step = float(models[0].opt.timestep)
    for begin in range(0, len(order), width):
        rows = order[begin : begin + width]
        count = int(np.ceil(float(last[rows].max()) / step - 1e-9)) + 1
        own = None if pushes is None else [pushes[row] for row in rows]
        found[:, rows] = _interpolate(
            _simulate_poses(models, body, states[rows], count, own), step, times[rows]
        )
    return found


def _simulate_poses(
    models: Sequence[mujoco.MjModel],
    body: FreeBody,
    states: FloatArray,
    steps: int,
    pushes: Sequence[AppliedWrench | None] | None,
) -> FloatArray:
    """(m, t, steps + 1, 7) poses at each step; NaN after a rollout diverged."""
    first = _full_states(models[0], body, states)
    rows = len(models) * len(states)
    each = [model for model in models for _ in range(len(states))]
    workers = [mujoco.MjData(models[0]) for _ in range(usable_cores())]
    start = np.tile(first, (len(models), 1))
    if pushes is None or all(one is None for one in pushes):
        path, _ = rollout.rollout(each, workers, start, nstep=steps, persistent_pool=True)
    else:
        applied = np.tile(_applied_forces(models[0], body, steps, pushes), (len(models), 1, 1))
        path, _ = rollout.rollout(
            each, workers, start, applied, persistent_pool=True,
            control_spec=int(mujoco.mjtState.mjSTATE_XFRC_APPLIED),
        )  # fmt: skip
    at = 1 + body.qpos
    poses = np.empty((rows, steps + 1, 7))
    poses[:, 0] = np.tile(states[:, :7], (len(models), 1))
    poses[:, 1:] = path[:, :, at : at + 7]
    # MuJoCo resets a diverged simulation to its reference state; the time then decreases.
    back = np.flatnonzero((np.diff(path[:, :, 0], axis=1) <= 0.0).any(axis=1))
    for row in back:
        lost = int(np.argmax(np.diff(path[row, :, 0]) <= 0.0))
        poses[row, lost + 1 :] = np.nan
    return poses.reshape(len(models), len(states), steps + 1, 7)


def _applied_forces(
    model: mujoco.MjModel, body: FreeBody, steps: int, pushes: Sequence[AppliedWrench | None]
) -> FloatArray:
    """(t, steps, 6 nbody) ``xfrc_applied`` of each step: the wrench at the middle of the step."""
    found = np.zeros((len(pushes), steps, 6 * model.nbody))
    middle = float(model.opt.timestep) * (np.arange(steps) + 0.5)
    for row, push in enumerate(pushes):
        if push is not None:
            for axis in range(6):
                values = np.interp(middle, push[0], push[1][:, axis])
                found[row, :, 6 * body.body + axis] = values
    return found


def _full_states(model: mujoco.MjModel, body: FreeBody, states: FloatArray) -> FloatArray:
    """(t, nstate) full physics states: reference state of the model with the free body's state."""
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    data = mujoco.MjData(model)
    found = np.empty((len(states), mujoco.mj_stateSize(model, kind)))
    for row, state in enumerate(states):
        data.qpos[body.qpos : body.qpos + 7] = state[:7]
        data.qvel[body.dof : body.dof + 6] = state[7:]
        mujoco.mj_getState(model, data, found[row], kind)
    return found


def _interpolate(path: FloatArray, step: float, times: FloatArray) -> FloatArray:
    """Interpolate (m, t, s, 7) poses at (t, n) times; (m, t, n, 7), NaN where a time is NaN."""
    asked = np.isfinite(times)
    place = np.where(asked, times, 0.0) / step
    low = np.clip(place.astype(int), 0, path.shape[2] - 2)
    share = (place - low)[None, :, :, None]
    rows = np.arange(len(times))[:, None]
    early, late = path[:, rows, low], path[:, rows, low + 1]
    turned = np.sum(early[..., 3:] * late[..., 3:], axis=-1, keepdims=True) < 0.0
    found = (1.0 - share) * early + share * np.concatenate(
        [late[..., :3], np.where(turned, -1.0, 1.0) * late[..., 3:]], axis=-1
    )
    found[..., 3:] /= np.linalg.norm(found[..., 3:], axis=-1, keepdims=True)
    found[:, ~asked] = np.nan
    return np.asarray(found)


def copy_of_model(model: mujoco.MjModel) -> mujoco.MjModel:
    """Copy of a model whose parameters can be changed."""
    return copy.copy(model)
