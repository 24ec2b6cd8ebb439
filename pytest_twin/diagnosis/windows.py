"""Trials in the model's terms: whole, or in short windows where errors would grow.

Under an effort command errors integrate twice, and a servo that hunts or an arm that falls does not
do the same twice: a simulation is held to the recording for a while, then starts anew from the
measured state (multiple shooting; Bock, 1981).
"""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hidden_state import HiddenState
from pytest_twin.diagnosis.smoothing import SMOOTH, derivatives, smooth_state
from pytest_twin.effects.contact_geoms import ContactGeoms, in_the_air
from pytest_twin.effects.memory_warmup import LEAD
from pytest_twin.effects.segment import Segment
from pytest_twin.realization import Realization
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.realization.mjcf import compiled
from pytest_twin.trial import Trial

WINDOW = 0.5
"""s, of windows, where motions are not too wild for it."""
_START_SAMPLES, _FEWEST_SAMPLES = 12, 8
# s by which a first command may be late and be held from the start.
_LATE = 0.05
# Mean square, of its usual size, by which samples are off a smooth motion where a command jumps;
# the median of the squares of a unit normal distribution.
_ROUGH, _MEDIAN_SQUARE = 4.0, 0.455


@dataclass(frozen=True, slots=True)
class Cutting:
    """Which parts of a trial become segments.

    Attributes:
        window: length of a window in s; None: effort commands have :data:`WINDOW`, others are not
            cut.
        moving: whether a whole trial without velocities begins with what its first samples say, and
            not at rest.
        commanded: whether what lies well before the first command is left out: what the robot was
            told until then is in no recording. A part after a hole begins amid a motion.
        contact: what the robot meets, if its windows are to lie where it is far from that; a trial
            may have none.
    """

    window: float | None = None
    moving: bool = False
    commanded: bool = False
    contact: ContactGeoms | None = None


_WHOLE_TRIAL = Cutting()


def segments_of(
    realization: Realization,
    trial: Trial,
    index: int,
    joints: Sequence[str],
    cutting: Cutting = _WHOLE_TRIAL,
    *,
    coldness: float = 1.0,
    creeps: bool = False,
) -> list[Segment]:
    """A trial in the model's terms: one segment, or short windows.

    Args:
        realization: what it is stepped on, under the trial's own controller and payload.
        trial: what was recorded.
        index: of the trial, kept in its segments.
        joints: columns; all are in the trial.
        cutting: which parts become segments; all of it by default.
        coldness: of the trial, as its segments have it.
        creeps: whether dry friction does, as MuJoCo's default constraint has it.

    Raises:
        SpecError: a controller or payload that the model lacks.
    """
    recorded = replace(_recorded(realization, trial, index, joints, coldness), creeps=creeps)
    first = _first_commanded(recorded) if cutting.commanded else 0
    after_hole = cutting.commanded and trial.offset > 0.0
    clear = np.arange(len(recorded.time)) >= first
    if after_hole:
        # What the robot was told in the hole acts on for a while.
        clear &= recorded.time >= LEAD
    if cutting.window is None and recorded.mode != "effort":
        if after_hole:
            return _windows(recorded, joints, clear, trial.duration, whole=True)
        return [_whole(recorded, joints, first, cutting.moving)]
    if cutting.contact is not None:
        ids = np.array([recorded.model.joint(j).id for j in joints])
        clear &= in_the_air(recorded.model, ids, cutting.contact, recorded.position)
    length = cutting.window or WINDOW
    return _windows(recorded, joints, clear, length, whole=cutting.contact is None)


def _recorded(
    realization: Realization, trial: Trial, index: int, joints: Sequence[str], coldness: float
) -> Segment:
    """All of a trial in the model's terms, from rest."""
    columns = [trial.joints.index(j) for j in joints]
    encoders = Encoders.of(calibration_of(realization), joints)
    keep = np.concatenate([[True], np.diff(trial.time) > 0])
    position = encoders.model_position(trial.position[keep][:, columns])
    asked = trial.setpoint
    command = np.full((len(asked.time), len(joints)), np.nan)
    for j, joint in enumerate(joints):
        if joint in trial.command_joints:
            command[:, j] = asked.value[:, trial.command_joints.index(joint)]
    modes = [trial.mode_of(joint) for joint in joints]
    hardest = trial.hardest_mode
    each = tuple(mode or hardest for mode in modes)
    # Of commands with one stamp the last counts.
    ascending = np.append(np.diff(asked.time) > 0, True)
    return Segment(
        trial=index,
        model=_model(realization, trial),
        mode=hardest,
        modes=() if set(each) == {hardest} else each,
        moving=asked.linear,
        start=0.0,
        time=trial.time[keep],
        position=position,
        velocity=_columns(trial.velocity, keep, columns, encoders),
        effort=_columns(trial.effort, keep, columns, encoders),
        command_time=asked.time[ascending],
        command=encoders.model_command(command, each)[ascending],
        initial_position=position[0],
        initial_velocity=np.zeros(len(joints)),
        coldness=coldness,
    )


def _first_commanded(recorded: Segment) -> int:
    """Number of the first sample under a command; 0 where none is well before it, or hardly any are
    left.
    """
    time, since = recorded.time, recorded.command_time[0]
    first = int(np.searchsorted(time, since))
    return first if since > time[0] + _LATE and len(time) - first >= _FEWEST_SAMPLES else 0


