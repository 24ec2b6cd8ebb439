"""Compare simulations of fitted and nominal model under recorded commands with measurements."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.model import AppliedEffect, read_patched_model
from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.diagnosis.patched.write import load_written
from pytest_twin.effects.timing import CommandDelay
from pytest_twin.errors import TwinError
from pytest_twin.identification.drive_effects import DriveEffects, DriveRecordings, fit_drives
from pytest_twin.identification.effort.servo_gains import ServoGains
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.identification.stages import HeldOut, Stage, judge_stage
from pytest_twin.identification.write import ModelChanges, Patches, add_effects, write_fitted
from pytest_twin.metrics.joint_frequency import effort_response
from pytest_twin.metrics.residual import residual
from pytest_twin.realization import Realization
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.time_limit import skips
from pytest_twin.trial import Trial, make_trials, recordings_at

_SOLVED = 0.05
"""Share of the nominal position error below which servos with late commands leave nothing that a
search of further effects, which takes a minute for a joint, could find."""
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
        drives: effects of drives, if they are kept.
    """

    folder: Path
    fit: Patches
    positions: dict[str, PositionError]
    stage: Stage
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    drives: DriveEffects | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def is_solved_by_delays(self) -> bool:
        """Whether late commands explain nearly all of the nominal position error."""
        held_out = self.stage.held_out
        late = any(f".{CommandDelay.id}" in name for name in self.parameters)
        return late and held_out is not None and held_out.after < _SOLVED * held_out.before

    def has_larger_error_than(self, other: ClosedLoop) -> bool:
        """Whether the other model has a smaller simulated position error."""
        own, its = self.stage.held_out, other.stage.held_out
        return own is not None and its is not None and its.after < own.after


def close_loop(
    nominal: Realization,
    changes: ModelChanges,
    gains: Sequence[ServoGains],
    recordings: DriveRecordings | None,
    trials: Sequence[Trial] | TwinError,
    folder: Path,
) -> ClosedLoop:
    """Write the fitted model that has the smallest simulated position error.

    It has servo gains from effort and tracking error, or effects of drives, or neither.

    Args:
        changes: changes of bodies, joints and encoders.
        gains: gains of position servos from measured effort.
        recordings: recordings to which the effects of drives are fitted; None for no effects.
        trials: result of :func:`trials_of`.
        folder: new and empty; gets the fitted model.
    """
    write_fitted(folder, nominal, changes)
    positions, stage = compare_simulations(nominal, load_written(folder), trials)
    plain = ClosedLoop(folder, changes.patches, positions, stage)
    if stage.held_out is None:
        return plain
    best, notes = plain, []
    if gains:
        servos = _with_gains(nominal, changes, gains, trials, _new_folder(folder, "servo_gains"))
        if any(one.is_late for one in gains):
            late = _with_delays(
                nominal, servos, gains, trials, _new_folder(folder, "command_delays")
            )
            servos = late if servos.has_larger_error_than(late) else servos
        if best.has_larger_error_than(servos):
            best = servos
        else:
            words = ", ".join(one.words for one in gains)
            notes.append(
                "servo gains from effort and tracking error are not kept, because they do not "
                f"lower the simulated position error: {words}"
            )
    searched = recordings is not None and not best.is_solved_by_delays
    if recordings is not None and searched and not skips("effects of drives, by simulation"):
        base = plain
        if recordings.known:
            aside = _new_folder(folder, "known_servos")
            base = _with_gains(nominal, changes, recordings.known, trials, aside)
        other = _new_folder(folder, "drive_effects")
        try:
            found = fit_drives(load_written(base.folder), recordings, other)
        except TwinError as error:
            found = None
            notes.append(f"no effects of drives are fitted: {error}")
        if found is not None:
            driven = _with_drives(nominal, base, found, trials, other)
            best = driven if best.has_larger_error_than(driven) else best
    return replace(_move_model(best, folder), notes=[*notes, *best.notes])


def _with_gains(
    nominal: Realization,
    changes: ModelChanges,
    gains: Sequence[ServoGains],
    trials: Sequence[Trial] | TwinError,
    folder: Path,
) -> ClosedLoop:
    patches = {**changes.patches, "actuator": {one.actuator: dict(one.patch()) for one in gains}}
    write_fitted(folder, nominal, replace(changes, patches=patches))
    positions, stage = compare_simulations(nominal, load_written(folder), trials)
    parameters = {name: one for each in gains for name, one in each.parameters().items()}
    words = ", ".join(one.words for one in gains)
    stage = replace(
        stage,
        why=f"servo stiffness from effort and tracking error: {words}; {stage.why}",
        parameters=tuple(parameters),
        excludes="weights, inertias and friction are given; a delay of the command was free",
    )
    return ClosedLoop(folder, patches, positions, stage, parameters)


