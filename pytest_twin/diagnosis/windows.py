"""Segments of trials: whole trials, or short windows if errors of the prediction would grow.

Under effort commands errors are integrated twice. The motion of an oscillating servo or of a
falling arm is not repeatable. A simulation therefore starts again from the measured state at the
beginning of each window (multiple shooting; Bock, 1981).
"""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hidden_state import HiddenState
from pytest_twin.diagnosis.smoothing import SMOOTHING_WIDTH, derivatives, smooth_state
from pytest_twin.diagnosis.window_settings import WINDOWS
from pytest_twin.effects.contact_geoms import ContactGeoms, is_far_from_surfaces
from pytest_twin.effects.memory_warmup import WARM_UP_TIME
from pytest_twin.effects.segment import Segment
from pytest_twin.realization import Realization
from pytest_twin.realization.driven_base import DrivenBase, drive_base, refuse_contact
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.realization.mjcf import compile_spec
from pytest_twin.trial import Trial

WINDOW = 0.5
"""Length of windows, s; halved if the discretization error of a window is too large."""
# Median of the square of a standard normal variable.
_MEDIAN_SQUARE = 0.455


@dataclass(frozen=True, slots=True)
class Cutting:
    """Which parts of a trial become segments.

    Attributes:
        window: length of a window in s. None: trials under effort commands are cut into windows of
            :data:`WINDOW`, others are not cut.
        estimates_velocity: whether the initial velocity of a whole trial without measured
            velocities is estimated from its first samples; otherwise the trial starts at rest.
        skips_hole: whether a part after a hole begins, in motion, once the commands that the hole
            hides have no influence left; otherwise it begins with its first sample.
        contact: surfaces from which windows keep a distance; a trial may then have no window.
    """

    window: float | None = None
    estimates_velocity: bool = False
    skips_hole: bool = False
    contact: ContactGeoms | None = None


_WHOLE_TRIAL = Cutting()


def segments_of(
    realization: Realization,
    trial: Trial,
    index: int,
    joints: Sequence[str],
    cutting: Cutting = _WHOLE_TRIAL,
    *,
    cold_fraction: float = 1.0,
    has_friction_creep: bool = False,
) -> list[Segment]:
    """Segments of a trial: one whole segment, or short windows.

    Args:
        realization: the model, which gets the controller and payload of the trial.
        index: index of the trial, stored in its segments.
        joints: names of the columns; the trial has all of them.
        cutting: which parts become segments; the whole trial by default.
        cold_fraction: normalized temperature of the trial.
        has_friction_creep: whether a joint creeps under dry friction, as with MuJoCo's default
            constraint.

    Raises:
        SpecError: the model lacks the trial's controller or payload.
        RecordingError: the robot of a recorded base pose touches something.
    """
    recorded = replace(
        _whole_trial_segment(realization, trial, index, joints, cold_fraction),
        has_friction_creep=has_friction_creep,
    )
    after_hole = cutting.skips_hole and trial.offset > 0.0
    clear = np.ones(len(recorded.time), dtype=bool)
    if after_hole and recorded.time[-1] > 2.0 * WARM_UP_TIME:
        # Unknown commands during the hole still influence the motion for a while.
        clear &= recorded.time >= WARM_UP_TIME
    if cutting.window is None and recorded.mode != "effort":
        if after_hole:
            return _cut_windows(recorded, joints, clear, trial.duration, whole=True)
        return [_from_first_sample(recorded, joints, cutting.estimates_velocity)]
    if cutting.contact is not None:
        ids = np.array([recorded.model.joint(j).id for j in joints])
        clear &= is_far_from_surfaces(recorded.model, ids, cutting.contact, recorded.position)
    length = cutting.window or WINDOW
    return _cut_windows(recorded, joints, clear, length, whole=cutting.contact is None)


