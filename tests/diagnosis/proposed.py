"""Proposals of a structure search that are chosen by simulation."""

from __future__ import annotations

from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.cost_screen import CostScreen
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.structure_search.search import StructureSearch
from pytest_twin.diagnosis.structure_search.simulated_proposals import propose_by_simulation
from pytest_twin.estimation.hypothesis import Hypothesis


def proposed(problem: Problem, own: Hypothesis) -> list[Hypothesis]:
    """Proposals in addition to a fit and instead of it."""
    search = StructureSearch(problem)
    incumbent = search.scorer.simulate_with_own_correction(own)
    best = ModelComparison(problem).score_without_fit(own, slopes=True)
    trial = CostScreen(best, best.max_mean_square)
    return propose_by_simulation(search.scorer, incumbent, incumbent, trial, search.candidates)
