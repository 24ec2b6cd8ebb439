"""A quick diagnosis of one recording, in seconds: the first rounds of the search.

It locates the missing force, searches the effects at that joint on short parts of the recording,
and tests them on the whole recording.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.build_problem import build_problem, residuals_everywhere
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
from pytest_twin.diagnosis.problem import CandidateMask, Problem
from pytest_twin.diagnosis.quick_settings import QUICK
from pytest_twin.diagnosis.search.physics import SimulatedPhysics
from pytest_twin.diagnosis.search.posterior import AlternativeEffects, posterior
from pytest_twin.diagnosis.search.search import Search, SearchOutcome
from pytest_twin.diagnosis.smoothing import smooth_state
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.effects import catalogue
from pytest_twin.errors import SimulationError
from pytest_twin.estimation.deadline import CHECK, no_limit
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.open_loop import replay
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial


@dataclass(frozen=True, slots=True)
class QuickDiagnosis:
    """Result of a quick diagnosis.

    Attributes:
        likely_effects: the most likely effects, that which explains most first; empty if none is
            supported.
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

    @property
    def is_at_noise(self) -> bool:
        """Whether no error is above the noise, so that no cause was looked for."""
        return self.floors <= VERDICT.at_floor


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
    setup = ModelSetup.of(realization, patched)
    whole = setup.prepare([examined], [])
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
    likely_effects: tuple[LikelyEffect, ...] = ()
    left = must_explain & (size > VERDICT.at_floor)
    if left.any():
        own = [j for j in causes if must_explain[j]] or causes
        parts = _parts_with_largest_force(whole.problem, examined, _force_excess(force, own))
        # A short part does not show the time step of a simulation that made it.
        masked = replace(setup, mask=_mask(whole.problem, causes), is_of_robot=True)
        searched = _search(masked, parts, whole.problem, must_explain)
        # What was found within the time is tested.
        token = CHECK.set(no_limit)
        try:
            likely_effects, after = _likely_effects(searched, whole.problem, must_explain)
        finally:
            CHECK.reset(token)
        left &= ~_is_explained(before, after, joints)
    is_located = bool(force.strength[causes[0]] > 1.0)
    names = whole.problem.joints
    return QuickDiagnosis(
        likely_effects=likely_effects,
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


def _mask(problem: Problem, causes: Sequence[int]) -> CandidateMask:
    """Effects of the robot and of the joints ``causes`` that a short part shows.

    A warm-up takes minutes.
    """
    effects = (name for name, law in catalogue().items() if not law.needs_temperature)
    others = (n for j, n in enumerate(problem.joints) if j not in causes)
    return CandidateMask(frozenset(effects), unchanged_joints=frozenset(others))


def _search(
    setup: ModelSetup,
    parts: Sequence[Trial],
    whole: Problem,
    must_explain: NDArray[np.bool_],
) -> SearchOutcome:
    """The first rounds of the search on parts of a recording.

    Parameters have the scales of the whole recording.
    """
    ignored = [n for n, must in zip(whole.joints, must_explain, strict=True) if not must]
    trials = TrialSet(tuple(parts), (), (), unseen=frozenset(ignored))
    prepared, trials = build_problem(setup, trials, [], scales=whole.scales)
    return Search(SimulatedPhysics(setup, prepared, trials)).run(rounds=QUICK.rounds)


def _likely_effects(
    searched: SearchOutcome, whole: Problem, must_explain: NDArray[np.bool_]
) -> tuple[tuple[LikelyEffect, ...], FloatArray]:
    """The effects of a search that remove much of the error, and the residual with them.

    Args:
        whole: the problem of the examined recording.
        must_explain: (joints,) whether the error of a joint is to be explained.
    """
    found = searched.incumbent.hypothesis
    while True:
        after, *without = (
            residuals_everywhere(whole, h) for h in (found, *map(found.without, found.terms))
        )
        squared = _squared(after, whole, must_explain)
        removed = {
            t: 1.0 - squared / _squared(absent, whole, must_explain)
            for t, absent in zip(found.terms, without, strict=True)
        }
        weakest = min(found.terms, key=removed.__getitem__, default=None)
        if weakest is None or removed[weakest] >= QUICK.removes:
            break
        found = found.without(weakest)
    shares, out = posterior(searched), list[LikelyEffect]()
    for term, absent in zip(found.terms, without, strict=True):
        explained = must_explain & _is_explained(absent, after, len(must_explain))
        alone = EMPTY.with_term_of(found, term)
        out.append(
            LikelyEffect(
                place=_place_of(whole, [term]),
                values=_reported_values(whole, alone),
                posterior_share=min(shares.confidence[term], QUICK.most_confidence),
                removed_share=removed[term],
                alternatives=_rivals(shares.alternatives[term], whole),
                explained_joints=()
                if explained.all()
                else tuple(np.array(whole.joints)[explained].tolist()),
                fitted=applied_effects(alone, whole.joints, whole.scales),
            )
        )
    return tuple(sorted(out, key=lambda effect: -effect.removed_share)), after


def _rivals(alternatives: Sequence[AlternativeEffects], problem: Problem) -> tuple[Place, ...]:
    """The likeliest single effects that may act instead of one, most likely first."""
    likely = [
        _place_of(problem, a.new) for a in alternatives
        if a.confidence >= 1.0 - QUICK.most_confidence and len({t.effect for t in a.new}) == 1
    ]  # fmt: skip
    return tuple(dict.fromkeys(likely))[: QUICK.most_alternatives]


def _place_of(problem: Problem, terms: Sequence[Term]) -> Place:
    """The effect of some terms, and its joints."""
    return terms[0].effect, tuple(problem.joints[t.joint] for t in terms if t.joint >= 0)


def _squared(residual: FloatArray, problem: Problem, must_explain: NDArray[np.bool_]) -> float:
    """Sum of squared position errors in noise floors; infinite where a simulation diverged."""
    positions = residual[:, : len(problem.joints)] / problem.floor
    value = float(np.sum(positions[:, must_explain] ** 2))
    return value if np.isfinite(value) else float("inf")


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