def _whole_trial_segment(
    realization: Realization, trial: Trial, index: int, joints: Sequence[str], cold_fraction: float
) -> Segment:
    """The whole trial as one segment that starts at rest, in the model's joint coordinates."""
    columns = [trial.joints.index(j) for j in joints]
    encoders = Encoders.of(calibration_of(realization), joints)
    keep = np.concatenate([[True], np.diff(trial.time) > 0])
    position = encoders.model_position(trial.position[keep][:, columns])
    setpoint = trial.setpoint
    command = np.full((len(setpoint.time), len(joints)), np.nan)
    for j, joint in enumerate(joints):
        if joint in trial.command_joints:
            command[:, j] = setpoint.value[:, trial.command_joints.index(joint)]
    modes = [trial.mode_of(joint) for joint in joints]
    hardest = trial.hardest_mode
    each = tuple(mode or hardest for mode in modes)
    # The last of several commands with the same stamp is used.
    ascending = np.append(np.diff(setpoint.time) > 0, True)
    model, base = _model_and_base(realization, trial, joints, keep, position)
    return Segment(
        trial=index,
        model=model,
        base=base,
        mode=hardest,
        modes=() if set(each) == {hardest} else each,
        is_interpolated=setpoint.is_linear,
        start=0.0,
        time=trial.time[keep],
        position=position,
        velocity=_columns(trial.velocity, keep, columns, encoders.model_velocity),
        effort=_columns(trial.effort, keep, columns, encoders.signed),
        command_time=setpoint.time[ascending],
        command=encoders.model_command(command, each)[ascending],
        initial_position=position[0],
        initial_velocity=np.zeros(len(joints)),
        cold_fraction=cold_fraction,
    )


def _hidden_state_along(
    recorded: Segment, joints: Sequence[str], position: FloatArray, velocity: FloatArray
) -> HiddenState:
    """The unmeasured state of the model along a motion."""
    motion = recorded.time, position, velocity
    return HiddenState(
        recorded.model,
        joints,
        [recorded.mode_of(j) for j in range(len(joints))],
        recorded.setpoint,
        motion,
        recorded.base,
    )


def _from_first_sample(recorded: Segment, joints: Sequence[str], moving: bool) -> Segment:
    """The whole trial as a segment; if it is ``moving``, with an estimated initial velocity."""
    time, position = recorded.time, recorded.position
    velocity = recorded.initial_velocity
    if recorded.velocity is not None:
        velocity = np.nan_to_num(recorded.velocity[0])
    elif moving:
        velocity = smooth_state(time, position, recorded.start, 2.0 * SMOOTHING_WIDTH)[1]
    around = _hidden_state_along(recorded, joints, position, np.zeros_like(position))
    (unrecorded,) = around.at([recorded.start], [(position[0], velocity)])
    return replace(recorded, initial_velocity=velocity, unrecorded=unrecorded)


def _cut_windows(
    recorded: Segment,
    joints: Sequence[str],
    clear: NDArray[np.bool_],
    window: float,
    *,
    whole: bool,
) -> list[Segment]:
    """Windows of about ``window`` s from the (n,) samples that are ``clear``.

    If ``whole`` is set, there is at least one window.
    """
    time, position = recorded.time, recorded.position
    width = start_width(time)
    smooth, speed, _ = derivatives(time, position, width)
    # A local cubic gives a poor velocity at the edge of its samples.
    between = clear & (time >= time[0] + width / 2)
    spans = []
    for run in runs(between):
        edges = edges_of(time[run], (position - smooth)[run], max(window, width))
        every = [
            (float(start), (time >= start) & (time <= end))
            for start, end in itertools.pairwise(edges)
        ]
        spans += [
            (start, inside) for start, inside in every if inside.sum() >= WINDOWS.fewest_samples
        ]
    if whole and not spans:
        spans = [(float(time[clear][0]), clear)]
    states = [smooth_state(time, position, start, width) for start, _ in spans]
    hidden = _hidden_state_along(recorded, joints, smooth, speed).at(
        [start for start, _ in spans], states
    )
    return [
        recorded.part(
            inside, start=start, initial_position=q, initial_velocity=v,
            history=(time, smooth, speed), unrecorded=unrecorded,
        )
        for (start, inside), (q, v), unrecorded in zip(spans, states, hidden, strict=True)
    ]  # fmt: skip


