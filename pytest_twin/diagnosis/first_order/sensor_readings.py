"""Sensor readings of small deviations: from samples of a motion to means over bins.

All operations are linear: interpolation at the stamps, weights of efforts, projection on free
initial states, and averaging. They are computed once as sparse matrices. Each column then costs one
product with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.bins import Bins
from pytest_twin.diagnosis.first_order.linearized_dynamics import LinearizedDynamics
from pytest_twin.diagnosis.first_order.measured_trajectory import MeasuredTrajectory
from pytest_twin.diagnosis.free_initial_state import FreeInitialState
from pytest_twin.diagnosis.problem import Problem

_AT_ONCE = 32
"""Number of columns that are converted together, so that they fit into a core's cache."""


@dataclass(slots=True)
class ReadingChange:
    """Changes by one amplitude of one candidate, or by one whole hypothesis.

    Attributes:
        force, drive: change of the generalized force and of the drive's effort, (segments, samples,
            joints), N*m or N. They are (segments, samples) if only ``joint`` is affected, and None
            if there is no change.
        initial: (segments, 2 joints) change of the initial state, or None.
        direct: (stamps of all segments, signals) direct change of the readings, or None. Columns
            may share one array; its means are then computed once.
        joint: the only joint that is affected; None for all joints.
    """

    force: FloatArray | None = None
    drive: FloatArray | None = None
    initial: FloatArray | None = None
    direct: FloatArray | None = None
    joint: int | None = None

    def at_all_joints(self, joints: int) -> ReadingChange:
        """The same column with forces at all joints."""
        if self.joint is None:
            return self
        force, drive = (_only_at_joint(x, self.joint, joints) for x in (self.force, self.drive))
        return ReadingChange(force, drive, self.initial, self.direct)


