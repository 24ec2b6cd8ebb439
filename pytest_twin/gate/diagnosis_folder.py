"""Write the folder of a diagnosis: patched model, ``diagnosis.json`` and report.

This module runs in the child process.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pytest_twin.diagnosis.diagnose import diagnose
from pytest_twin.diagnosis.not_separated import state_not_separated
from pytest_twin.diagnosis.patched.frequency import frequency_responses
from pytest_twin.diagnosis.patched.model import read_patched_model
from pytest_twin.diagnosis.patched.write import RecordingSettings, load_written, write_realization
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.formats import atomic
from pytest_twin.gate.diagnosis_view import view_of
from pytest_twin.gate.failure_diagnosis import DIAGNOSIS_FILE, REALIZATION, REPORT_FILE
from pytest_twin.realization import Realization
from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings
from pytest_twin.realization.record_inputs import basis_json, unfitted
from pytest_twin.records.basis import Uses
from pytest_twin.report.diagnosis import render, words


# Its keywords are independent of each other, and most callers give one or two.
def write_diagnosis(  # noqa: PLR0913
    folder: Path,
    realization: Realization,
    trials: TrialSet,
    *,
    model: str,
    threads: int = 0,
    progress: Callable[[float], None],
    run: Run | None = None,
    record_folder: Path | None = None,
) -> dict[str, Any]:
    """Diagnose a model, and write the result into an empty folder.

    Args:
        folder: an empty folder.
        realization: the nominal model, with the effects next to it if an earlier diagnosis wrote
            it.
        model: name of the model in the report.
        threads: number of threads of the simulations, 0 for all cores.
        progress: called with the fraction that is done, 0 to 1.
        run: time limit and receiver of progress messages; no time limit by default.
        record_folder: folder that ``folder`` becomes; itself by default.

    Returns:
        ``verdict``, and ``words``: the lines for a terminal.

    Raises:
        TwinError: the model or the recordings cannot be used, or the folder cannot be written.
    """
    inherited = read_patched_model(realization)
    run = run or Run()
    with suppress_mujoco_warnings():
        found = diagnose(
            realization, trials,
            inherited=inherited, threads=threads, run=run, progress=progress,
        )  # fmt: skip
        (folder / REALIZATION).mkdir()
        patched = write_realization(
            folder / REALIZATION,
            realization,
            found.prepared.problem,
            found.free.hypothesis,
            inherited,
            RecordingSettings(
                found.prepared.cold_fractions, found.prepared.substeps, found.signals.found_between
            ),
        )
        fitted = load_written(folder / REALIZATION)
        frequency = frequency_responses(fitted, found.tested.trials.held_out or trials.fit)
    said = {**found.to_json(realization=f"{REALIZATION}/"), "frequency_response": frequency}
    said["basis"] = _basis(realization, trials, record_folder or folder)
    twin = realization.twin
    state_not_separated(
        said, realization.path if twin is None else twin.path, record_folder or folder
    )
    atomic.write_text(folder / DIAGNOSIS_FILE, json.dumps(said, indent=2, allow_nan=False) + "\n")
    progress(0.96)
    view = view_of(found, said, patched, model)
    atomic.write_text(folder / REPORT_FILE, render(view))
    progress(1.0)
    return {"verdict": found.verdict, "words": words(said)}


def _basis(realization: Realization, trials: TrialSet, folder: Path) -> dict[str, Any]:
    """Return the inputs of the patched model."""
    every = (*trials.fit, *trials.held_out)

    def named(key: str) -> tuple[str, ...]:
        return tuple(sorted({trial.metadata[key] for trial in every if key in trial.metadata}))

    joints = {joint for trial in every for joint in trial.joints}
    uses = Uses(
        joints=tuple(joint for joint in realization.joints if joint in joints),
        controllers=named("controller"),
        payloads=named("payload"),
    )
    return basis_json(
        unfitted(realization), uses, realization.twin, folder,
        {trial.path.name: trial.path for trial in every},
        has_twin=realization.twin is not None,
    )  # fmt: skip
