"""Functions of the child process: load a realization, run goldens on it, return the results."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from pytest_twin.checks import Check, Observation, Trace, check_of
from pytest_twin.errors import SpecError, TwinError
from pytest_twin.formats.trace import read_trace, trace_text
from pytest_twin.gate.noise import without_rounding_errors
from pytest_twin.gate.specs import load_golden
from pytest_twin.golden import Golden
from pytest_twin.outcome import Measure
from pytest_twin.realization import Realization, load
from pytest_twin.realization.features.cache import Features
from pytest_twin.realization.features.stated_elements import elements_part
from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings
from pytest_twin.realization.record_inputs import load_unfitted, replaced_parts
from pytest_twin.report.plots import plot
from pytest_twin.trial import make_trials, recording_at
from pytest_twin.twin import RealizationRef, Twin, load_twin

Progress = Callable[[float], None]
_DIAGNOSIS_SECONDS = 3600.0
"""Limit of the processor time of a diagnosis, s: its best result is written then."""


def run_golden(
    twin: str, spec: str, realization: str, plots: str, progress: Progress
) -> dict[str, Any]:
    """Run one golden.

    Args:
        twin, spec: paths of ``twin.yaml`` and of the golden.
        realization: its name in ``twin.yaml``.
        plots: ``all``, or ``failed`` for plots of failed goldens only.
        progress: called with the fraction that is done, 0 to 1.

    Returns:
        ``measures``, ``plot``: SVG text or None, and ``notes``.

    Raises:
        TwinError: an error of the check, the model or a file.
    """
    golden, loaded, check = _open(Path(twin), Path(spec), realization)
    with suppress_mujoco_warnings():
        observation = check.observe(golden, loaded, progress)
    stored = _stored_trace(golden)
    return _comparison(golden, check, observation, stored, plots=plots)


def quick_diagnosis(twin: str, spec: str, realization: str, failed: list[str]) -> dict[str, str]:
    """Name the probable cause why a golden fails against its recording, in one line.

    Args:
        twin, spec: paths of ``twin.yaml`` and of the golden.
        realization: its name in ``twin.yaml``.
        failed: subjects of the exceeded tolerances, such as joints.

    Returns:
        ``line``.

    Raises:
        TwinError: the recording or the model cannot be used.
    """
    from pytest_twin.diagnosis.patched.model import read_patched_model
    from pytest_twin.diagnosis.quick_diagnosis import quick_diagnosis as diagnose_quickly
    from pytest_twin.report.quick_diagnosis import quick_diagnosis_in_words

    golden, loaded, check = _open(Path(twin), Path(spec), realization)
    with suppress_mujoco_warnings():
        seen = diagnose_quickly(
            loaded, check.trial(golden, loaded), read_patched_model(loaded), failed
        )
    return {"line": quick_diagnosis_in_words(seen)}


def diagnose(
    twin: str,
    realization: str,
    failed: list[tuple[str, int | None]],
    others: list[tuple[str, int | None]],
    out: str,
    folder: str,
    progress: Progress,
) -> dict[str, Any]:
    """Diagnose a realization from recordings; write the same folder as ``pytest-twin diagnose``.

    Args:
        twin: path of ``twin.yaml``.
        failed: recordings to explain: path, and the episode of a data set or None.
        others: further recordings; those with the same command mode are used.
        out: an empty folder.
        folder: folder that it becomes.
        progress: called with the fraction that is done, 0 to 1.

    Returns:
        ``verdict``, and ``words``: the lines for a terminal.

    Raises:
        TwinError: the model or the recordings cannot be used.
    """
    from pytest_twin.diagnosis.budget import Budget
    from pytest_twin.diagnosis.run import Run
    from pytest_twin.diagnosis.trials import read_trials
    from pytest_twin.gate.diagnosis_folder import write_diagnosis
    from pytest_twin.processor_time import call_began

    loaded = _realization(Path(twin), realization)
    described = _twin(Path(twin))
    wanted = {_command_mode(*one, loaded) for one in failed} - {None}
    alike = [one for one in others if not wanted or _command_mode(*one, loaded) in wanted]
    episodes: dict[Path, set[int]] = {}
    for path, episode in (*failed, *alike):
        if episode is not None:
            episodes.setdefault(Path(path), set()).add(episode)
    trials = read_trials(
        list(dict.fromkeys(Path(path) for path, _ in (*failed, *alike))),
        [],
        described.topics,
        loaded.structure,
        described.recordings,
        episodes,
    )
    return write_diagnosis(
        Path(out),
        loaded,
        trials,
        model=f"{described.name}, {realization}",
        progress=progress,
        run=Run(Budget(_DIAGNOSIS_SECONDS, begin=call_began())),
        record_folder=Path(folder),
    )


def _command_mode(path: str, episode: int | None, realization: Realization) -> str | None:
    """Command mode of a recording (position, velocity, effort); None where it cannot be read."""
    twin = realization.twin
    assert twin is not None
    try:
        recording = recording_at(Path(path), twin.topics, twin.recordings, episode)
        return make_trials(recording, realization.structure, twin.recordings)[0].command_mode
    except TwinError:
        return None


def record(twin: str, spec: str, realization: str, progress: Progress) -> dict[str, Any]:
    """Run one golden and return the values to record.

    Returns:
        ``expected``, ``trace`` (CSV text or None), ``measures``: comparison of the observation with
        the new record and with independent references, and ``moved``: deviations from the previous
        record that are not zero.

    Raises:
        TwinError: as :func:`run_golden`.
    """
    golden, loaded, check = _open(Path(twin), Path(spec), realization)
    with suppress_mujoco_warnings():
        observation = check.observe(golden, loaded, progress)
    expected, trace = without_rounding_errors(*check.expect(golden, observation))
    recorded = replace(golden, expected=expected or None)
    moved: list[Measure] = []
    if golden.provenance is not None:
        before = check.compare(golden, observation, _stored_trace(golden))
        moved = [measure for measure in before if measure.against == "golden" and measure.error]
    return {
        "expected": dict(expected),
        "trace": None if trace is None else trace_text(trace),
        "moved": [measure.to_json() for measure in moved],
        **_comparison(recorded, check, observation, trace, plots="none"),
    }


def _comparison(
    golden: Golden,
    check: Check,
    observation: Observation,
    stored: Trace | None,
    *,
    plots: str,
) -> dict[str, Any]:
    measures = check.compare(golden, observation, stored)
    failed = not all(measure.passed for measure in measures)
    # An audit has sentences and no numbers to draw.
    in_numbers = any(measure.against != "audit" for measure in measures)
    drawn = in_numbers and (plots == "all" or (plots == "failed" and failed))
    return {
        "measures": [measure.to_json() for measure in measures],
        "plot": _plot(golden, measures, observation, stored) if drawn else None,
        "notes": list(observation.notes),
    }


def _open(twin: Path, spec: Path, realization: str) -> tuple[Golden, Realization, Check]:
    loaded = _twin(twin)
    golden = load_golden(spec, loaded)
    check, simulator = check_of(golden.kind), loaded.realizations[realization].simulator
    if simulator not in check.simulators:
        raise SpecError(
            f"a golden of kind {golden.kind} is not computed on {simulator}",
            path=golden.path,
            where="realizations",
            value=realization,
            expected=f"realizations on {' or '.join(check.simulators)}",
        )
    return golden, _realization(twin, realization), check


def _stored_trace(golden: Golden) -> Trace | None:
    if golden.trace is None:
        return None
    return read_trace(golden.path.parent / golden.trace.file, golden.trace.sha256)


def _plot(
    golden: Golden, measures: list[Measure], observation: Observation, stored: Trace | None
) -> str | None:
    against = observation.against or stored
    title = golden.title or golden.id
    drawn = plot(golden.kind, title, measures, observation.trace, against)
    return None if drawn is None else drawn.decode()


@lru_cache(maxsize=8)
def _twin(path: Path) -> Twin:
    return load_twin(path)


@lru_cache(maxsize=8)
def _realization(twin: Path, name: str) -> Realization:
    loaded = _twin(twin)
    reference = loaded.realizations[name]
    return load(reference.file, twin=loaded, name=name, simulator=reference.simulator)


def features(twin: str, realization: str) -> dict[str, Any]:
    """Parts, structure and files of a realization, for the dependency map."""
    loaded = _realization(Path(twin), realization)
    replaced = replaced_parts(loaded)
    elements = elements_part(loaded)
    parts = {**loaded.parts, elements.id: elements}
    structure = replace(loaded.structure, part_ids=frozenset(parts))
    return Features(parts, structure, loaded.source.files, replaced).to_json()


def source_features(twin: str, name: str, model: str) -> dict[str, Any]:
    """Parts, structure and files of another model that a record was made with."""
    loaded = load_unfitted(_twin(Path(twin)), RealizationRef(name, Path(model)))
    return Features(loaded.parts, loaded.structure, loaded.source.files).to_json()