def _around(
    recorded: Segment, joints: Sequence[str], position: FloatArray, velocity: FloatArray
) -> HiddenState:
    """The rest of the model, along a motion."""
    motion = recorded.time, position, velocity
    return HiddenState(
        recorded.model,
        joints,
        [recorded.mode_of(j) for j in range(len(joints))],
        recorded.setpoint,
        motion,
    )


def _whole(recorded: Segment, joints: Sequence[str], first: int, moving: bool) -> Segment:
    """From the sample ``first`` to the last."""
    time, position = recorded.time, recorded.position
    start = float(time[first]) if first else 0.0
    velocity = recorded.initial_velocity
    if recorded.velocity is not None:
        velocity = np.nan_to_num(recorded.velocity[first])
    elif moving:
        velocity = smooth_state(time[first:], position[first:], start, 2.0 * SMOOTH)[1]
    around = _around(recorded, joints, position, np.zeros_like(position))
    (rest,) = around.at([start], [(position[first], velocity)])
    return recorded.part(
        np.arange(len(time)) >= first, start=start, initial_position=position[first],
        initial_velocity=velocity, unrecorded=rest,
    )  # fmt: skip


def _windows(
    recorded: Segment,
    joints: Sequence[str],
    clear: NDArray[np.bool_],
    window: float,
    *,
    whole: bool,
) -> list[Segment]:
    """Windows of about ``window`` s of the (n,) samples that are ``clear``; at least one where the
    ``whole`` trial is meant.
    """
    time, position = recorded.time, recorded.position
    width = start_width(time)
    smooth, speed, _ = derivatives(time, position, width)
    # A cubic says little of a velocity where its samples lie on one side.
    between = clear & (time >= time[0] + width / 2)
    spans = []
    for run in runs(between):
        edges = edges_of(time[run], (position - smooth)[run], max(window, width))
        every = [
            (float(start), (time >= start) & (time <= end))
            for start, end in itertools.pairwise(edges)
        ]
        spans += [(start, inside) for start, inside in every if inside.sum() >= _FEWEST_SAMPLES]
    if whole and not spans:
        spans = [(float(time[clear][0]), clear)]
    states = [smooth_state(time, position, start, width) for start, _ in spans]
    rests = _around(recorded, joints, smooth, speed).at([start for start, _ in spans], states)
    return [
        recorded.part(
            inside, start=start, initial_position=q, initial_velocity=v,
            history=(time, smooth, speed), unrecorded=rest,
        )
        for (start, inside), (q, v), rest in zip(spans, states, rests, strict=True)
    ]  # fmt: skip


def runs(inside: NDArray[np.bool_]) -> list[slice]:
    """Stretches of consecutive samples that are ``inside``."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(np.int8), [0]])))
    return [slice(a, b) for a, b in zip(ends[::2], ends[1::2], strict=True)]


def edges_of(time: FloatArray, off: FloatArray, window: float) -> FloatArray:
    """Where windows begin and end, s.

    A velocity is not known where a command jumps: there, they begin a little before or after.

    Args:
        time: (n,) s.
        off: (n, joints) samples less a smooth motion.
        window: s, about.
    """
    count = max(1, round((time[-1] - time[0]) / window))
    edges = np.linspace(time[0], time[-1], count + 1)
    usual = np.maximum(np.median(off**2, axis=0), 1e-30) / _MEDIAN_SQUARE
    rough = (off**2 / usual).max(axis=1)
    level = np.convolve(rough, np.ones(_START_SAMPLES) / _START_SAMPLES, mode="same")
    for k in range(1, count):
        near = np.flatnonzero(np.abs(time - edges[k]) <= window / 4.0)
        near = near[np.argsort(np.abs(time[near] - edges[k]))]
        if len(near) and level[near[0]] > _ROUGH:
            smooth = near[level[near] <= _ROUGH]
            edges[k] = time[smooth[0] if len(smooth) else near[np.argmin(level[near])]]
    return edges


def _columns(
    values: FloatArray | None, keep: NDArray[np.bool_], columns: list[int], encoders: Encoders
) -> FloatArray | None:
    return None if values is None else encoders.signed(values[keep][:, columns])


_MODELS: weakref.WeakKeyDictionary[Realization, dict[tuple[str | None, ...], mujoco.MjModel]] = (
    weakref.WeakKeyDictionary()
)


def _model(realization: Realization, trial: Trial) -> mujoco.MjModel:
    """What a trial is stepped on: one model for all trials of a controller and a payload."""
    twin = realization.twin
    chosen: list[str | None] = [None, None]
    if twin is not None:
        controller, payload = (trial.metadata.get(key) for key in ("controller", "payload"))
        chosen = [
            controller if controller in twin.controllers else None,
            payload if payload in twin.payloads else None,
        ]
    known = _MODELS.setdefault(realization, {})
    if tuple(chosen) not in known:
        spec = realization.variant(*chosen).spec.copy()
        for body in spec.bodies:
            # MuJoCo's shortcut for bodies that turn about their centre: effects move centres.
            body.simple = 0
        known[tuple(chosen)] = compiled(spec)[0]
    return known[tuple(chosen)]


def start_width(time: FloatArray) -> float:
    """Seconds of samples that a window's initial state is taken from."""
    return _START_SAMPLES * float(np.median(np.diff(time)))
