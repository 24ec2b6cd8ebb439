"""How small forces move the measured motion: the equation of small deviations along it.

``M dq'' + D dq' + K dq = force``, with the mass matrix, the slopes of bias forces and the drive's
own gains along the motion (time-varying); a drive at its limit has none, and a joint that stands is
held. Integrated by the trapezoidal rule.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.law_forces import Forces
from pytest_twin.diagnosis.first_order.measured_trajectory import MeasuredTrajectory
from pytest_twin.diagnosis.first_order.rigid_terms import slopes, upsampled
from pytest_twin.effects.active_effects import ActiveEffects
from pytest_twin.effects.batch_simulator import BatchSimulator

_HELD = 1e4
_IN_CACHE = 50_000
"""Numbers that are carried on together: few enough to stay in a core's cache."""


@dataclass(frozen=True, slots=True)
class LinearizedDynamics:
    """Transition of (position, velocity) deviations from sample to sample.

    Attributes:
        step: (samples - 1, segments, 2 joints, 2 joints): what one sample asks for lies together.
        push: (samples - 1, segments, 2 joints, joints) per unit of force held over a sample.
        stiffness, damping: (segments, samples, joints) of the drive, zero at its limit.
    """

    step: FloatArray
    push: FloatArray
    stiffness: FloatArray
    damping: FloatArray

    def of(self, force: FloatArray, initial: FloatArray) -> Iterator[FloatArray]:
        """Deviations under forces, from the first sample on, some samples at a time.

        Args:
            force: (segments, samples, joints, k) N*m or N.
            initial: (segments, 2 joints, k) deviation at the first sample.

        Yields:
            (n, segments, 2 joints, k) positions, then velocities, at the next n samples.
        """
        mean = _held(force)
        return self._carried(lambda some: self.push[some] @ mean[some], initial)

    def trajectory(self, force: FloatArray, initial: FloatArray) -> FloatArray:
        """(segments, samples, 2 joints, k), all that :meth:`of` yields."""
        return np.concatenate(list(self.of(force, initial))).swapaxes(0, 1)

    def of_joints(
        self, force: FloatArray, joint: NDArray[np.int64], initial: FloatArray
    ) -> Iterator[FloatArray]:
        """As :meth:`of`, under forces each of which acts at one joint alone.

        Args:
            force: (segments, samples, k) N*m or N.
            joint: (k,) at which.
            initial: (segments, 2 joints, k) deviation at the first sample.
        """
        mean = _held(force)
        joints = self.push.shape[-1]
        # A product with ones and zeros picks columns sooner than an index does.
        chosen = np.eye(joints)[:, joint]

        def pushed(some: slice) -> FloatArray:
            push = self.push[some]
            each: FloatArray = (push.reshape(-1, joints) @ chosen).reshape(*push.shape[:-1], -1)
            each *= mean[some, :, None]
            return each

        return self._carried(pushed, initial)

    def _carried(
        self, pushed: Callable[[slice], FloatArray], initial: FloatArray
    ) -> Iterator[FloatArray]:
        """Deviations of which each sample is pushed from the one before."""
        yield initial[None]
        state = initial
        at_once = max(1, _IN_CACHE // initial.size)
        for first in range(0, len(self.step), at_once):
            some = slice(first, first + at_once)
            out = pushed(some)
            for after, step in zip(out, self.step[some], strict=True):
                after += step @ state
                state = after
            yield out


def _held(force: FloatArray) -> FloatArray:
    """(samples - 1, segments, ...) means over each sample."""
    mean: FloatArray = force[:, 1:] + force[:, :-1]
    mean *= 0.5
    return mean.swapaxes(0, 1)


def linearized_dynamics(
    simulator: BatchSimulator,
    along: MeasuredTrajectory,
    effects: ActiveEffects,
    measured: Forces,
    predicted: Forces,
    slopes_of_forces: tuple[FloatArray, FloatArray],
) -> LinearizedDynamics:
    """Linearize between the predicted and the measured motion.

    Slopes of forces that bend (a drive's limit, dry friction at a reversal) are secants between the
    two motions, so that large deviations are carried as well as small ones.

    Args:
        simulator: of the segments.
        along: the motion.
        effects: of the hypothesis, values (1, joints).
        measured, predicted: what acts along either motion under the hypothesis.
        slopes_of_forces: stiffness and damping of what else depends on the state, as
            :func:`~pytest_twin.diagnosis.first_order.law_forces.force_slopes` has it.
    """
    n = along.position.shape[2]
    middle, slope_q, slope_v = slopes(simulator, along, effects)
    samples = along.position.shape[1]
    mass, slope_q, slope_v = (
        upsampled(x, middle.at, samples) for x in (middle.mass, slope_q, slope_v)
    )
    off_q = along.position - along.predicted_position
    off_v = along.velocity - along.predicted_velocity
    linear = measured.stiffness[0] * off_q + measured.damping[0] * off_v
    real = -(measured.drive[0] - predicted.drive[0])
    tiny = 1e-9 * np.max(np.abs(linear), axis=(0, 1)) + 1e-30
    share = np.where(
        np.abs(linear) > tiny, np.clip(real / np.where(linear == 0.0, 1.0, linear), 0.0, 1.0), 1.0
    )
    stiffness, damping = share * measured.stiffness[0], share * measured.damping[0]
    apart = np.abs(off_v) > 1e-6 * along.slip_velocity
    friction = np.where(
        apart,
        -(measured.dry[0] - predicted.dry[0]) / np.where(apart, off_v, 1.0),
        measured.level[0]
        / along.slip_velocity
        / np.cosh(np.minimum(np.abs(along.velocity) / along.slip_velocity, 30.0)) ** 2,
    )
    eye = np.eye(n)
    h = along.interval
    more_stiffness, more_damping = slopes_of_forces
    passive = measured.passive_stiffness[0] + more_stiffness
    k_all = slope_q + eye * (stiffness + passive)[..., None]
    held = np.maximum(friction, 0.0) + damping + measured.passive_damping[0] + more_damping
    diagonal = np.einsum("stjj->stj", mass)
    held = held + _HELD * along.at_rest * diagonal / h
    d_all = slope_v + eye * held[..., None]
    inverse = np.linalg.inv(mass)
    a = np.zeros((*mass.shape[:2], 2 * n, 2 * n))
    a[..., :n, n:] = eye
    a[..., n:, :n] = -inverse @ k_all
    a[..., n:, n:] = -inverse @ d_all
    a = 0.5 * (a[:, 1:] + a[:, :-1])
    b = np.zeros((*a.shape[:2], 2 * n, n))
    b[..., n:, :] = 0.5 * (inverse[:, 1:] + inverse[:, :-1])
    whole = np.eye(2 * n)
    both = np.concatenate([whole + 0.5 * h * a, h * b], axis=-1)
    solved = np.linalg.solve(whole - 0.5 * h * a, both)
    step, push = (
        np.ascontiguousarray(x.swapaxes(0, 1)) for x in (solved[..., : 2 * n], solved[..., 2 * n :])
    )
    return LinearizedDynamics(step, push, stiffness, damping)
