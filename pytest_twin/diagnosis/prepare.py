"""From trials to a problem: segments, floor, scales."""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis
from pytest_twin.diagnosis.problem import (
    REFINE,
    Problem,
    joint_scales,
    nominal_replay,
    sensor_noise,
)
from pytest_twin.diagnosis.smoothing import derivatives, smooth_state
from pytest_twin.diagnosis.start import FreeStart, free_starts
from pytest_twin.effects.base import FloatArray
from pytest_twin.effects.rows import Predicted, RowSimulator, Segment
from pytest_twin.errors import RecordingError
from pytest_twin.realization import Realization
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.realization.mjcf import compiled
from pytest_twin.trial import Trial

# Under an effort command errors integrate twice: a simulation is held to the recording for this
# long, then starts anew from the measured state.
_EFFORT_WINDOW = 0.5
_START_SAMPLES = 12
# Share of the greatest effort below which a model's negative efforts say nothing of the sign.
_UNSIGNED = 0.05
# Times the noise by which a finer step may change a window of usual length.
_WILD = 30.0
# Mean square, of its usual size, by which samples are off a smooth motion where a command jumps;
# the median of the squares of a unit normal distribution.
_ROUGH, _MEDIAN_SQUARE = 4.0, 0.455
# Share of the samples, those that the model's step changes least, that tell an effort's noise.
_QUIET = 0.3
NOISE = "sensor noise and quantization"
# As measured on an arm whose tip taps on a table, and on arms whose drives are sent efforts:
# impacts and the jumps of a command fall between steps.
_LEFT_OF_IMPACTS, _LEFT_OF_JUMPS = 0.35, 0.5


@dataclass(frozen=True, slots=True)
class Prepared:
    """A problem and where it came from.

    Attributes:
        problem: to explain.
        segment_trial: trial index of each segment.
        floor_parts: name of a source -> (joints,) deviations, SI units.
    """

    problem: Problem
    segment_trial: tuple[int, ...]
    floor_parts: dict[str, FloatArray]


def prepare(
    realization: Realization,
    fit: Sequence[Trial],
    held_out: Sequence[Trial],
    *,
    threads: int = 0,
    window: float = _EFFORT_WINDOW,
) -> Prepared:
    """Build the problem of explaining ``fit`` and predicting ``held_out``.

    Args:
        realization: the model as it came.
        fit, held_out: recordings.
        threads: of the simulation; 0 for all.
        window: s, of motions under effort commands; halved where they are too wild for it.

    Raises:
        RecordingError: no joint that the model and every recording share.
        SpecError: a controller, payload or actuator that the model lacks.
    """
    trials = [*fit, *held_out]
    joints = _shared_joints(realization, trials)
    segments: list[Segment] = []
    owner: list[int] = []
    for i, trial in enumerate(trials):
        made = segments_of(realization, trial, i, joints, window)
        segments += made
        owner += [i] * len(made)
    simulator = RowSimulator(segments, joints, threads=threads)
    is_fit = np.array(owner) < len(fit)
    noise = _greatest_noise(segments, [s.position for s in segments], owner)
    refined = RowSimulator(segments, joints, threads=threads, refine=REFINE)
    nominal = nominal_replay(simulator)
    effort_floor: FloatArray | None = None
    if _signed_efforts(segments, nominal):
        effort_floor = _effort_noise(segments, nominal, owner)
    scales = joint_scales(simulator, nominal)
    problem = Problem(
        simulator,
        np.flatnonzero(is_fit),
        np.flatnonzero(~is_fit),
        noise,
        scales,
        effort_floor,
        refined=refined,
    )
    problem.start_noise, problem.start_width = noise, _start_width(segments[0])
    if any(s.mode != "position" for s in segments):

        def free(hypothesis: Hypothesis) -> dict[int, FreeStart]:
            return free_starts(
                segments, joints, noise, problem.start_width, threads, hypothesis, scales
            )

        problem.free = free
    problem.refine_at(EMPTY)
    steps = discretization(problem)
    if window == _EFFORT_WINDOW and segments[0].mode == "effort" and (steps > _WILD * noise).any():
        return prepare(realization, fit, held_out, threads=threads, window=0.5 * window)
    if segments[0].mode == "effort":
        problem.step_left = _LEFT_OF_JUMPS
    elif simulator.contact.world.size:
        problem.step_left = _LEFT_OF_IMPACTS
    problem.floor = np.sqrt(noise**2 + (problem.step_left * steps) ** 2)
    if effort_floor is not None and problem.defect:
        if segments[0].mode == "effort":
            # An effort drive gives what it is sent: only when is open, by a sample.
            jumps = {i: _steepest(p.effort) for i, p in enumerate(nominal)}
        else:
            effort_floor = np.minimum(effort_floor, _quiet_noise(problem, nominal, owner))
            jumps = {i: add.effort for i, add in problem.defect.items()}
        _trust_efforts(problem, effort_floor, jumps)
    parts = {NOISE: noise, "discretization of the simulator": steps}
    return Prepared(problem, tuple(owner), parts)


