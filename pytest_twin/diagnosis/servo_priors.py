"""Combine the parameters of a fit with what the twin knows of its servos.

Each known parameter is one row of a pseudo-residual, ``(quantity - value) / deviation``: the Kalman
update of the fit by one more measurement (Kalman 1960; Gelman et al., Bayesian Data Analysis, 2013,
sec. 14.8). The quantity is the model's own value with all effects of the fit that correct it, so
the row does not ask which effect it was called. Where the recordings contradict a value, it is not
used: the servo is then another one, or has other settings.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.intervals import ParameterUncertainty, parameter_uncertainty
from pytest_twin.diagnosis.physical_totals import own_values, totals
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.actuation import ControllerGain, TorqueConstant, TorqueSaturation
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel, fit
from pytest_twin.estimation.score import effective_samples
from pytest_twin.formats.record_fields import Z95
from pytest_twin.metrics.joint_covariance import with_deviations
from pytest_twin.servos.prior import ParameterPrior

CONTRADICTED = 3.0
"""Joint standard deviations of recordings and prior from which a prior is not used."""
MOST_SURPRISE = 12.5
"""Largest log-density that one prior takes off a score: five standard deviations. It pays for one
more effect that predicts as well, such as friction of the joint instead of other damping of the
servo, and not for a worse prediction: the servo may have other settings."""
_STEPS = 6
"""Largest number of steps of a fit with priors."""
_UNDAMPED, _DAMPED = 1e-6, 1e-2
"""Damping of these steps, relative to the diagonal of the normal matrix."""
_CORRECTIONS = 3
"""Undamped steps of which the best counts."""
_LEAST_GAIN = 0.01
"""Log-density that a step must gain."""
_MOST_INFLATION = 100.0
"""Largest factor of the variance of the recordings: beyond it a fit has not converged."""
_COLUMNS_DIFFER = 0.01
"""Share of a derivative by which two of them must differ to be distinguished, as in
:mod:`pytest_twin.identification.simulation.undetermined_terms`."""
_NARROWER = 0.999
"""Share of a deviation up to which a prior has narrowed it."""
_MOST_OPEN = 10.0
"""Standard deviations of a prior above which the recordings do not determine its parameter."""
_LEAST_SHARE = 1e-9
"""Least share of a prior's variance that the recordings must reduce to say anything of it."""
_TOTALS: Mapping[str, str] = {
    "viscous": "viscous friction", "friction": "dry friction", "armature": "armature",
}  # fmt: skip
_GAINS = ("stiffness", "damping")

State = Literal["combined", "contradicted", "not_estimated", "not_comparable"]


@dataclass(frozen=True, slots=True)
class PriorUse:
    """What became of one prior.

    Attributes:
        state: ``combined`` with the recordings; ``contradicted`` by them and not used;
            ``not_estimated``, because no effect of the fit corrects the parameter, which then has
            the model's value; ``not_comparable``, with the reason.
        model: the model's own value, in the prior's unit.
        data: value and 95 % interval of the recordings alone; None if they are not estimated.
        combined: the same with the prior; None if it is not used.
        distance: of prior and recordings, in their joint standard deviations; None without data.
        why: reason, for the reader.
    """

    prior: ParameterPrior
    state: State
    model: float | None = None
    data: tuple[float, float, float] | None = None
    combined: tuple[float, float, float] | None = None
    distance: float | None = None
    why: str = ""

    def to_json(self) -> dict[str, Any]:
        """One entry of ``priors`` in ``diagnosis.json`` and ``identification.json``."""
        prior = self.prior
        entry: dict[str, Any] = {
            "servo": prior.servo, "joint": prior.joint, "parameter": prior.parameter,
            "unit": prior.unit, "value": prior.value, "ci95": list(prior.ci95),
            "state": self.state, "model": self.model,
        }  # fmt: skip
        for name, estimate in (("data", self.data), ("combined", self.combined)):
            if estimate is not None:
                entry[name] = {"value": estimate[0], "ci95": list(estimate[1:])}
        if self.distance is not None:
            entry["distance"] = round(self.distance, 3)
        return entry | ({"why": self.why} if self.why else {})


