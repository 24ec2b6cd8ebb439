"""The search over the recordings of a diagnosis: whole, in windows, or far from contact."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.diagnosis.build_problem import build_problem, residuals_everywhere
from pytest_twin.diagnosis.conclusion import ChosenModel
from pytest_twin.diagnosis.equation_error import distant_gains
from pytest_twin.diagnosis.findings import order_by_whole_motions
from pytest_twin.diagnosis.first_answer import hypothesis_of
from pytest_twin.diagnosis.first_order.sensitivities import starts_in_first_form
from pytest_twin.diagnosis.intervals import parameter_uncertainty
from pytest_twin.diagnosis.longest_windows import followed_windows
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.noise_levels import in_noise_floors, label
from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.diagnosis.patched.native import mjcf_expresses
from pytest_twin.diagnosis.prepare import PreparedProblem, discretization_rms
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run, ScoredHypothesis
from pytest_twin.diagnosis.search.model import Acceptance, Model
from pytest_twin.diagnosis.search.neighbours import has_given
from pytest_twin.diagnosis.search.physics import SimulatedPhysics
from pytest_twin.diagnosis.search.posterior import (
    SAME_PREDICTION,
    NamedModel,
    best_named,
    posterior,
)
from pytest_twin.diagnosis.search.report_rules import Rejections, rejections
from pytest_twin.diagnosis.search.search import Search, SearchOutcome
from pytest_twin.diagnosis.search.settings import SETTINGS
from pytest_twin.diagnosis.search.simplification import as_settings
from pytest_twin.diagnosis.search_result import SearchResult, build_result
from pytest_twin.diagnosis.servo_priors import combine, contradicted_terms
from pytest_twin.diagnosis.simulated_recordings import with_detected_timestep
from pytest_twin.diagnosis.simulation_settings import (
    FRICTION_CREEP_NOTE,
    adopt_simulation_step,
    build_problem_with_better_constraint,
    describe_integrator,
)
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.unit_check import drop_other_units
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.diagnosis.window_length import model_follows_recordings, typical_window_length
from pytest_twin.diagnosis.window_settings import WINDOWS
from pytest_twin.diagnosis.windows import WINDOW
from pytest_twin.errors import RecordingError
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel, fit, weighted_cost
from pytest_twin.realization import Realization
from pytest_twin.recording_options import CommandBetween
from pytest_twin.trial import Trial

_LAST_ITERATIONS = 8
"""Iterations of the last fit; one that has converged stops earlier."""
_REFIT_ITERATIONS = 3
"""Iterations of a refit without one effect, which starts with the Jacobian of all effects."""
_LATE_ITERATIONS = 6
"""Iterations of a fit after the limit: without an effect, others change by its whole amount."""
_LOWER_FLOORS = 2
"""Largest number of searches with a lower noise floor."""
_WHOLE_SHARE = 0.4
"""Share of the time limit that searches in windows leave for whole recordings."""
_WINDOWS_NOTE = (
    "all errors are of predictions over windows of {:.2g} s that start from measured states: over "
    "whole recordings small errors of this motion grow"
)
_UNRESOLVED = (
    "its 95 % interval contains its absence, but without it the recordings are predicted worse, so "
    "it has no name"
)
_ONE_RECORDING_NOTE = (
    "effects were accepted on parts of one recording, because there is no second one to predict; "
    "no confidence is above 90 %"
)


def find_structure(
    realization: Realization,
    trials: TrialSet,
    *,
    inherited: PatchedModel | None = None,
    threads: int = 0,
    run: Run | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
    possible: Sequence[CommandBetween] = (),
) -> ChosenModel:
    """Choose effects and fit them, without the test recordings.

    Args:
        trials: the fit recordings; none is held out.
        inherited, threads, run, progress: as of :func:`~pytest_twin.diagnosis.diagnose.diagnose`.
        possible: possible interpolations of the commands between their stamps.

    Raises:
        RecordingError, SpecError: as of :func:`~pytest_twin.diagnosis.diagnose.diagnose`.
    """
    run = Run() if run is None else run
    notes: list[str] = []
    setup = replace(ModelSetup.of(realization, inherited, threads), mask=run.mask)
    progress(0.02)
    trials = drop_other_units(realization, trials, notes)
    setup, prepared, trials = build_problem_with_better_constraint(setup, trials, notes)
    notes += _notes_on_missing_joints(realization, trials.fit, prepared.problem.joints)
    progress(0.06)
    run.trace.listeners.append(lambda step: progress(0.06 + 0.74 * run.share_done))
    setup, prepared, trials = adopt_simulation_step(setup, prepared, trials, run)
    searched = _search_recordings(SimulatedPhysics(setup, prepared, trials, possible), run)
    physics = searched.physics
    assert isinstance(physics, SimulatedPhysics)
    if not searched.is_complete:
        run.skip("the search for further effects")
    if searched.comparison.has_one_recording:
        notes.append(_ONE_RECORDING_NOTE)
    with run.budget.reserved():
        found = _conclude(physics, searched, is_late=run.is_over)
    window = physics.prepared.window
    if window is not None:
        notes.append(_WINDOWS_NOTE.format(window))
        ordered = order_by_whole_motions(found.explanation, prepared.problem)
        found = replace(found, explanation=ordered)
    setup = physics.setup
    if setup.has_friction_creep:
        notes.append(FRICTION_CREEP_NOTE)
    if setup.substeps:
        notes.append(describe_integrator(found.prepared))
    every = (*notes, *found.explanation.notes)
    return ChosenModel(setup, found, window, every, between=physics.between)


def _search_recordings(whole: SimulatedPhysics, run: Run) -> SearchOutcome:
    """The search over whole recordings, or over windows of them that the model follows.

    Far from contact, and in short windows, the linearization is valid where it is not over whole
    recordings. Where the found model follows the whole recordings, the search continues there.

    Args:
        whole: the robot with its whole recordings.
    """
    setup, prepared, trials = whole.setup, whole.prepared, whole.trials
    problem = prepared.problem
    first = hypothesis_of(problem, run.first_answer) or EMPTY
    if run.first_values is not None:
        first = run.first_values(problem)
    start = first
    contact = problem.simulator.models.contact
    if contact.world.size:
        with contextlib.suppress(RecordingError):
            away, kept = build_problem(setup, trials, [], window=WINDOW, contact=contact)
            far = SimulatedPhysics(setup, away, kept)
            own = set(far.candidates)
            of_motion = first.without(*(t for t in first.terms if t not in own))
            start = _rescaled(of_motion, problem, away.problem)
            found = _search(
                far, run, "windows far from contact", [], _WHOLE_SHARE, tentative=[start]
            )
            start = _rescaled(found.incumbent.hypothesis, away.problem, problem)
    elif run.first_values is None and not _follows(problem, EMPTY):
        cut = _followed_windows(setup, prepared, trials)
        stage = f"windows of {cut.prepared.window:.2g} s"
        in_windows = _search(
            cut, run, stage, [], _WHOLE_SHARE, tentative=[_rescaled(first, problem, cut.problem)]
        )
        start = _rescaled(in_windows.incumbent.hypothesis, cut.problem, problem)
        physics = in_windows.physics
        assert isinstance(physics, SimulatedPhysics)
        whole = SimulatedPhysics(physics.setup, prepared, trials, whole.possible)
        if start.terms and not _follows(problem, start):
            return _in_longer_windows(in_windows, run)
    both = start
    for term in first.terms:
        both = both if term in both.terms else both.with_term_of(first, term)
    is_first = start is first and run.first_values is None
    starts, tentative = ([], [first]) if is_first else ([first, start, both], [])
    if run.first_values is None:
        tentative = [*tentative, distant_gains(problem)]
    found = _search(whole, run, "whole recordings", starts, tentative=tentative)
    found = _with_last_effects(found, run)
    for _ in range(_LOWER_FLOORS):
        physics, best = found.physics, found.incumbent.hypothesis
        assert isinstance(physics, SimulatedPhysics)
        lower = physics.prepared.with_lower_floor(best) if best.terms else None
        if lower is None or not found.is_complete:
            break
        lowered = SimulatedPhysics(
            physics.setup, lower, physics.trials, physics.possible, between=physics.between
        )
        found = _search(lowered, run, "whole recordings, lower noise floor", [best])
    if _is_unpredictable(found):
        windows, kept = build_problem(setup, trials, [], window=WINDOW)
        best = _rescaled(found.incumbent.hypothesis, problem, windows.problem)
        return _search(
            SimulatedPhysics(setup, windows, kept), run, f"windows of {WINDOW:.2g} s", [best]
        )
    return _in_longer_windows(found, run)


def _in_longer_windows(found: SearchOutcome, run: Run) -> SearchOutcome:
    """The search continued in the longest windows that the model follows, if it misses there.

    Short windows begin with measured states and do not show an effect that needs time to act.
    """
    physics, best = found.physics, found.incumbent.hypothesis
    assert isinstance(physics, SimulatedPhysics)
    if not found.is_complete:
        return found
    followed = followed_windows(best, physics.prepared, physics.setup, physics.trials)
    if followed is None:
        return found
    floor = followed.prepared.problem.floor
    left = followed.residual[:, : len(floor)]
    if (in_noise_floors(left, floor) <= VERDICT.at_floor).all():
        return found
    longer = SimulatedPhysics(physics.setup, followed.prepared, followed.trials)
    return _search(longer, run, f"windows of {followed.seconds:.2g} s", [best])


def _with_last_effects(found: SearchOutcome, run: Run) -> SearchOutcome:
    """The search continued with the last effects of its mask, if more than noise remains."""
    physics = found.physics
    assert isinstance(physics, SimulatedPhysics)
    problem, mask = physics.prepared.problem, physics.problem.mask
    limit = (VERDICT.identifiable * physics.floor) ** 2
    remains = bool((found.incumbent.mean_square > limit).any())
    if mask is None or not mask.last or not remains or not found.is_complete:
        return found
    wider = SimulatedPhysics(
        replace(physics.setup, mask=mask.with_last()),
        replace(physics.prepared, problem=replace(problem, mask=mask.with_last())),
        physics.trials, physics.possible, noise_of=physics.problem, between=physics.between,
    )  # fmt: skip
    return _search(wider, run, "effects that no stage has", [found.incumbent.hypothesis])


def _is_unpredictable(found: SearchOutcome) -> bool:
    """Whether errors of the time step explain what remains over whole recordings, at all joints.

    In the motion of an unstable servo they grow until no simulation predicts it.
    """
    physics, incumbent = found.physics, found.incumbent
    assert isinstance(physics, SimulatedPhysics)
    if not incumbent.hypothesis.terms or not incumbent.is_finite or physics.setup.substeps:
        return False
    joints = len(physics.joints)
    limit = VERDICT.at_floor * physics.floor[:joints]
    remains = np.sqrt(incumbent.mean_square[:joints]) > limit
    steps = discretization_rms(physics.problem.at(incumbent.hypothesis)) > limit
    return bool(remains.any() and steps[remains].all())


def _followed_windows(
    setup: ModelSetup, prepared: PreparedProblem, trials: TrialSet
) -> SimulatedPhysics:
    """The longest windows, each half of the last, in which the model follows the recordings."""
    window = typical_window_length(prepared.problem)
    while True:
        window *= 0.5
        cut, kept = build_problem(setup, trials, [], window=window)
        if _follows(cut.problem, EMPTY) or window <= 2.0 * WINDOWS.shortest:
            return SimulatedPhysics(setup, cut, kept)


def _rescaled(hypothesis: Hypothesis, of: Problem, to: Problem) -> Hypothesis:
    """A hypothesis of one problem in the reference scales of another one."""
    ratios = [
        of.scales.value(p, t.joint) / to.scales.value(p, t.joint)
        for t in hypothesis.terms
        for p in t.parameters
    ]
    return hypothesis.with_theta(np.clip(hypothesis.theta * ratios, *hypothesis.bounds))


def _follows(problem: Problem, hypothesis: Hypothesis) -> bool:
    return model_follows_recordings(problem, residuals_everywhere(problem, hypothesis))


class _MadeBySimulationError(Exception):
    """A simulation made the recordings.

    Attributes:
        physics: the recordings as those of the simulation.
        hypothesis: the effects so far.
    """

    def __init__(self, physics: SimulatedPhysics, hypothesis: Hypothesis) -> None:
        self.physics, self.hypothesis = physics, hypothesis


def _search(
    physics: SimulatedPhysics,
    run: Run,
    stage: str,
    starts: Sequence[Hypothesis],
    kept_share: float = 0.0,
    *,
    tentative: Sequence[Hypothesis] = (),
) -> SearchOutcome:
    """One search, which the limits of the diagnosis may end early.

    Args:
        starts: earlier answers.
        tentative: earlier answers from one recording, and gains by the equation error.
        kept_share: share of the time limit that is kept for later searches.
    """

    def check(incumbent: Model) -> None:
        if run.is_over:
            raise OutOfTime
        present = search.physics
        assert isinstance(present, SimulatedPhysics)
        made = with_detected_timestep(present, incumbent)
        if made is not None:
            raise _MadeBySimulationError(*made)

    run.begin(stage, physics.problem)
    with run.budget.reserved():
        search = Search(physics, listener=_tracer(physics.problem, run), check=check)
        # What an earlier search found is the result if no time is left to fit it here.
        earlier, first = (
            [search.simulated(h) for h in each if h.terms] for each in (starts, tentative)
        )
    try:
        with run.budget.searching(kept_share):
            return search.run(earlier, tentative=first)
    except _MadeBySimulationError as made:
        return _search(made.physics, run, "recordings of a simulation", [made.hypothesis])


def _tracer(problem: Problem, run: Run) -> Callable[[Model, Model, Acceptance], None]:
    def record(model: Model, incumbent: Model, decision: Acceptance) -> None:
        run.step(
            problem, model.origin, "accepted" if decision.is_accepted else "rejected",
            decision.reason,
            ScoredHypothesis(model.hypothesis, model.score),
            ScoredHypothesis(incumbent.hypothesis, incumbent.score),
        )  # fmt: skip

    return record


def _conclude(physics: SimulatedPhysics, found: SearchOutcome, *, is_late: bool) -> SearchResult:
    """Findings of a search: confidences from its pool, names by the report rules.

    Args:
        is_late: whether the time of the search is over; fits then take few steps.
    """
    problem, notes = physics.problem, list[str]()
    model = _refit(physics, found, found.incumbent.hypothesis, is_late=is_late)
    while True:
        found = replace(found, incumbent=model)
        best = best_named(found, _inexpressible, physics.is_possible)
        if best is not found.incumbent.hypothesis:
            renamed = _refit(physics, found, best, is_late=is_late)
            # Few steps may not reach the values that a model has without an effect.
            if not is_late or renamed.score > found.incumbent.score - SETTINGS.earns:
                found = replace(found, incumbent=renamed)
        found = _with_special_cases(physics, found, is_late=is_late)
        found = _with_settings(physics, found, is_late=is_late)
        found = _with_known_servos(physics, found, is_late=is_late)
        model = found.incumbent
        fitted, here = _fitted(problem, model), problem.at(model.hypothesis)
        refitted = _refit_without_each(here, fitted, 1 if is_late else _REFIT_ITERATIONS)
        without = {
            t: np.mean(f.residual**2, axis=0)
            for t, f in zip(model.hypothesis.terms, refitted, strict=True)
        }
        uncertainty = combine(here, fitted, parameter_uncertainty(here, fitted)).uncertainty
        rejected = rejections(model, found.nominal, without, uncertainty, physics)
        gone, model = _without_names(physics, found, rejected, is_late=is_late)
        if not gone:
            break
        notes += [f"rejected: {label(problem, t)}: {why}" for t, why in gone.items()]
    shares = posterior(found, physics.is_possible)
    named = NamedModel(
        fitted, [f.hypothesis for f in refitted], shares, notes,
        dict.fromkeys(rejected.absent, _UNRESOLVED),
    )  # fmt: skip
    return build_result(physics.prepared, physics.trials, named, found.comparison.candidates)


def _without_names(
    physics: SimulatedPhysics, found: SearchOutcome, rejected: Rejections, *, is_late: bool
) -> tuple[Mapping[Term, str], Model]:
    """Effects that the model loses, with their reasons, and the model without them.

    These are the wrong ones; without any, as many of those that may be absent as the score does not
    contradict. An interval is that of the motion linearized at the fit, and a fit that a limit
    ended has not converged. Where a refit without effects is worse, these remain, without a name.
    """
    model, absent = found.incumbent, rejected.absent
    if rejected.wrong:
        rest = model.hypothesis.without(*rejected.wrong)
        return rejected.wrong, _refit(physics, found, rest, is_late=is_late)
    # After the limit there is time for one refit.
    fewest = len(absent) - 1 if is_late else 0
    for count in range(len(absent), fewest, -1):
        gone = dict(itertools.islice(absent.items(), count))
        simpler = _refit(physics, found, model.hypothesis.without(*gone), is_late=is_late)
        if simpler.score > model.score - SETTINGS.earns:
            return gone, simpler
    return {}, model


def _with_special_cases(
    physics: SimulatedPhysics, found: SearchOutcome, *, is_late: bool
) -> SearchOutcome:
    """The outcome with special cases of all laws that predict no better than these.

    A limit may end the search before it compares them, and a law may have been accepted beside
    effects that were removed later.
    """
    model = found.incumbent
    for special in physics.special_cases(model.hypothesis):
        if not has_given(special, physics.given):
            continue
        simpler = _refit(physics, found, special, is_late=is_late)
        refused = physics.refusals(model.hypothesis).keys() - set(special.terms)
        contradicts = simpler.size.surprise - model.size.surprise >= SETTINGS.earns
        if refused or not (contradicts or found.is_better(model, simpler)):
            return _with_special_cases(physics, replace(found, incumbent=simpler), is_late=is_late)
    return found


def _with_settings(
    physics: SimulatedPhysics, found: SearchOutcome, *, is_late: bool
) -> SearchOutcome:
    """The outcome with a setting of a drive where a property of the motor predicts no better.

    A gain is set to another value more often than a torque constant is wrong, and to values that
    no torque constant has. Where both predict the same, they remain equally likely.
    """
    model = found.incumbent
    for restated in as_settings(physics.problem, model.hypothesis):
        setting = _refit(physics, found, restated, is_late=is_late)
        change = np.sqrt(np.mean((setting.residual - model.residual) ** 2, axis=0))
        alike = bool((change <= SAME_PREDICTION * physics.floor).all())
        is_better = setting.score > model.score and not setting.size.is_richer_than(model.size)
        if alike or is_better:
            found.pool.add(model)
            return _with_settings(physics, replace(found, incumbent=setting), is_late=is_late)
    return found


def _with_known_servos(
    physics: SimulatedPhysics, found: SearchOutcome, *, is_late: bool
) -> SearchOutcome:
    """The outcome with an effect that is confused with an error of a servo, if the servo is known.

    Where both predict the same, what is known of the servo decides between friction of the joint
    and other damping of the servo. The score has the priors.
    """
    model = found.incumbent
    tried = [
        Term(effect, term.joint)
        for term in contradicted_terms(physics.problem, model.hypothesis)
        for effect in term.law.confused_with
    ]
    possible = set(physics.candidates) - set(model.hypothesis.terms)
    others = [t for t in dict.fromkeys(tried) if t in possible]
    models = [
        _refit(
            physics, found, model.hypothesis.with_term(t, starts_in_first_form(t)[0]),
            is_late=is_late,
        )
        for t in others
    ]  # fmt: skip
    allowed = [m for m in models if m.is_finite and physics.is_possible(m.hypothesis)]
    best = max(allowed, key=lambda m: m.score, default=model)
    if best.score <= model.score:
        return found
    found.pool.add(best)
    return _with_known_servos(physics, replace(found, incumbent=best), is_late=is_late)


def _inexpressible(hypothesis: Hypothesis) -> int:
    """Number of effects that plain MJCF cannot express."""
    return sum(not mjcf_expresses(t.effect) for t in hypothesis.terms)


def _refit(
    physics: SimulatedPhysics, found: SearchOutcome, start: Hypothesis, *, is_late: bool
) -> Model:
    """A hypothesis fitted to convergence, with the corrections of its own parameters."""
    known = found.incumbent
    if is_late and known.jacobian is not None and start is known.hypothesis:
        return known
    (residual,) = physics.simulate([start], start)
    hypothesis, residual, jacobian = physics.fit(
        start, residual, _LATE_ITERATIONS if is_late else _LAST_ITERATIONS, start
    )
    size = physics.size(hypothesis)
    model = Model.of(found.comparison, hypothesis, residual, size, "report", hypothesis)
    return model.with_jacobian(found.comparison, jacobian)


def _fitted(problem: Problem, model: Model) -> FittedModel:
    weights = problem.weights(model.mean_square)
    assert model.jacobian is not None
    return FittedModel(
        model.hypothesis, model.residual, model.jacobian, weighted_cost(model.residual, weights)
    )


def _refit_without_each(
    problem: Problem, fitted: FittedModel, iterations: int
) -> list[FittedModel]:
    """The model refitted without each of its effects; starts with the Jacobian of the model.

    Args:
        problem: with the corrections at the model.
    """
    terms = fitted.hypothesis.terms
    return fit(
        problem, [fitted.hypothesis.without(t) for t in terms],
        problem.weights(fitted.mean_square), problem.fit,
        iterations=iterations, slopes=False,
        jacobians=[fitted.jacobian[:, :, fitted.hypothesis.parameters_without(t)] for t in terms],
    ) if terms else []  # fmt: skip


def _notes_on_missing_joints(
    realization: Realization, trials: Sequence[Trial], joints: Sequence[str]
) -> list[str]:
    """Notes on the joints of the model that are not in every recording."""
    notes = []
    for joint in realization.joints:
        if joint in joints:
            continue
        lacking = [t.path.name for t in trials if joint not in t.joints]
        if lacking and len(lacking) < len(trials):
            lack = "lacks" if len(lacking) == 1 else "lack"
            notes.append(f"joint {joint!r} is left out: {', '.join(lacking)} {lack} it")
        elif lacking:
            notes.append(
                f"joint {joint!r} is in no recording: it is simulated from the model's initial "
                "position, and its influence on the other joints is not tested"
            )
    return notes
