"""Structure search: proposals, their comparison and acceptance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from two_pendulums import mjcf, record

from pytest_twin.diagnosis.effect_selection import EffectSelection
from pytest_twin.diagnosis.first_order.beam_search import CandidateSensitivities
from pytest_twin.diagnosis.first_order.sensitivities import starting_grid
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search import alternatives
from pytest_twin.diagnosis.search.alternatives import AlternativeComparison
from pytest_twin.diagnosis.search.linearized_view import LinearizedView, linearize_around
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search.term_exchange import TermExchange, find_exchanges
from pytest_twin.diagnosis.structure_search import search as search_module
from pytest_twin.diagnosis.structure_search.proposals import (
    Proposal,
    Quota,
    best_of_each_size,
    removals,
)
from pytest_twin.diagnosis.structure_search.score import SimulatedModel
from pytest_twin.diagnosis.structure_search.search import StructureSearch
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.loaded_model import load_model


def problem_of(folder: Path, **hidden: float) -> Problem:
    """The problem of one pendulum with hidden effects."""
    model = folder / "model.xml"
    model.write_text(mjcf(("left",)))
    loaded = load_model(model)
    realization = loaded.realization
    paths = [
        record(folder / f"{seed}.mcap", seed, joints=("left",), role="fit", seconds=2.2, **hidden)
        for seed in (1, 2)
    ]
    trials = read_trials(paths, [], loaded.topics, realization.structure)
    return prepare(realization, trials.fit, (), threads=1).problem


@pytest.mark.parametrize(
    ("hidden", "names"),
    [
        ({"viscous": 0.03}, {"viscous_friction"}),
        ({"viscous": 0.03, "delay": 0.02}, {"viscous_friction", "command_delay"}),
        ({}, set()),
    ],
    ids=["one effect", "two effects", "no effect"],
)
def test_exactly_the_hidden_effects_are_found_with_less_than_150_simulations(
    tmp_path: Path, hidden: dict[str, float], names: set[str]
) -> None:
    problem = problem_of(tmp_path, **hidden)
    before = problem.simulated_steps
    run = Run()
    result = StructureSearch(problem, run).run()
    found = {t.effect for t in result.model.hypothesis.terms}
    # With one joint, a command delay cannot be distinguished from a sensor delay.
    assert {"command_delay" if e == "sensor_delay" else e for e in found} == names
    assert (problem.simulated_steps - before) / problem.simulator.steps.sum() < 150
    left = np.sqrt(result.model.mean_square) / problem.signal_floor
    assert left.max() < 2.0
    accepted = [s for s in run.trace.steps if s.decision == "accepted"]
    assert bool(accepted) is bool(names)


def test_a_small_effect_of_another_signal_is_accepted_beside_a_large_one(tmp_path: Path) -> None:
    """Two signals, as of two joints: the second effect gains 7 % of all, but all of its own."""
    problem = problem_of(tmp_path)
    scorer = StructureSearch(problem).scorer
    scorer.problem = SimpleNamespace(
        signal_floor=np.array([1e-4, 1e-4]), fit=problem.fit, held_out=problem.held_out,
        lengths=problem.lengths,
    )  # fmt: skip
    noise = np.random.default_rng(0).standard_normal((sum(problem.lengths(problem.fit)), 2))

    def model(effects: int, *levels: float) -> SimulatedModel:
        terms = [Term("viscous_friction", 0), Term("command_delay", 0)][:effects]
        h = EMPTY.with_terms({t: np.array([1.0]) for t in terms})
        return SimulatedModel(h, noise * np.array(levels), np.zeros((0, 2)), problem)

    scorer.nominal = model(0, 1.0, 2e-4)
    one, same_joint = model(1, 1e-4, 2e-4), model(2, 0.9e-4, 2e-4)
    assert scorer.is_better(model(2, 1e-4, 1e-4), one)
    assert not scorer.is_better(same_joint, one)
    # A model that diverges gives way to a larger one that does not.
    assert scorer.is_better(model(2, 1e-4, 2e-4), model(1, np.nan, 2e-4))
    # Of one and the same signal, the same gain is too little: a wrong effect can have it.
    assert not scorer.is_better(model(2, 2e-4, 2e-4), model(1, 4e-4, 2e-4))


def test_where_the_linearization_shows_nothing_candidates_are_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = CandidateSensitivities([])

    def blind(best: ScoredModel) -> LinearizedView:
        return replace(linearize_around(best), candidate_sensitivities=nothing)

    problem = problem_of(tmp_path, viscous=0.03)
    monkeypatch.setattr(search_module, "linearize_around", blind)
    before = problem.simulated_steps
    result = StructureSearch(problem).run()
    assert [t.effect for t in result.model.hypothesis.terms] == ["viscous_friction"]
    assert (problem.simulated_steps - before) / problem.simulator.steps.sum() < 250


def test_sets_that_explain_nearly_as_much_are_kept_best_first(tmp_path: Path) -> None:
    result = StructureSearch(problem_of(tmp_path, delay=0.02)).run()
    (found,) = result.model.hypothesis.terms
    assert found.effect == "command_delay"
    behind = {m.hypothesis.terms: gain for m, gain in result.rejected_models}
    (late_readings,) = (t for t in behind if [x.effect for x in t] == ["sensor_delay"])
    near = [h.terms for h in result.nearly_as_good(1.0 - behind[late_readings])]
    assert late_readings in near
    assert [behind[t] for t in near] == sorted((behind[t] for t in near), reverse=True)
    assert late_readings not in [h.terms for h in result.nearly_as_good(-behind[late_readings])]


def test_when_time_runs_out_the_best_simulated_proposal_is_the_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def out_of_time(*arguments: object) -> list[SimulatedModel]:
        raise OutOfTime

    monkeypatch.setattr(search_module, "fit_with_correction", out_of_time)
    result = StructureSearch(problem_of(tmp_path, viscous=0.03)).run()
    assert [t.effect for t in result.model.hypothesis.terms] == ["viscous_friction"]
    assert not result.is_complete


def test_without_time_for_exchanges_elastic_transmissions_are_no_alternatives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Along the measured motion, a transmission seems to explain nearly everything."""

    def out_of_time(*arguments: object) -> bool:
        raise OutOfTime

    friction, gear = Term("viscous_friction", 0), Term("joint_elasticity", 0)

    def with_gear(best: ScoredModel, *more: Any) -> list[TermExchange]:
        rigid = find_exchanges(best, *more)
        (start, _), *_ = starting_grid(gear)
        elastic = EMPTY.with_term(gear, start)
        return [*rigid, TermExchange((friction,), gear, elastic, 500.0, is_doubtful=False)]

    selection = EffectSelection(problem_of(tmp_path, viscous=0.03))
    monkeypatch.setattr(AlternativeComparison, "exchange", out_of_time)
    monkeypatch.setattr(alternatives, "find_exchanges", with_gear)
    start = selection.comparison.score_without_fit(EMPTY.with_term(friction, np.array([1.0])))
    selected = selection.refine(selection.comparison.fit_to_convergence(start))
    assert selected.not_simulated == {friction}
    assert gear not in [other for other, _ in selected.alternatives[friction]]


