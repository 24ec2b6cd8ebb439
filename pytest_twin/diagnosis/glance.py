"""A quick diagnosis of one recording, in seconds: the single most likely effect.

It locates the missing force, fits each effect at that joint to a short part of the recording, and
tests the best one on the whole recording. It does not combine effects and uses no other recording;
:mod:`pytest_twin.diagnosis.diagnose` does.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.evidence import effective_samples, log_likelihood
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.responses import responses
from pytest_twin.diagnosis.first_order.screen import Answers, Lens, View, candidates
from pytest_twin.diagnosis.fit import Fitted, fit
from pytest_twin.diagnosis.given import Given
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.locate import MissingForce, Where, missing_force, motions, place_of
from pytest_twin.diagnosis.patched.model import Patched
from pytest_twin.diagnosis.patched.replay import replay_whole
from pytest_twin.diagnosis.prepare import NOISE, Prepared
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.smoothing import smooth_state
from pytest_twin.diagnosis.verdict import AT_FLOOR
from pytest_twin.errors import SimulationError
from pytest_twin.realization import Realization
from pytest_twin.replay import replay
from pytest_twin.trial import Trial

# Of a longer recording, the stretch around its worst error, s.
_LOOKED_AT = 20.0
# Candidates are simulated over this share of what is looked at, and no less or more than this, s.
_STRETCH_SHARE, _SHORTEST, _LONGEST = 0.15, 1.0, 2.5
# Joints whose missing force stands out at least this much of the clearest one's are looked at.
_CAUSE, _MOST_JOINTS = 0.4, 2
_RIVALS, _ITERATIONS = 5, 3
# A name has to earn this much evidence, and take this share of the squared error away.
_EARNS, _WORTH = 5.0, 0.3
# What a short fit leaves below this share of the model's own error speaks for no name.
_COARSE = 0.05
# One stretch of one recording settles nothing.
_MOST_SURE = 0.9
_STATE_SECONDS = 0.06


@dataclass(frozen=True, slots=True)
class Suspect:
    """The most likely effect.

    Attributes:
        term: effect and column of the joint.
        joint: name of the joint, None for an effect of the whole robot.
        values: reported name of a parameter -> (value, unit).
        share: posterior share among the effects that were fitted.
        removed: share of the squared error that it removes.
        rivals: (effect, joint) of effects that fit nearly as well.
        of: joints whose errors it was fitted to; empty for all joints.
    """

    term: Term
    joint: str | None
    values: dict[str, tuple[float, str]]
    share: float
    removed: float
    rivals: tuple[tuple[str, str | None], ...] = ()
    of: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Glance:
    """Result of a quick diagnosis.

    Attributes:
        suspect: the most likely effect; None where no effect explains enough.
        joint: joint at which a force is missing, None where none is above the sensor noise.
        where: when and in which regime.
        floors: RMS error of the worst joint that was to be explained, in floors.
    """

    suspect: Suspect | None
    joint: str | None
    where: Where
    floors: float


def glance(
    realization: Realization,
    trial: Trial,
    patched: Patched | None = None,
    failed: Collection[str] = (),
) -> Glance:
    """Look at one trial.

    Args:
        realization: the model as it came.
        trial: what was recorded.
        patched: what stands beside the model, where a diagnosis wrote it.
        failed: joints whose errors are to be explained; all, where it names none that both have.
            Others may have errors that somebody allowed them, and that are larger in floors.

    Raises:
        RecordingError: the model and the recording share no joint.
        SimulationError: the model diverges.
        SpecError: a controller, payload or actuator that the model lacks.
    """
    seen, since = _worst_part(realization, trial, patched, failed)
    whole = _prepared(realization, [seen], [], patched)
    before = whole.problem.residuals([EMPTY], whole.problem.fit)[0]
    if not np.isfinite(before).all():
        raise SimulationError("the model diverges under the recorded commands", path=trial.path)
    joints = len(whole.problem.joints)
    counted = _counted(whole.problem.joints, failed)
    size = np.sqrt(np.mean(before[:, :joints] ** 2, axis=0)) / whole.problem.floor
    force = missing_force(whole.problem, before, whole.floor_parts[NOISE])
    causes = _causes(force, size, counted)
    blame = np.maximum((force.force[:, causes] / force.noise[causes]) ** 2 - 1.0, 0.0)
    where = _where(whole, seen, since, blame[:, 0], causes[0])
    suspect = None
    if size[counted].max() > AT_FLOOR:
        own = counted[causes] if counted[causes].any() else np.ones(len(causes), dtype=bool)
        parts = _stretches(whole.problem, seen, blame[:, own].sum(axis=1))
        suspect = _suspect(realization, parts, patched, whole, before, causes, counted)
    stands = bool(force.strength[causes[0]] > 1.0)
    joint = whole.problem.joints[causes[0]] if stands else None
    return Glance(suspect, joint, where, float(size[counted].max()))


def cut(trial: Trial, start: float, end: float) -> Trial:
    """A stretch of a trial, s from its first state; earlier commands stay, as they still act.

    Where no velocity was recorded, the first state gets that of a cubic through its neighbours.
    """
    inside = np.flatnonzero((trial.time >= start) & (trial.time <= end))
    first = float(trial.time[inside[0]])
    velocity: FloatArray
    if trial.velocity is None or not np.isfinite(trial.velocity[inside[0]]).all():
        velocity = np.full((len(inside), len(trial.joints)), np.nan)
        velocity[0] = smooth_state(trial.time, trial.position, first, _STATE_SECONDS)[1]
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
    realization: Realization, trial: Trial, patched: Patched | None, failed: Collection[str]
) -> tuple[Trial, float]:
    """The trial, or, of a long one, what lies around its largest error; and where that begins."""
    if trial.duration <= _LOOKED_AT:
        return trial, 0.0
    if patched is None:
        replayed = replay(realization, [trial], tcp=False)[0]
    else:
        replayed = replay_whole(realization, patched, trial)
    if replayed.error is not None:
        raise replayed.error
    off = (trial.position - replayed.position)[:, _counted(trial.joints, failed)]
    off = off / np.maximum(np.sqrt(np.mean(off**2, axis=0)), 1e-12)
    start = _fullest(trial.time, (off**2).sum(axis=1), _LOOKED_AT)
    return cut(trial, start, start + _LOOKED_AT), start


def _prepared(
    realization: Realization, fit: Sequence[Trial], aside: Sequence[Trial], patched: Patched | None
) -> Prepared:
    return Given.of(realization, patched).prepared(fit, aside)


def _counted(joints: Sequence[str], failed: Collection[str]) -> NDArray[np.bool_]:
    """(joints,) whose errors are to be explained."""
    named = np.array([j in failed for j in joints])
    return named if named.any() else np.ones_like(named)


def _causes(force: MissingForce, size: FloatArray, counted: NDArray[np.bool_]) -> list[int]:
    """Joints whose own force is missing, the clearest first, of those that count before others
    that may move them; else the joint that shows most.
    """
    strength = force.strength
    order = np.argsort(-strength, kind="stable")
    stands = np.where(counted, strength, 0.0).max()
    # Where none of their own forces stands out of the noise, they are moved by others.
    own = counted & (stands > 1.0) & (strength >= _CAUSE * stands)
    clear = [int(j) for j in order if own[j]]
    clear += [int(j) for j in order if strength[j] >= max(_CAUSE * strength.max(), 1e-9)]
    worst = int(np.argmax(np.where(counted, size, 0.0)))
    return list(dict.fromkeys(clear))[:_MOST_JOINTS] or [worst]


def _where(prepared: Prepared, trial: Trial, since: float, blame: FloatArray, joint: int) -> Where:
    problem = prepared.problem
    unit = "m" if problem.simulator.layout.slides[joint] else "rad"
    found = place_of(motions(prepared, [trial]), blame, joint, unit)
    moved = {
        name: [[round(a + since, 3), round(b + since, 3)] for a, b in windows]
        for name, windows in found.windows.items()
    }
    return Where(found.summary, moved)


def _stretches(problem: Problem, trial: Trial, blame: FloatArray) -> list[Trial]:
    """Where most of the blame lies, and, where there is room, where most of the rest does."""
    length = float(np.clip(_STRETCH_SHARE * trial.duration, _SHORTEST, _LONGEST))
    time = np.concatenate([s.time for s in problem.simulator.segments])
    first = _fullest(time, blame, length)
    found = [cut(trial, first, first + length)]
    left = np.where((time >= first - length) & (time <= first + length), 0.0, blame)
    if left.any():
        second = _fullest(time, left, length)
        if abs(second - first) >= length:
            found.append(cut(trial, second, second + length))
    return found


def _fullest(time: FloatArray, blame: FloatArray, length: float) -> float:
    """Start of the stretch of ``length`` s that holds most of the blame."""
    summed = np.concatenate([[0.0], np.cumsum(blame)])
    last = max(float(time[-1]) - length, 0.0)
    begin = np.searchsorted(time, np.minimum(time, last))
    end = np.searchsorted(time, time[begin] + length, side="right")
    return float(time[begin[int(np.argmax(summed[end] - summed[begin]))]])


def _suspect(
    realization: Realization,
    parts: Sequence[Trial],
    patched: Patched | None,
    whole: Prepared,
    before: FloatArray,
    causes: Sequence[int],
    counted: NDArray[np.bool_],
) -> Suspect | None:
    problem = _prepared(realization, parts[:1], parts[1:], patched).problem
    # One measure of parameters, so that a fit of the stretch means the same on the whole.
    problem.scales, problem.floor = whole.problem.scales, whole.problem.floor
    terms = [
        t
        for t in candidates(problem)
        # A stretch's clock begins anew, and what warms up does so over minutes.
        if (t.joint < 0 or t.joint in causes) and not t.law.asks_temperature
    ]
    # Positions come first, and are what is held; what efforts are off may be another law's.
    signals = np.flatnonzero(counted)
    nominal = problem.residuals([EMPTY], problem.fit)[0]
    answers, mean = responses(problem, terms, problem.fit, residual=nominal)
    seen = [replace(r, change=r.change[:, signals]) for r in answers if r.change[:, signals].any()]
    binned = bins(problem, problem.fit)
    left = mean[:, signals]
    view = View(left, np.empty((*left.shape, 0)), problem.signal_floor[signals], binned.lengths)
    lens = Lens(view, Answers(seen))
    found = [
        next(iter(lens.structure(chosen).starts.items()))
        for chosen in lens.children(lens.bare, _RIVALS)
    ]
    if not found:
        return None
    fitted, evidence = _weighed(problem, found, nominal, signals)
    best = int(np.argmax(evidence))
    named = found[best][0]
    share = np.exp(np.clip(evidence - evidence.max(), -700.0, 0.0))
    # A law that is the named one without what more it has is no other name for it.
    share[[t.joint == named.joint and named.effect in _plainer(t) for t, _ in found]] = 0.0
    share /= share.sum()
    after = whole.problem.residuals([fitted[best].hypothesis], whole.problem.fit)[0]
    squared_after, squared_before = (_squared(r, whole.problem, counted) for r in (after, before))
    removed = 1.0 - squared_after / squared_before
    if evidence[best] < _EARNS or not removed >= _WORTH:
        return None
    rivals = [i for i in np.argsort(-share) if i != best and share[i] >= 1.0 - _MOST_SURE]
    return Suspect(
        term=named,
        joint=_joint(problem, named),
        values=_values(problem, fitted[best].hypothesis),
        share=min(float(share[best]), _MOST_SURE),
        removed=float(removed),
        rivals=tuple((found[i][0].effect, _joint(problem, found[i][0])) for i in rivals),
        of=() if counted.all() else tuple(np.array(problem.joints)[counted].tolist()),
    )


def _plainer(term: Term) -> Collection[str]:
    """Laws with fewer parameters that a term's comes to."""
    return term.law.special_cases({p.name: p.starts[0] for p in term.parameters}).keys()


