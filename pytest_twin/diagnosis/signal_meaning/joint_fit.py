"""A quick fit of smooth parameters of all joints to the measured positions.

It makes questions about the recording independent of errors of the model. All joints are perturbed
together and each column of the Jacobian is taken from its own joint, so the cost does not grow with
the number of joints. The next iteration corrects the neglected coupling.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem, add_step_error
from pytest_twin.diagnosis.signal_meaning.settings import JOINT_FIT
from pytest_twin.effects.actuation import ActuatorLag, ControllerGain, DeadZone
from pytest_twin.effects.friction import CoulombFriction, ViscousFriction
from pytest_twin.effects.rigid_body import Armature
from pytest_twin.effects.sensing import EncoderBias
from pytest_twin.effects.timing import CommandDelay
from pytest_twin.effects.transmission import JointSpring
from pytest_twin.estimation.hypothesis import Hypothesis, Term, effect_values

PRIOR_DEVIATIONS: dict[tuple[str, str], float] = {
    (CommandDelay.id, "delay"): 0.02,
    (ActuatorLag.id, "time_constant"): 0.02,
    (ControllerGain.id, "stiffness_error"): 0.3,
    (ControllerGain.id, "damping_error"): 0.3,
    (ViscousFriction.id, "coefficient"): 0.5,
    (CoulombFriction.id, "coulomb"): 0.5,
    (DeadZone.id, "width"): 0.1,
    (Armature.id, "inertia"): 0.3,
    (JointSpring.id, "stiffness"): 0.3,
    (EncoderBias.id, "bias"): 0.03,
}
"""Effect and parameter -> standard deviation of its prior around the model's value, in the scale of
the parameter (s, 1, rad, or the joint's typical damping, effort, inertia or stiffness). The priors
are wide, so they only determine parameters that the recordings do not."""
DELAY = list(PRIOR_DEVIATIONS).index((CommandDelay.id, "delay"))
# Levenberg-Marquardt dampings that are tried, as shares of the diagonal of the normal matrix.
_DAMPINGS = (1e-4, 1e-1)


@dataclass(frozen=True, slots=True)
class SmoothParameterFit:
    """Parameters of all joints at their optimum, with their residuals.

    Attributes:
        residual: (samples, joints) measured minus predicted positions, rad or m.
        nominal: the same for the nominal model.
        slopes: (samples, parameters, joints) derivatives of each joint's prediction with respect to
            its own parameters.
        theta: (parameters, joints) scaled parameters, in the order of :data:`PRIOR_DEVIATIONS`.
        has_converged: whether another step would gain nothing.
    """

    residual: FloatArray
    nominal: FloatArray
    slopes: FloatArray
    theta: FloatArray
    has_converged: bool


@dataclass(slots=True)
class _State:
    """Parameters with their residual and log-posterior ``score``."""

    theta: FloatArray
    residual: FloatArray
    score: float
    has_converged: bool = False


def fit_smooth_parameters(
    space: SmoothParameters, delays: Sequence[float]
) -> list[SmoothParameterFit]:
    """Fit the smooth parameters of all joints to each group of segments.

    The groups are the same recordings under different assumptions. The derivatives are computed for
    the assumption with the highest posterior and used for all, because they hardly differ. Each fit
    also tries the parameters of the best one, with the difference of the mean delays.

    Args:
        space: the parameters, with the segments of each assumption.
        delays: mean delay of a command under each assumption, s.

    Returns:
        One fit for each group.
    """
    none = np.zeros(space.shape)
    states = space.states([(i, none) for i in range(len(space.groups))])
    nominal = [s.residual for s in states]
    while True:
        best = max(range(len(states)), key=lambda i: states[i].score)
        slopes = space.slopes(best, states[best])
        if space.iterations >= JOINT_FIT.iterations or _has_settled(states, space.noise):
            break
        tried = []
        for i, state in enumerate(states):
            tried += [
                (i, state.theta + space.step(state.theta, state.residual, slopes, damping))
                for damping in _DAMPINGS
            ]
            if i != best:
                other = states[best].theta.copy()
                other[DELAY] += delays[best] - delays[i]
                tried.append((i, other))
        found = space.states(tried)
        for i, state in enumerate(states):
            mine = [f for f, (at, _) in zip(found, tried, strict=True) if at == i]
            better = max(mine, key=lambda f: f.score)
            better.has_converged = (
                better.score < state.score + JOINT_FIT.least_gain * space.shape[1]
            )
            state.has_converged = True
            states[i] = better if better.score > state.score else state
    return [
        SmoothParameterFit(s.residual, before, slopes, s.theta, s.has_converged)
        for s, before in zip(states, nominal, strict=True)
    ]


def _has_settled(states: Sequence[_State], noise: FloatArray) -> bool:
    """Whether all fits are done.

    A fit is done if it has converged, if only noise remains, or if its residual is far larger than
    that of another fit at the noise level.
    """
    levels = [np.sqrt(np.mean(s.residual**2, axis=0)) / noise for s in states]
    fits = [bool((level <= JOINT_FIT.at_noise).all()) for level in levels]
    far = [any(fits) and bool((level >= JOINT_FIT.far).any()) for level in levels]
    return all(s.has_converged or f or o for s, f, o in zip(states, fits, far, strict=True))


class SmoothParameters:
    """The parameters of all joints: their terms, bounds and priors.

    Args:
        problem: the problem with the segments; its efforts are not used.
        groups: indices of the segments of each assumption, in the same order of recordings.
        noise: (joints,) encoder noise, rad or m.
    """

    def __init__(
        self, problem: Problem, groups: Sequence[NDArray[np.int64]], noise: FloatArray
    ) -> None:
        self.problem, self.groups, self.noise = problem, groups, noise
        self.iterations = 0
        joints = len(problem.joints)
        effects = list(dict.fromkeys(effect for effect, _ in PRIOR_DEVIATIONS))
        self.terms = tuple(Term(e, j) for e in effects for j in range(joints))
        self.neutral = np.concatenate([
            [p.absent_value if p.neutral is None else p.neutral for p in t.parameters]
            for t in self.terms
        ])  # fmt: skip
        self.shape = (len(PRIOR_DEVIATIONS), joints)
        self.columns = np.zeros(self.shape, dtype=np.int64)
        self.lower, self.upper = np.zeros(self.shape), np.zeros(self.shape)
        self.nudge = np.zeros(len(PRIOR_DEVIATIONS))
        self.prior = np.array(list(PRIOR_DEVIATIONS.values()))
        start = np.cumsum([0, *(len(t.parameters) for t in self.terms)])
        model, dofs = problem.simulator.segments[0].model, problem.simulator.layout.dof_index
        own = {
            ViscousFriction.id: np.reshape(model.dof_damping[dofs], (joints, -1))[:, 0],
            CoulombFriction.id: np.reshape(model.dof_frictionloss[dofs], (joints, -1))[:, 0],
        }
        for k, (effect, name) in enumerate(PRIOR_DEVIATIONS):
            for j in range(joints):
                term = Term(effect, j)
                at = next(i for i, p in enumerate(term.parameters) if p.name == name)
                p = term.parameters[at]
                self.columns[k, j] = start[self.terms.index(term)] + at
                self.lower[k, j], self.upper[k, j] = p.lower, p.upper
                self.nudge[k] = p.step
                if effect in own:
                    # The sum of the model's value and the parameter must not be negative.
                    least = -float(own[effect][j]) / problem.scales.value(p, j)
                    self.lower[k, j] = max(p.lower, least)

    def states(self, tried: Sequence[tuple[int, FloatArray]]) -> list[_State]:
        """Residuals and scores for pairs of group and (parameters, joints), in one batch."""
        inside = [(i, np.clip(theta, self.lower, self.upper)) for i, theta in tried]
        return [
            self._state(theta, residual)
            for (_, theta), residual in zip(inside, self._residuals(inside), strict=True)
        ]

    def _state(self, theta: FloatArray, residual: FloatArray) -> _State:
        if not np.isfinite(residual).all():
            return _State(theta, residual, -np.inf)
        square = np.mean(residual**2, axis=0) + 0.01 * self.noise**2
        prior_penalty = float(np.sum((theta / self.prior[:, None]) ** 2))
        count = len(residual) / JOINT_FIT.smooth_samples
        score = -0.5 * (count * float(np.sum(np.log(square))) + prior_penalty)
        return _State(theta, residual, score)

    def _residuals(self, tried: Sequence[tuple[int, FloatArray]]) -> list[FloatArray]:
        """(samples, joints) measured minus predicted positions for each pair, rad or m."""
        problem = self.problem
        rows = np.concatenate([self.groups[i] for i, _ in tried])
        each = [
            h
            for i, theta in tried
            for h in [self.hypothesis(theta)] * len(self.groups[i])
        ]  # fmt: skip
        values = effect_values(each, len(problem.joints), problem.scales)
        parts = []
        for row, p in zip(rows, problem.simulator.simulate(rows, values), strict=True):
            error, start = problem.discretization_error.get(int(row)), problem.starts.get(int(row))
            read = p if error is None else add_step_error(p, error)
            off = problem.simulator.segments[row].position - read.position
            off = off if start is None else start.without_initial_error(off)
            parts.append(off * problem.position_weights.get(int(row), 1.0))
        ends = np.cumsum([0, *(len(self.groups[i]) for i, _ in tried)])
        return [np.concatenate(parts[a:b]) for a, b in itertools.pairwise(ends)]

    def hypothesis(self, theta: FloatArray) -> Hypothesis:
        """The hypothesis with all terms, from (parameters, joints) scaled parameters."""
        values = self.neutral.copy()
        values[self.columns] = theta
        return Hypothesis(self.terms, values)

    def value(self, theta: FloatArray, effect: str, joint: int) -> float:
        """The first parameter of an effect at a joint, SI units."""
        k = next(i for i, (name, _) in enumerate(PRIOR_DEVIATIONS) if name == effect)
        parameter = next(
            p for p in Term(effect, joint).parameters if p.name == list(PRIOR_DEVIATIONS)[k][1]
        )
        return float(theta[k, joint] * self.problem.scales.value(parameter, joint))

    def slopes(self, group: int, state: _State) -> FloatArray:
        """(samples, parameters, joints) finite differences; all joints are perturbed together."""
        self.iterations += 1
        moved = []
        for k, nudge in enumerate(self.nudge):
            theta = state.theta.copy()
            theta[k] += nudge
            moved.append((group, theta))
        changes = [
            (state.residual - residual) / nudge
            for residual, nudge in zip(self._residuals(moved), self.nudge, strict=True)
        ]
        return np.nan_to_num(np.stack(changes, axis=1))

    def step(
        self, theta: FloatArray, residual: FloatArray, slopes: FloatArray, damping: float = 0.0
    ) -> FloatArray:
        """(parameters, joints) bounded and damped Gauss-Newton step of each joint.

        It is zero if the prediction diverged.
        """
        step = np.zeros(self.shape)
        if not np.isfinite(residual).all():
            return step
        for j in range(self.shape[1]):
            step[:, j] = bounded_step(
                slopes[:, :, j], residual[:, j], theta[:, j], self.prior,
                (self.lower[:, j], self.upper[:, j]), self.noise[j], damping,
            )  # fmt: skip
        return step


def bounded_step(
    slopes: FloatArray,
    residual: FloatArray,
    theta: FloatArray,
    prior: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    noise: float,
    damping: float = 0.0,
) -> FloatArray:
    """(parameters,) change with the largest posterior, within bounds, for one joint.

    Args:
        slopes: (samples, parameters) derivatives of the prediction.
        residual: (samples,) measured minus predicted.
        theta: (parameters,) present parameters, scaled.
        prior: (parameters,) standard deviations of the priors around zero.
        bounds: lower and upper bounds, (parameters,) each.
        noise: encoder noise, rad or m.
        damping: Levenberg-Marquardt damping, as a share of the diagonal.
    """
    variance = max(noise**2, float(np.mean(residual**2)))
    normal = slopes.T @ slopes / variance + np.diag(prior**-2)
    right = slopes.T @ residual / variance - theta / prior**2
    # The Cholesky factor gives a smaller least-squares problem with the same bounded minimum.
    normal += damping * np.diag(np.diag(normal))
    factor = np.linalg.cholesky(normal)
    lower = np.minimum(bounds[0] - theta, -1e-12)
    upper = np.maximum(bounds[1] - theta, 1e-12)
    found: FloatArray = lsq_linear(factor.T, np.linalg.solve(factor, right), (lower, upper)).x
    return found