@dataclass(frozen=True, slots=True)
class CombinedFit:
    """A fit with the priors of its servos.

    Attributes:
        fitted: at the combined parameters.
        uses: what became of each prior.
    """

    fitted: FittedModel
    uncertainty: ParameterUncertainty
    uses: tuple[PriorUse, ...] = ()

    @property
    def hypothesis(self) -> Hypothesis:
        """The combined parameters."""
        return self.fitted.hypothesis

    @property
    def is_moved(self) -> bool:
        """Whether a prior was combined with the recordings."""
        return any(use.state == "combined" for use in self.uses)


@dataclass(frozen=True, slots=True)
class _Row:
    """One prior as a row of the fit; reciprocals for a limit of the effort.

    Attributes:
        value: the quantity at the parameters of the fit.
        gradient: (parameters,) its derivatives.
        expected, deviation: of the prior.
    """

    prior: ParameterPrior
    own: float
    value: float
    gradient: FloatArray
    expected: float
    deviation: float

    @property
    def model(self) -> float | None:
        """The model's own value, in the prior's unit; None for an unlimited effort."""
        if not self.is_reciprocal:
            return self.own
        return 1.0 / self.own if self.own > 0.0 else None

    @property
    def is_reciprocal(self) -> bool:
        """Whether the quantity is the reciprocal of the prior's parameter."""
        return self.prior.parameter == "effort_limit"

    def estimate(self, value: float, deviation: float) -> tuple[float, float, float]:
        """Value and 95 % interval in the prior's unit, not below zero."""
        ends = value, max(value - Z95 * deviation, 0.0), value + Z95 * deviation
        if not self.is_reciprocal:
            return ends
        least = 1e-12
        reciprocals = [1.0 / max(end, least) for end in ends]
        return reciprocals[0], reciprocals[2], reciprocals[1]


def surprise(problem: Problem, hypothesis: Hypothesis) -> float:
    """Minus the log-density of a hypothesis under the priors of the servos; 0 without priors.

    It is at most ``MOST_SURPRISE`` for each of them.
    """
    if not problem.priors:
        return 0.0
    rows, _ = _rows(problem, hypothesis)
    return float(
        sum(
            min(0.5 * ((row.value - row.expected) / row.deviation) ** 2, MOST_SURPRISE)
            for row in rows
        )
    )


def combine(
    problem: Problem,
    fitted: FittedModel,
    uncertainty: ParameterUncertainty,
    widened: ParameterUncertainty | None = None,
) -> CombinedFit:
    """A fit combined with the priors of the servos that it does not contradict.

    What the recordings alone say of a parameter follows from the combined fit without one row
    (leave-one-out residuals; Cook, Weisberg: Residuals and Influence in Regression, 1982).

    Args:
        problem: with the corrections at the fit.
        fitted: a fit with its Jacobian, which may contain the priors already.
        uncertainty: of the fit to the recordings alone.
        widened: the same with what effects that the fit lacks could take of it, for the intervals.
            It moves no value: the fit lacks the effect that would take the difference.

    Raises:
        OutOfTime: the time of the search is over.
    """
    widened = uncertainty if widened is None else widened
    hypothesis = fitted.hypothesis
    if not problem.priors:
        return CombinedFit(fitted, widened)
    rows, uses = _rows(problem, hypothesis)
    exact = _with_exact_slopes(problem, fitted) if hypothesis.theta.size else fitted
    covariance = _covariance(problem, exact, uncertainty)
    used = set[ParameterPrior]()
    for row in rows:
        if _terms_of(hypothesis, row) and _deviation(row, covariance) > 0.0:
            used.add(row.prior)
        else:
            uses[row.prior] = PriorUse(row.prior, "not_estimated", row.model)
    objective = _Objective(problem, exact, _inflation(problem, exact, covariance, rows))
    point, contradicted = exact, True
    while used and contradicted:
        point = objective.minimize(point, used)
        contradicted = False
        compared = _leave_one_out(problem, point.hypothesis, covariance, used)
        for use in sorted(compared, key=lambda use: -(use.distance or 0.0)):
            if (use.distance or 0.0) <= CONTRADICTED or contradicted:
                break
            others = used - {use.prior}
            alone = objective.minimize(point, others)
            gain = objective.cost(point, used) - objective.cost(alone, others)
            if gain > 0.5 * CONTRADICTED**2:
                used, point, contradicted = others, alone, True
                use = replace(use, distance=float(np.sqrt(2.0 * gain)))
                uses[use.prior] = _contradicted(problem, alone.hypothesis, covariance, others, use)
    if not used:
        point = fitted
    covariance = _covariance(problem, exact, widened)
    kept = [row for row in _rows(problem, point.hypothesis)[0] if row.prior in used]
    posterior = _updated(covariance, kept)
    data = {use.prior: use for use in _leave_one_out(problem, point.hypothesis, covariance, used)}
    for row in kept:
        both, own = row.estimate(row.value, _deviation(row, posterior)), data[row.prior]
        # What the recordings do not determine has no value of its own.
        known = (
            own
            if _deviation(row, covariance) < _MOST_OPEN * row.deviation
            else replace(own, data=None, distance=None)
        )
        uses[row.prior] = replace(known, state="combined", combined=both)
    if used:
        widened = _narrowed(widened, covariance, posterior)
    return CombinedFit(point, widened, tuple(uses[p] for p in problem.priors if p in uses))


