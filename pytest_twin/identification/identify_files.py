"""Run one identification, from its files to the output folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from pytest_twin.diagnosis.patched.frequency import frequency_responses
from pytest_twin.diagnosis.patched.write import load_written
from pytest_twin.effects.friction import AsymmetricFriction
from pytest_twin.errors import PathError, RecordingError, TwinError
from pytest_twin.formats.digest import file_sha256
from pytest_twin.identification.closed_loop import (
    close_loop,
    effort_responses,
    trials_of,
    with_command_delays,
)
from pytest_twin.identification.contact.identify_contact import are_tosses, identify_contact
from pytest_twin.identification.contact.roles import TossOptions
from pytest_twin.identification.document import nominal_document
from pytest_twin.identification.drive_effects import (
    add_covariance,
    drive_recordings,
    with_drive_effects,
)
from pytest_twin.identification.effort.amounts import without_amounts
from pytest_twin.identification.effort.document import effort_document
from pytest_twin.identification.effort.identify_effort import (
    EffortResult,
    has_effort,
    identify_effort,
)
from pytest_twin.identification.effort.servo_gains import servo_gains
from pytest_twin.identification.effort.stage_comparison import EffortError
from pytest_twin.identification.encoder_changes import encoder_changes
from pytest_twin.identification.fit_patches import laws_of, patches_of, reading_effects
from pytest_twin.identification.known_effects import notes_on_effects
from pytest_twin.identification.measured_recordings import MeasuredRecording, MeasuredRecordings
from pytest_twin.identification.recheck import EffortRecord, effort_errors
from pytest_twin.identification.roles import read_by_role
from pytest_twin.identification.sensing.identify_sensors import identify_sensors
from pytest_twin.identification.sensing.sensor_recordings import NamedSensor
from pytest_twin.identification.signal_table import signal_table
from pytest_twin.identification.write import ModelChanges, add_effects, write_fitted
from pytest_twin.realization import Realization, load
from pytest_twin.realization.record_inputs import basis_json, states_of_records, unfitted
from pytest_twin.recording_options import NO_OPTIONS, Base, RecordingOptions
from pytest_twin.records.basis import Uses
from pytest_twin.records.state import stale_lines
from pytest_twin.replay_order import refuse_other_order
from pytest_twin.time_limit import limited, skips
from pytest_twin.twin import DEFAULT_TOPICS, Twin, load_twin

REALIZATION = "realization"


@dataclass(frozen=True, slots=True)
class IdentificationRequest:
    """Request of an identification, as passed between processes.

    Attributes:
        model: path of an MJCF, URDF or ``twin.yaml``.
        out: empty folder, in which ``realization/`` is written.
        folder: folder that the record will be in; ``out`` if empty.
        seconds: limit of the processor time, s; 0 for none.
        topics: role of a topic -> topic; these take precedence over those of the twin.
        options: settings for reading recordings; they take precedence over the twin's.
        tosses: fields of ``TossOptions``, for recordings of a free object.
        sensors: fields of ``NamedSensor``; if there are any, only sensors are estimated.
    """

    model: str
    recordings: Sequence[str]
    held_out: Sequence[str]
    out: str
    name: str
    topics: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    tosses: Mapping[str, Any] | None = None
    sensors: Sequence[Mapping[str, str]] = ()
    folder: str = ""
    seconds: float = 0.0


def identify_files(
    request: Mapping[str, Any],
    progress: Callable[[float], None] = lambda fraction: None,
) -> dict[str, Any]:
    """Load the model, identify and write the fitted model, in the child process.

    At the time limit and at a stop request of the parent, the stages so far are the result, which
    is never accepted.

    Args:
        request: fields of :class:`IdentificationRequest`.
        progress: called with the fraction done.

    Returns:
        The content of ``identification.json``.

    Raises:
        TwinError: the input cannot be used.
    """
    asked = IdentificationRequest(**request)
    with limited(asked.seconds) as limit:
        document = _identify_files(asked, progress)
    document["not_tried"] = limit.not_tried
    if limit.not_tried:
        document["notes"].insert(0, limit.note())
        if document["verdict"] == "accepted":
            document["verdict"] = "improved"
    return document


def _identify_files(
    asked: IdentificationRequest, progress: Callable[[float], None]
) -> dict[str, Any]:
    model, out, name, topics = asked.model, asked.out, asked.name, asked.topics
    recordings, held_out, sensors = asked.recordings, asked.held_out, asked.sensors
    options = RecordingOptions.from_json(asked.options)
    realization, notes = _load(Path(model), name, options.base)
    twin = realization.twin
    if twin is not None:
        notes += stale_lines(states_of_records(twin), twin)
    chosen = options.over(NO_OPTIONS if twin is None else twin.recordings)
    signals = chosen.signals
    stated = DEFAULT_TOPICS if twin is None else twin.topics
    paths = [Path(one) for one in recordings]
    tested = [Path(one) for one in held_out]
    inputs = _Inputs(realization, Path(model), name, Path(asked.folder or out), [*paths, *tested])
    progress(0.1)
    if sensors:
        document = identify_sensors(
            realization, paths, tested, [NamedSensor(**one) for one in sensors],
            {**stated, **topics}["state"], _new_folder(Path(out) / REALIZATION),
            lambda fraction: progress(0.1 + 0.9 * fraction),
        )  # fmt: skip
        return inputs.add(document, notes, Uses(everything=True))
    tossed = TossOptions(**(asked.tosses or {}))
    if are_tosses([*paths, *tested], tossed):
        document = identify_contact(
            realization, paths, tested, tossed, _new_folder(Path(out) / REALIZATION),
            lambda fraction: progress(0.1 + 0.9 * fraction),
        )  # fmt: skip
        return inputs.add(document, notes, Uses(everything=True))
    measured = read_by_role(
        paths, tested, realization,
        {**stated, **topics}, chosen, signals,
    )  # fmt: skip
    measured = without_amounts(realization, measured)
    folder = _new_folder(Path(out) / REALIZATION)
    progress(0.3)
    if has_effort(measured) and skips("all stages"):
        document = nominal_document("measured effort")
        write_fitted(folder, realization)
    elif has_effort(measured):
        tried = trials_of(
            realization, _paths(measured.held_out) or _paths(measured.fit),
            {**stated, **topics}, chosen,
        )  # fmt: skip
        if not isinstance(tried, TwinError):
            refuse_other_order(realization, tried)
        result = identify_effort(realization, measured, signals)
        progress(0.8)
        encoders = encoder_changes(realization, result)
        gains = servo_gains(realization, measured.fit, result, signals)
        driven = drive_recordings(measured, {**stated, **topics}, chosen, signals, result, gains)
        loop = close_loop(
            realization,
            ModelChanges(patches_of(realization, result), encoders, laws_of(result)),
            gains, driven, tried, folder,
        )  # fmt: skip
        stages = (*with_command_delays(result.stages, loop), loop.stage)
        if loop.drives is not None:
            stages = with_drive_effects(stages, loop.drives)
        moved = {
            name.split(".")[0]
            for name in loop.parameters
            if AsymmetricFriction.id in name.split(".")
        }
        add_effects(folder, result.regressor.joints, reading_effects(result, moved))
        errors = _written_errors(
            folder, _paths(measured.held_out) or _paths(measured.fit), result,
            {**stated, **topics}, chosen,
        )  # fmt: skip
        document = effort_document(result, stages, errors)
        if loop.drives is not None:
            add_covariance(document, loop.drives)
        document["fit"] = loop.fit
        document["parameters"].update(loop.parameters)
        document["notes"] += [*notes_on_effects(realization), *loop.notes]
        document["encoders"] = {joint: asdict(one) for joint, one in encoders.items()}
        document["frequency_response"] = (
            effort_responses(measured.held_out or measured.fit)
            if isinstance(tried, TwinError)
            else frequency_responses(load_written(folder), tried)
        )
        for joint, error in loop.positions.items():
            document["held_out"].setdefault(joint, {}).update(
                position_rms=error.fitted, position_unit=error.unit,
                position_rms_nominal=error.nominal,
            )  # fmt: skip
        fitted, aside = measured.fit, measured.held_out
        document["trials"] = {
            "fit": list(dict.fromkeys(one.path.name for one in fitted)),
            "held_out": list(dict.fromkeys(one.path.name for one in aside)),
        }
    else:
        try:
            document = _from_commands(
                realization,
                _paths(measured.fit),
                _paths(measured.held_out),
                {**stated, **topics},
                chosen,
                folder,
                progress,
            )
        except RecordingError as error:
            raise _without_effort(error, measured.fit) from None
    document["signals"] = signal_table((*measured.fit, *measured.held_out), signals)
    reasons = [] if has_effort(measured) else [n for one in measured.fit for n in one.notes]
    said = [*notes, *measured.notes, *dict.fromkeys(reasons)]
    progress(1.0)
    # Along measured efforts, the motion is simulated only where commands drive it.
    simulated = any("position_rms" in errors for errors in document["held_out"].values())
    return inputs.add(document, said, _uses(realization, measured, simulated=simulated))


def _written_errors(
    folder: Path,
    recordings: Sequence[Path],
    result: EffortResult,
    topics: Mapping[str, str],
    options: RecordingOptions,
) -> dict[str, EffortError]:
    """Return joint -> error of the written model, read like any other model."""
    written = dict(
        zip(
            (column.name for column in result.regressor.columns),
            result.physical.parameters.tolist(),
            strict=True,
        )
    )
    if result.delay is not None:
        written[result.delay.name] = result.delay.value
    fitted = load_written(folder)
    signals = options if fitted.twin is None else options.over(fitted.twin.recordings)
    errors = effort_errors(
        fitted, recordings, EffortRecord(written, {}, result.filter, result.samples[0].rest),
        topics, signals,
    )  # fmt: skip
    return {joint: error for joint, error in errors.items() if joint in result.errors}


def _without_effort(
    error: RecordingError, recordings: Sequence[MeasuredRecording]
) -> RecordingError:
    """Extend the error on unusable commands by the reason why efforts are unusable."""
    why = "; ".join(dict.fromkeys(note for one in recordings for note in one.notes))
    return RecordingError(
        f"{error.problem}, and no effort that can be used: {why or 'none is recorded'}",
        path=error.path,
        where=error.where,
        value=error.value,
        expected=error.expected,
    )


def _new_folder(folder: Path) -> Path:
    folder.mkdir()
    return folder


@dataclass(frozen=True, slots=True)
class _Inputs:
    """Inputs of an identification.

    Attributes:
        realization: the model as identified.
        given: path of the MODEL that the user named.
        folder: folder that the record will be in.
        recordings: all recordings.
    """

    realization: Realization
    given: Path
    name: str
    folder: Path
    recordings: Sequence[Path]

    def add(self, document: dict[str, Any], notes: Sequence[str], uses: Uses) -> dict[str, Any]:
        """Return the document with its id, and with digests and content of its inputs."""
        realization = self.realization
        document["notes"] = [*notes, *document["notes"]]
        document["identification"] = self.name
        document["inputs"] = {
            path.name: {"sha256": file_sha256(path)}
            for path in (self.given, *self.recordings, realization.path)
            if path.is_file()
        }
        document["basis"] = basis_json(
            unfitted(realization), uses, realization.twin, self.folder,
            {path.name: path for path in self.recordings},
            has_twin=realization.twin is not None,
        )  # fmt: skip
        document["realization"] = f"{REALIZATION}/"
        return document


def _uses(realization: Realization, recordings: MeasuredRecordings, *, simulated: bool) -> Uses:
    """Return the parts that the fit of a robot's motion uses."""

    measured = (*recordings.fit, *recordings.held_out)

    def named(key: str) -> tuple[str, ...]:
        return tuple(sorted({one.metadata[key] for one in measured if key in one.metadata}))

    joints = {joint for one in measured for joint in one.joints}
    return Uses(
        joints=tuple(joint for joint in realization.joints if joint in joints),
        simulated=simulated,
        controllers=named("controller"),
        payloads=named("payload"),
    )


