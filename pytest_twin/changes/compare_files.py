"""Compare recordings of one robot, from their files to the document."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.changes.by_simulation import find_changes_by_simulation
from pytest_twin.changes.document import changes_document
from pytest_twin.changes.find_changes import find_changes
from pytest_twin.changes.recordings import (
    has_efforts,
    read_compared,
    refuse_without_commands,
)
from pytest_twin.changes.simulated_document import simulated_document
from pytest_twin.changes.trials import read_compared_trials
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
    if has_efforts(compared.every):
        progress(0.4)
        found = find_changes(loaded.realization, compared, asked.level)
        progress(0.95)
        return changes_document(found, level=asked.level, release=asked.release)
    refuse_without_commands(compared)
    with suppress_mujoco_warnings():
        by_simulation = find_changes_by_simulation(
            loaded.realization,
            read_compared_trials(loaded.realization, before, new, held_out, topics, options),
            asked.level, budget, loaded.patched, progress,
        )  # fmt: skip
    return simulated_document(by_simulation, level=asked.level, release=asked.release)
