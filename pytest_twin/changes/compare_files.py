"""Compare recordings of one robot, from their files to the document."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.changes.by_simulation import find_changes_by_simulation
from pytest_twin.changes.declared import declared_differences
from pytest_twin.changes.document import changes_document
from pytest_twin.changes.find_changes import find_changes
from pytest_twin.changes.recordings import (
    has_efforts,
    read_compared,
    refuse_without_commands,
)
from pytest_twin.changes.simulated_document import simulated_document
from pytest_twin.changes.trials import read_compared_trials
from pytest_twin.changes.undone import REALIZATION, write_changed_model
from pytest_twin.diagnosis.budget import Budget
from pytest_twin.loaded_model import load_model
from pytest_twin.processor_time import call_began
from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings
from pytest_twin.recording_options import RecordingOptions


@dataclass(frozen=True, slots=True)
class ComparisonRequest:
    """Request of a comparison, as passed between processes.

    Attributes:
        before, new, held_out: files and folders of earlier and later recordings.
        level: probability of an alarm if nothing changed.
        release: number of the release whose recordings are the earlier ones.
        seconds: limit of the processor time, s; 0 for no limit.
        out: empty folder, in which the model with its changes is written.
    """

    model: str
    before: Sequence[str]
    new: Sequence[str]
    held_out: Sequence[str] = ()
    topics: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    level: float = 0.05
    release: int | None = None
    seconds: float = 0.0
    out: str = ""


def compare_files(
    request: Mapping[str, Any], progress: Callable[[float], None] = lambda fraction: None
) -> dict[str, Any]:
    """Load, compare, and return the content of ``diagnosis.json``; runs in the child process.

    Args:
        request: fields of :class:`ComparisonRequest`.
        progress: called with the fraction done.

    Raises:
        TwinError: the input cannot be used.
    """
    asked = ComparisonRequest(**request)
    budget = Budget(asked.seconds, begin=call_began())
    options = RecordingOptions.from_json(asked.options)
    loaded = load_model(Path(asked.model), options.base)
    progress(0.02)
    before, new, held_out = (
        [Path(p) for p in paths] for paths in (asked.before, asked.new, asked.held_out)
    )
    topics, options = {**loaded.topics, **asked.topics}, options.over(loaded.options)
    compared = read_compared(loaded.realization, before, new, held_out, topics, options)
    recordings = compared.before, [*compared.new, *compared.held_out]
    if has_efforts(compared.every):
        progress(0.4)
        found = find_changes(loaded.realization, compared, asked.level)
        progress(0.95)
        document = changes_document(found, level=asked.level, release=asked.release)
        return document | {"declared": declared_differences(loaded.realization, *recordings)}
    refuse_without_commands(compared)
    with suppress_mujoco_warnings():
        by_simulation = find_changes_by_simulation(
            loaded.realization,
            read_compared_trials(loaded.realization, before, new, held_out, topics, options),
            asked.level, budget, loaded.patched, progress,
        )  # fmt: skip
        counterfactual = None
        if by_simulation.found is not None and asked.out:
            tested = by_simulation.found.tested
            folder = Path(asked.out) / REALIZATION
            folder.mkdir()
            counterfactual = write_changed_model(
                folder, loaded.realization, by_simulation.known, loaded.patched,
                tested.prepared.problem, tested.explanation.hypothesis,
            )  # fmt: skip
    document = simulated_document(
        by_simulation, level=asked.level, release=asked.release, counterfactual=counterfactual
    )
    return document | {"declared": declared_differences(loaded.realization, *recordings)}