def _paths(measured: Sequence[MeasuredRecording]) -> list[Path]:
    return list(dict.fromkeys(one.path for one in measured))


def _from_commands(
    realization: Realization,
    recordings: Sequence[Path],
    held_out: Sequence[Path],
    topics: Mapping[str, str],
    options: RecordingOptions,
    folder: Path,
    progress: Callable[[float], None],
) -> dict[str, Any]:
    """Identify without efforts, by closed-loop simulation of the recorded commands."""
    from pytest_twin.diagnosis.patched.model import read_patched_model
    from pytest_twin.diagnosis.patched.write import RecordingSettings, write_realization
    from pytest_twin.diagnosis.trials import read_trials
    from pytest_twin.diagnosis.unit_check import drop_other_units
    from pytest_twin.identification.simulation.document import simulation_document
    from pytest_twin.identification.simulation.identify_by_simulation import identify_simulation
    from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings

    trials = read_trials(recordings, held_out, topics, realization.structure, options)
    inherited = read_patched_model(realization)
    if inherited is None:
        refuse_other_order(realization, trials.fit)
    notes: list[str] = []
    trials = drop_other_units(realization, trials, notes)
    trials = replace(trials, notes=(*notes, *trials.notes))
    with suppress_mujoco_warnings():
        result = identify_simulation(
            realization, trials,
            inherited=inherited, progress=lambda fraction: progress(0.3 + 0.6 * fraction),
        )  # fmt: skip
        write_realization(
            folder, realization, result.prepared.problem, result.hypothesis, inherited,
            RecordingSettings(
                result.prepared.cold_fractions, result.prepared.substeps,
                result.signals.found_between
            ),
        )  # fmt: skip
    document = simulation_document(result)
    document["fit"] = {}
    document["frequency_response"] = frequency_responses(
        load_written(folder), result.trials.held_out or result.trials.fit
    )
    document["trials"] = {
        "fit": list(dict.fromkeys(t.path.name for t in result.trials.fit)),
        "held_out": list(dict.fromkeys(t.path.name for t in result.trials.held_out)),
    }
    return document


def _load(path: Path, ident: str, base: Base | None) -> tuple[Realization, list[str]]:
    """Load the model with its twin, without shapes if meshes of a URDF are missing.

    An earlier record of the same id is left out: the record is made afresh from the same inputs.
    """
    twin: Twin | None = None
    name = "mujoco"
    if path.suffix.lower() in (".yaml", ".yml"):
        twin = load_twin(path).before_fit(ident)
        first = twin.first_realization
        name, path = first.name, first.file
    as_declared = partial(load, path, twin=twin, name=name, accept_invalid_inertia=True, base=base)
    try:
        return as_declared(), []
    except PathError as error:
        if path.suffix.lower() != ".urdf":
            raise
        loaded = as_declared(shapes=False)
        return loaded, [
            f"the model is used without its shapes, which no effort depends on: {error}"
        ]