def fitted_with_priors(
    problem: Problem, hypothesis: Hypothesis, residual: FloatArray, jacobian: FloatArray
) -> tuple[Hypothesis, FloatArray, FloatArray]:
    """A fit by simulation, combined with the priors of the servos; unchanged without any.

    Args:
        hypothesis: the fit, with its (samples, signals) residual and its Jacobian.

    Raises:
        OutOfTime: the time of the search is over.
    """
    if not problem.priors or not hypothesis.terms or not np.isfinite(residual).all():
        return hypothesis, residual, jacobian
    here = problem.at(hypothesis)
    fitted = FittedModel(hypothesis, residual, jacobian, 0.0)
    combined = combine(here, fitted, parameter_uncertainty(here, fitted))
    if not combined.is_moved:
        return hypothesis, residual, jacobian
    found = combined.fitted
    return found.hypothesis, found.residual, found.jacobian


def contradicted_terms(problem: Problem, hypothesis: Hypothesis) -> list[Term]:
    """Effects that move a parameter of a servo far from its prior."""
    rows, _ = _rows(problem, hypothesis)
    far = [row for row in rows if abs(row.value - row.expected) > CONTRADICTED * row.deviation]
    return list(dict.fromkeys(t for row in far for t in _terms_of(hypothesis, row)))


def _terms_of(hypothesis: Hypothesis, row: _Row) -> list[Term]:
    """Effects of a hypothesis that correct the quantity of a row."""
    return [t for t in hypothesis.terms if (row.gradient[hypothesis.slice_of(t)] != 0.0).any()]


def _contradicted(
    problem: Problem,
    alone: Hypothesis,
    covariance: FloatArray,
    others: Collection[ParameterPrior],
    use: PriorUse,
) -> PriorUse:
    """A prior that is not used, with the reason and with what else may make the difference.

    Args:
        alone: the fit with the other priors.
        covariance: of the fit to the recordings alone.
    """
    rows = _rows(problem, alone)[0]
    row = next(row for row in rows if row.prior == use.prior)
    posterior = _updated(covariance, [row for row in rows if row.prior in others])
    terms = _terms_of(alone, row)
    confused = dict.fromkeys(other for t in terms for other in t.law.confused_with)
    names = [name for name in confused if name not in {t.effect for t in terms}]
    unless = f", unless the cause is {' or '.join(names)}" if names else ""
    return replace(
        use, data=row.estimate(row.value, _deviation(row, posterior)),
        why=f"not used: the recordings contradict it{unless}",
    )  # fmt: skip


def _leave_one_out(
    problem: Problem,
    hypothesis: Hypothesis,
    covariance: FloatArray,
    used: Collection[ParameterPrior],
) -> list[PriorUse]:
    """Each used prior against the recordings with the other priors.

    Args:
        hypothesis: the fit with all of them.
        covariance: of the fit to the recordings alone.
    """
    rows = [row for row in _rows(problem, hypothesis)[0] if row.prior in used]
    posterior = _updated(covariance, rows)
    out = []
    for row in rows:
        variance, known = _deviation(row, posterior) ** 2, row.deviation**2
        open_share = max(1.0 - variance / known, _LEAST_SHARE)
        residual = (row.expected - row.value) / open_share
        deviation = float(np.sqrt(variance / open_share))
        distance = abs(residual) / float(np.hypot(deviation, row.deviation))
        data = row.estimate(row.expected - residual, deviation)
        out.append(PriorUse(row.prior, "contradicted", row.model, data, None, distance))
    return out


