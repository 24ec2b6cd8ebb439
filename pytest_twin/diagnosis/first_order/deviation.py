"""How small forces move the measured motion: the equation of small deviations along it.

``M dq'' + D dq' + K dq = force``, with the mass matrix, the slopes of bias forces and the drive's
own gains along the motion (time-varying); a drive at its limit has none, and a joint that stands is
held. Integrated by the trapezoidal rule.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.along import Along
from pytest_twin.diagnosis.first_order.laws import ActiveEffects, Forces
from pytest_twin.diagnosis.first_order.rigid_terms import slopes, upsampled
from pytest_twin.effects.rows import RowSimulator

_HELD = 1e4


@dataclass(frozen=True, slots=True)
class Deviation:
    """Transition of (position, velocity) deviations from sample to sample.

    Attributes:
        step: (samples - 1, segments, 2 joints, 2 joints): what one sample asks for lies together.
        push: (segments, samples - 1, 2 joints, joints) per unit of force held over a sample.
        stiffness, damping: (segments, samples, joints) of the drive, zero at its limit.
    """

    step: FloatArray
    push: FloatArray
    stiffness: FloatArray
    damping: FloatArray

    def of(self, force: FloatArray, initial: FloatArray | None = None) -> FloatArray:
        """Deviations under forces.

        Args:
            force: (segments, samples, joints, k) N*m or N.
            initial: (segments, 2 joints, k) deviation at the first sample.

        Returns:
            (segments, samples, 2 joints, k) positions, then velocities.
        """
        segments, samples, joints, k = force.shape
        out = np.zeros((samples, segments, 2 * joints, k))
        if initial is not None:
            out[0] = initial
        mean = 0.5 * (force[:, 1:] + force[:, :-1])
        np.matmul(self.push, mean, out=out[1:].swapaxes(0, 1))
        for before, after, step in zip(out[:-1], out[1:], self.step, strict=True):
            after += step @ before
        return out.swapaxes(0, 1)


def deviation(
    simulator: RowSimulator,
    along: Along,
    effects: ActiveEffects,
    measured: Forces,
    predicted: Forces,
    slopes_of_forces: tuple[FloatArray, FloatArray],
) -> Deviation:
    """Linearize between the predicted and the measured motion.

    Slopes of forces that bend (a drive's limit, dry friction at a reversal) are secants between the
    two motions, so that large deviations are carried as well as small ones.

    Args:
        simulator: of the segments.
        along: the motion.
        effects: of the hypothesis, values (1, joints).
        measured, predicted: what acts along either motion under the hypothesis.
        slopes_of_forces: stiffness and damping of what else depends on the state, as
            :func:`~pytest_twin.diagnosis.first_order.laws.force_slopes` has it.
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
    step = np.ascontiguousarray(solved[..., : 2 * n].swapaxes(0, 1))
    return Deviation(step, solved[..., 2 * n :], stiffness, damping)
