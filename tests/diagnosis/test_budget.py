"""One budget of time and simulations for a diagnosis, which returns its best result at the end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from two_pendulums import JOINTS, mjcf, record

from pytest_twin.diagnosis.budget import RESERVED_SHARE, Budget
from pytest_twin.diagnosis.diagnose import diagnose
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.run import Run, describe_skipped_searches
from pytest_twin.diagnosis.trace import MOST_STEPS, Step, Trace
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.estimation.deadline import OutOfTime, check_deadline
from pytest_twin.estimation.hypothesis import EMPTY
from pytest_twin.loaded_model import load_model
from pytest_twin.realization import Realization

LEFT = JOINTS[:1]


class Clock:
    """A clock that advances by 1 s at every reading."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 1.0
        return self.now


@pytest.fixture
def with_friction(tmp_path: Path) -> tuple[Realization, TrialSet]:
    """One joint with more viscous friction than its model."""
    (tmp_path / "model.xml").write_text(mjcf(LEFT))
    files = [record(tmp_path / f"{seed}.mcap", seed, joints=LEFT, viscous=0.1) for seed in range(3)]
    loaded = load_model(tmp_path / "model.xml")
    trials = read_trials(files[:2], files[2:], loaded.topics, loaded.realization.structure)
    return loaded.realization, trials


@pytest.mark.parametrize(
    "accepted", [0, 1], ids=["before the first step", "after the first effect"]
)
def test_a_stopped_search_returns_the_best_result_so_far(
    with_friction: tuple[Realization, TrialSet], accepted: int
) -> None:
    """An effect whose alternatives were not simulated is not sure."""
    budget = Budget()
    run = Run(budget, Trace(lambda step: budget.stop() if step.decision == "accepted" else None))
    if not accepted:
        budget.stop()
    found = diagnose(*with_friction, threads=1, run=run)
    assert found.verdict in ("unexplained", "improved", "explained")
    assert set(found.errors) == {"left"}
    (note,) = [n for n in found.notes if n.startswith("the search ended early")]
    assert "because it was stopped. Not tried: " in note
    assert bool(found.explanation.findings) is bool(accepted)
    assert all(f.confidence <= 0.8 for f in found.explanation.findings)
    assert all(f.parameters and f.held_out_gain > 0.5 for f in found.explanation.findings)


def test_the_search_ends_when_a_fifth_of_the_time_remains() -> None:
    clock = Clock()
    budget = Budget(seconds=100.0, clock=clock)
    clock.now = 100.0 * (1.0 - RESERVED_SHARE) - 2.0
    with budget.searching():
        check_deadline()
        clock.now += 5.0
        with pytest.raises(OutOfTime):
            check_deadline()
        with budget.reserved():
            check_deadline()
    check_deadline()


def test_a_time_limit_of_zero_is_no_limit() -> None:
    clock = Clock()
    budget = Budget(seconds=0.0, clock=clock)
    clock.now = 1e9
    assert not budget.is_out_of_time
    assert budget.left == np.inf


def test_all_searches_share_one_limit_of_simulations(
    with_friction: tuple[Realization, TrialSet],
) -> None:
    realization, trials = with_friction
    problem = prepare(realization, trials.fit, (), threads=1).problem
    run = Run(Budget(simulations=20.0))
    run.budget.add(problem)
    run.budget.add(problem)
    assert not run.is_over
    while run.budget.work <= 20.0:
        problem.residuals([EMPTY] * 10, problem.fit)
    assert run.is_over, "a second search must not have its own budget"
    assert run.attempt("more", lambda: "more", "the best so far") == "the best so far"
    (note,) = describe_skipped_searches(run)
    assert "its 20 simulations of all data were used. Not tried: more" in note


def test_the_result_contains_the_number_of_simulations_and_the_search_trace(
    with_friction: tuple[Realization, TrialSet],
) -> None:
    found = diagnose(*with_friction, threads=1)
    assert [f.effect for f in found.explanation.findings] == ["viscous_friction"]
    result = found.to_json(realization="realization/")
    assert 10.0 < result["cost"]["simulations"] < 1200.0
    steps = result["search_trace"]["steps"]
    assert result["search_trace"]["left_out"] == 0
    taken = [s for s in steps if s["decision"] == "accepted"]
    assert taken
    assert taken[-1]["proposed"] == ["viscous_friction at left"]
    assert all(s["reason"] for s in steps)
    assert [s["simulations"] for s in steps] == sorted(s["simulations"] for s in steps)
    gains = [s["score"] - s["best_score"] for s in taken if s["best"] == []]
    assert min(gains) > 5.0


def test_a_trace_has_a_maximum_length_and_counts_the_omitted_steps() -> None:
    trace = Trace()
    step = Step("stage", "addition", (), None, (), None, "rejected", "why", 0.0, 0.0)
    for _ in range(MOST_STEPS + 7):
        trace.add(step)
    assert len(trace.to_json()["steps"]) == MOST_STEPS
    assert trace.to_json()["left_out"] == 7