def _weighed(
    problem: Problem,
    found: Sequence[tuple[Term, FloatArray]],
    nominal: FloatArray,
    signals: NDArray[np.int64],
) -> tuple[list[Fitted], FloatArray]:
    """The candidates after a short fit, and the evidence of each over the model as it came.

    Args:
        nominal: (samples, signals) residual of the model as it came.
        signals: columns of those that count.
    """
    left = nominal[:, signals]
    mean_square = np.mean(left**2, axis=0)
    floor = np.maximum(problem.signal_floor[signals], _COARSE * np.sqrt(mean_square))
    starts = [EMPTY.with_term(term, start) for term, start in found]
    weights = np.zeros(nominal.shape[1])
    weights[signals] = 1.0 / np.sqrt(mean_square + floor**2)
    fitted = fit(problem, starts, weights, problem.fit, iterations=_ITERATIONS)
    effective = effective_samples(left, problem.lengths(problem.fit))
    price = 0.5 * np.log(max(float(effective.mean()), 2.0))
    base = log_likelihood(left, floor, effective)
    evidence = np.array([
        log_likelihood(f.residual[:, signals], floor, effective) - base - price * f.hypothesis.free
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


def _squared(residual: FloatArray, problem: Problem, counted: NDArray[np.bool_]) -> float:
    """Sum of squared position errors in floors; infinite where a simulation diverged."""
    positions = residual[:, : len(problem.joints)] / problem.floor
    value = float(np.sum(positions[:, counted] ** 2))
    return value if np.isfinite(value) else float("inf")


def _joint(problem: Problem, term: Term) -> str | None:
    return None if term.joint < 0 else problem.joints[term.joint]


def _values(problem: Problem, hypothesis: Hypothesis) -> dict[str, tuple[float, str]]:
    (term,) = hypothesis.terms
    simulator = problem.simulator
    kind = "slide" if simulator.layout.slides[max(term.joint, 0)] else "hinge"
    servo = str(simulator.layout.servo[max(term.joint, 0)])
    return {
        p.reported_name: (
            p.reported(float(value * problem.scales.value(p, term.joint))),
            p.unit(kind, servo),
        )
        for p, value in zip(term.parameters, hypothesis.theta, strict=True)
    }