def runs(inside: NDArray[np.bool_]) -> list[slice]:
    """Slices of consecutive samples that are ``inside``, an (n,) mask."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(np.int8), [0]])))
    return [slice(a, b) for a, b in zip(ends[::2], ends[1::2], strict=True)]


def edges_of(time: FloatArray, off: FloatArray, window: float) -> FloatArray:
    """Times in s at which windows begin and end.

    The velocity is uncertain where a command jumps. Edges are moved away from such places by at
    most a quarter of a window.

    Args:
        time: (n,) s.
        off: (n, joints) samples minus a smooth motion.
        window: desired length of a window, s.
    """
    count = max(1, round((time[-1] - time[0]) / window))
    edges = np.linspace(time[0], time[-1], count + 1)
    usual = np.maximum(np.median(off**2, axis=0), 1e-30) / _MEDIAN_SQUARE
    rough = (off**2 / usual).max(axis=1)
    level = np.convolve(rough, np.ones(WINDOWS.start_samples) / WINDOWS.start_samples, mode="same")
    for k in range(1, count):
        near = np.flatnonzero(np.abs(time - edges[k]) <= window / 4.0)
        near = near[np.argsort(np.abs(time[near] - edges[k]))]
        if len(near) and level[near[0]] > WINDOWS.rough:
            smooth = near[level[near] <= WINDOWS.rough]
            edges[k] = time[smooth[0] if len(smooth) else near[np.argmin(level[near])]]
    return edges


def _columns(
    values: FloatArray | None,
    keep: NDArray[np.bool_],
    columns: list[int],
    in_model: Callable[[FloatArray], FloatArray],
) -> FloatArray | None:
    return None if values is None else in_model(values[keep][:, columns])


def _model_and_base(
    realization: Realization,
    trial: Trial,
    joints: Sequence[str],
    keep: NDArray[np.bool_],
    position: FloatArray,
) -> tuple[mujoco.MjModel, DrivenBase | None]:
    """The model of a trial, and its floating base where the pose of that was recorded.

    Raises:
        RecordingError: the robot touches something along its recorded motion.
    """
    model = _model(realization, trial)
    if trial.base is None:
        return model, None
    ids = [model.joint(joint).id for joint in joints]
    heavy, base, _ = drive_base(model, ids, trial.base, realization.path)
    heavy = _DRIVEN_MODELS.setdefault(model, heavy)
    refuse_contact(heavy, base, ids, trial.time[keep], position, trial.path)
    return heavy, base


_DRIVEN_MODELS: weakref.WeakKeyDictionary[mujoco.MjModel, mujoco.MjModel] = (
    weakref.WeakKeyDictionary()
)
"""Model -> the one whose base follows its recorded pose, shared by all trials."""
_MODELS: weakref.WeakKeyDictionary[Realization, dict[tuple[str | None, ...], mujoco.MjModel]] = (
    weakref.WeakKeyDictionary()
)


def _model(realization: Realization, trial: Trial) -> mujoco.MjModel:
    """The model of a trial, shared by all trials with the same controller and payload."""
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
            # MuJoCo's simplification for bodies that rotate about their centre of mass is not valid
            # under effects that move this centre.
            body.simple = 0
        known[tuple(chosen)] = compile_spec(spec)[0]
    return known[tuple(chosen)]


def start_width(time: FloatArray) -> float:
    """Duration in s of the samples from which the initial state of a window is estimated."""
    return WINDOWS.start_samples * float(np.median(np.diff(time)))
