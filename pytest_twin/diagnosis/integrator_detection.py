"""Whether recordings were made by a simulation, with a step of its own.

A prediction has the error of the model's step taken out, for a robot has none. A simulation has:
what MuJoCo recorded of the very same model at the very same step would be off by it, and damping
and inertia would be found that nobody hid. The recordings are asked, where the step's error stands
out of their noise: with it left in, all or the part that a finer step has, only noise may be left.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.coarse_step import integration_errors
from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.sensitivities import grid, linearize
from pytest_twin.diagnosis.friction_constraint import has_dry_friction, with_other_constraint
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.prepare import (
    NOISE,
    STEP,
    Prepared,
    discretization,
)
from pytest_twin.diagnosis.prepare_settings import PREPARE
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search.noise_levels import in_noise_floors
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search_result import SearchResult, build_problem
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict import UNSEEN
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.effects.segment import Predicted

SUBSTEPS = (1, 2, 4, 5)
"""Steps, for each of the model's, of simulations that are told from a robot: what more of them
leave of the error is in the floor."""
# Greatest share of the residual above the noise if recordings were simulated, and of the linearized
# residual for a search to be worth its time.
_LEFT, _FAR_LESS = 0.5, 0.25
# Of a joint's travel, up to which the step's error is taken for one of first order.
_SMALL = 0.05
# rad or m, of what neither moves nor has noise.
_LEAST = 1e-9


def as_simulated_before(
    given: ModelSetup, prepared: Prepared, trials: TrialSet, run: Run
) -> tuple[ModelSetup, Prepared, TrialSet]:
    """The problem, stepped as the recordings were simulated, where the nominal model explains them.

    Args:
        given: the model.
        prepared, trials: the problem as a robot would have it.
        run: the diagnosis.
    """
    substeps = _substeps_of(prepared)
    if not substeps:
        return given, prepared, trials
    run.budget.add(prepared.problem)
    given = replace(given, substeps=substeps)
    return given, *build_problem(given, trials, [])


def detect_integrator(found: SearchResult, given: ModelSetup) -> ModelSetup | None:
    """How a simulation may have made the recordings, by the residual once effects were found; None
    where none is seen.

    Held against each other to first order around what was found: its values give way, and smooth
    laws that any joint may have take what they can, whichever way the step's error is taken. Where
    there is dry friction it may creep as well. Of a gear nothing is asked: its motor is stepped
    apart from the link, its teeth meet within a step, and no simulation has that error.

    Args:
        found: with the error of the step taken out.
        given: the model, so stepped.
    """
    problem, best = found.prepared.problem, found.selected.best
    noise = _noise(found.prepared)
    if any(t.law.is_elastic_transmission for t in best.hypothesis.terms):
        return None
    if found.verdict == "no_mismatch" or not _measured(problem, best.hypothesis):
        return None
    if (discretization(problem) < VERDICT.stands_out * noise).all():
        return None
    if not _error_stays_small(problem):
        return None
    span = _Span(problem, best)
    before = span.left(problem, noise)
    seen = bool((before > VERDICT.stands_out**2).any())
    ways = {}
    for creeps, stepped in _ways(problem, best.hypothesis, given).items():
        for k in SUBSTEPS:
            part = _with_part(stepped, 1.0 - 1.0 / k)
            above = np.maximum(span.left(part, noise) - 1.0, 0.0).sum()
            ways[creeps, k] = float(above)
    creeps, substeps = min(ways, key=lambda way: ways[way])
    most = _FAR_LESS * float(np.maximum(before - 1.0, 0.0).sum())
    if seen and ways[creeps, substeps] <= most:
        return replace(given, creeps=creeps, substeps=substeps)
    # The linearization around a wrong effect shows nothing: the residual may be the step's error.
    named = found.explained.findings
    may_be = named and integration_errors(problem, found.errors, 1.0)
    return replace(given, substeps=1) if may_be else None


def explains_more(stepped: SearchResult, found: SearchResult) -> bool:
    """Whether a search with the error of a simulation's step left in explains the recordings with
    no more effects than one without, and leaves far less.
    """
    if stepped.verdict not in ("explained", "no_mismatch"):
        return False
    mine, others = (s.explained.hypothesis for s in (stepped, found))
    if mine.more_terms(others) > 0:
        # An integration error that needs new physics is that physics.
        return False
    less = [e.after / max(found.errors[j].after, 1e-12) for j, e in stepped.errors.items()]
    return max(less) <= 1.0 and min(less) <= _LEFT


def describe_integrator(prepared: Prepared) -> str:
    """A note that the recordings come from a simulation with a certain time step."""
    step = 1e3 * prepared.problem.simulator.timestep
    return (
        f"the recordings come from a simulation with a time step of {step:g} ms: predictions keep "
        "the integration error of that step (for recordings of a robot it is removed)"
    )


def _substeps_of(prepared: Prepared) -> int:
    """Steps for each of the model's with which the nominal model leaves noise alone; 0 where
    none does, or without the step's error nothing more is left.
    """
    problem, noise = prepared.problem, _noise(prepared)
    if not _measured(problem, EMPTY):
        return 0
    before = _squares(problem, EMPTY, noise)
    left = {k: _squares(_with_part(problem, 1.0 - 1.0 / k), EMPTY, noise) for k in SUBSTEPS}
    best = min(left, key=lambda k: float(left[k].max()))
    only_noise = bool((left[best] < VERDICT.stands_out**2).all())
    above = [float(np.maximum(x - 1.0, 0.0).sum()) for x in (left[best], before)]
    seen = bool((before > VERDICT.stands_out**2).any())
    return best if only_noise and seen and above[0] <= _LEFT * above[1] else 0


def _noise(prepared: Prepared) -> FloatArray:
    """(joints,) deviations, rad or m, of what is told from the error of the step: that of the
    sensors and a little of the error itself; of an encoder that says nothing, its floor.
    """
    floor, parts = prepared.problem.floor, prepared.floor_parts
    noise = np.hypot(parts[NOISE], PREPARE.step_of_simulation * parts[STEP])
    known: FloatArray = np.where(floor >= UNSEEN, floor, np.maximum(noise, _LEAST))
    return known


def _error_stays_small(problem: Problem) -> bool:
    """Whether the step's error stays small against the motion. Where it grows (a hunting servo, a
    falling arm) it is not of first order, and whole recordings tell nothing of it; windows do.
    """
    travel = np.array([np.ptp(s.position, axis=0) for s in problem.simulator.segments])
    size = _SMALL * np.sqrt(np.mean(travel**2, axis=0))
    return bool((discretization(problem) <= np.maximum(size, _LEAST)).all())


def _measured(problem: Problem, hypothesis: Hypothesis) -> bool:
    """Measure the error of the model's step at a hypothesis; whether it is known everywhere."""
    problem.refine_at(hypothesis)
    known = len(problem.defect) == len(problem.simulator.segments)
    return problem.refined is not None and known


