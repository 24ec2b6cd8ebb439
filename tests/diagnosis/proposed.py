"""Proposals of a structure search that are chosen by simulation."""

from __future__ import annotations

from pytest_twin.diagnosis.hypothesis import Hypothesis
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.trial_simulation import TrialSimulation
from pytest_twin.diagnosis.structure_search.search import StructureSearch
from pytest_twin.diagnosis.structure_search.simulated_proposals import simulated_proposals


def proposed(problem: Problem, own: Hypothesis) -> list[Hypothesis]:
    """Proposals in addition to a fit and instead of it."""
    search = StructureSearch(problem)
    incumbent = search.scorer.at(own)
    best = ModelComparison(problem).score_without_fit(own, slopes=True)
    trial = TrialSimulation(best, best.left)
    return simulated_proposals(search.scorer, incumbent, incumbent, trial, search.candidates)