def _signed_efforts(segments: Sequence[Segment], nominal: Sequence[Predicted]) -> bool:
    """Whether every recording has efforts that can be compared with a drive's.

    Some drivers publish the magnitude of a current: nowhere negative, where the model says that it
    must be.
    """
    lowest, modelled = np.inf, np.inf
    for segment, predicted in zip(segments, nominal, strict=True):
        if segment.effort is None or not np.isfinite(segment.effort).all():
            return False
        lowest = min(lowest, float(segment.effort.min()))
        highest = np.abs(predicted.effort).max()
        modelled = min(modelled, float(predicted.effort.min() + _UNSIGNED * highest))
    return lowest < 0.0 or not modelled < 0.0


def _effort_noise(
    segments: Sequence[Segment], nominal: Sequence[Predicted], owner: Sequence[int]
) -> FloatArray:
    """(joints,) deviation of measured efforts, N*m or N.

    A stiff servo's effort jumps at every command, which third differences take for noise where the
    model does not say the same.
    """
    efforts = [s.effort for s in segments if s.effort is not None]
    off = [e - p.effort for e, p in zip(efforts, nominal, strict=True)]
    least: FloatArray = np.minimum(
        _greatest_noise(segments, efforts, owner), _greatest_noise(segments, off, owner)
    )
    return least


def _trust_efforts(problem: Problem, noise: FloatArray, jumps: Mapping[int, FloatArray]) -> None:
    """Weigh efforts by their noise against what may be wrong beside a jump of the command.

    Such a sample is right or wrong as a whole.

    Args:
        noise: (joints,) N*m or N.
        jumps: segment -> (samples, joints) N*m or N.
    """
    problem.effort_floor = noise
    for i, jump in jumps.items():
        problem.effort_trust[i] = 1.0 / np.sqrt(1.0 + (jump / noise) ** 2)


def _steepest(effort: FloatArray) -> FloatArray:
    """(samples, joints) greatest change to a neighbouring sample."""
    change = np.abs(np.diff(effort, axis=0))
    none = np.zeros((1, effort.shape[1]))
    steepest: FloatArray = np.maximum(np.vstack([none, change]), np.vstack([change, none]))
    return steepest


def _quiet_noise(
    problem: Problem, nominal: Sequence[Predicted], owner: Sequence[int]
) -> FloatArray:
    """(joints,) deviation of measured efforts where the model's step is no matter, N*m or N.

    Efforts that jump do so in proportion to the model's: what third differences leave beside that
    is noise.
    """
    worst = np.zeros(len(problem.joints))
    for trial in sorted(set(owner)):
        measured, modelled, shaken = [], [], []
        for i, o in enumerate(owner):
            effort, add = problem.simulator.segments[i].effort, problem.defect.get(i)
            if o == trial and effort is not None and add is not None:
                measured.append(effort)
                modelled.append(nominal[i].effort + add.effort)
                shaken.append(np.abs(add.effort))
        if not measured:
            return np.full(len(problem.joints), np.inf)
        third, like = (np.diff(np.concatenate(x), n=3, axis=0) for x in (measured, modelled))
        shake = np.max(
            np.lib.stride_tricks.sliding_window_view(np.concatenate(shaken), 4, axis=0), axis=-1
        )
        quiet = shake <= np.quantile(shake, _QUIET, axis=0)
        for j in range(third.shape[1]):
            a, b = third[quiet[:, j], j], like[quiet[:, j], j]
            a = a - b * (a @ b) / max(float(b @ b), 1e-30)
            worst[j] = max(worst[j], 1.4826 * float(np.median(np.abs(a))) / np.sqrt(20.0))
    return worst


