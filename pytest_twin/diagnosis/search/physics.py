"""What a search asks of a robot and its recordings: the seam between the search and simulation."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.build_problem import build_problem
from pytest_twin.diagnosis.first_order.beam_search import candidates, given_terms
from pytest_twin.diagnosis.first_order.sensitivities import starts_in_first_form
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.passive_joints import (
    LargestBackEmf,
    has_excessive_back_emf,
    with_largest_back_emf,
)
from pytest_twin.diagnosis.physical_totals import without_negative_totals
from pytest_twin.diagnosis.prepare import NOISE, PreparedProblem, discretization_rms
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded_range import RecordedRange
from pytest_twin.diagnosis.refusal import refused_effects
from pytest_twin.diagnosis.search.common_effects import (
    idle_parameters,
    replace_robot_effects,
    set_size,
)
from pytest_twin.diagnosis.search.linearized_view import View, linearize_around, simulate_around
from pytest_twin.diagnosis.search.proposed_starts import starts_at
from pytest_twin.diagnosis.search.simplification import (
    as_settings,
    equal_sized_forms,
    merge_joints,
    merge_terms,
    simpler_forms,
    special_cases,
    split_terms,
)
from pytest_twin.diagnosis.servo_priors import fitted_with_priors
from pytest_twin.diagnosis.simulation_settings import SUBSTEPS, has_dry_friction
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.comparison import Size
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.estimation.least_squares import (
    broyden_update,
    fit,
    propose_step,
    weighted_cost,
)
from pytest_twin.recording_options import CommandBetween
from pytest_twin.trial import Trial

_OWN_STEPS = 4
"""Largest number of steps of a fit with the corrections at its own parameters."""
_DAMPING = 1e-4
"""Damping of these steps, relative to the diagonal of the normal matrix."""
_SETTLED = 0.1
"""Change of the prediction by a step, in noise floors, below which a fit is final."""
_SMALLEST_NOISE = 1e-9
"""Smallest noise of a position, rad or m."""


class Physics(Protocol):
    """A robot with its recordings, as the search sees it."""

    @property
    def joints(self) -> Sequence[str]:
        """Names of the joints."""

    @property
    def candidates(self) -> Sequence[Term]:
        """Effects at joints that may be added."""

    @property
    def given(self) -> Collection[Term]:
        """Effects that every model of the search has; none in a diagnosis."""

    @property
    def floor(self) -> FloatArray:
        """(signals,) noise floor."""

    @property
    def noise(self) -> FloatArray:
        """(signals,) noise of the recordings: the floor without the integration error."""

    @property
    def lengths(self) -> Sequence[int]:
        """Number of samples of each segment."""

    @property
    def recordings(self) -> Sequence[int]:
        """Recording of each segment."""

    @property
    def is_linearizable(self) -> bool:
        """Whether the motion can be linearized; not in contact."""

    def simulate(
        self, hypotheses: Sequence[Hypothesis], corrected_at: Hypothesis
    ) -> list[FloatArray]:
        """(samples, signals) residual of each hypothesis.

        Args:
            corrected_at: hypothesis at which the corrections of their predictions are measured.
        """

    def simulate_recording(
        self, hypotheses: Sequence[Hypothesis], corrected_at: Hypothesis, recording: int
    ) -> list[FloatArray]:
        """As :meth:`simulate`, on one recording."""

    def fit(
        self,
        hypothesis: Hypothesis,
        residual: FloatArray,
        iterations: int,
        corrected_at: Hypothesis,
    ) -> tuple[Hypothesis, FloatArray, FloatArray]:
        """A hypothesis fitted by simulation, with its residual and Jacobian.

        The residual has the corrections of the fitted parameters.

        Args:
            hypothesis: with the start of its parameters.
            residual: (samples, signals) its residual, from which the weights follow.
            iterations: largest number of steps.
            corrected_at: hypothesis whose corrections the predictions of the fit have.
        """

    def linearize(self, hypothesis: Hypothesis, residual: FloatArray, jacobian: FloatArray) -> View:
        """The motion linearized around a fitted hypothesis."""

    def view_by_simulation(
        self, hypothesis: Hypothesis, residual: FloatArray, jacobian: FloatArray, closest: int
    ) -> View:
        """As :meth:`linearize`, with candidates that are simulated at one size.

        Args:
            closest: number of candidates that are simulated at all sizes.
        """

    def size(self, hypothesis: Hypothesis) -> Size:
        """Number of effects and parameters; an effect that is common to all joints counts once."""

    def special_cases(self, hypothesis: Hypothesis) -> list[Hypothesis]:
        """The hypothesis with one law replaced by a special case of it."""

    def rewrites(self, hypothesis: Hypothesis) -> list[Hypothesis]:
        """The same physics in other words, special cases included."""

    def sensor_effects(self, hypothesis: Hypothesis, mean_square: FloatArray) -> list[Hypothesis]:
        """The hypothesis with an effect of one effort sensor whose residual is large."""

    def starts(
        self, hypothesis: Hypothesis, unexplained: NDArray[np.bool_]
    ) -> list[tuple[Term, Hypothesis]]:
        """Starts that effects propose at unexplained joints, by the effect that proposes them."""

    def within_totals(self, hypothesis: Hypothesis) -> Hypothesis:
        """The hypothesis, with zero for negative totals of model and given effects.

        A fit along the motion may end there, where another given effect compensates.
        """

    def refusals(self, hypothesis: Hypothesis) -> Mapping[Term, str]:
        """Effects with impossible totals or outside the recorded range, and the reason of each."""

    def other_friction_constraint(self, hypothesis: Hypothesis) -> Iterator[Physics]:
        """The same robot and samples with the other friction constraint, if friction is dry."""

    def other_settings(self, hypothesis: Hypothesis, *, is_explained: bool) -> Iterator[Physics]:
        """The same robot and samples with each other setting of the simulation that is open.

        Args:
            is_explained: whether only noise remains. A setting may then need fewer effects.
        """


class SimulatedPhysics:
    """The physics of an estimation problem, by simulation.

    Attributes:
        setup: the model with its simulation settings.
        prepared: the problem; all its segments are fitted.
        possible: interpolations of the commands that the recordings do not rule out.
        given: effects that every model of the search has.
        between: interpolation that the search decided; None if it decided none.
        problem: the problem with the noise by which all settings are compared.
    """

    given: Collection[Term] = ()

    def __init__(
        self,
        setup: ModelSetup,
        prepared: PreparedProblem,
        trials: TrialSet,
        possible: Sequence[CommandBetween] = (),
        *,
        noise_of: Problem | None = None,
        between: CommandBetween | None = None,
    ) -> None:
        self.setup, self.prepared, self.trials = setup, prepared, trials
        self.possible, self.between = possible, between
        self.problem = problem = (
            prepared.problem
            if noise_of is None
            else replace(
                prepared.problem,
                floor=noise_of.floor,
                effort_floor=noise_of.effort_floor,
                position_weights=noise_of.position_weights,
                effort_weights=noise_of.effort_weights,
            )
        )
        self.candidates: Sequence[Term] = tuple(candidates(problem))
        self.given = given_terms(problem)
        self.recorded = RecordedRange.of(problem)

    @property
    def joints(self) -> Sequence[str]:
        """Names of the joints."""
        return self.problem.joints

    @property
    def floor(self) -> FloatArray:
        """(signals,) noise floor."""
        return self.problem.signal_floor

    @property
    def noise(self) -> FloatArray:
        """(signals,) noise of the recordings: the floor without the integration error."""
        positions = np.maximum(self.prepared.floor_parts[NOISE], _SMALLEST_NOISE)
        return np.concatenate([positions, self.floor[len(positions) :]])

    @property
    def lengths(self) -> Sequence[int]:
        """Number of samples of each segment."""
        return self.problem.lengths(self.problem.fit)

    @property
    def recordings(self) -> Sequence[int]:
        """Recording of each segment."""
        return [self.problem.simulator.segments[s].trial for s in self.problem.fit]

    @property
    def is_linearizable(self) -> bool:
        """As :attr:`Physics.is_linearizable`."""
        return not self.problem.simulator.models.contact.world.size

    def simulate(
        self, hypotheses: Sequence[Hypothesis], corrected_at: Hypothesis
    ) -> list[FloatArray]:
        """As :meth:`Physics.simulate`."""
        problem = self.problem.at(corrected_at)
        return problem.residuals(hypotheses, problem.fit)

    def simulate_recording(
        self, hypotheses: Sequence[Hypothesis], corrected_at: Hypothesis, recording: int
    ) -> list[FloatArray]:
        """As :meth:`Physics.simulate_recording`."""
        which = np.asarray(self.recordings) == recording
        return self.problem.at(corrected_at).residuals(hypotheses, self.problem.fit[which])

    def fit(
        self,
        hypothesis: Hypothesis,
        residual: FloatArray,
        iterations: int,
        corrected_at: Hypothesis,
    ) -> tuple[Hypothesis, FloatArray, FloatArray]:
        """As :meth:`Physics.fit`."""
        fitted = self._fit_recordings(hypothesis, residual, iterations, corrected_at)
        return fitted_with_priors(self.problem, *fitted)

    def _fit_recordings(
        self,
        hypothesis: Hypothesis,
        residual: FloatArray,
        iterations: int,
        corrected_at: Hypothesis,
    ) -> tuple[Hypothesis, FloatArray, FloatArray]:
        here = self.problem.at(corrected_at)
        weights = here.weights(np.mean(residual**2, axis=0))
        (fitted,) = fit(here, [hypothesis], weights, here.fit, iterations=iterations)
        settled = self._with_own_corrections(fitted.hypothesis, fitted.jacobian, weights)
        if not self.given or self._is_within_totals(settled[0]):
            return settled
        found = fitted.hypothesis
        if has_excessive_back_emf(self.problem, found):
            # The back-EMF follows the damping: at a fixed bound it would hold the damping.
            bounded = LargestBackEmf(here)
            (fitted,) = fit(bounded, [found], weights, here.fit, iterations=iterations)
            found = with_largest_back_emf(self.problem, fitted.hypothesis)
        # A negative total shows that a given effect compensates for one that is missing.
        found = self.within_totals(found)
        (last,) = self.simulate([found], found)
        return found, last, fitted.jacobian

    def _is_within_totals(self, hypothesis: Hypothesis) -> bool:
        """Whether no total of model and effects is negative, and no drive makes energy."""
        is_passive = not has_excessive_back_emf(self.problem, hypothesis)
        possible = without_negative_totals(self.problem, hypothesis)
        return is_passive and np.array_equal(possible, hypothesis.theta)

    def _with_own_corrections(
        self, start: Hypothesis, jacobian: FloatArray, weights: FloatArray
    ) -> tuple[Hypothesis, FloatArray, FloatArray]:
        """A fit continued with the corrections at its own parameters, until it settles.

        The corrections change with the parameters. A quasi-Newton step on residuals that each have
        their own corrections needs one of them, where a fit with fixed corrections needs several.
        """
        best = start
        (residual,) = self.simulate([best], best)
        for _ in range(_OWN_STEPS if best.terms else 0):
            new = propose_step(best, residual, jacobian, weights, _DAMPING)
            change = jacobian @ (new.theta - best.theta)
            if not (np.sqrt(np.mean(change**2, axis=0)) > _SETTLED * self.floor).any():
                break
            (tried,) = self.simulate([new], new)
            jacobian = broyden_update(jacobian, new.theta - best.theta, residual - tried)
            if weighted_cost(tried, weights) < weighted_cost(residual, weights):
                best, residual = new, tried
        return best, residual, jacobian

    def linearize(self, hypothesis: Hypothesis, residual: FloatArray, jacobian: FloatArray) -> View:
        """As :meth:`Physics.linearize`."""
        return linearize_around(self.problem.at(hypothesis), hypothesis, residual, jacobian)

    def view_by_simulation(
        self, hypothesis: Hypothesis, residual: FloatArray, jacobian: FloatArray, closest: int
    ) -> View:
        """As :meth:`Physics.view_by_simulation`."""
        here = self.problem.at(hypothesis)
        return simulate_around(here, hypothesis, residual, jacobian, closest)

    @cached_property
    def _idle(self) -> dict[Term, NDArray[np.bool_]]:
        """Parameters of candidates that change nothing in this robot's drives."""
        return idle_parameters(self.problem, self.candidates)

    def size(self, hypothesis: Hypothesis) -> Size:
        """As :meth:`Physics.size`."""
        return set_size(self.problem, hypothesis, self._idle)

    def special_cases(self, hypothesis: Hypothesis) -> list[Hypothesis]:
        """As :meth:`Physics.special_cases`."""
        return special_cases(self.problem, hypothesis)

    def rewrites(self, hypothesis: Hypothesis) -> list[Hypothesis]:
        """As :meth:`Physics.rewrites`."""
        problem = self.problem
        return [
            *merge_terms(problem, hypothesis),
            *merge_joints(problem, hypothesis),
            *as_settings(problem, hypothesis),
            *self.special_cases(hypothesis),
            *split_terms(problem, hypothesis),
            *simpler_forms(problem, hypothesis),
            *equal_sized_forms(hypothesis),
            *replace_robot_effects(problem, hypothesis),
        ]

    def sensor_effects(self, hypothesis: Hypothesis, mean_square: FloatArray) -> list[Hypothesis]:
        """As :meth:`Physics.sensor_effects`.

        The linearized search compares means over bins with the noise floor of single samples, so it
        may miss an offset of the effort that is below the floor in each bin.
        """
        large = mean_square > (VERDICT.identifiable * self.floor) ** 2
        (joints,) = np.nonzero(large[len(self.joints) :])
        return [
            hypothesis.with_term(t, starts_in_first_form(t)[0])
            for t in self.candidates
            if t.law.overrides("sense_effort") and t.joint in joints and t not in hypothesis.terms
        ]

    def starts(
        self, hypothesis: Hypothesis, unexplained: NDArray[np.bool_]
    ) -> list[tuple[Term, Hypothesis]]:
        """As :meth:`Physics.starts`: beside the effects of the hypothesis, and instead of them."""
        out = list[tuple[Term, Hypothesis]]()
        for term in dict.fromkeys((*hypothesis.terms, *self.candidates)):
            if term.joint < 0 or not unexplained[term.joint]:
                continue
            for start in starts_at(self.problem, hypothesis, term):
                others = {
                    other: np.array([values.get(p.name, 0.0) for p in other.parameters])
                    for effect, values in start.others.items()
                    if (other := Term(effect, term.joint))
                }
                if others.keys() & set(hypothesis.terms):
                    continue
                if term in hypothesis.terms:
                    theta = hypothesis.theta.copy()
                    theta[hypothesis.slice_of(term)] = start.parameters
                    out.append((term, hypothesis.with_theta(theta).with_terms(others)))
                    continue
                of_joint = tuple(t for t in hypothesis.terms if t.joint == term.joint)
                rests = [
                    hypothesis.without(*replaced) for replaced in dict.fromkeys([(), of_joint])
                ]
                if term.joint in {t.joint for t in self.given}:
                    # Without a limit of the drive, the fit of a gain may end far off.
                    rests = [hypothesis, self._with_absent_given(hypothesis, term.joint)]
                out += [
                    (term, rest.with_terms({**others, term: start.parameters})) for rest in rests
                ]
        return out

    def _with_absent_given(self, hypothesis: Hypothesis, joint: int) -> Hypothesis:
        """A hypothesis without the effects of a joint, of which the given ones are at absence."""
        rest = hypothesis.without(*(t for t in hypothesis.terms if t.joint == joint))
        return rest.with_terms(
            {
                t: np.array([p.absent_value for p in t.parameters])
                for t in self.given
                if t.joint == joint
            }
        )

    def within_totals(self, hypothesis: Hypothesis) -> Hypothesis:
        """As :meth:`Physics.within_totals`."""
        if not self.given:
            return hypothesis
        return hypothesis.with_theta(without_negative_totals(self.problem, hypothesis))

    def refusals(self, hypothesis: Hypothesis) -> Mapping[Term, str]:
        """As :meth:`Physics.refusals`."""
        return refused_effects(self.problem, hypothesis, self.recorded)

    def is_possible(self, hypothesis: Hypothesis) -> bool:
        """Whether a hypothesis may be reported: no effect is refused, and no drive makes energy."""
        is_passive = not self.given or not has_excessive_back_emf(self.problem, hypothesis)
        return is_passive and not self.refusals(hypothesis)

    def other_friction_constraint(self, hypothesis: Hypothesis) -> Iterator[Physics]:
        """As :meth:`Physics.other_friction_constraint`."""
        if has_dry_friction(self.problem, hypothesis):
            creeps = self.setup.has_friction_creep
            yield from self._with(replace(self.setup, has_friction_creep=not creeps))

    def other_settings(self, hypothesis: Hypothesis, *, is_explained: bool) -> Iterator[Physics]:
        """As :meth:`Physics.other_settings`.

        The interpolation of commands is open where the recordings did not decide it. The friction
        constraint is open where there is dry friction, and the time step of a simulation that made
        the recordings where its discretization error is above the noise.
        """
        assumed = {t.command_between for t in self.trials.fit if t.between_source == "assumed"}
        for between in self.possible:
            if assumed and assumed != {between}:
                yield from self._with(self.setup, between)
        if is_explained:
            return
        setup = self.setup
        yield from self.other_friction_constraint(hypothesis)
        noise = np.maximum(self.prepared.floor_parts[NOISE], _SMALLEST_NOISE)
        steps = discretization_rms(self.problem.at(hypothesis))
        is_visible = bool((steps > VERDICT.identifiable * noise).any())
        if setup.is_of_robot or not (is_visible or setup.substeps):
            return
        for substeps in {0, *SUBSTEPS} - {setup.substeps}:
            yield from self._with(replace(setup, substeps=substeps))

    def _with(
        self, setup: ModelSetup, between: CommandBetween | None = None
    ) -> Iterator[SimulatedPhysics]:
        """The physics with other settings; none if the nominal model then diverges.

        Args:
            setup: the model with its simulation settings.
            between: interpolation of the commands; unchanged by default.
        """
        trials = self.trials if between is None else with_interpolation(self.trials, between)
        prepared, trials = build_problem(
            setup, trials, [], window=self.prepared.window, scales=self.problem.scales
        )
        if self.problem.lengths(self.problem.fit) == prepared.problem.lengths(prepared.problem.fit):
            yield SimulatedPhysics(
                setup, prepared, trials, self.possible,
                noise_of=self.problem, between=between or self.between,
            )  # fmt: skip


def with_interpolation(trials: TrialSet, between: CommandBetween) -> TrialSet:
    """The trials with an interpolation of commands, unless it is declared."""

    def changed(trial: Trial) -> Trial:
        if trial.between_source != "assumed":
            return trial
        return replace(trial, command_between=between, between_source="data")

    fit, held_out = (tuple(map(changed, role)) for role in (trials.fit, trials.held_out))
    return replace(trials, fit=fit, held_out=held_out)
