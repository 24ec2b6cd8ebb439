"""Whether a run may be signed. Pure: facts in, verdict out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from pytest_twin.outcome import Measure, Outcome


@dataclass(frozen=True, slots=True)
class Signed:
    """Everything is proven, and something of it is new: a release may be written."""


@dataclass(frozen=True, slots=True)
class Holds:
    """All goldens are proven by the baseline, and none was added or removed."""

    release: int


@dataclass(frozen=True, slots=True)
class Refused:
    """No release, and why: one line each, the most serious first."""

    reasons: tuple[str, ...]


Verdict = Signed | Holds | Refused


@dataclass(frozen=True, slots=True)
class SessionFacts:
    """What the test session says beside the goldens.

    Attributes:
        selection: what picked a subset, one phrase each: ``-k home``, ``3 tests deselected``.
        collection_errors: what could not be collected, one line each.
        failures: node ids of ordinary tests that failed.
        interrupted: why the session ended before its end, None where it did not.
    """

    selection: tuple[str, ...] = ()
    collection_errors: tuple[str, ...] = ()
    failures: tuple[str, ...] = ()
    interrupted: str | None = None


@dataclass(frozen=True, slots=True)
class Facts:
    """What one twin's run has brought out. Keys are ``golden@realization``.

    Attributes:
        criticality: every key that the specs on disk ask for -> critical or advisory, today.
        proven: outcomes that the baseline release carries over.
        outcomes: outcomes of this run.
        repeated: keys of ``outcomes`` that ran because they had failed, and failed again.
        unproven: ids of goldens that were never recorded.
        orphans: traces that no spec refers to.
        missing: ids that the baseline knows and that are gone without being retired.
        dropped: keys that the baseline knows and that were retired or given up with a realization.
        changed: what changed while it ran, one phrase each.
        problems: what else speaks against a release of this twin.
        baseline: number of the baseline release, None without one.
        session: the session around it.
    """

    criticality: Mapping[str, str]
    proven: Mapping[str, Outcome] = field(default_factory=dict)
    outcomes: Mapping[str, Outcome] = field(default_factory=dict)
    repeated: frozenset[str] = frozenset()
    unproven: tuple[str, ...] = ()
    orphans: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    baseline: int | None = None
    session: SessionFacts = field(default_factory=SessionFacts)


def judge(facts: Facts) -> Verdict:
    """The verdict on one twin."""
    reasons = tuple(_reasons(facts))
    if reasons:
        return Refused(reasons)
    news = facts.outcomes.keys() - facts.repeated
    if facts.baseline is not None and not news and not facts.dropped:
        return Holds(facts.baseline)
    return Signed()


def _reasons(facts: Facts) -> Iterator[str]:
    session = facts.session
    if session.selection:
        yield "only a full run is released, and this one selected: " + ", ".join(session.selection)
    if session.interrupted is not None:
        yield f"the run was stopped: {session.interrupted}"
    for error in session.collection_errors:
        yield f"could not be collected: {error}"
    for changed in facts.changed:
        yield f"changed during the run: {changed}"
    yield from (problem for problem in facts.problems if problem not in session.collection_errors)
    # What did not run for one of these reasons needs no line of its own.
    explained = session.selection or session.collection_errors or session.interrupted is not None
    yield from _unproven_results(facts, say_missing=not explained)
    for golden in facts.unproven:
        yield f"{golden}: never recorded: run pytest --twin-update"
    for trace in facts.orphans:
        yield f"{trace}: no spec refers to this trace: delete it, or restore its spec"
    for golden in facts.missing:
        yield f"{golden}: no spec: restore it, or give a reason under 'retired:' in twin.yaml"
    for failure in session.failures:
        yield f"{failure}: an ordinary test failed in the same run"
    if not facts.criticality:
        yield "no golden: specs are YAML files below a folder named golden"


def _unproven_results(facts: Facts, *, say_missing: bool) -> Iterator[str]:
    results = {**facts.proven, **facts.outcomes}
    for key, criticality in facts.criticality.items():
        if key.rpartition("@")[0] in facts.unproven:
            continue
        outcome = results.get(key)
        if outcome is None:
            if say_missing:
                yield f"{key}: did not run"
        elif (broken := not_finite(outcome)) is not None:
            yield f"{key}: {broken.name} of {broken.subject} is not finite"
        elif outcome.status == "error":
            # Advisory goldens may fail; one that gave no number proves nothing at all.
            yield f"{key}: could not be compared: {outcome.error}"
        elif criticality == "critical" and outcome.status != "passed":
            yield f"{key}: a critical golden failed"


def not_finite(outcome: Outcome) -> Measure | None:
    """The first measure that is not a number, or None."""
    for measure in outcome.measures:
        if not (
            math.isfinite(measure.error)
            and math.isfinite(measure.measured)
            and math.isfinite(measure.golden)
        ):
            return measure
    return None