def _deviation(row: _Row, covariance: FloatArray) -> float:
    """Standard deviation of a row's quantity."""
    return float(np.sqrt((row.gradient @ covariance @ row.gradient).clip(0.0)))


def _in_order(problem: Problem, uses: Mapping[ParameterPrior, PriorUse]) -> tuple[PriorUse, ...]:
    return tuple(uses[prior] for prior in problem.priors if prior in uses)


def _updated(covariance: FloatArray, rows: Sequence[_Row]) -> FloatArray:
    """Covariance of parameters after one measurement for each row."""
    if not rows:
        return covariance
    gradients = np.array([row.gradient for row in rows])
    noise = np.diag([row.deviation**2 for row in rows])
    across = covariance @ gradients.T
    gain = np.linalg.solve(gradients @ across + noise, across.T).T
    left = np.eye(len(covariance)) - gain @ gradients
    # Joseph's form: a difference of large variances would lose the small one of the prior.
    posterior: FloatArray = left @ covariance @ left.T + gain @ noise @ gain.T
    return posterior


def _narrowed(
    uncertainty: ParameterUncertainty, covariance: FloatArray, posterior: FloatArray
) -> ParameterUncertainty:
    """An uncertainty whose conservative covariance is ``posterior`` instead of ``covariance``."""
    before, after = (np.sqrt(np.diag(each).clip(0.0)) for each in (covariance, posterior))
    is_narrower = after < _NARROWER * before
    half = np.where(is_narrower, Z95 * after, uncertainty.half_width)
    share = np.divide(
        half, uncertainty.half_width, out=np.ones_like(half), where=uncertainty.half_width > 0.0
    )
    deviation = np.sqrt(np.diag(uncertainty.covariance).clip(0.0)) * share
    safe = np.where(after > 0.0, after, 1.0)
    correlation = np.where(
        np.outer(after, after) > 0.0, posterior / np.outer(safe, safe), uncertainty.correlation
    )
    return replace(
        uncertainty,
        half_width=half,
        correlation=correlation,
        covariance=correlation * np.outer(deviation, deviation),
        conservative_covariance=with_deviations(posterior, half / Z95),
    )


def _covariance(
    problem: Problem, fitted: FittedModel, uncertainty: ParameterUncertainty
) -> FloatArray:
    """Covariance of a fit, with directions that derivatives by simulation do not determine.

    No parameter varies by more than the range of its law.
    """
    hypothesis, covariance = fitted.hypothesis, uncertainty.conservative_covariance
    lower, upper = hypothesis.bounds
    known = np.isfinite(covariance).all(axis=1)
    information = _information(problem, fitted)
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    shares, directions = np.linalg.eigh(information / np.outer(size, size))
    open_ones = (directions / size[:, None])[:, shares < _COLUMNS_DIFFER**2]
    wide = np.where(np.outer(known, known), covariance, 0.0)
    for direction in open_ones.T:
        moved = np.abs(direction) > _COLUMNS_DIFFER * np.abs(direction).max()
        reach = np.min((upper - lower)[moved] / np.abs(direction)[moved])
        wide = wide + np.outer(direction, direction) * reach**2
    deviation = np.sqrt(np.diag(wide).clip(0.0))
    return with_deviations(
        wide, np.where(known, np.minimum(deviation, upper - lower), upper - lower)
    )


def _inflation(
    problem: Problem, fitted: FittedModel, covariance: FloatArray, rows: Sequence[_Row]
) -> float:
    """Factor by which the variance of the recordings is larger than their residual shows."""
    information = _information(problem, fitted)
    white: FloatArray = np.linalg.pinv(information, hermitian=True).astype(np.float64)
    pairs = [(_deviation(row, covariance), _deviation(row, white)) for row in rows]
    ratios = [(wide / narrow) ** 2 for wide, narrow in pairs if narrow > 0.0]
    return float(np.clip(max(ratios, default=1.0), 1.0, _MOST_INFLATION))


