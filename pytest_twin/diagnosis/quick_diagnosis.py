"""A quick diagnosis of one recording, in seconds: the single most likely effect.

It locates the missing force, fits each effect at that joint to a short part of the recording, and
tests the best one on the whole recording. In contrast to :mod:`pytest_twin.diagnosis.diagnose` it
neither combines effects nor uses several recordings.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import (
    CandidateSensitivities,
    NormalEquations,
    ResidualView,
    candidates,
)
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.sensitivities import sensitivities
from pytest_twin.diagnosis.likely_effect import LikelyEffect, Place
from pytest_twin.diagnosis.locate import (
    MissingForce,
    TimeAndRegime,
    compute_missing_force,
    locate_error,
    smooth_motions,
)
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.model import PatchedModel, applied_effects
from pytest_twin.diagnosis.patched.replay import replay_whole
from pytest_twin.diagnosis.prepare import NOISE, PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.quick_settings import QUICK
from pytest_twin.diagnosis.smoothing import smooth_state
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.errors import SimulationError
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel, fit
from pytest_twin.estimation.score import effective_samples, log_likelihood
from pytest_twin.open_loop import replay
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial

Starts = dict[Term, FloatArray]
"""Terms that are fitted together -> start values of their parameters."""


@dataclass(frozen=True, slots=True)
class QuickDiagnosis:
    """Result of a quick diagnosis.

    Attributes:
        likely_effects: the most likely effect, then the most likely one for the joints that it does
            not explain, and so on; empty if no effect is supported.
        unexplained: joints outside their tolerance that no likely effect explains.
        joint: joint with the largest missing force; None if no force exceeds the sensor noise.
        where: when and in which regime the error occurs.
        floors: RMS error of the worst examined joint, in noise floors.
    """

    likely_effects: tuple[LikelyEffect, ...]
    unexplained: tuple[str, ...]
    joint: str | None
    where: TimeAndRegime
    floors: float


def quick_diagnosis(
    realization: Realization,
    trial: Trial,
    patched: PatchedModel | None = None,
    failed: Collection[str] = (),
) -> QuickDiagnosis:
    """Find the most likely effects of one trial.

    Args:
        patched: effects that a diagnosis wrote outside the MJCF.
        failed: joints whose errors are to be explained; all if none of them is in the trial. Other
            joints may have larger errors within their tolerances.

    Raises:
        RecordingError: the model and the recording share no joint.
        SimulationError: the model diverges.
        SpecError: a controller, payload or actuator that the model lacks.
        OutOfTime: the time is over before any effect was found.
    """
    examined, start = _worst_part(realization, trial, patched, failed)
    whole = _prepare(realization, [examined], [], patched)
    before = whole.problem.residuals([EMPTY], whole.problem.fit)[0]
    if not np.isfinite(before).all():
        raise SimulationError(
            "the model diverges under the recorded commands",
            path=trial.path,
            expected="finite joint positions; check the unit of the commands, then the masses, "
            "inertias and servo gains of the model",
        )
    joints = len(whole.problem.joints)
    must_explain = _must_explain(whole.problem.joints, failed)
    size = np.sqrt(np.mean(before[:, :joints] ** 2, axis=0)) / whole.problem.floor
    force = compute_missing_force(whole.problem, before, whole.floor_parts[NOISE])
    causes = _likely_causes(force, size, must_explain)
    where = _locate(whole, examined, start, _force_excess(force, causes[:1]), causes[0])
    likely_effects: list[LikelyEffect] = []
    left = must_explain & (size > VERDICT.at_floor)
    rounds = QUICK.most_rounds
    while left.any() and rounds:
        rounds -= 1
        search = _EffectSearch(
            realization,
            patched,
            examined,
            whole,
            before,
            must_explain if not likely_effects else left,
        )
        try:
            found = search.find_likely_effect(force, size)
        except OutOfTime:
            if not likely_effects:
                raise
            break
        if found is None:
            break
        likely, after = found
        likely_effects.append(likely)
        left = left & ~_is_explained(before, after, joints)
    is_located = bool(force.strength[causes[0]] > 1.0)
    names = whole.problem.joints
    return QuickDiagnosis(
        likely_effects=tuple(likely_effects),
        unexplained=tuple(n for n, out in zip(names, left, strict=True) if out and n in failed),
        joint=names[causes[0]] if is_located else None,
        where=where,
        floors=float(size[must_explain].max()),
    )


def _force_excess(force: MissingForce, causes: Sequence[int]) -> FloatArray:
    """(samples,) squared missing force of the joints ``causes`` above its noise, in variances."""
    squared: FloatArray = (force.force[:, causes] / force.noise[list(causes)]) ** 2
    excess: FloatArray = np.maximum(squared - 1.0, 0.0).sum(axis=1)
    return excess


def _is_explained(before: FloatArray, after: FloatArray, joints: int) -> NDArray[np.bool_]:
    """(joints,) whether the share of the squared error that an effect removes is large enough."""
    left, whole = (np.sum(r[:, :joints] ** 2, axis=0) for r in (after, before))
    explained: NDArray[np.bool_] = left <= (1.0 - QUICK.removes) * whole
    return explained


def cut_trial(trial: Trial, start: float, end: float) -> Trial:
    """The part of a trial between two times in s from its first state.

    Earlier commands are kept, because a delay makes them act later. Without a recorded velocity the
    first state has that of a local cubic.
    """
    inside = np.flatnonzero((trial.time >= start) & (trial.time <= end))
    first = float(trial.time[inside[0]])
    velocity: FloatArray
    if trial.velocity is None or not np.isfinite(trial.velocity[inside[0]]).all():
        velocity = np.full((len(inside), len(trial.joints)), np.nan)
        velocity[0] = smooth_state(trial.time, trial.position, first, QUICK.state_seconds)[1]
    else:
        velocity = trial.velocity[inside]
    sent = trial.command_time <= end
    return replace(
        trial,
        start=trial.start + round(first * 1e9),
        time=trial.time[inside] - first,
        position=trial.position[inside],
        velocity=velocity,
        effort=None if trial.effort is None else trial.effort[inside],
        command_time=trial.command_time[sent] - first,
        command=trial.command[sent],
        marks=(),
    )


def _worst_part(
    realization: Realization, trial: Trial, patched: PatchedModel | None, failed: Collection[str]
) -> tuple[Trial, float]:
    """The part of a trial around its largest error, and its start in s; a short trial whole."""
    if trial.duration <= QUICK.looked_at:
        return trial, 0.0
    if patched is None:
        replayed = replay(realization, [trial])[0]
    else:
        replayed = replay_whole(realization, patched, trial)
    if replayed.error is not None:
        raise replayed.error
    off = (trial.position - replayed.position)[:, _must_explain(trial.joints, failed)]
    off = off / np.maximum(np.sqrt(np.mean(off**2, axis=0)), 1e-12)
    start = _start_of_largest_sum(trial.time, (off**2).sum(axis=1), QUICK.looked_at)
    return cut_trial(trial, start, start + QUICK.looked_at), start


def _prepare(
    realization: Realization,
    fit: Sequence[Trial],
    aside: Sequence[Trial],
    patched: PatchedModel | None,
) -> PreparedProblem:
    """The problem of fitting ``fit`` and predicting ``aside``."""
    return ModelSetup.of(realization, patched).prepare(fit, aside)


def _must_explain(joints: Sequence[str], failed: Collection[str]) -> NDArray[np.bool_]:
    """(joints,) whether the error of a joint is to be explained: the failed joints, or all."""
    named = np.array([j in failed for j in joints])
    return named if named.any() else np.ones_like(named)


def _likely_causes(
    force: MissingForce, size: FloatArray, must_explain: NDArray[np.bool_]
) -> list[int]:
    """Joints at which effects are tried, the largest signal-to-noise ratio first.

    Joints whose error is to be explained come first, then others that may move them. If no force
    exceeds its noise, the joint with the largest error ``size``, in noise floors.
    """
    strength = force.strength
    order = np.argsort(-strength, kind="stable")
    largest = np.where(must_explain, strength, 0.0).max()
    # If the forces of these joints are all within the noise, other joints move them.
    own = must_explain & (largest > 1.0) & (strength >= QUICK.cause * largest)
    clear = [int(j) for j in order if own[j]]
    clear += [int(j) for j in order if strength[j] >= max(QUICK.cause * strength.max(), 1e-9)]
    worst = int(np.argmax(np.where(must_explain, size, 0.0)))
    return list(dict.fromkeys(clear))[: QUICK.most_joints] or [worst]


def _locate(
    prepared: PreparedProblem, trial: Trial, since: float, excess: FloatArray, joint: int
) -> TimeAndRegime:
    problem = prepared.problem
    unit = "m" if problem.simulator.layout.slides[joint] else "rad"
    found = locate_error(smooth_motions(prepared, [trial]), excess, joint, unit)
    moved = {
        name: [[round(a + since, 3), round(b + since, 3)] for a, b in windows]
        for name, windows in found.windows.items()
    }
    return TimeAndRegime(found.summary, moved)


def _parts_with_largest_force(problem: Problem, trial: Trial, excess: FloatArray) -> list[Trial]:
    """One or two short parts of a trial with the largest sums of ``excess``, not overlapping."""
    length = float(np.clip(QUICK.stretch_share * trial.duration, QUICK.shortest, QUICK.longest))
    time = np.concatenate([s.time for s in problem.simulator.segments])
    first = _start_of_largest_sum(time, excess, length)
    found = [cut_trial(trial, first, first + length)]
    left = np.where((time >= first - length) & (time <= first + length), 0.0, excess)
    if left.any():
        second = _start_of_largest_sum(time, left, length)
        if abs(second - first) >= length:
            found.append(cut_trial(trial, second, second + length))
    return found


def _start_of_largest_sum(time: FloatArray, excess: FloatArray, length: float) -> float:
    """Start in s of the part of ``length`` s with the largest sum of ``excess``."""
    summed = np.concatenate([[0.0], np.cumsum(excess)])
    last = max(float(time[-1]) - length, 0.0)
    begin = np.searchsorted(time, np.minimum(time, last))
    end = np.searchsorted(time, time[begin] + length, side="right")
    return float(time[begin[int(np.argmax(summed[end] - summed[begin]))]])


@dataclass(frozen=True, slots=True)
class _EffectSearch:
    """Search for the single most likely effect.

    Attributes:
        patched: effects that a diagnosis wrote outside the MJCF.
        examined: the trial, or its worst part.
        whole: the problem over ``examined``.
        before: (samples, signals) residual of the nominal model over ``examined``.
        must_explain: (joints,) whether the error of a joint is to be explained.
    """

    realization: Realization
    patched: PatchedModel | None
    examined: Trial
    whole: PreparedProblem
    before: FloatArray
    must_explain: NDArray[np.bool_]

    def find_likely_effect(
        self, force: MissingForce, size: FloatArray
    ) -> tuple[LikelyEffect, FloatArray] | None:
        """The most likely effect, and the residual over ``examined`` with it.

        None if no effect is supported.

        Args:
            size: (joints,) RMS error of the nominal model, in noise floors.
        """
        whole, must_explain = self.whole.problem, self.must_explain
        causes = _likely_causes(force, size, must_explain)
        own = [j for j in causes if must_explain[j]] or causes
        parts = _parts_with_largest_force(whole, self.examined, _force_excess(force, own))
        problem = _prepare(self.realization, parts[:1], parts[1:], self.patched).problem
        # The same scales, so that parameters fitted to the part have the same values on the whole.
        problem = replace(problem, scales=whole.scales, floor=whole.floor)
        signals = np.flatnonzero(must_explain)
        nominal = problem.residuals([EMPTY], problem.fit)[0]
        tried = _select_candidates(problem, causes, nominal, signals)
        if not tried:
            return None
        fitted, evidence = _fit_candidates(problem, tried, nominal, signals)
        best = int(np.argmax(evidence))
        after = whole.residuals([f.hypothesis for f in fitted], whole.fit)
        removed_share = 1.0 - _squared(after[best], whole, must_explain) / _squared(
            self.before, whole, must_explain
        )
        if not removed_share >= QUICK.removes:
            return None
        named = tried[best]
        place = _place_of(problem, named)
        places = [_place_of(problem, starts) for starts in tried]
        # Forms of one law are the same effect. A candidate that contains the best one and more is
        # no alternative to it.
        same = np.array([p == place for p in places])
        other = np.array([not _contains(starts, named) for starts in tried]) & ~same
        posterior_share = np.exp(np.maximum(evidence - evidence.max(), -700.0)) * (same | other)
        posterior_share /= posterior_share.sum()
        explained = must_explain & _is_explained(self.before, after[best], len(must_explain))
        left = np.array([_squared(r, whole, explained) for r in after])
        floor = float(len(self.before) * explained.sum())
        close = (left <= QUICK.clearly_worse * max(left[best], floor)) | (
            posterior_share >= 1.0 - QUICK.most_confidence
        )
        order = np.argsort(-evidence, kind="stable")
        close_alternatives = dict.fromkeys(places[i] for i in order if close[i] and other[i])
        alternatives = tuple(close_alternatives)[: QUICK.most_alternatives]
        effect = LikelyEffect(
            place=place,
            values=_reported_values(problem, fitted[best].hypothesis),
            posterior_share=min(float(posterior_share[same].sum()), QUICK.most_confidence),
            removed_share=float(removed_share),
            alternatives=alternatives,
            explained_joints=()
            if must_explain.all()
            else tuple(np.array(problem.joints)[must_explain].tolist()),
            alternative_shares=tuple(
                sum(float(s) for s, p in zip(posterior_share, places, strict=True) if p == place)
                for place in alternatives
            ),
            fitted=applied_effects(fitted[best].hypothesis, problem.joints, problem.scales),
        )
        return effect, after[best]


def _select_candidates(
    problem: Problem, causes: Sequence[int], nominal: FloatArray, signals: NDArray[np.int64]
) -> list[Starts]:
    """Candidates to be fitted: the best to first order, and those confused with the first one."""
    terms = [
        t
        for t in candidates(problem)
        # A short part does not show a warm-up, which takes minutes.
        if (t.joint < 0 or t.joint in causes) and not t.law.needs_temperature
    ]
    # Only positions count: an error of the efforts may have another cause.
    responses, mean = sensitivities(problem, terms, problem.fit, residual=nominal)
    seen = [
        replace(r, change=r.change[:, signals]) for r in responses if r.change[:, signals].any()
    ]
    binned = bins(problem, problem.fit)
    left = mean[:, signals]
    view = ResidualView(
        left, np.empty((*left.shape, 0)), problem.signal_floor[signals], binned.lengths
    )
    equations = NormalEquations(view, CandidateSensitivities(seen))
    chosen = list(equations.children(equations.base, QUICK.candidates))
    if not chosen:
        return []
    first = seen[chosen[0][0]].term
    chosen += [(at,) for at, response in enumerate(seen) if _are_confused(first, response.term)]
    # An effect of the robot may be the same effect at each of its joints.
    for robot in [seen[at].term for (at,) in chosen if seen[at].term.joint < 0]:
        alike: dict[str, list[int]] = {}
        for at, response in enumerate(seen):
            if response.term.joint >= 0 and _are_confused(robot, response.term):
                alike.setdefault(response.term.effect, []).append(at)
        chosen += [tuple(joints) for joints in alike.values() if len(joints) > 1]
    return [equations.structure(c).starts for c in dict.fromkeys(chosen)]


def _are_confused(one: Term, other: Term) -> bool:
    """Whether the catalogue lists two effects as confused, and they share a joint or the robot."""
    same = one.joint == other.joint or min(one.joint, other.joint) < 0
    return same and (other.effect in one.law.confused_with or one.effect in other.law.confused_with)


def _contains(starts: Starts, named: Starts) -> bool:
    """Whether a candidate contains ``named``: at more joints, or as a special case of its law."""
    if named.keys() < starts.keys():
        return True
    (term,), (other,) = (list(starts)[:1], list(named)[:1])
    special = term.law.special_cases({p.name: p.starts[0] for p in term.parameters})
    return term.joint == other.joint and other.effect in special


def _fit_candidates(
    problem: Problem,
    found: Sequence[Starts],
    nominal: FloatArray,
    signals: NDArray[np.int64],
) -> tuple[list[FittedModel], FloatArray]:
    """Candidates after a short fit, and their evidence relative to the nominal model.

    Args:
        nominal: (samples, signals) residual of the nominal model.
        signals: columns of the residual that count.
    """
    left = nominal[:, signals]
    mean_square = np.mean(left**2, axis=0)
    floor = np.maximum(problem.signal_floor[signals], QUICK.coarse * np.sqrt(mean_square))
    starts = [
        reduce(lambda made, term: made.with_term(*term), terms.items(), EMPTY) for terms in found
    ]
    weights = np.zeros(nominal.shape[1])
    weights[signals] = 1.0 / np.sqrt(mean_square + floor**2)
    fitted = fit(problem, starts, weights, problem.fit, iterations=QUICK.iterations)
    effective = effective_samples(left, problem.lengths(problem.fit))
    penalty = 0.5 * np.log(max(float(effective.mean()), 2.0))
    base = log_likelihood(left, floor, effective)
    evidence = np.array([
        log_likelihood(f.residual[:, signals], floor, effective) - base
        - penalty * f.hypothesis.free_count
        for f in fitted
    ])  # fmt: skip
    if len(problem.held_out):
        hypotheses = [EMPTY, *(f.hypothesis for f in fitted)]
        predicted = problem.residuals(hypotheses, problem.held_out)
        without, *with_term = (r[:, signals] for r in predicted)
        worth = effective_samples(without, problem.lengths(problem.held_out))
        base = log_likelihood(without, floor, worth)
        evidence += [log_likelihood(r, floor, worth) - base for r in with_term]
    return fitted, np.nan_to_num(evidence, nan=-np.inf)


def _squared(residual: FloatArray, problem: Problem, must_explain: NDArray[np.bool_]) -> float:
    """Sum of squared position errors in noise floors; infinite where a simulation diverged."""
    positions = residual[:, : len(problem.joints)] / problem.floor
    value = float(np.sum(positions[:, must_explain] ** 2))
    return value if np.isfinite(value) else float("inf")


def _place_of(problem: Problem, starts: Starts) -> Place:
    (effect,) = {term.effect for term in starts}
    return effect, tuple(problem.joints[term.joint] for term in starts if term.joint >= 0)


def _reported_values(problem: Problem, hypothesis: Hypothesis) -> dict[str, tuple[float, str]]:
    """Reported name -> (value, unit) of the first term's parameters, without choices of a form."""
    term = hypothesis.terms[0]
    simulator = problem.simulator
    kind = "slide" if simulator.layout.slides[max(term.joint, 0)] else "hinge"
    servo = str(simulator.layout.servo[max(term.joint, 0)])
    return {
        p.reported_name: (
            p.reported(float(value * problem.scales.value(p, term.joint))),
            p.unit(kind, servo),
        )
        for p, value in zip(term.parameters, hypothesis.theta, strict=False)
        if not p.choice
    }