def test_a_search_without_time_keeps_the_effects_that_it_starts_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def out_of_time(*arguments: object) -> tuple[SimulatedModel, np.ndarray]:
        raise OutOfTime

    monkeypatch.setattr(search_module, "fit_by_simulation", out_of_time)
    start = EMPTY.with_term(Term("viscous_friction", 0), np.array([1.0]))
    result = StructureSearch(problem_of(tmp_path, viscous=0.03)).run(start)
    assert result.model.hypothesis == start
    assert not result.is_complete


def test_a_search_that_starts_with_a_wrong_effect_removes_it(tmp_path: Path) -> None:
    problem = problem_of(tmp_path, viscous=0.03)
    search = StructureSearch(problem)
    wrong = next(t for t in search.candidates if t.effect == "quadratic_drag")
    start = EMPTY.with_term(wrong, np.array([p.starts[0] for p in wrong.parameters]))
    found = search.run(start).model.hypothesis
    assert {t.effect for t in found.terms} == {"viscous_friction"}


def test_removals_contain_the_empty_set_and_all_terms_of_a_joint(tmp_path: Path) -> None:
    terms = StructureSearch(problem_of(tmp_path)).candidates[:3]
    own = EMPTY
    for term in terms:
        own = own.with_term(term, np.array([p.starts[0] for p in term.parameters]))
    sizes = sorted(len(removed) for removed in removals(own))
    assert sizes[0] == 0
    assert sizes[-1] == len([t for t in terms if t.joint in (terms[0].joint, -1)])


def test_the_best_proposals_with_each_number_of_effects_are_kept() -> None:
    """Sets of three effects with slightly more gain do not displace single effects."""
    one, two = (Hypothesis((Term(e, 0),), np.zeros(1)) for e in ("armature", "viscous_friction"))
    three = one.with_term(Term("cogging", 0), np.zeros(3)).with_term(
        Term("encoder_bias", 0), np.zeros(2)
    )
    ranked = [
        Proposal(h, g, np.ones(1)) for h, g in ((three, 9.0), (three, 8.0), (one, 7.0), (two, 6.0))
    ]
    kept, others = best_of_each_size(ranked, Quota(1, 1, 1))
    assert [p.gain for p in kept] == [9.0, 7.0]
    assert [p.gain for p in others] == [8.0, 6.0]


def test_elastic_transmissions_displace_no_other_effects() -> None:
    """In the linearization along the measured motion they explain nearly every residual."""
    names = ("joint_elasticity", "backlash", "encoder_scale", "payload", "armature")
    models = [
        EMPTY.with_term(Term(n, -1 if n == "payload" else 0), np.zeros(len(Term(n, 0).parameters)))
        for n in names
    ]
    ranked = [Proposal(h, 9.0 - k, np.ones(1)) for k, h in enumerate(models)]
    kept, others = best_of_each_size(ranked, Quota(2, 1, 1))
    assert [p.hypothesis.terms[0].effect for p in kept] == [
        "joint_elasticity", "encoder_scale", "payload",
    ]  # fmt: skip
    assert [p.hypothesis.terms[0].effect for p in others] == ["backlash", "armature"]
