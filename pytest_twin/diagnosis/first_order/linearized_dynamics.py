"""Linearized dynamics along the measured motion: deviations caused by small forces.

``M dq'' + D dq' + K dq = force``. M is the mass matrix. D and K contain the derivatives of the bias
forces and the gains of the drives; all vary with time. The gains are zero while a drive is at its
limit. A joint at rest is held by friction. A joint that creeps with friction at its level is not.
The equation is integrated by the trapezoidal rule.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.law_forces import Forces
from pytest_twin.diagnosis.first_order.measured_trajectory import MeasuredTrajectory
from pytest_twin.diagnosis.first_order.rigid_terms import rigid_derivatives, upsample
from pytest_twin.effects.active_effects import ActiveEffects
from pytest_twin.effects.batch_simulator import BatchSimulator

# Damping of a joint at rest, in multiples of its inertia per interval.
_REST_DAMPING = 1e4
_HOLDS = 0.95
"""Share of its level below which dry friction holds a slow joint; at its level the joint creeps."""
_IN_CACHE = 50_000
"""Number of elements that are propagated together, so that they fit into a core's cache."""


@dataclass(frozen=True, slots=True)
class LinearizedDynamics:
    """Discrete-time transition of (position, velocity) deviations from sample to sample.

    Attributes:
        transition: (samples - 1, segments, 2 joints, 2 joints) state transition matrices.
        input_matrix: (samples - 1, segments, 2 joints, joints) input matrices, for a force that is
            constant over the interval.
        stiffness, damping: (segments, samples, joints) gains of the drive, zero at its limit.
    """

    transition: FloatArray
    input_matrix: FloatArray
    stiffness: FloatArray
    damping: FloatArray

    def propagate(self, force: FloatArray, initial: FloatArray) -> Iterator[FloatArray]:
        """Deviations under forces, in blocks of consecutive samples.

        Args:
            force: (segments, samples, joints, k) N*m or N.
            initial: (segments, 2 joints, k) deviation at the first sample.

        Yields:
            Positions, then velocities, at the next n samples: (n, segments, 2 joints, k).
        """
        mean = _interval_means(force)
        return self._propagate(lambda some: self.input_matrix[some] @ mean[some], initial)

    def trajectory(self, force: FloatArray, initial: FloatArray) -> FloatArray:
        """Deviations at all samples, (segments, samples, 2 joints, k).

        Args:
            force, initial: as for :meth:`propagate`.
        """
        return np.concatenate(list(self.propagate(force, initial))).swapaxes(0, 1)

    def propagate_joint_forces(
        self, force: FloatArray, joint: NDArray[np.int64], initial: FloatArray
    ) -> Iterator[FloatArray]:
        """As :meth:`propagate`, for forces that act at one joint each.

        Args:
            force: (segments, samples, k) N*m or N.
            joint: (k,) index of the joint of each force.
            initial: (segments, 2 joints, k) deviation at the first sample.
        """
        mean = _interval_means(force)
        joints = self.input_matrix.shape[-1]
        # A product with a selection matrix is faster than indexing.
        chosen = np.eye(joints)[:, joint]

        def force_inputs(some: slice) -> FloatArray:
            push = self.input_matrix[some]
            each: FloatArray = (push.reshape(-1, joints) @ chosen).reshape(*push.shape[:-1], -1)
            each *= mean[some, :, None]
            return each

        return self._propagate(force_inputs, initial)

    def _propagate(
        self, force_inputs: Callable[[slice], FloatArray], initial: FloatArray
    ) -> Iterator[FloatArray]:
        """Deviations by recursion over the samples, in blocks.

        Args:
            force_inputs: slice of samples -> contribution of the forces in each interval.
            initial: (segments, 2 joints, k) deviation at the first sample.
        """
        yield initial[None]
        state = initial
        at_once = max(1, _IN_CACHE // initial.size)
        for first in range(0, len(self.transition), at_once):
            some = slice(first, first + at_once)
            out = force_inputs(some)
            for after, step in zip(out, self.transition[some], strict=True):
                after += step @ state
                state = after
            yield out


def _interval_means(force: FloatArray) -> FloatArray:
    """(samples - 1, segments, ...) mean force over each interval."""
    mean: FloatArray = force[:, 1:] + force[:, :-1]
    mean *= 0.5
    return mean.swapaxes(0, 1)


def linearize_dynamics(
    simulator: BatchSimulator,
    trajectory: MeasuredTrajectory,
    effects: ActiveEffects,
    measured: Forces,
    predicted: Forces,
    force_derivatives: tuple[FloatArray, FloatArray],
) -> LinearizedDynamics:
    """Linearize the dynamics between the predicted and the measured motion.

    Nonlinear forces (a drive's limit, dry friction at a reversal) have secants between the two
    motions as slopes. The linearization is therefore valid for large deviations too.

    Args:
        trajectory: the measured and the predicted motion.
        effects: effects of the hypothesis, values (1, joints).
        measured, predicted: forces of the hypothesis along the measured and the predicted motion.
        force_derivatives: stiffness and damping of the other forces that depend on the state, of
            :func:`~pytest_twin.diagnosis.first_order.law_forces.state_force_derivatives`.
    """
    n = trajectory.position.shape[2]
    middle, slope_q, slope_v = rigid_derivatives(simulator, trajectory, effects)
    samples = trajectory.position.shape[1]
    mass, slope_q, slope_v = (
        upsample(x, middle.at, samples) for x in (middle.mass, slope_q, slope_v)
    )
    error_q = trajectory.position - trajectory.predicted_position
    error_v = trajectory.velocity - trajectory.predicted_velocity
    linear = measured.stiffness[0] * error_q + measured.damping[0] * error_v
    actual = -(measured.drive[0] - predicted.drive[0])
    tiny = 1e-9 * np.max(np.abs(linear), axis=(0, 1)) + 1e-30
    share = np.where(
        np.abs(linear) > tiny, np.clip(actual / np.where(linear == 0.0, 1.0, linear), 0.0, 1.0), 1.0
    )
    stiffness, damping = share * measured.stiffness[0], share * measured.damping[0]
    differs = np.abs(error_v) > 1e-6 * trajectory.slip_velocity
    friction = np.where(
        differs,
        -(measured.dry[0] - predicted.dry[0]) / np.where(differs, error_v, 1.0),
        measured.level[0]
        / trajectory.slip_velocity
        / np.cosh(np.minimum(np.abs(trajectory.velocity) / trajectory.slip_velocity, 30.0)) ** 2,
    )
    eye = np.eye(n)
    h = trajectory.interval
    more_stiffness, more_damping = force_derivatives
    passive = measured.passive_stiffness[0] + more_stiffness
    k_all = slope_q + eye * (stiffness + passive)[..., None]
    d_joint = np.maximum(friction, 0.0) + damping + measured.passive_damping[0] + more_damping
    diagonal = np.einsum("stjj->stj", mass)
    is_held = trajectory.at_rest & (
        (np.abs(predicted.dry[0]) < _HOLDS * predicted.level[0])
        | (np.abs(trajectory.predicted_velocity) < trajectory.slip_velocity)
        & (predicted.level[0] > 0.0)
    )
    d_joint = d_joint + _REST_DAMPING * is_held * diagonal / h
    d_all = slope_v + eye * d_joint[..., None]
    inverse = np.linalg.inv(mass)
    a = np.zeros((*mass.shape[:2], 2 * n, 2 * n))
    a[..., :n, n:] = eye
    a[..., n:, :n] = -inverse @ k_all
    a[..., n:, n:] = -inverse @ d_all
    a = 0.5 * (a[:, 1:] + a[:, :-1])
    b = np.zeros((*a.shape[:2], 2 * n, n))
    b[..., n:, :] = 0.5 * (inverse[:, 1:] + inverse[:, :-1])
    identity = np.eye(2 * n)
    both = np.concatenate([identity + 0.5 * h * a, h * b], axis=-1)
    solved = np.linalg.solve(identity - 0.5 * h * a, both)
    step, push = (
        np.ascontiguousarray(x.swapaxes(0, 1)) for x in (solved[..., : 2 * n], solved[..., 2 * n :])
    )
    return LinearizedDynamics(step, push, stiffness, damping)
