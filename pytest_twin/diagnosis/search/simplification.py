"""Simpler models of the same physics: merged terms, special cases, forms with fewer parameters."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.first_order.sensitivities import starting_grid
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects import catalogue
from pytest_twin.estimation.hypothesis import Hypothesis, Term


def merge_terms(problem: Problem, hypothesis: Hypothesis) -> list[Hypothesis]:
    """Hypotheses with one term instead of two of a joint.

    The one term is either of the two, if it can represent the other, or another effect that the
    catalogue lists as confused with both.
    """
    out = []
    terms = [t for t in hypothesis.terms if t.joint >= 0]
    for a, b in itertools.combinations(terms, 2):
        if a.joint != b.joint:
            continue
        out += [h for h in (hypothesis.with_absorbed(a, b), hypothesis.with_absorbed(b, a)) if h]
        for new in candidates(problem):
            both = {a.effect, b.effect} <= set(new.law.confused_with)
            if both and new.joint == a.joint and new not in hypothesis.terms:
                (start, _), *_ = starting_grid(new)
                out.append(hypothesis.without(a, b).with_term(new, start))
    return out


def merge_joints(problem: Problem, hypothesis: Hypothesis) -> list[Hypothesis]:
    """Hypotheses with one effect of the robot instead of an effect at several joints.

    For example a sensor delay instead of command delays at all joints. Parameters with the same
    name start at the mean over the joints.
    """
    out = []
    for new in candidates(problem):
        if new.joint >= 0 or new in hypothesis.terms:
            continue
        for effect in new.law.confused_with:
            each = [t for t in hypothesis.terms if t.effect == effect and t.joint >= 0]
            if len(each) > 1:
                start = mean_start(problem, hypothesis, each, new)
                out.append(hypothesis.without(*each).with_term(new, start))
    return out


def mean_start(
    problem: Problem, hypothesis: Hypothesis, each: Sequence[Term], new: Term
) -> FloatArray:
    """Start of the term ``new``: the mean of equally named parameters of the terms ``each``."""
    (start, _), *_ = starting_grid(new)
    each_has = [values_of(problem, hypothesis, t) for t in each]
    for k, p in enumerate(new.parameters):
        alike = [values[p.name] for values in each_has if p.name in values]
        if alike:
            scale = problem.scales.value(p, new.joint)
            start[k] = np.clip(np.mean(alike) / scale, p.lower, p.upper)
    return start


def values_of(problem: Problem, hypothesis: Hypothesis, term: Term) -> dict[str, float]:
    """Parameters of a term by name, SI units."""
    theta = hypothesis.theta[hypothesis.slice_of(term)]
    return {
        p.name: float(t) * problem.scales.value(p, term.joint)
        for p, t in zip(term.parameters, theta, strict=True)
    }


def special_cases(problem: Problem, hypothesis: Hypothesis) -> list[Hypothesis]:
    """Hypotheses with one law replaced by a special case of it."""
    out = []
    for term in hypothesis.terms:
        rest = hypothesis.without(term)
        cases = _special_cases(problem, hypothesis, term)
        out += [rest.with_term(new, start) for new, start in cases.items()]
    return out


def as_settings(problem: Problem, hypothesis: Hypothesis) -> list[Hypothesis]:
    """Hypotheses with a special case replaced by the law that every drive of its kind has.

    For example the gain of a position servo instead of a torque constant.
    """
    servo, possible, out = problem.simulator.layout.servo, set(candidates(problem)), []
    for term in hypothesis.terms:
        if term.joint < 0 or servo[term.joint] in term.law.basic_modes:
            continue
        for effect, law in catalogue().items():
            new = replace(term, effect=effect)
            general = term.effect in law.generalizes and servo[term.joint] in law.basic_modes
            if general and new in possible and new not in hypothesis.terms:
                absent = np.array([p.absent_value for p in new.parameters])
                restated = hypothesis.with_term(new, absent).with_absorbed(term, new)
                out += [] if restated is None else [restated]
    return out


def split_terms(problem: Problem, hypothesis: Hypothesis) -> list[Hypothesis]:
    """Hypotheses with a law whose shape parameter is at its bound replaced by its special cases.

    For example thermal friction that takes 1000 s to fade becomes Coulomb and viscous friction.
    """
    out = []
    for term in hypothesis.terms:
        cases = _special_cases(problem, hypothesis, term)
        if len(cases) > 1 and problem.has_shape_at_bound(hypothesis, term):
            out.append(hypothesis.without(term).with_terms(cases))
    return out


def _special_cases(problem: Problem, hypothesis: Hypothesis, term: Term) -> dict[Term, FloatArray]:
    """Special case of a term that the hypothesis lacks -> its scaled parameters.

    A law that cannot have the value is none: no torque constant is 1 % of the right one.
    """
    out = {}
    for effect, special in term.law.special_cases(values_of(problem, hypothesis, term)).items():
        new = Term(effect, term.joint)
        if new not in hypothesis.terms:
            own = [special[p.name] / problem.scales.value(p, term.joint) for p in new.parameters]
            if all(p.lower <= x <= p.upper for x, p in zip(own, new.parameters, strict=True)):
                out[new] = np.array(own)
    return out


def simpler_forms(problem: Problem, hypothesis: Hypothesis) -> list[Hypothesis]:
    """Hypotheses with a law in a form with fewer parameters, or with an equivalent effect.

    For example a payload instead of other inertial parameters of the last link.
    """
    out = []
    for term in hypothesis.terms:
        out += _forms_with_fewer(hypothesis, term)
        out += _as_equivalents(problem, hypothesis, term)
    return out


def equal_sized_forms(hypothesis: Hypothesis) -> list[Hypothesis]:
    """Hypotheses with a law in another form with the same number of parameters.

    Examples are another number of periods per turn, or a dead zone of the other signal. A form is
    discrete: no gradient decides it, and it was chosen before other effects were found.
    """
    out = []
    for term in hypothesis.terms:
        out += _other_forms(hypothesis, term, len(term.parameters))
    return [h for h in out if h.free_count == hypothesis.free_count]


def _forms_with_fewer(hypothesis: Hypothesis, term: Term) -> list[Hypothesis]:
    """The hypothesis with a term in each form that has fewer parameters."""
    own = hypothesis.theta[hypothesis.slice_of(term)]
    return _other_forms(hypothesis, term, int(term.is_estimated(own).sum()) - 1)


def _other_forms(hypothesis: Hypothesis, term: Term, max_parameters: int) -> list[Hypothesis]:
    """Hypotheses with a term in each other form with at most ``max_parameters`` parameters.

    Parameters that both forms have are kept.
    """
    place = hypothesis.slice_of(term)
    own = hypothesis.theta[place]
    is_estimated, found = term.is_estimated(own), dict[bytes, Hypothesis]()
    for start, _ in starting_grid(term):
        other = term.is_estimated(start)
        if other.sum() <= max_parameters:
            theta = hypothesis.theta.copy()
            theta[place] = np.where(is_estimated & other, own, start)
            found[theta.tobytes()] = hypothesis.with_theta(theta)
    found.pop(hypothesis.theta.tobytes(), None)
    return list(found.values())


def _as_equivalents(problem: Problem, hypothesis: Hypothesis, term: Term) -> list[Hypothesis]:
    """Hypotheses with a term replaced by each form of each equivalent effect that they lack."""
    layout, model = problem.simulator.layout, problem.simulator.segments[0].model
    values = values_of(problem, hypothesis, term)
    out: list[Hypothesis] = []
    for effect, own in term.law.equivalents(values, layout, model, term.joint).items():
        new = Term(effect, -1 if catalogue()[effect].scope == "robot" else term.joint)
        if new in hypothesis.terms:
            continue
        forms = dict[bytes, Hypothesis]()
        for start, _ in starting_grid(new):
            has = new.law.has(start)
            for k, p in enumerate(new.parameters):
                if has[k] and p.name in own:
                    scale = problem.scales.value(p, new.joint)
                    start[k] = np.clip(own[p.name] / scale, p.lower, p.upper)
            forms[has.tobytes()] = hypothesis.without(term).with_term(new, start)
        out += forms.values()
    return out
