"""Decide from the facts of a run whether it may be released.

This module reads no files.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from pytest_twin.outcome import Measure, Outcome


@dataclass(frozen=True, slots=True)
class Releasable:
    """All goldens have a valid result, and something is new: a release may be signed."""


@dataclass(frozen=True, slots=True)
class StillValid:
    """The baseline is valid for all goldens and for the asset, and no golden was removed."""

    release: int


@dataclass(frozen=True, slots=True)
class Refused:
    """No release may be signed, with the reasons: one line each, the most serious first."""

    reasons: tuple[str, ...]


Verdict = Releasable | StillValid | Refused


@dataclass(frozen=True, slots=True)
class SessionFacts:
    """Facts of the pytest session apart from the goldens.

    Attributes:
        selection: options that selected a subset, one phrase each: ``-k home``, ``3 deselected``.
        collection_errors: errors of the collection, one line each.
        failures: node ids of ordinary tests that failed.
        interrupted: why the session stopped early, or None.
    """

    selection: tuple[str, ...] = ()
    collection_errors: tuple[str, ...] = ()
    failures: tuple[str, ...] = ()
    interrupted: str | None = None


@dataclass(frozen=True, slots=True)
class Facts:
    """Facts of a run of one twin. Keys are ``golden@realization``.

    Attributes:
        criticality: key of each spec on disk -> ``critical`` or ``advisory``.
        proven: outcomes of the baseline release that are still valid.
        repeated: keys of ``outcomes`` that failed in the baseline and failed again.
        unproven: ids of goldens that were never recorded.
        orphans: traces that no spec refers to.
        missing: ids in the baseline that no longer exist and are not retired.
        dropped: keys in the baseline that were retired or whose realization was removed.
        changed: changes of files or packages during the run, one phrase each.
        problems: other reasons against a release of this twin.
        chain_changes: steps from the supplier's files to the models that differ from the baseline,
            one line each.
        baseline: number of the baseline release, or None.
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
    chain_changes: tuple[str, ...] = ()
    baseline: int | None = None
    session: SessionFacts = field(default_factory=SessionFacts)


def judge(facts: Facts) -> Verdict:
    """Decide whether a release of one twin may be signed."""
    reasons = tuple(_reasons(facts))
    if reasons:
        return Refused(reasons)
    news = facts.outcomes.keys() - facts.repeated
    news |= {*facts.dropped, *facts.chain_changes}
    if facts.baseline is not None and not news:
        return StillValid(facts.baseline)
    return Releasable()


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
    # One of these reasons explains why a golden did not run; it is not reported again.
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
            # An advisory golden may fail, but it must give a result.
            yield f"{key}: could not be compared: {outcome.error}"
        elif criticality == "critical" and outcome.status != "passed":
            yield f"{key}: a critical golden failed"


def not_finite(outcome: Outcome) -> Measure | None:
    """The first measure with a value that is not finite, or None."""
    for measure in outcome.measures:
        if not (
            math.isfinite(measure.error)
            and math.isfinite(measure.measured)
            and math.isfinite(measure.golden)
        ):
            return measure
    return None
