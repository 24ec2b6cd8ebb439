"""Compare recordings of one robot, from their files to the document."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.changes.document import changes_document
from pytest_twin.changes.find_changes import find_changes
from pytest_twin.changes.recordings import has_efforts, read_compared
from pytest_twin.errors import RecordingError
from pytest_twin.loaded_model import load_model
from pytest_twin.recording_options import RecordingOptions


@dataclass(frozen=True, slots=True)
class ComparisonRequest:
    """Request of a comparison, as passed between processes.

    Attributes:
        before, new, held_out: files and folders of earlier and later recordings.
        level: probability of an alarm if nothing changed.
        release: number of the release whose recordings are the earlier ones.
    """

    model: str
    before: Sequence[str]
    new: Sequence[str]
    held_out: Sequence[str] = ()
    topics: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    level: float = 0.05
    release: int | None = None


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
    options = RecordingOptions.from_json(asked.options)
    loaded = load_model(Path(asked.model), options.base)
    progress(0.1)
    compared = read_compared(
        loaded.realization,
        [Path(p) for p in asked.before],
        [Path(p) for p in asked.new],
        [Path(p) for p in asked.held_out],
        {**loaded.topics, **asked.topics},
        options.over(loaded.options),
    )
    if not has_efforts(compared.every):
        first = next(one for one in compared.every if not has_efforts([one]))
        raise RecordingError(
            "no measured effort of a joint in every recording",
            path=first.path,
            where="effort",
            expected="efforts in the earlier and the new recordings: --before compares them",
        )
    progress(0.4)
    found = find_changes(loaded.realization, compared, asked.level)
    progress(0.95)
    return changes_document(found, level=asked.level, release=asked.release)
