"""Why goldens fail against their recordings: one full diagnosis of each realization, at the end.

The recordings of the goldens that failed are diagnosed together with those of the other goldens of
the same realization that depend on a recording; which are fitted and which held out, their own
metadata says.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from pytest_twin.checks import check_of
from pytest_twin.checks.files import find_file
from pytest_twin.errors import TwinError
from pytest_twin.formats import atomic
from pytest_twin.gate.gate import Gate, Progress
from pytest_twin.golden import Golden
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.report.text import printable

FOLDER = Path(".twin") / "diagnosis"
"""Below the twin's root: a folder for each realization, as ``pytest-twin diagnose`` writes it."""
DIAGNOSIS_FILE = "diagnosis.json"
REPORT_FILE = "report.html"
REALIZATION = "realization"
Recorded: TypeAlias = tuple[str, int | None]
"""Path of a recording; of a data set also its episode."""
_SECONDS = 3600.0


@dataclass(frozen=True, slots=True)
class Diagnosed:
    """What came of the diagnosis of one realization.

    Attributes:
        realization: its name.
        goldens: keys of those that failed.
        report: the page, None where no diagnosis could be made.
        lines: what a terminal shows: the verdict first; or why there is none.
    """

    realization: str
    goldens: tuple[str, ...]
    report: Path | None
    lines: tuple[str, ...]


def diagnose_failures(
    gate: Gate, say: Callable[[str], None], progress: Progress | None = None
) -> list[Diagnosed]:
    """Diagnose every realization on which a golden failed against its recording.

    Args:
        gate: after its goldens ran.
        say: called with a line when a diagnosis begins.
        progress: called with the fraction done.
    """
    return [
        _diagnosed(gate, realization, failed, say, progress)
        for realization, failed in _failed(gate).items()
    ]


def _failed(gate: Gate) -> dict[str, list[Golden]]:
    """Realization -> goldens that failed on it and depend on a recording."""
    found: dict[str, list[Golden]] = {}
    for task in gate.plan().tasks.values():
        outcome = gate.outcomes.get(task.key)
        if outcome is not None and outcome.status == "failed" and check_of(outcome.kind).recorded:
            found.setdefault(task.realization, []).append(task.golden)
    return found


def _diagnosed(
    gate: Gate,
    realization: str,
    failed: list[Golden],
    say: Callable[[str], None],
    progress: Progress | None,
) -> Diagnosed:
    goldens = tuple(f"{golden.id}@{realization}" for golden in failed)
    try:
        recordings = [_recording(gate, golden) for golden in failed]
        others = [r for r in _others(gate, realization) if r not in recordings]
        count = len({*recordings, *others})
        say(
            f"twin {gate.twin.name}: diagnosing {realization} over {count} "
            f"recording{'s' if count > 1 else ''}"
        )
        report, lines = _written(gate, realization, recordings, others, progress)
    except (TwinError, OSError) as error:
        text = f"no diagnosis of {realization}: {' '.join(str(error).split())}"
        return Diagnosed(realization, goldens, None, (printable(text),))
    return Diagnosed(realization, goldens, report, lines)


def _recording(gate: Gate, golden: Golden) -> Recorded:
    path = find_file(golden, "target.recording", golden.target["recording"], gate.twin)
    return str(path), golden.target.get("episode")


def _others(gate: Gate, realization: str) -> Iterator[Recorded]:
    """Recordings of all goldens of a realization; of those that can be found."""
    for task in gate.plan().tasks.values():
        if task.realization == realization and check_of(task.golden.kind).recorded:
            try:
                yield _recording(gate, task.golden)
            except TwinError:
                # Its own golden says so.
                continue


def _written(
    gate: Gate,
    realization: str,
    recordings: list[Recorded],
    others: list[Recorded],
    progress: Progress | None,
) -> tuple[Path, tuple[str, ...]]:
    folder = gate.root / FOLDER
    atomic.make_folder(folder)
    with tempfile.TemporaryDirectory(prefix=".twin-", dir=folder) as scratch:
        staging = Path(scratch) / "diagnosis"
        staging.mkdir()
        # A process of its own: the simulator writes its log into the working folder.
        with Sandbox(seconds=_SECONDS, cwd=Path(scratch)) as sandbox:
            said = sandbox.call(
                "pytest_twin.gate.worker:diagnose",
                {
                    "twin": str(gate.twin.path),
                    "realization": realization,
                    "failed": list(dict.fromkeys(recordings)),
                    "others": list(dict.fromkeys(others)),
                    "out": str(staging),
                },
                progress=progress,
            )
        atomic.replace_directory(staging, folder / realization)
    return folder / realization / REPORT_FILE, tuple(printable(line) for line in said["words"])