def _greatest_noise(
    segments: Sequence[Segment], values: Sequence[FloatArray], owner: Sequence[int]
) -> FloatArray:
    """(joints,) of the noisiest trial; the windows of one trial are taken together."""
    each = []
    for trial in sorted(set(owner)):
        mine = [i for i, o in enumerate(owner) if o == trial]
        time = np.concatenate([segments[i].time for i in mine])
        each.append(sensor_noise(time, np.concatenate([values[i] for i in mine])))
    greatest: FloatArray = np.max(each, axis=0)
    return greatest


def _start_width(segment: Segment) -> float:
    return _START_SAMPLES * float(np.median(np.diff(segment.time)))


def discretization(problem: Problem) -> FloatArray:
    """(joints,) root mean square of what the model's own step changes, rad or m."""
    changes = [add.position for add in problem.defect.values()]
    if not changes:
        return np.zeros(len(problem.joints))
    error: FloatArray = np.sqrt(np.mean(np.concatenate(changes) ** 2, axis=0))
    return error


def _shared_joints(realization: Realization, trials: Sequence[Trial]) -> tuple[str, ...]:
    scalar = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    model = realization.model
    joints = tuple(
        j
        for j in realization.joints
        if int(model.jnt_type[realization.joint_index(j)]) in scalar
        and all(j in t.joints for t in trials)
    )
    if not joints:
        raise RecordingError(
            "no joint of the model is in every recording",
            path=trials[0].path,
            value=", ".join(trials[0].joints),
            expected=", ".join(realization.joints),
        )
    return joints


def segments_of(
    realization: Realization,
    trial: Trial,
    index: int,
    joints: Sequence[str],
    window: float = _EFFORT_WINDOW,
) -> list[Segment]:
    """A trial in the model's terms: one segment, or, under effort commands, short windows.

    Args:
        realization: what it is stepped on, under the trial's own controller and payload.
        trial: what was recorded.
        index: of the trial, kept in its segments.
        joints: columns; all are in the trial.
        window: s.

    Raises:
        SpecError: a controller or payload that the model lacks.
    """
    columns = [trial.joints.index(j) for j in joints]
    encoders = Encoders.of(calibration_of(realization), joints)
    model = _model(realization, trial)
    keep = np.concatenate([[True], np.diff(trial.time) > 0])
    time = trial.time[keep]
    position = encoders.model_position(trial.position[keep][:, columns])
    velocity = _columns(trial.velocity, keep, columns, encoders)
    effort = _columns(trial.effort, keep, columns, encoders)
    command = np.full((len(trial.command_time), len(joints)), np.nan)
    for j, joint in enumerate(joints):
        if joint in trial.command_joints:
            command[:, j] = trial.command[:, trial.command_joints.index(joint)]
    command = encoders.model_command(command, trial.command_mode)
    ascending = np.concatenate([[True], np.diff(trial.command_time) > 0])
    common = {
        "trial": index,
        "model": model,
        "mode": trial.command_mode,
        "command_time": trial.command_time[ascending],
        "command": command[ascending],
    }
    if trial.command_mode != "effort":
        first = np.zeros(len(joints)) if velocity is None else np.nan_to_num(velocity[0])
        return [
            Segment(start=0.0, time=time, position=position, velocity=velocity, effort=effort,
                    initial_position=position[0], initial_velocity=first, **common)
        ]  # fmt: skip
    out = []
    width = _START_SAMPLES * float(np.median(np.diff(time)))
    smooth, speed, _ = derivatives(time, position, width)
    history = (time, smooth, speed)
    for start, end in itertools.pairwise(_edges(time, position - smooth, window)):
        inside = (time >= start) & (time <= end)
        if inside.sum() < 8:
            continue
        q, v = smooth_state(time, position, float(start), width)
        out.append(
            Segment(start=float(start), time=time[inside], position=position[inside],
                    velocity=None if velocity is None else velocity[inside],
                    effort=None if effort is None else effort[inside],
                    initial_position=q, initial_velocity=v, history=history, **common)
        )  # fmt: skip
    return out


def _edges(time: FloatArray, off: FloatArray, window: float) -> FloatArray:
    """Where windows under effort commands begin and end, s.

    A velocity is not known where a command jumps: there, they begin a little before or after.

    Args:
        time: (n,) s, from 0 on.
        off: (n, joints) samples less a smooth motion.
        window: s, about.
    """
    count = max(1, round(time[-1] / window))
    edges = np.linspace(0.0, time[-1], count + 1)
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
