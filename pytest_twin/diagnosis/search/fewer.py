"""The same physics in fewer words: two terms as one law, a law as the simpler one it comes to."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.responses import grid
from pytest_twin.diagnosis.first_order.screen import candidates
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem


def merged(problem: Problem, hypothesis: Hypothesis) -> list[Hypothesis]:
    """The hypothesis with two terms of a joint as one of them that has the other in it, or as
    the one law that is confused with both.
    """
    out = []
    terms = [t for t in hypothesis.terms if t.joint >= 0]
    for a, b in itertools.combinations(terms, 2):
        if a.joint != b.joint:
            continue
        out += [h for h in (hypothesis.absorbed(a, b), hypothesis.absorbed(b, a)) if h]
        for new in candidates(problem):
            both = {a.effect, b.effect} <= set(new.law.confused_with)
            if both and new.joint == a.joint and new not in hypothesis.terms:
                (start, _), *_ = grid(new)
                out.append(hypothesis.without(a, b).with_term(new, start))
    return out


def of_the_robot(problem: Problem, hypothesis: Hypothesis) -> list[Hypothesis]:
    """The hypothesis with the same law at two joints or more as the one of the whole robot that is
    confused with it: commands that come late everywhere, or sensors that do. Parameters of one
    name start at the mean of what the joints have.
    """
    out = []
    for new in candidates(problem):
        if new.joint >= 0 or new in hypothesis.terms:
            continue
        for effect in new.law.confused_with:
            each = [t for t in hypothesis.terms if t.effect == effect and t.joint >= 0]
            if len(each) > 1:
                start = _mean(problem, hypothesis, each, new)
                out.append(hypothesis.without(*each).with_term(new, start))
    return out


def _mean(problem: Problem, hypothesis: Hypothesis, each: Sequence[Term], new: Term) -> FloatArray:
    """Where a term starts in the place of several: at their mean in parameters of one name."""
    (start, _), *_ = grid(new)
    each_has = [_values(problem, hypothesis, t) for t in each]
    for k, p in enumerate(new.parameters):
        alike = [values[p.name] for values in each_has if p.name in values]
        if alike:
            scale = problem.scales.value(p, new.joint)
            start[k] = np.clip(np.mean(alike) / scale, p.lower, p.upper)
    return start


def _values(problem: Problem, hypothesis: Hypothesis, term: Term) -> dict[str, float]:
    """Parameters of a term by name, SI units."""
    theta = hypothesis.theta[hypothesis.slice_of(term)]
    return {
        p.name: float(t) * problem.scales.value(p, term.joint)
        for p, t in zip(term.parameters, theta, strict=True)
    }


def simpler(problem: Problem, hypothesis: Hypothesis) -> list[Hypothesis]:
    """The hypothesis with one of its laws as the special case that it comes to."""
    out = []
    for term in hypothesis.terms:
        bare = hypothesis.without(term)
        cases = _special_cases(problem, hypothesis, term)
        out += [bare.with_term(new, start) for new, start in cases.items()]
    return out


def in_parts(problem: Problem, hypothesis: Hypothesis) -> list[Hypothesis]:
    """The hypothesis with a law whose shape ends at its bound as all that it comes to there: what
    takes a thousand seconds to fade is dry and viscous friction that stays.
    """
    out = []
    for term in hypothesis.terms:
        cases = _special_cases(problem, hypothesis, term)
        if len(cases) > 1 and problem.out_of_shape(hypothesis, term):
            out.append(hypothesis.without(term).with_terms(cases))
    return out


def _special_cases(problem: Problem, hypothesis: Hypothesis, term: Term) -> dict[Term, FloatArray]:
    """Laws that a term comes to at some of its parameters and that the hypothesis has not, and
    their own.
    """
    out = {}
    for effect, special in term.law.special_cases(_values(problem, hypothesis, term)).items():
        new = Term(effect, term.joint)
        if new not in hypothesis.terms:
            own = [special[p.name] / problem.scales.value(p, term.joint) for p in new.parameters]
            bounds = zip(own, new.parameters, strict=True)
            out[new] = np.array([np.clip(x, p.lower, p.upper) for x, p in bounds])
    return out


def in_other_forms(problem: Problem, hypothesis: Hypothesis) -> list[Hypothesis]:
    """The hypothesis with a law in a form that has fewer parameters, with a load on the last link
    in the place of another such link, or with a rotor in the place of a link's inertia.
    """
    out = []
    for term in hypothesis.terms:
        out += _forms_with_fewer(hypothesis, term)
        if term == Term("inertial_parameters", len(problem.joints) - 1):
            out += _as_payload(problem, hypothesis, term)
        if term.effect == "inertial_parameters":
            out += _as_rotor(problem, hypothesis, term)
    return out


def in_like_forms(hypothesis: Hypothesis) -> list[Hypothesis]:
    """The hypothesis with a law in another form that has as many parameters: other crests a turn, a
    gap on the other side of a law. Which one it takes is no slope's to tell, and was chosen when
    less was known beside it.
    """
    out = []
    for term in hypothesis.terms:
        out += _forms(hypothesis, term, len(term.parameters))
    return [h for h in out if h.free == hypothesis.free]


def _forms_with_fewer(hypothesis: Hypothesis, term: Term) -> list[Hypothesis]:
    """The hypothesis with a term in each form that has fewer parameters."""
    own = hypothesis.theta[hypothesis.slice_of(term)]
    return _forms(hypothesis, term, int(term.movable(own).sum()) - 1)


def _forms(hypothesis: Hypothesis, term: Term, most: int) -> list[Hypothesis]:
    """The hypothesis with a term in each other form of so many parameters at most; what both have
    stays.
    """
    place = hypothesis.slice_of(term)
    own = hypothesis.theta[place]
    movable, found = term.movable(own), dict[bytes, Hypothesis]()
    for start, _ in grid(term):
        other = term.movable(start)
        if other.sum() <= most:
            theta = hypothesis.theta.copy()
            theta[place] = np.where(movable & other, own, start)
            found[theta.tobytes()] = hypothesis.with_theta(theta)
    found.pop(hypothesis.theta.tobytes(), None)
    return list(found.values())


def _as_payload(problem: Problem, hypothesis: Hypothesis, link: Term) -> list[Hypothesis]:
    """The hypothesis with a last link of another mass and centre as it is and a load on it, of the
    same mass and first moment.
    """
    load = Term("payload", -1)
    layout, values = problem.simulator.layout, _values(problem, hypothesis, link)
    mass = float(problem.simulator.segments[0].model.body_mass[layout.body_index[-1]])
    added = values["mass_error"] * mass
    if load in hypothesis.terms or not added:
        return []
    last = np.array([link.joint])
    radial, tangential = np.array([values["radial"]]), np.array([values["tangential"]])
    (moved,), (axes,) = layout.shift(radial, tangential, last), layout.own_axes(last)
    center = layout.link_length[-1] * layout.directions[-1]
    at = axes @ (center + (mass + added) / added * moved)
    place = {"mass": added, **dict(zip(("distance", "sideways", "across"), at, strict=True))}
    found = dict[bytes, Hypothesis]()
    for start, _ in grid(load):
        has = load.law.has(start)
        for k, p in enumerate(load.parameters):
            if has[k] and p.name in place:
                start[k] = np.clip(place[p.name] / problem.scales.value(p, -1), p.lower, p.upper)
        found[has.tobytes()] = hypothesis.without(link).with_term(load, start)
    return list(found.values())


def _as_rotor(problem: Problem, hypothesis: Hypothesis, link: Term) -> list[Hypothesis]:
    """The hypothesis with a link of another inertia alone as it is, and as much more at its rotor.

    Where no joint before it turns the link about that axis the two are the same motion; and rotors
    and gears are what models leave out.
    """
    rotor = Term("armature", link.joint)
    layout, values = problem.simulator.layout, _values(problem, hypothesis, link)
    theta = hypothesis.theta[hypothesis.slice_of(link)]
    changed = {
        p.name for p, moves in zip(link.parameters, link.movable(theta), strict=True) if moves
    }
    if rotor in hypothesis.terms or layout.slides[link.joint] or changed != {"inertia_error"}:
        return []
    model, body = problem.simulator.segments[0].model, layout.body_index[link.joint]
    axis, turned_back = np.zeros(3), np.zeros(4)
    mujoco.mju_negQuat(turned_back, model.body_iquat[body])
    mujoco.mju_rotVecQuat(axis, model.jnt_axis[layout.joint_ids[link.joint]], turned_back)
    added = values["inertia_error"] * float(model.body_inertia[body] @ axis**2)
    (p,) = rotor.parameters
    start = np.clip(added / problem.scales.value(p, rotor.joint), p.lower, p.upper)
    return [hypothesis.without(link).with_term(rotor, np.array([start]))]
