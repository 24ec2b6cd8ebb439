"""The verdict of the gate: signed, still holds, or refused with the exact reason."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from pytest_twin.gate.verdict import Facts, Refused, Releasable, SessionFacts, StillValid, judge
from pytest_twin.outcome import Measure, Outcome

FINE = Measure("position", "tcp", 0.0, 0.0, 1e-5, 1e-4, "m")
KEY = "golden/fk/home@mujoco"


def outcome(status: str = "passed", measure: Measure = FINE, criticality: str = "critical"):
    return Outcome(
        "golden/fk/home", "fk", "mujoco", criticality, status, (measure,), error="it crashed"
    )


def facts(**changes: object) -> Facts:
    return replace(Facts({KEY: "critical"}, outcomes={KEY: outcome()}), **changes)


def refusals(found: Facts) -> tuple[str, ...]:
    verdict = judge(found)
    assert isinstance(verdict, Refused)
    return verdict.reasons


def test_a_run_with_all_goldens_passed_is_signed() -> None:
    assert judge(facts()) == Releasable()


def test_the_last_release_holds_if_no_golden_had_to_run() -> None:
    assert judge(facts(outcomes={}, proven={KEY: outcome()}, baseline=3)) == StillValid(3)


def test_a_repeated_advisory_failure_needs_no_new_release() -> None:
    failed = outcome("failed", replace(FINE, error=1.0), "advisory")
    found = facts(criticality={KEY: "advisory"}, outcomes={KEY: failed}, baseline=3)
    assert judge(found) == Releasable()
    assert judge(replace(found, repeated=frozenset({KEY}))) == StillValid(3)


def test_a_retired_golden_requires_a_new_release() -> None:
    found = facts(
        outcomes={}, proven={KEY: outcome()}, baseline=3, dropped=("golden/fk/old@mujoco",)
    )
    assert judge(found) == Releasable()


def test_carried_over_and_new_results_are_signed_together() -> None:
    other = "golden/fk/b@mujoco"
    found = facts(
        criticality={KEY: "critical", other: "critical"}, proven={other: outcome()}, baseline=1
    )
    assert judge(found) == Releasable()


@pytest.mark.parametrize("criticality", ["critical", "advisory"])
def test_only_critical_failures_block_a_release(criticality: str) -> None:
    failed = outcome("failed", replace(FINE, error=1.0), criticality)
    verdict = judge(facts(criticality={KEY: criticality}, outcomes={KEY: failed}))
    assert isinstance(verdict, Releasable) == (criticality == "advisory")


def test_a_carried_over_result_is_judged_by_the_current_criticality() -> None:
    carried = outcome("failed", replace(FINE, error=1.0), "advisory")
    assert refusals(facts(outcomes={}, proven={KEY: carried}, baseline=1)) == (
        f"{KEY}: a critical golden failed",
    )


def test_an_advisory_golden_without_a_result_blocks_the_release() -> None:
    crashed = outcome("error", criticality="advisory")
    assert refusals(facts(criticality={KEY: "advisory"}, outcomes={KEY: crashed})) == (
        f"{KEY}: could not be compared: it crashed",
    )


@pytest.mark.parametrize("field", ["error", "measured", "golden"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_non_finite_measure_blocks_the_release_even_if_advisory(field: str, value: float) -> None:
    broken = outcome("failed", replace(FINE, **{field: value}), "advisory")
    assert refusals(facts(criticality={KEY: "advisory"}, outcomes={KEY: broken})) == (
        f"{KEY}: position of tcp is not finite",
    )


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"outcomes": {}}, f"{KEY}: did not run"),
        (
            {"outcomes": {KEY: outcome("failed")}},
            f"{KEY}: a critical golden failed",
        ),
        (
            {"outcomes": {KEY: outcome("error")}},
            f"{KEY}: could not be compared: it crashed",
        ),
        (
            {"unproven": ("golden/fk/home",), "outcomes": {}},
            "golden/fk/home: never recorded: run pytest --twin-update",
        ),
        (
            {"orphans": ("golden/old.trace.csv",)},
            "golden/old.trace.csv: no spec refers to this trace: delete it, or restore its spec",
        ),
        (
            {"missing": ("golden/gone",)},
            "golden/gone: no spec: restore it, or give a reason under 'retired:' in twin.yaml",
        ),
        ({"changed": ("arm.xml",)}, "changed during the run: arm.xml"),
        ({"problems": ("the map cannot be made",)}, "the map cannot be made"),
        (
            {"criticality": {}, "outcomes": {}},
            "no golden: specs are YAML files below a folder named golden",
        ),
        (
            {"session": SessionFacts(selection=("-k home",))},
            "only a full run is released, and this one selected: -k home",
        ),
        (
            {"session": SessionFacts(collection_errors=("a.yaml:3: no",))},
            "could not be collected: a.yaml:3: no",
        ),
        (
            {"session": SessionFacts(failures=("test_a.py::test_b",))},
            "test_a.py::test_b: an ordinary test failed in the same run",
        ),
        (
            {"session": SessionFacts(interrupted="stopping after 1 failures")},
            "the run was stopped: stopping after 1 failures",
        ),
    ],
)
def test_each_reason_for_refusal_is_stated_exactly(change: dict[str, object], reason: str) -> None:
    assert refusals(facts(**change)) == (reason,)


@pytest.mark.parametrize(
    "session",
    [
        SessionFacts(interrupted="interrupted"),
        SessionFacts(selection=("-k home",)),
        SessionFacts(collection_errors=("a.yaml:3: no",)),
    ],
)
def test_goldens_that_did_not_run_are_not_listed_if_the_reason_is_stated(
    session: SessionFacts,
) -> None:
    found = refusals(facts(outcomes={}, session=session, problems=session.collection_errors))
    assert len(found) == 1
    assert "did not run" not in found[0]
