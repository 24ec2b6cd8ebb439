"""What changed in the model since a release, and what error this makes in earlier recordings.

The recordings that proved the release are replayed with today's model and with the released one.
Each part that differs is then given its released values in turn. This runs in the child process.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.loaded_model import LoadedModel, load_model
from pytest_twin.open_loop import Row, replay_rows, row_of
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.trial import Trial

_FIELDS: Mapping[str, tuple[str, int, tuple[str, ...]]] = {
    "mass": ("nbody", int(mujoco.mjtObj.mjOBJ_BODY),
             ("body_mass", "body_inertia", "body_ipos", "body_iquat")),
    "frame": ("nbody", int(mujoco.mjtObj.mjOBJ_BODY), ("body_pos", "body_quat")),
    "gain": ("nactuator", int(mujoco.mjtObj.mjOBJ_ACTUATOR), (
        "actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "actuator_ctrlrange",
        "actuator_dynprm", "actuator_gear", "actuator_delay")),
    "joint": ("njnt", int(mujoco.mjtObj.mjOBJ_JOINT),
              ("jnt_axis", "jnt_pos", "jnt_range", "jnt_stiffness")),
    "friction of dof": ("nv", -1, ("dof_damping", "dof_armature", "dof_frictionloss")),
    "geometry": ("ngeom", int(mujoco.mjtObj.mjOBJ_GEOM),
                 ("geom_size", "geom_pos", "geom_quat", "geom_friction")),
}  # fmt: skip
"""Part -> size of its arrays, kind of object, and fields of the compiled model."""
_NOTHING = 1e-9
"""Relative difference below which two values are the same: files are rounded."""


def model_changes(
    today: str, released: str, recordings: Sequence[str], topics: Mapping[str, str],
    options: Mapping[str, Any],
) -> list[dict[str, Any]]:  # fmt: skip
    """Changed parts, with the share of each in the error that the model has gained.

    Args:
        today, released: ``twin.yaml`` of today and of the release's copy.
        recordings: earlier recordings.
        topics, options: as on the command line.

    Returns:
        ``part``, ``share``: the share of the squared error gained since the release that is gone
        with the released value of this part alone; None where today's error is no larger.

    Raises:
        TwinError: a model or a recording cannot be used.
    """
    now, then = load_model(Path(today)), load_model(Path(released))
    trials = _trials(now, recordings, topics, RecordingOptions.from_json(options))
    pairs = [(row_of(now.realization, t), row_of(then.realization, t)) for t in trials]
    errors = _error([new for new, _ in pairs])
    before = _error([old for _, old in pairs])
    out = []
    for part, fields, at in _differences(*(row.model for row in pairs[0])):
        undone = [_undone(new, old, fields, at) for new, old in pairs]
        out.append({"part": part, "share": _share(errors, before, _error(undone))})
    if not _same_layout(*(row.model for row in pairs[0])):
        share = _share(errors, before, before)
        out.append({"part": "bodies, joints or actuators", "share": share})
    return sorted(out, key=lambda change: -(change["share"] or 0.0))


def _trials(
    loaded: LoadedModel, recordings: Sequence[str], topics: Mapping[str, str],
    options: RecordingOptions,
) -> list[Trial]:  # fmt: skip
    read = read_trials(
        [Path(r) for r in recordings], [], {**loaded.topics, **topics},
        loaded.realization.structure, options.over(loaded.options),
    )  # fmt: skip
    return [*read.fit, *read.held_out]


def _same_layout(new: mujoco.MjModel, old: mujoco.MjModel) -> bool:
    return all(getattr(new, size) == getattr(old, size) for size, _, _ in _FIELDS.values())


def _differences(
    new: mujoco.MjModel, old: mujoco.MjModel
) -> Iterator[tuple[str, tuple[str, ...], int]]:
    """Part in words, its fields and its row; row -1 for a field of the simulation."""
    if new.opt.timestep != old.opt.timestep:
        yield f"timestep, {old.opt.timestep:g} to {new.opt.timestep:g} s", ("timestep",), -1
    for kind, (size, object_kind, fields) in _FIELDS.items():
        count = getattr(new, size)
        if count != getattr(old, size):
            continue
        for i in range(count):
            changed = [f for f in fields if not _alike(getattr(new, f)[i], getattr(old, f)[i])]
            if changed:
                before, after = (np.ravel(getattr(m, changed[0])[i]) for m in (old, new))
                k = int(np.argmax(np.abs(after - before)))
                name = _name(new, object_kind, i)
                yield f"{kind} {name}: {changed[0]}, {before[k]:g} to {after[k]:g}", fields, i


def _name(model: mujoco.MjModel, object_kind: int, index: int) -> str:
    if object_kind < 0:
        object_kind, index = int(mujoco.mjtObj.mjOBJ_JOINT), int(model.dof_jntid[index])
    return mujoco.mj_id2name(model, object_kind, index) or str(index)


def _alike(a: Any, b: Any) -> bool:
    return bool(np.allclose(a, b, rtol=_NOTHING, atol=1e-12))


def _undone(new: Row, old: Row, fields: Sequence[str], at: int) -> Row:
    """The row with the released values of one part."""
    model = copy.copy(new.model)
    if at < 0:
        model.opt.timestep = old.model.opt.timestep
    else:
        for field in fields:
            getattr(model, field)[at] = getattr(old.model, field)[at]
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return replace(new, model=model)


def _error(rows: Sequence[Row]) -> float:
    """Squared error of the predicted positions, each joint relative to its variance."""
    total = 0.0
    for replayed, row in zip(replay_rows(rows), rows, strict=True):
        measured = row.trial.position
        spread = np.maximum(np.nanvar(measured, axis=0), 1e-9)
        total += float(np.nansum((replayed.position - measured) ** 2 / spread))
    return total if np.isfinite(total) else float("inf")


def _share(today: float, released: float, undone: float) -> float | None:
    """Share of the error gained since the release that is gone; None where none is gained."""
    if not np.isfinite([today, released, undone]).all() or today <= released:
        return None
    return round((today - undone) / (today - released), 4)