class SensorReadings:
    """Converts deviations from a motion into bin means of the sensor readings."""

    def __init__(
        self,
        problem: Problem,
        trajectory: MeasuredTrajectory,
        dynamics: LinearizedDynamics,
        bins: Bins,
    ) -> None:
        self.dynamics = dynamics
        self.joints = len(problem.joints)
        self.signals = len(problem.signal_floor)
        segments = [problem.simulator.segments[s] for s in trajectory.segments]
        lengths = [len(s.time) for s in segments]
        self._stamps = np.concatenate([[0], np.cumsum(lengths)])
        self._bins = np.concatenate([[0], np.cumsum(bins.lengths)])
        self._at = [_interpolation_matrix(trajectory, i, s.time) for i, s in enumerate(segments)]
        self._mean = _averaging_matrix(bins, int(self._stamps[-1]))
        at = sparse.block_diag(self._at, format="csr")
        self._position = self._samples_first(self._mean @ at)
        self._position_weights: FloatArray | None = None
        if problem.position_weights:
            self._position_weights = problem.position_weights_of(trajectory.segments, bins.lengths)
        self._effort_weights: FloatArray | None = None
        self._efforts = [self._position] * self.joints
        if problem.effort_floor is not None and problem.effort_weights:
            pairs = zip(trajectory.segments, lengths, strict=True)
            self._effort_weights = np.concatenate(
                [problem.weigh_efforts(int(s), np.ones((n, self.joints))) for s, n in pairs]
            )
            self._efforts = [
                self._samples_first(self._mean @ sparse.diags_array(weights) @ at)
                for weights in self._effort_weights.T
            ]
        self._stiffness, self._damping = (
            np.ascontiguousarray(x.swapaxes(0, 1))[..., None]
            for x in (dynamics.stiffness, dynamics.damping)
        )
        self._starts: dict[int, _FreeState] = {}

    def subtract_free_states(self, starts: dict[int, FreeInitialState]) -> None:
        """Subtract the part that free initial states explain from all later results.

        Args:
            starts: segment -> its free initial state.
        """
        for i, start in starts.items():
            shifts = start.solve.shape[0]
            solve = start.solve.reshape(shifts, -1, self.joints)
            of_samples = np.stack([s @ self._at[i] for s in np.moveaxis(solve, 2, 0)], axis=2)
            mean = self._mean[self._bins[i] : self._bins[i + 1], self._stamps_of(i)]
            response = start.response.reshape(len(self._at[i].indptr) - 1, -1)
            self._starts[i] = _FreeState(
                of_samples.reshape(shifts, -1), start.solve,
                np.asarray(mean @ response).reshape(-1, shifts),
            )  # fmt: skip

    def at_stamps(self, i: int, values: FloatArray) -> FloatArray:
        """(samples, ...) values of segment ``i``, interpolated linearly at its stamps."""
        read = self._at[i] @ values.reshape(len(values), -1)
        return np.asarray(read).reshape(-1, *values.shape[1:])

    def bin_means(self, columns: Sequence[ReadingChange]) -> list[FloatArray]:
        """Bin means (bins, signals) of the readings of every column."""
        return [
            change
            for first in range(0, len(columns), _AT_ONCE)
            for change in self._convert_batch(columns[first : first + _AT_ONCE])
        ]

    def _samples_first(self, read: sparse.csr_array) -> sparse.csr_array:
        """Reorder the columns of a matrix from (segments, samples) to (samples, segments)."""
        segments, samples = self.dynamics.stiffness.shape[:2]
        in_turn = np.arange(segments * samples).reshape(segments, samples).T.ravel()
        return sparse.csr_array(read[:, in_turn])

    def _stamps_of(self, i: int) -> slice:
        """Slice of the stamps of segment ``i`` among those of all segments."""
        return slice(int(self._stamps[i]), int(self._stamps[i + 1]))

    def _convert_batch(self, columns: Sequence[ReadingChange]) -> list[FloatArray]:
        joints, count = self.joints, len(columns)
        segments, samples = self.dynamics.stiffness.shape[:2]
        initial = np.zeros((segments, 2 * joints, count))
        for k, c in enumerate(columns):
            if c.initial is not None:
                initial[..., k] = c.initial
        binned = np.zeros((int(self._bins[-1]), self.signals, count))
        moved, effort = self._deviations(columns, initial)
        if moved is not None:
            flat = moved.reshape(samples * segments, -1)
            binned[:, :joints] = (self._position @ flat).reshape(-1, joints, count)
        if effort is not None:
            for j, mean in enumerate(self._efforts):
                of_joint = effort[:, :, j].reshape(samples * segments, -1)
                binned[:, joints + j] = mean @ of_joint
        direct = {id(c.direct): c.direct for c in columns if c.direct is not None}
        means = {key: self._bin_means(d) for key, d in direct.items()}
        for k, c in enumerate(columns):
            if c.direct is not None:
                binned[:, :, k] += means[id(c.direct)]
        self._subtract_free_starts(binned, columns, moved)
        if self._position_weights is not None:
            binned[:, :joints] *= self._position_weights[..., None]
        out = binned.astype(np.float32)
        return [np.asarray(out[:, :, k]) for k in range(count)]

    def _deviations(
        self, columns: Sequence[ReadingChange], initial: FloatArray
    ) -> tuple[FloatArray | None, FloatArray | None]:
        """Deviations of positions and of efforts, (samples, segments, joints, columns) each.

        Positions are None if no force and no initial state changes; efforts are None if they are
        not measured.
        """
        joints, count = self.joints, len(columns)
        segments, samples = self.dynamics.stiffness.shape[:2]
        pushed = [c for c in columns if c.force is not None or c.drive is not None]
        alone = all(c.joint is not None for c in pushed)
        if not alone:
            columns = [c.at_all_joints(joints) for c in columns]
        joint = np.array([c.joint or 0 for c in columns])
        none = np.zeros((segments, samples) if alone else (segments, samples, joints))
        shape = (samples, segments, joints, count)
        effort = None
        if self.signals > joints:
            effort = np.empty(shape)
            drive = _stack_columns([none if c.drive is None else c.drive for c in columns])
            drive = drive.swapaxes(0, 1)
            here = joint == np.arange(joints)[:, None]

        def delivered(some: slice) -> FloatArray:
            return np.where(here, drive[some, :, None], 0.0) if alone else drive[some]

        if not initial.any() and all(c.force is None for c in columns):
            if effort is not None:
                effort[:] = delivered(slice(None))
            return None, effort
        force = _stack_columns([none if c.force is None else c.force for c in columns])
        of = self.dynamics
        states = (
            of.propagate_joint_forces(force, joint, initial)
            if alone
            else of.propagate(force, initial)
        )
        moved, first = np.empty(shape), 0
        for state in states:
            some = slice(first, first + len(state))
            first = some.stop
            position, velocity = state[:, :, :joints], state[:, :, joints:]
            moved[some] = position
            if effort is not None:
                effort[some] = delivered(some)
                effort[some] -= self._stiffness[some] * position
                effort[some] -= self._damping[some] * velocity
        return moved, effort

    def _subtract_free_starts(
        self, binned: FloatArray, columns: Sequence[ReadingChange], moved: FloatArray | None
    ) -> None:
        """Subtract the part of the deviations that free initial states explain, in place.

        Args:
            binned: (bins, signals, columns) means; changed.
            columns: the columns.
            moved: (samples, segments, joints, columns) deviations of positions, or None.
        """
        direct = {id(c.direct): c.direct for c in columns if c.direct is not None}
        for i, start in self._starts.items():
            shift = np.zeros((len(start.solve), len(columns)))
            if moved is not None:
                shift += start.of_samples @ moved[:, i].reshape(-1, len(columns))
            solved = {
                key: start.solve @ d[self._stamps_of(i), : self.joints].ravel()
                for key, d in direct.items()
            }
            for k, c in enumerate(columns):
                if c.direct is not None:
                    shift[:, k] += solved[id(c.direct)]
            of_segment = binned[self._bins[i] : self._bins[i + 1], : self.joints]
            of_segment -= (start.response @ shift).reshape(of_segment.shape)

    def _bin_means(self, direct: FloatArray) -> FloatArray:
        """(bins, signals) means of (stamps, signals) readings, with weighted efforts."""
        if self._effort_weights is not None:
            weigh_efforts = direct[:, self.joints :] * self._effort_weights
            direct = np.concatenate([direct[:, : self.joints], weigh_efforts], axis=1)
        return np.asarray(self._mean @ direct)