def _with_delays(
    nominal: Realization,
    servos: ClosedLoop,
    gains: Sequence[ServoGains],
    trials: Sequence[Trial] | TwinError,
    folder: Path,
) -> ClosedLoop:
    """Return the model with fitted servos whose commands act late."""
    held = not isinstance(trials, TwinError) and trials[0].command_between == "held"
    late = [one for one in gains if one.is_late]
    shutil.copytree(servos.folder, folder, dirs_exist_ok=True)
    joints = tuple(nominal.joints)
    add_effects(folder, joints, [
        AppliedEffect(CommandDelay.id, one.joint, {"delay": one.command_delay(held)},
                      is_in_mjcf=False)
        for one in late
    ])  # fmt: skip
    positions, stage = compare_simulations(nominal, load_written(folder), trials)
    words = ", ".join(f"{one.joint} {1e3 * one.command_delay(held):.3g} ms" for one in late)
    parameters = {name: one for each in late for name, one in each.delay_parameter(held).items()}
    stage = replace(
        stage,
        why=f"commands act late, from effort and tracking error: {words}; servo stiffness: "
        f"{', '.join(one.words for one in gains)}; {stage.why}",
        parameters=(*servos.stage.parameters, *parameters),
        excludes="weights, inertias and friction are given",
    )
    parameters = {**servos.parameters, **parameters}
    return replace(servos, folder=folder, positions=positions, stage=stage, parameters=parameters)


def _with_drives(
    nominal: Realization,
    base: ClosedLoop,
    found: DriveEffects,
    trials: Sequence[Trial] | TwinError,
    folder: Path,
) -> ClosedLoop:
    positions, stage = compare_simulations(nominal, load_written(folder), trials)
    named = ", ".join(found.together.parameters)
    stage = replace(
        stage,
        why=f"effects of the drives, fitted to the motion: {named}; {stage.why}",
        parameters=(*base.parameters, *found.together.parameters),
        excludes="weights, inertias and friction are given",
    )
    notes = []
    fit = {family: dict(own) for family, own in base.fit.items()}
    for family, own in found.fit.items():
        elements = fit.setdefault(family, {})
        for name, changed in own.items():
            elements[name] = {**elements.get(name, {}), **changed}
    if found.outside:
        notes.append(
            f"only realization/ contains {', '.join(found.outside)}: fit: of a twin has no fields "
            "for them; name the folder of this identification as its model:"
        )
    parameters = {**base.parameters, **found.parameters}
    return ClosedLoop(folder, fit, positions, stage, parameters, found, notes)


def _new_folder(folder: Path, name: str) -> Path:
    """Return a new folder beside that of the fitted model."""
    other = folder.with_name(f"with_{name}")
    other.mkdir()
    return other


def _move_model(loop: ClosedLoop, folder: Path) -> ClosedLoop:
    """Move the model of a closed loop to a folder, and remove the others beside it."""
    if loop.folder != folder:
        shutil.rmtree(folder)
        loop.folder.rename(folder)
    for other in folder.parent.glob("with_*"):
        shutil.rmtree(other)
    return replace(loop, folder=folder)


def trials_of(
    nominal: Realization,
    recordings: Sequence[Path],
    topics: Mapping[str, str],
    options: RecordingOptions,
) -> list[Trial] | TwinError:
    """Return the trials of recordings, or the error if they have no commands to simulate.

    Args:
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


def compare_simulations(
    nominal: Realization, fitted: Realization, trials: Sequence[Trial] | TwinError
) -> tuple[dict[str, PositionError], Stage]:
    """Return joint -> position error of both models, and the stage ``closed_loop``.

    Args:
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


def with_command_delays(stages: Sequence[Stage], loop: ClosedLoop) -> tuple[Stage, ...]:
    """Return the stages with the command delays of the closed loop in the stage ``delay``."""
    late = [name for name in loop.parameters if f".{CommandDelay.id}" in name]
    if not late:
        return tuple(stages)
    values = (f"{name} {1e3 * loop.parameters[name]['value']:.3g} ms" for name in late)
    found = f"commands act late: {', '.join(values)}; {loop.stage.why}"
    return tuple(
        replace(
            one,
            state="accepted",
            why=found if one.state == "not_observable" else f"{one.why}; {found}",
            parameters=(*one.parameters, *late),
        )
        if one.name == "delay" and loop.stage.state == "accepted"
        else one
        for one in stages
    )


def effort_responses(recordings: Sequence[MeasuredRecording]) -> list[dict[str, Any]]:
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
    each: dict[str, list[float]] = {}
    for trial, (joints, position) in zip(trials, _positions(realization, trials), strict=True):
        for joint, predicted in zip(joints, position.T, strict=True):
            measured = trial.position[:, trial.joints.index(joint)]
            seen = np.isfinite(measured)
            each.setdefault(joint, []).append(residual(predicted[seen], measured[seen]).rms)
    return {joint: float(np.sqrt(np.mean(np.square(all_)))) for joint, all_ in each.items()}


def _positions(
    realization: Realization, trials: Sequence[Trial]
) -> list[tuple[tuple[str, ...], FloatArray]]:
    """Return the joints of each trial and their simulated positions, with all effects."""
    from pytest_twin.open_loop import replay

    patched = read_patched_model(realization)
    if patched is not None:
        predicted = replay_patched(realization, patched, trials)
        return [(patched.joints, one.position) for one in predicted]
    results = replay(realization, list(trials))
    for result in results:
        if result.error is not None:
            raise result.error
    return [(t.joints, one.position) for t, one in zip(trials, results, strict=True)]
