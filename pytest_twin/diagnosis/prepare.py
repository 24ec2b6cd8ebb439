"""From trials to a problem: segments, floor, scales."""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Sequence
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
# A drive's effort jumps with its command; a sample beside a jump is right or wrong as a whole. Root
# mean square of that, in those of what a finer step changes, as measured on 20 arms.
_LEFT_OF_JUMPS = 0.6
# Impacts jump by more: as measured on the arm that taps.
_LEFT_OF_IMPACTS = 1.0
# Share of the greatest effort below which a model's negative efforts say nothing of the sign.
_UNSIGNED = 0.05
NOISE = "sensor noise and quantization"
# As measured on an arm whose tip taps on a table: impacts fall between steps.
_LEFT_IN_CONTACT = 0.35


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
) -> Prepared:
    """Build the problem of explaining ``fit`` and predicting ``held_out``.

    Raises:
        RecordingError: no joint that the model and every recording share.
        SpecError: a controller, payload or actuator that the model lacks.
    """
    trials = [*fit, *held_out]
    joints = _shared_joints(realization, trials)
    segments: list[Segment] = []
    owner: list[int] = []
    for i, trial in enumerate(trials):
        made = segments_of(realization, trial, i, joints)
        segments += made
        owner += [i] * len(made)
    simulator = RowSimulator(segments, joints, threads=threads)
    is_fit = np.array(owner) < len(fit)
    noise = _greatest_noise([s.position for s in segments], owner)
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
        refined,
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
    if simulator.contact.world.size:
        problem.step_left = _LEFT_IN_CONTACT
    problem.floor = np.sqrt(noise**2 + (problem.step_left * steps) ** 2)
    if effort_floor is not None and problem.defect:
        jumps = np.concatenate([add.effort for add in problem.defect.values()])
        share = _LEFT_OF_IMPACTS if simulator.contact.world.size else _LEFT_OF_JUMPS
        left = share * np.sqrt(np.mean(jumps**2, axis=0))
        problem.effort_floor = np.sqrt(effort_floor**2 + left**2)
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
    least: FloatArray = np.minimum(_greatest_noise(efforts, owner), _greatest_noise(off, owner))
    return least


def _greatest_noise(values: Sequence[FloatArray], owner: Sequence[int]) -> FloatArray:
    """(joints,) of the noisiest trial; the windows of one trial are taken together."""
    trials = sorted(set(owner))
    each = [
        np.concatenate([v for v, o in zip(values, owner, strict=True) if o == trial])
        for trial in trials
    ]
    greatest: FloatArray = np.max([sensor_noise(e) for e in each], axis=0)
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
    realization: Realization, trial: Trial, index: int, joints: Sequence[str]
) -> list[Segment]:
    """A trial in the model's terms: one segment, or, under effort commands, short windows.

    Args:
        realization: what it is stepped on, under the trial's own controller and payload.
        trial: what was recorded.
        index: of the trial, kept in its segments.
        joints: columns; all are in the trial.

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
    count = max(1, round(time[-1] / _EFFORT_WINDOW))
    edges = np.linspace(0.0, time[-1], count + 1)
    for start, end in itertools.pairwise(edges):
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
