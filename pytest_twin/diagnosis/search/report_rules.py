"""Which effects of the last incumbent carry a name, by three rules.

1. A total of model and effects is possible, and shape parameters are in the recorded range.
2. The 95 % interval of an effect does not contain its absence.
3. An effect explains its own mismatch: of the error where it acts no large share remains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.intervals import ParameterUncertainty
from pytest_twin.diagnosis.noise_levels import excess
from pytest_twin.diagnosis.search.model import Model
from pytest_twin.diagnosis.search.physics import Physics
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.hypothesis import Term

_NEEDED_SHARE = 0.25
"""Share of the mismatch from which an effect is needed, whatever its interval contains."""
_MAY_REMAIN = 0.25
"""Largest share of the squared mismatch that may remain where an effect acts."""


@dataclass(frozen=True, slots=True)
class Rejections:
    """Effects without a name -> the reason, for the reader.

    Attributes:
        wrong: impossible, or they leave much where they act.
        absent: their intervals contain their absence; the least needed first.
    """

    wrong: Mapping[Term, str]
    absent: Mapping[Term, str]


def rejections(
    model: Model,
    nominal: Model,
    without_each: Mapping[Term, FloatArray],
    uncertainty: ParameterUncertainty,
    physics: Physics,
) -> Rejections:
    """Effects without a name, by the rules above.

    Args:
        model: the last incumbent, with its Jacobian.
        nominal: the model without effects.
        without_each: term -> (signals,) mean squared residual of the model refitted without it.
        physics: the robot and its recordings. Effects that every robot has, such as friction,
            imitate nothing: the third rule does not apply to the given ones.
    """
    out, floor, joints = dict[Term, str](), physics.floor, len(physics.joints)
    impossible, given = physics.refusals(model.hypothesis), physics.given
    before, after = (m.mean_square / floor**2 for m in (nominal, model))
    may_be_absent = list[Term]()
    for term in model.hypothesis.terms:
        columns = _signals_of(term, joints, len(floor))
        if term in impossible:
            out[term] = impossible[term]
        elif contains_absence(model, term, uncertainty) and not _is_needed(
            without_each[term][columns] / floor[columns] ** 2, after[columns], before[columns]
        ):
            may_be_absent.append(term)
        elif (
            term not in given
            and (share := _remaining_share(before[columns], after[columns])) > _MAY_REMAIN
        ):
            out[term] = (
                f"it is the closest known effect: {100 * share:.0f} % of the squared error remains "
                "where it acts"
            )
    may_be_absent.sort(key=lambda t: float(np.sum(without_each[t] / floor**2)))
    absent = absent_together(model, may_be_absent, uncertainty, floor)
    return Rejections(out, dict.fromkeys(absent, "its 95 % interval contains its absence"))


def absent_together(
    model: Model, terms: Sequence[Term], uncertainty: ParameterUncertainty, floor: FloatArray
) -> list[Term]:
    """Effects that may all be absent at once, of those that may be absent alone.

    Two effects with one cause, such as the damping of a joint and of its servo, may each be absent,
    but not both. The least needed one is removed, and the others are tested with the parameters
    that a fit without it would have (in the linearized motion).

    Args:
        terms: effects whose interval contains their absence, the least needed first.
        uncertainty: of the parameters of the model.
        floor: (signals,) noise floor.
    """
    if len(terms) < 2:
        return list(terms)
    hypothesis, jacobian = model.hypothesis, model.jacobian
    assert jacobian is not None
    weight = 1.0 / np.maximum(model.mean_square, floor**2)
    information = np.einsum("tsp,s,tsq->pq", jacobian, weight, jacobian)
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    variance = np.diag(np.linalg.pinv(information / np.outer(size, size), hermitian=True))
    ratio = uncertainty.half_width * size / np.sqrt(np.maximum(variance, 1e-300))
    # Half width of an interval over the deviation of white noise, of the best determined parameter.
    width = float(np.min(ratio[np.isfinite(ratio) & (ratio > 0.0)], initial=np.inf))
    removed = list(terms[:1])
    for term in terms[1:]:
        columns = np.flatnonzero(hypothesis.parameters_without(*removed))
        gone = np.flatnonzero(~hypothesis.parameters_without(*removed))
        inverse = np.linalg.pinv(
            information[np.ix_(columns, columns)] / np.outer(size[columns], size[columns]),
            hermitian=True,
        ) / np.outer(size[columns], size[columns])
        absent = np.concatenate([[p.absent_value for p in t.parameters] for t in hypothesis.terms])
        step = inverse @ information[np.ix_(columns, gone)] @ (hypothesis.theta - absent)[gone]
        theta = hypothesis.theta.copy()
        theta[columns] += step
        place = hypothesis.slice_of(term)
        own = [place.start + k for k in term.amplitude_indices(theta[place])]
        within = np.searchsorted(columns, own)
        offset = (theta - absent)[own]
        covariance = inverse[np.ix_(within, within)] * width**2
        distance = offset @ np.linalg.pinv(covariance, hermitian=True) @ offset
        if distance <= 1.0:
            removed.append(term)
    return removed


def contains_absence(model: Model, term: Term, uncertainty: ParameterUncertainty) -> bool:
    """Whether the 95 % region of the parameters that switch an effect on contains its absence.

    Parameters without a slope (the release of a drive) have no region; such an effect is present.
    """
    jacobian = model.jacobian
    assert jacobian is not None
    parameters = model.hypothesis.slice_of(term)
    amplitudes = term.amplitude_indices(model.hypothesis.theta[parameters])
    columns = np.array([parameters.start + k for k in amplitudes])
    if not np.any(jacobian[:, :, columns] != 0.0, axis=(0, 1)).all():
        return False
    neutral = np.array([term.parameters[k].neutral for k in amplitudes], dtype=float)
    offset = neutral - model.hypothesis.theta[columns]
    return uncertainty.normalized_distance(columns, offset) <= 1.0


def _is_needed(without: FloatArray, after: FloatArray, before: FloatArray) -> bool:
    """Whether the residual grows by a large share of the mismatch without an effect."""
    return bool((without - after > _NEEDED_SHARE * before).any())


def _remaining_share(before: FloatArray, after: FloatArray) -> float:
    """Share of the squared mismatch above the noise that remains; 0 where only noise remains."""
    if after.max() <= VERDICT.identifiable**2:
        return 0.0
    mismatch = excess(before)
    return excess(after) / mismatch if mismatch > 0.0 else 0.0


def _signals_of(term: Term, joints: int, signals: int) -> slice:
    """Signals that an effect can change: positions and efforts of its joint, or of all joints.

    Of an error of effort readings these are efforts alone, since it changes no motion.
    """
    first = joints if term.law.needs_effort_sensor and signals > joints else 0
    return slice(first, None) if term.joint < 0 else slice(first + term.joint, None, joints)
