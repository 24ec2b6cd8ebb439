"""Compare simulations of fitted and nominal model under recorded commands with measurements."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.diagnosis.patched.write import load_written
from pytest_twin.errors import TwinError
from pytest_twin.formats.identification_record import EncoderChange
from pytest_twin.identification.effort.servo_gains import ServoGains
from pytest_twin.identification.fit_patches import Patches
from pytest_twin.identification.measured import Measured
from pytest_twin.identification.stages import HeldOut, Stage, judge_stage
from pytest_twin.identification.write import write_fitted
from pytest_twin.metrics.joint_frequency import effort_response
from pytest_twin.metrics.residual import residual
from pytest_twin.realization import Realization
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.trial import Trial, make_trials, recordings_at

_EXCLUDES = "nothing is fitted here: all accepted parameters together are simulated"


@dataclass(frozen=True, slots=True)
class PositionError:
    """Root mean square of predicted minus measured positions of one joint.

    Attributes:
        nominal, fitted: error of the nominal and of the fitted model, rad or m.
        unit: unit of both errors.
    """

    nominal: float
    fitted: float
    unit: str


@dataclass(frozen=True)
class ClosedLoop:
    """The fitted model under recorded commands.

    Attributes:
        fit: family -> element -> attribute -> value, with servo gains if they are kept.
        positions: joint -> errors of its simulated position.
        stage: the stage ``closed_loop``.
        parameters: parameters of the stage for the record.
        notes: messages.
    """

    fit: Patches
    positions: dict[str, PositionError]
    stage: Stage
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def close_loop(
    nominal: Realization,
    fit: Patches,
    encoders: Mapping[str, EncoderChange],
    gains: Sequence[ServoGains],
    trials: Sequence[Trial] | TwinError,
    folder: Path,
) -> ClosedLoop:
    """Write and simulate the fitted model; servo gains are kept if they lower its position error.

    Args:
        nominal: the nominal model.
        fit: changes of bodies and joints.
        encoders: changes of encoders.
        gains: gains of position servos from measured effort.
        trials: result of :func:`trials_of`.
        folder: new and empty; gets the fitted model.
    """
    write_fitted(folder, nominal, fit, encoders)
    positions, stage = simulated(nominal, load_written(folder), trials)
    if not gains or stage.held_out is None:
        return ClosedLoop(fit, positions, stage)
    words = ", ".join(one.words for one in gains)
    with_gains = {**fit, "actuator": {one.actuator: dict(one.patch()) for one in gains}}
    other = folder.with_name("with_servo_gains")
    other.mkdir()
    write_fitted(other, nominal, with_gains, encoders)
    others, tried = simulated(nominal, load_written(other), trials)
    if tried.held_out is None or tried.held_out.after >= stage.held_out.after:
        shutil.rmtree(other)
        note = (
            f"servo gains from effort and tracking error are not kept, because they do not lower "
            f"the simulated position error: {words}"
        )
        return ClosedLoop(fit, positions, stage, notes=[note])
    shutil.rmtree(folder)
    other.rename(folder)
    parameters = {name: one for each in gains for name, one in each.parameters().items()}
    tried = replace(
        tried,
        why=f"servo stiffness from effort and tracking error: {words}; {tried.why}",
        parameters=tuple(parameters),
        excludes="weights, inertias and friction are given; a delay of the command was free",
    )
    return ClosedLoop(with_gains, others, tried, parameters)


def trials_of(
    nominal: Realization,
    recordings: Sequence[Path],
    topics: Mapping[str, str],
    options: RecordingOptions,
) -> list[Trial] | TwinError:
    """Return the trials of recordings, or the error if they have no commands to simulate.

    Args:
        nominal: the nominal model.
        recordings: held-out recordings, or the fitted ones if nothing is held out.
        topics, options: settings for reading the recordings.
    """
    try:
        return [
            trial
            for path in recordings
            for one in recordings_at(path, topics, options)
            for trial in make_trials(one, nominal.structure, options)
        ]
    except TwinError as error:
        return error


def simulated(
    nominal: Realization, fitted: Realization, trials: Sequence[Trial] | TwinError
) -> tuple[dict[str, PositionError], Stage]:
    """Return joint -> position error of both models, and the stage ``closed_loop``.

    Args:
        nominal, fitted: the two models.
        trials: result of :func:`trials_of`.
    """
    try:
        if isinstance(trials, TwinError):
            raise trials
        before, after = (_errors(model, trials) for model in (nominal, fitted))
    except TwinError as error:
        why = f"no command can be simulated: {error.problem}"
        return {}, Stage("closed_loop", "not_observable", why, (), None, _EXCLUDES)
    kinds = nominal.structure.joint_type
    found = {
        joint: PositionError(before[joint], after[joint], "m" if kinds[joint] == "slide" else "rad")
        for joint in before
        if joint in after and np.isfinite(before[joint]) and np.isfinite(after[joint])
    }
    if not found:
        why = "the simulation under the recorded commands diverges"
        return {}, Stage("closed_loop", "not_observable", why, (), None, _EXCLUDES)
    held = HeldOut(
        1.0,
        float(np.sqrt(np.mean([
            (one.fitted / max(one.nominal, 1e-12)) ** 2 for one in found.values()
        ]))),
        "nominal position error",
    )  # fmt: skip
    why = "open-loop simulation under the recorded commands"
    return found, judge_stage(Stage("closed_loop", "accepted", why, (), None, _EXCLUDES), held)


def effort_responses(recordings: Sequence[Measured]) -> list[dict[str, Any]]:
    """Return each joint's response from effort to position, of recordings without commands.

    Each joint has the recording that supports the most frequencies.

    Args:
        recordings: recordings of the same joints.
    """
    found = []
    for k, joint in enumerate(recordings[0].joints):
        each = [
            response
            for one in recordings
            if (
                response := effort_response(
                    joint, one.path.name, one.time, one.effort[:, k], one.position[:, k]
                )
            )
        ]
        if each:
            found.append(max(each, key=lambda one: len(one.measured.frequency)).to_json())
    return found


def _errors(realization: Realization, trials: Sequence[Trial]) -> dict[str, float]:
    from pytest_twin.replay import replay

    each: dict[str, list[float]] = {}
    results = replay(realization, list(trials))
    for trial, result in zip(trials, results, strict=True):
        if result.error is not None:
            raise result.error
        for column, joint in enumerate(trial.joints):
            seen = np.isfinite(trial.position[:, column])
            off = residual(result.position[seen, column], trial.position[seen, column])
            each.setdefault(joint, []).append(off.rms)
    return {joint: float(np.sqrt(np.mean(np.square(all_)))) for joint, all_ in each.items()}
