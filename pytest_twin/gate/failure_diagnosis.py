"""Diagnose each realization whose goldens failed against recordings, at the end of a run.

A diagnosis uses the recordings of the failed goldens and of all other goldens of the same
realization. The metadata of a recording decide whether it is fitted or held out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from pytest_twin.checks import check_of
from pytest_twin.checks.files import find_file
from pytest_twin.errors import TwinError
from pytest_twin.formats import results
from pytest_twin.formats.temporary import temporary_folder
from pytest_twin.gate.gate import Gate, Progress
from pytest_twin.golden import Golden
from pytest_twin.interrupts import stop_on_interrupt
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.report.text import printable

FOLDER = Path(".twin") / "diagnosis"
"""Folder below the twin's root; for each realization a folder in the form of ``diagnose``."""
DIAGNOSIS_FILE = "diagnosis.json"
REPORT_FILE = "report.html"
REALIZATION = "realization"
RecordingRef: TypeAlias = tuple[str, int | None]
"""Path of a recording, and the episode where it is a data set."""
_SECONDS = 4 * 3600.0
"""Wall time after which the child process of a diagnosis is ended as hung, s. The search ends
earlier, by its processor time, with its best result."""


@dataclass(frozen=True, slots=True)
class RealizationDiagnosis:
    """Result of the diagnosis of one realization.

    Attributes:
        goldens: keys of the failed goldens.
        report: path of the report, None where the diagnosis was not possible.
        lines: lines for the terminal, the verdict first; or the reason for no diagnosis.
    """

    realization: str
    goldens: tuple[str, ...]
    report: Path | None
    lines: tuple[str, ...]


def diagnose_failures(
    gate: Gate, say: Callable[[str], None], progress: Progress | None = None
) -> list[RealizationDiagnosis]:
    """Diagnose every realization on which a golden failed against its recording.

    Args:
        gate: after its goldens ran.
        say: called with a line when a diagnosis begins.
        progress: called with the fraction that is done, 0 to 1.
    """
    return [
        _diagnose_realization(gate, realization, failed, say, progress)
        for realization, failed in _failed_goldens(gate).items()
    ]


def _failed_goldens(gate: Gate) -> dict[str, list[Golden]]:
    """Realization -> goldens that failed on it against a recording."""
    found: dict[str, list[Golden]] = {}
    for task in gate.plan().tasks.values():
        outcome = gate.outcomes.get(task.key)
        if outcome is not None and outcome.status == "failed" and check_of(outcome.kind).recorded:
            found.setdefault(task.realization, []).append(task.golden)
    return found


def _diagnose_realization(
    gate: Gate,
    realization: str,
    failed: list[Golden],
    say: Callable[[str], None],
    progress: Progress | None,
) -> RealizationDiagnosis:
    goldens = tuple(f"{golden.id}@{realization}" for golden in failed)
    try:
        recordings = [_recording(gate, golden) for golden in failed]
        others = [r for r in _other_recordings(gate, realization) if r not in recordings]
        count = len({*recordings, *others})
        say(
            f"twin {gate.twin.name}: diagnosing {realization} over {count} "
            f"recording{'s' if count > 1 else ''}"
        )
        report, lines = _write_diagnosis(gate, realization, recordings, others, progress)
    except (TwinError, OSError) as error:
        text = f"no diagnosis of {realization}: {' '.join(str(error).split())}"
        return RealizationDiagnosis(realization, goldens, None, (printable(text),))
    # What changed since the release comes before what any model would lack.
    lines = (*lines[:1], *_since_release(gate, realization, recordings), *lines[1:])
    return RealizationDiagnosis(realization, goldens, report, lines)


def _since_release(gate: Gate, realization: str, failed: list[RecordingRef]) -> tuple[str, ...]:
    """Lines on what changed since the newest release, as ``diagnose --before`` says it."""
    # It reads signatures, which collecting goldens does without.
    from pytest_twin.gate.since_release import since_release

    if realization != gate.twin.first_realization.name:
        return ()
    try:
        with (
            temporary_folder() as scratch,
            stop_on_interrupt() as stop,
            Sandbox(
                seconds=_SECONDS, cwd=scratch, untrusted=gate.runner.untrusted, stop=stop
            ) as sandbox,
        ):
            paths = [Path(path) for path in dict.fromkeys(path for path, _ in failed)]
            folder = gate.root / FOLDER / f"{realization}_since_release"
            return tuple(map(printable, since_release(gate.twin, paths, folder, sandbox)))
    except (TwinError, OSError) as error:
        text = f"not compared with the release: {' '.join(str(error).split())}"
        return (printable(text),)


def _recording(gate: Gate, golden: Golden) -> RecordingRef:
    path = find_file(golden, "target.recording", golden.target["recording"], gate.twin)
    return str(path), golden.target.get("episode")


def _other_recordings(gate: Gate, realization: str) -> Iterator[RecordingRef]:
    """Recordings of all goldens of a realization, as far as their files exist."""
    for task in gate.plan().tasks.values():
        if task.realization == realization and check_of(task.golden.kind).recorded:
            try:
                yield _recording(gate, task.golden)
            except TwinError:
                # The error is reported as the result of that golden.
                continue


def _write_diagnosis(
    gate: Gate,
    realization: str,
    recordings: list[RecordingRef],
    others: list[RecordingRef],
    progress: Progress | None,
) -> tuple[Path, tuple[str, ...]]:
    folder = gate.root / FOLDER / realization
    with (
        results.result_folder(folder, DIAGNOSIS_FILE) as staging,
        # A separate process, because MuJoCo writes its log into the working directory.
        temporary_folder() as scratch,
        stop_on_interrupt() as stop,
        Sandbox(
            seconds=_SECONDS, cwd=scratch, untrusted=gate.runner.untrusted, stop=stop
        ) as sandbox,
    ):
        said = sandbox.call(
            "pytest_twin.gate.worker:diagnose",
            {
                "twin": str(gate.twin.path),
                "realization": realization,
                "failed": list(dict.fromkeys(recordings)),
                "others": list(dict.fromkeys(others)),
                "out": str(staging),
                "folder": str(folder),
            },
            progress=progress,
        )
    return folder / REPORT_FILE, tuple(printable(line) for line in said["words"])