def _information(problem: Problem, fitted: FittedModel) -> FloatArray:
    """(parameters, parameters) information of the recordings, for their effective samples."""
    weight = _sample_weights(problem, fitted)
    information: FloatArray = np.einsum("tsp,s,tsq->pq", fitted.jacobian, weight, fitted.jacobian)
    return information


def _sample_weights(problem: Problem, fitted: FittedModel) -> FloatArray:
    """(signals,) reciprocal variances of samples, as if they were independent."""
    effective = effective_samples(fitted.residual, problem.lengths(problem.fit))
    weights: FloatArray = (
        effective / len(fitted.residual) / (fitted.mean_square + problem.signal_floor**2)
    )
    return weights


def _with_exact_slopes(problem: Problem, fitted: FittedModel) -> FittedModel:
    """A fit with its Jacobian by finite differences.

    That of a fit is updated along its steps. It may then tell two effects apart that compensate
    for each other.
    """
    weights = problem.weights(fitted.mean_square)
    (exact,) = fit(problem, [fitted.hypothesis], weights, problem.fit, iterations=0)
    return FittedModel(fitted.hypothesis, fitted.residual, exact.jacobian, fitted.cost)


class _Objective:
    """Squared residuals of recordings and priors, each divided by its variance.

    Args:
        problem: with the corrections at the fit.
        fitted: a fit, whose residual gives the variance of the recordings.
        inflation: factor of this variance.
    """

    def __init__(self, problem: Problem, fitted: FittedModel, inflation: float) -> None:
        self.problem, self.jacobian = problem, fitted.jacobian
        self.weight = _sample_weights(problem, fitted) / inflation
        self.information = _information(problem, fitted) / inflation

    def cost(self, point: FittedModel, used: Collection[ParameterPrior]) -> float:
        """Minus the log-density of a fit; infinite where its simulation diverges."""
        rows = self._rows(point.hypothesis, used)
        of_priors = sum(((row.value - row.expected) / row.deviation) ** 2 for row in rows)
        value = 0.5 * float(np.sum(self.weight * point.residual**2) + of_priors)
        return value if np.isfinite(value) else np.inf

    def minimize(self, start: FittedModel, used: Collection[ParameterPrior]) -> FittedModel:
        """A fit moved to the optimum, by steps that improve it."""
        point = start
        for _ in range(_STEPS):
            tried = [self._stepped(point, used, _DAMPED)]
            moved = point
            # Where two effects nearly compensate, a long step needs the next ones to come down.
            for _ in range(_CORRECTIONS):
                moved = self._stepped(moved, used, _UNDAMPED)
                tried.append(moved)
            best = min(tried, key=lambda each: self.cost(each, used))
            if not self.cost(best, used) < self.cost(point, used) - _LEAST_GAIN:
                break
            point = best
        return point

    def _stepped(
        self, point: FittedModel, used: Collection[ParameterPrior], damping: float
    ) -> FittedModel:
        here = point.hypothesis
        normal = self.information.copy()
        right = np.einsum("tsp,s,ts->p", self.jacobian, self.weight, point.residual)
        for row in self._rows(here, used):
            normal += np.outer(row.gradient, row.gradient) / row.deviation**2
            right += row.gradient * (row.expected - row.value) / row.deviation**2
        free = here.is_estimated
        ridge = damping * np.diag(np.maximum(np.diag(normal), 1e-300))
        step = np.zeros(len(right))
        step[free] = np.linalg.lstsq((normal + ridge)[np.ix_(free, free)], right[free], rcond=None)[
            0
        ]
        moved = here.with_theta(np.clip(here.theta + step, *here.bounds))
        (residual,) = self.problem.at(moved).residuals([moved], self.problem.fit)
        return FittedModel(moved, residual, self.jacobian, 0.0)

    def _rows(self, hypothesis: Hypothesis, used: Collection[ParameterPrior]) -> list[_Row]:
        return [row for row in _rows(self.problem, hypothesis)[0] if row.prior in used]


