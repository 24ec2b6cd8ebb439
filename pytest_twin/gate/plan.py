"""What runs and why: goldens and parts of today against the last release. Pure."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from pytest_twin import staleness
from pytest_twin.dependency import Part
from pytest_twin.golden import Golden
from pytest_twin.outcome import Outcome, Reason

if TYPE_CHECKING:
    from pytest_twin.release import Proof, Release

NEVER_PROVEN = "never recorded: run pytest --twin-update"


@dataclass(frozen=True, slots=True)
class Task:
    """One golden on one realization.

    Attributes:
        parts: ids of everything that its result depends on today, sorted.
        reasons: why the last release does not prove it; empty where it does.
        proof: what the last release says of it, None where it knows nothing.
    """

    golden: Golden
    realization: str
    parts: tuple[str, ...]
    reasons: tuple[Reason, ...]
    proof: Proof | None

    @property
    def key(self) -> str:
        """``golden@realization``."""
        return f"{self.golden.id}@{self.realization}"

    @property
    def is_stale(self) -> bool:
        """Whether it has to run."""
        return bool(self.reasons)


@dataclass(frozen=True, slots=True)
class Plan:
    """Every golden of one twin, with what was found out before anything ran.

    Attributes:
        tasks: ``golden@realization`` -> task.
        parts: part id -> part, today.
        baseline: the last release that holds.
        missing: ids of goldens that were released before, are gone, and are not retired.
        dropped: keys of the baseline that were retired or whose realization was given up.
        orphans: traces that no spec refers to, relative to the twin's root.
        files: file -> SHA-256 before the run.
        problems: what speaks against a release whatever the outcomes are.
        notes: what else to say.
    """

    tasks: Mapping[str, Task]
    parts: Mapping[str, Part] = field(default_factory=dict)
    baseline: Release | None = None
    missing: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()
    orphans: tuple[str, ...] = ()
    files: Mapping[Path, str] = field(default_factory=dict)
    problems: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def stale(self) -> tuple[Task, ...]:
        """Tasks that have to run."""
        return tuple(task for task in self.tasks.values() if task.is_stale)

    @property
    def fresh(self) -> tuple[Task, ...]:
        """Tasks that the last release still proves."""
        return tuple(task for task in self.tasks.values() if not task.is_stale)

    @property
    def unproven(self) -> tuple[str, ...]:
        """Ids of goldens that were never recorded."""
        goldens = {task.golden.id: task.golden for task in self.tasks.values()}
        return tuple(ident for ident, golden in goldens.items() if golden.provenance is None)


def vouched(release: Release) -> staleness.Baseline:
    """What staleness asks of a release."""
    return staleness.Baseline(
        number=release.number,
        parts=release.parts,
        passed={key: proof.outcome.status == "passed" for key, proof in release.goldens.items()},
        rested_on={key: frozenset(proof.parts) for key, proof in release.goldens.items()},
    )


def missing_and_dropped(
    known: Release | None,
    tasks: Mapping[str, Task],
    retired: Mapping[str, str],
    broken: Collection[str] = (),
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Goldens that a release knows and that are not there any more; ``broken`` ids are there.

    Returns:
        Ids that are missing, and keys that were given up knowingly: retired, or on a realization
        that their spec does not name any more.
    """
    if known is None:
        return (), ()
    here = {task.golden.id for task in tasks.values()}
    missing: dict[str, None] = {}
    dropped = []
    for key, proof in known.goldens.items():
        ident = proof.outcome.golden
        if key in tasks:
            continue
        if ident in here or ident in retired:
            dropped.append(key)
        elif ident not in broken:
            missing[ident] = None
    return tuple(missing), tuple(dropped)


def line_of(golden: Golden, outcome: Outcome) -> int:
    """The line of the tolerance that was left, or of the golden's kind."""
    worst = outcome.worst
    places = ["kind"]
    if worst is not None and outcome.status == "failed":
        places[:0] = [
            f"target.joints.{worst.subject}.{worst.name}",
            f"target.outputs.{worst.name}",
            f"tolerance.{worst.name}",
        ]
    return next((golden.lines[place] for place in places if place in golden.lines), 1)
