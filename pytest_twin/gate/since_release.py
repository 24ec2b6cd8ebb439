"""What changed since the newest release, where a golden fails against its recording.

A recording that proved the release is old: if it fails now, the model changed, not the robot. A new
recording is compared with those that proved the release.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pytest_twin.diagnosis.not_separated import state_not_separated
from pytest_twin.formats import atomic, results
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.temporary import temporary_folder
from pytest_twin.gate.failure_diagnosis import DIAGNOSIS_FILE, REPORT_FILE
from pytest_twin.gate.released_model import (
    Released,
    model_changes,
    reference_recordings,
    released_beside,
)
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.release.released_files import copy_release, release_folder
from pytest_twin.report import changes
from pytest_twin.twin import Twin
from pytest_twin.words import counted, list_names

_SECONDS = 120.0
"""Limit of a comparison by simulation, s of processor time. By measured effort it takes one."""


def since_release(
    twin: Twin, failed: Sequence[Path], folder: Path, sandbox: Sandbox
) -> tuple[str, ...]:
    """Return lines for the terminal; none without a valid release that has recordings.

    Args:
        failed: recordings of the failed goldens.
        folder: folder in the form of ``diagnose --before``, written if a recording is new.

    Raises:
        TwinError: the release or a recording cannot be used.
    """
    released = released_beside(twin.path, failed)
    if released is None:
        return ()
    number = released.release.number
    with temporary_folder() as scratch:
        copy, root = Path(scratch).resolve(), twin.path.parent
        released_model = copy_release(released.release, release_folder(root, number), root, copy)
        references = reference_recordings(root, released.release, copy)
        digests = {file_sha256(path) for path in references}
        old = [path for path in failed if path.is_file() and file_sha256(path) in digests]
        new = [path for path in failed if path.is_file() and path not in old]
        lines: tuple[str, ...] = ()
        if old:
            lines += _of_model(twin, released, released_model, old, sandbox)
        if new and references:
            lines += _of_robot(twin, number, new, references, folder, sandbox)
    return lines


def _of_model(
    twin: Twin, released: Released, released_model: Path, old: Sequence[Path], sandbox: Sandbox
) -> tuple[str, ...]:
    """Old recordings fail: which part of the model makes the error?"""
    names = list_names([path.name for path in old])
    request = {"recordings": [str(path) for path in old], "topics": {}, "options": {}}
    parts = model_changes(twin.path, released_model, sandbox, request) if released.changes else []
    return (
        f"{names} proved release {released.release.number}: the robot is as it was then",
        *changes.model_lines({"model_changes": parts}),
        *released.notes,
    )


def _of_robot(
    twin: Twin,
    number: int,
    new: Sequence[Path],
    references: Sequence[Path],
    folder: Path,
    sandbox: Sandbox,
) -> tuple[str, ...]:
    """New recordings fail: what changed in the robot since those of the release?"""
    with results.result_folder(folder, DIAGNOSIS_FILE) as staging:
        document: dict[str, Any] = sandbox.call(
            "pytest_twin.changes.compare_files:compare_files",
            {
                "request": {
                    "model": str(twin.path),
                    "before": [str(path) for path in references],
                    "new": [str(path) for path in new],
                    "release": number,
                    "seconds": _SECONDS,
                    "out": str(staging),
                }
            },
        )
        state_not_separated(document, twin.path, folder)
        write_comparison(staging, document)
    return (
        f"compared with the {counted(len(references), 'recording')} that proved release {number}:",
        *changes.words(document),
        f"report: {folder / REPORT_FILE}",
    )


def write_comparison(folder: Path, document: dict[str, Any]) -> None:
    """Write the document of a comparison and its page."""
    atomic.write_json(folder / DIAGNOSIS_FILE, document)
    atomic.write_text(folder / REPORT_FILE, changes.render(document))