def _rows(
    problem: Problem, hypothesis: Hypothesis
) -> tuple[list[_Row], dict[ParameterPrior, PriorUse]]:
    """Each prior of a joint of the problem as a row; and those that are not comparable."""
    rows: list[_Row] = []
    uses: dict[ParameterPrior, PriorUse] = {}
    own, corrections = own_values(problem), totals(problem, hypothesis)
    for prior in problem.priors:
        if prior.joint not in problem.joints:
            continue
        joint = problem.joints.index(prior.joint)
        why = _incomparable(problem, prior, joint)
        if why:
            uses[prior] = PriorUse(prior, "not_comparable", why=why)
            continue
        gradient = np.zeros(hypothesis.theta.size)
        expected, deviation = prior.value, prior.deviation
        base = float(own[prior.parameter][joint])
        if prior.parameter in _GAINS:
            value = base * _gain_factor(problem, hypothesis, prior.parameter, joint, gradient)
            gradient *= base
        elif prior.parameter == "effort_limit":
            ends = [1.0 / max(end, 1e-12) for end in (prior.value, *prior.ci95)]
            expected = ends[0]
            deviation = max(abs(end - expected) for end in ends) / Z95
            value = _reciprocal_limit(problem, hypothesis, base, joint, gradient)
        else:
            name, value = _TOTALS[prior.parameter], base
            for total in corrections:
                if (total.name, total.joint) == (name, joint):
                    value = total.value
                    for term, at, _ in total.parts:
                        gradient[at] = _scale(problem, hypothesis, term, at)
        rows.append(_Row(prior, base, value, gradient, expected, deviation))
    return rows, uses


def _incomparable(problem: Problem, prior: ParameterPrior, joint: int) -> str:
    """Why a prior does not apply to a joint; empty if it does."""
    layout = problem.simulator.layout
    if layout.slides[joint]:
        return "the servo turns, and this joint slides"
    if prior.parameter in _GAINS and layout.servo[joint] != "position":
        return "the model has no position servo at this joint"
    if prior.parameter in (*_GAINS, "effort_limit") and not own_values(problem)["is_one"][joint]:
        return "the recordings were made with several controllers"
    return ""


def _gain_factor(
    problem: Problem, hypothesis: Hypothesis, parameter: str, joint: int, gradient: FloatArray
) -> float:
    """Product of all factors of a gain; ``gradient`` gets its derivatives."""
    names = {ControllerGain.id: f"{parameter}_error", TorqueConstant.id: "relative_error"}
    factors: list[tuple[int, float, float]] = []
    for term in hypothesis.terms:
        if term.joint == joint and term.effect in names:
            at = _index(hypothesis, term, names[term.effect])
            scale = _scale(problem, hypothesis, term, at)
            factors.append((at, 1.0 + float(hypothesis.theta[at]) * scale, scale))
    for at, _, scale in factors:
        gradient[at] = scale * float(np.prod([f for i, f, _ in factors if i != at]))
    return float(np.prod([f for _, f, _ in factors]))


def _reciprocal_limit(
    problem: Problem, hypothesis: Hypothesis, own: float, joint: int, gradient: FloatArray
) -> float:
    """Reciprocal of the smallest limit of a drive; ``gradient`` gets its derivative."""
    term = Term(TorqueSaturation.id, joint)
    if term not in hypothesis.terms:
        return own
    at = hypothesis.slice_of(term).start
    scale = _scale(problem, hypothesis, term, at)
    value = float(hypothesis.theta[at]) * scale
    if value <= own:
        return own
    gradient[at] = scale
    return value


def _index(hypothesis: Hypothesis, term: Term, name: str) -> int:
    names = [p.name for p in term.parameters]
    return int(hypothesis.slice_of(term).start) + names.index(name)


def _scale(problem: Problem, hypothesis: Hypothesis, term: Term, at: int) -> float:
    parameter = term.parameters[at - hypothesis.slice_of(term).start]
    return problem.scales.value(parameter, term.joint)


__all__ = [
    "CONTRADICTED", "MOST_SURPRISE", "CombinedFit", "PriorUse", "combine", "contradicted_terms",
    "fitted_with_priors", "surprise",
]  # fmt: skip
