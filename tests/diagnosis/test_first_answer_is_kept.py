"""A diagnosis that ends early never explains less than its first answer did."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from two_pendulums import JOINTS, case

from pytest_twin.diagnosis.budget import Budget
from pytest_twin.diagnosis.diagnose import Diagnosis, diagnose
from pytest_twin.diagnosis.first_answer import first_answer
from pytest_twin.diagnosis.likely_effect import LikelyEffect
from pytest_twin.diagnosis.patched.model import AppliedEffect
from pytest_twin.diagnosis.quick_diagnosis import QuickDiagnosis
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.loaded_model import load_model
from pytest_twin.realization import Realization

LEFT = JOINTS[:1]
Stopped = Callable[[Run], tuple[Diagnosis, QuickDiagnosis]]


class Checks:
    """A clock that counts its readings, so that a limit is a number of simulated steps."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 1.0
        return self.now


def _read(words: list[str]) -> tuple[Realization, TrialSet]:
    loaded = load_model(Path(words[0]))
    structure = loaded.realization.structure
    return loaded.realization, read_trials(
        [Path(w) for w in words[1:]], [], loaded.topics, structure
    )


@pytest.fixture(scope="module")
def braked(tmp_path_factory: pytest.TempPathFactory) -> Stopped:
    """The diagnosis of a joint with dry friction that its model lacks, after its first answer."""
    realization, trials = _read(case(tmp_path_factory.mktemp("braked"), joints=LEFT, dry=0.08))
    answer = first_answer(realization, trials.fit, None, seconds=600.0)
    assert answer is not None

    def run_diagnosis(run: Run) -> tuple[Diagnosis, QuickDiagnosis]:
        run.first_answer = answer.likely_effects
        return diagnose(realization, trials, threads=1, run=run), answer

    return run_diagnosis


def _stopped() -> Run:
    budget = Budget()
    budget.stop()
    return Run(budget)


def test_a_search_that_was_stopped_at_once_writes_the_first_answer(braked: Stopped) -> None:
    found, answer = braked(_stopped())
    (finding,), (likely,) = found.explanation.findings, answer.likely_effects
    assert likely.place == ("coulomb_friction", ("left",))
    assert (finding.effect, finding.joint) == ("coulomb_friction", "left")
    # It is no surer than the first answer was, and the searches that are missing are named.
    assert finding.confidence <= likely.posterior_share
    assert finding.confidence + sum(a.confidence for a in finding.alternatives) <= 1.0 + 1e-9
    assert found.errors["left"].after < 0.2 * found.errors["left"].before
    assert found.skipped_searches


def test_a_wrong_first_answer_does_not_replace_the_nominal_model(tmp_path: Path) -> None:
    realization, trials = _read(case(tmp_path, joints=LEFT))
    run = _stopped()
    friction = AppliedEffect("coulomb_friction", "left", {"coulomb": 0.01}, is_in_mjcf=False)
    run.first_answer = (
        LikelyEffect(("coulomb_friction", ("left",)), {}, 0.9, 0.9, fitted=(friction,)),
    )
    found = diagnose(realization, trials, threads=1, run=run)
    assert not found.explanation.findings
    assert found.errors["left"].after == found.errors["left"].before


def test_more_time_never_gives_a_larger_error(braked: Stopped) -> None:
    errors = []
    for readings_of_the_clock in (1, 300, 1500):
        limit = Budget(seconds=readings_of_the_clock, clock=Checks())
        errors.append(braked(Run(limit))[0].errors["left"].after)
    # The recordings that decide are others than those of this error.
    assert errors[1] <= 1.05 * errors[0]
    assert errors[2] <= 1.05 * errors[1]