@dataclass(frozen=True, slots=True)
class _FreeState:
    """The free initial state of one segment.

    Attributes:
        of_samples: (shifts, samples * joints) maps a deviation to the most probable shift.
        solve: (shifts, stamps * joints) maps readings to the most probable shift.
        response: (bins * joints, shifts) maps a shift to bin means of positions.
    """

    of_samples: FloatArray
    solve: FloatArray
    response: FloatArray


def _interpolation_matrix(
    trajectory: MeasuredTrajectory, i: int, stamps: FloatArray
) -> sparse.csr_array:
    """(stamps, samples) matrix that interpolates segment ``i`` linearly at its stamps."""
    samples = trajectory.position.shape[1]
    at = (stamps - trajectory.time[i, 0]) / trajectory.interval
    left = np.clip(at.astype(np.int64), 0, samples - 2)
    part = at - left
    row = np.arange(len(stamps))
    weights = np.concatenate([1.0 - part, part])
    places = np.tile(row, 2), np.concatenate([left, left + 1])
    return sparse.csr_array((weights, places), shape=(len(stamps), samples))


def _averaging_matrix(bins: Bins, stamps: int) -> sparse.csr_array:
    """(bins, stamps) matrix that averages the stamps of each bin."""
    counts = bins.counts
    weights = np.repeat(1.0 / counts, counts)
    ends = np.concatenate([[0], np.cumsum(counts)])
    return sparse.csr_array((weights, np.arange(stamps), ends), shape=(len(counts), stamps))


def _only_at_joint(values: FloatArray | None, joint: int, joints: int) -> FloatArray | None:
    """(..., joints) values that are zero except at one joint; None stays None."""
    if values is None:
        return None
    out = np.zeros((*values.shape, joints))
    out[..., joint] = values
    return out


def _stack_columns(columns: Sequence[FloatArray]) -> FloatArray:
    """Arrays stacked along a new last axis, (..., columns).

    ``np.stack`` gives the same and takes four times as long, because it writes column by column.
    """
    return np.ascontiguousarray(np.moveaxis(np.array(columns), 0, -1))
