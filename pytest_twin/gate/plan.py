"""Plan of a run: which goldens are stale compared with the last release, and why.

This module reads no files.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pytest_twin import staleness
from pytest_twin.checks import check_of
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
        parts: ids of the parts that its result depends on now, sorted.
        reasons: why it is stale; empty where the result in the last release is still valid.
        proof: its result in the last release, or None.
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
    """All goldens of a twin with their state before the run.

    Attributes:
        tasks: ``golden@realization`` -> task.
        parts: part id -> current part.
        baseline: the last valid release.
        missing: ids of released goldens that no longer exist and are not listed as retired.
        dropped: keys of the baseline that were retired or whose realization was removed.
        orphans: traces that no spec refers to, relative to the twin's root.
        files: file -> SHA-256 before the run.
        problems: reasons against a release that do not depend on the outcomes.
        notes: further lines for the terminal.
        chain: from the supplier's archive to the models, as a release states it.
        chain_changes: steps of the chain that differ from the baseline, one line each.
        stale_records: records whose inputs changed, one line each; they prevent a release.
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
    chain: Mapping[str, Any] = field(default_factory=dict)
    chain_changes: tuple[str, ...] = ()
    stale_records: tuple[str, ...] = ()

    @property
    def stale(self) -> tuple[Task, ...]:
        """Tasks that have to run."""
        return tuple(task for task in self.tasks.values() if task.is_stale)

    @property
    def fresh(self) -> tuple[Task, ...]:
        """Tasks whose result in the last release is still valid."""
        return tuple(task for task in self.tasks.values() if not task.is_stale)

    @property
    def unproven(self) -> tuple[str, ...]:
        """Ids of goldens that have to be recorded first."""
        goldens = {task.golden.id: task.golden for task in self.tasks.values()}
        return tuple(ident for ident, golden in goldens.items() if lacks_record(golden))


def lacks_record(golden: Golden) -> bool:
    """Whether a golden cannot be compared before ``--twin-update`` records it."""
    return golden.provenance is None and check_of(golden.kind).needs_record


def baseline_of(release: Release) -> staleness.Baseline:
    """Parts and results of a release, as input of :func:`pytest_twin.staleness.staleness`."""
    return staleness.Baseline(
        number=release.number,
        parts=release.parts,
        passed={key: proof.outcome.status == "passed" for key, proof in release.goldens.items()},
        depended_on={key: frozenset(proof.parts) for key, proof in release.goldens.items()},
    )


def missing_and_dropped(
    known: Release | None,
    tasks: Mapping[str, Task],
    retired: Mapping[str, str],
    broken: Collection[str] = (),
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Find the goldens of a release that no longer exist.

    Args:
        tasks: present goldens, by key.
        retired: id of a golden that was removed on purpose -> reason.
        broken: ids of goldens whose spec is not valid; they are not missing.

    Returns:
        Ids of missing goldens, and keys that were removed on purpose: retired, or on a realization
        that the spec no longer names.
    """
    if known is None:
        return (), ()
    present = {task.golden.id for task in tasks.values()}
    missing: dict[str, None] = {}
    dropped = []
    for key, proof in known.goldens.items():
        ident = proof.outcome.golden
        if key in tasks:
            continue
        if ident in present or ident in retired:
            dropped.append(key)
        elif ident not in broken:
            missing[ident] = None
    return tuple(missing), tuple(dropped)


def line_of(golden: Golden, outcome: Outcome) -> int:
    """Line in the spec of the exceeded tolerance, or of the kind."""
    worst = outcome.worst
    places = ["kind"]
    if worst is not None and outcome.status == "failed":
        places[:0] = [
            f"target.joints.{worst.subject}.{worst.name}",
            f"target.outputs.{worst.name}",
            f"tolerance.{worst.name}",
        ]
    return next((golden.lines[place] for place in places if place in golden.lines), 1)