def _with_part(problem: Problem, share: float) -> Problem:
    """The same with a share of the step's error taken out."""
    part = {
        i: Predicted(share * e.position, share * e.velocity, share * e.effort)
        for i, e in problem.defect.items()
    }
    return replace(problem, refined=None, defect=part)


def _ways(problem: Problem, hypothesis: Hypothesis, given: ModelSetup) -> dict[bool, Problem]:
    """Whether dry friction creeps -> the problem so stepped, the other way where there is some."""
    ways = {given.creeps: problem}
    if has_dry_friction(problem, hypothesis):
        ways[not given.creeps] = with_other_constraint(problem)
    return ways


def _squares(problem: Problem, hypothesis: Hypothesis, noise: FloatArray) -> FloatArray:
    """(joints,) mean squares, in those of the noise, of the residual of the fitted positions."""
    (left,) = problem.residuals([hypothesis], problem.fit)
    return in_noise_floors(left[:, : len(noise)], noise) ** 2


class _Span:
    """What may take a residual away to first order around a fit: its own values, and smooth laws
    that it lacks.
    """

    def __init__(self, problem: Problem, best: ScoredModel) -> None:
        self.hypothesis = best.hypothesis
        self.bins = bins(problem, problem.fit)
        columns = []
        if best.fitted.jacobian.shape[2]:
            columns.append(self.bins.mean(best.fitted.jacobian))
        linear = linearize(problem, problem.fit, best.hypothesis)
        if linear is not None:
            by_effect: dict[str, list[Term]] = {}
            for term in candidates(problem):
                if term.law.nearly_linear and term not in best.hypothesis.terms:
                    by_effect.setdefault(term.effect, []).append(term)
            for terms in by_effect.values():
                found = linear.at_sizes(terms, grid(terms[0])[:1])
                columns += [response.change for response in found]
        signals = (len(self.bins.counts), len(problem.signal_floor), 0)
        self.columns = np.concatenate([np.zeros(signals), *columns], axis=2)

    def left(self, problem: Problem, noise: FloatArray) -> FloatArray:
        """(joints,) mean squares of means over bins, in those of the noise, of what it cannot take
        away of the positions that are fitted.
        """
        joints = len(noise)
        off = noise / np.sqrt(self.bins.counts.mean())
        (residual,) = problem.residuals([self.hypothesis], problem.fit)
        left = self.bins.mean(residual)[:, :joints] / off
        along = (self.columns[:, :joints] / off[:, None]).reshape(left.size, -1)
        # What differs in size by powers of ten is solved as well as what does not.
        along = along / np.maximum(np.linalg.norm(along, axis=0), 1e-30)
        moved = along @ np.linalg.lstsq(along, left.ravel(), rcond=None)[0]
        return in_noise_floors(left - moved.reshape(left.shape), np.ones(joints)) ** 2
