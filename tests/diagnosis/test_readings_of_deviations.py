"""A product with one matrix gives the sensor readings of deviations at every stamp."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from test_first_order import problem_of

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.sensitivities import Linearization
from pytest_twin.diagnosis.first_order.sensor_readings import ReadingChange
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.estimation.hypothesis import EMPTY

Makes = Sequence[Callable[[Linearization, int], list[ReadingChange]]]
RNG = np.random.default_rng(3)


def with_efforts(problem: Problem) -> Problem:
    """The problem with measured efforts of different weights."""
    joints = len(problem.joints)
    weights = {
        i: RNG.uniform(0.1, 1.0, (n, joints)) for i, n in enumerate(problem.lengths(problem.fit))
    }
    return replace(problem, effort_floor=np.full(joints, 0.01), effort_weights=weights)


def random_columns(linear: Linearization, signals: int) -> list[ReadingChange]:
    """Columns of every kind; two of them share their direct readings."""
    segments, samples, joints = linear.trajectory.position.shape
    stamps = int(linear.bins.counts.sum())
    moving = [RNG.standard_normal((segments, samples, joints)) for _ in range(4)]
    start = RNG.standard_normal((segments, 2 * joints))
    direct = RNG.standard_normal((stamps, signals))
    return [
        ReadingChange(force=moving[0], drive=moving[1]),
        ReadingChange(direct=direct),
        ReadingChange(force=moving[2], initial=start, direct=direct),
        ReadingChange(drive=moving[3]),
        ReadingChange(initial=start),
        ReadingChange(),
    ]


def random_columns_of_one_joint(linear: Linearization, signals: int) -> list[ReadingChange]:
    """The same columns with forces at one joint each."""
    out = []
    for k, column in enumerate(random_columns(linear, signals)):
        if column.force is not None or column.drive is not None:
            column.joint = k % linear.trajectory.position.shape[2]
            for name in ("force", "drive"):
                everywhere = getattr(column, name)
                setattr(column, name, None if everywhere is None else everywhere[..., column.joint])
        out.append(column)
    return out


def readings_at_each_stamp(linear: Linearization, column: ReadingChange) -> FloatArray:
    """(bins, signals) readings, from the deviations interpolated at each stamp."""
    problem, trajectory, deviation = linear.problem, linear.trajectory, linear.dynamics
    segments, samples, joints = trajectory.position.shape

    def everywhere(values: FloatArray | None) -> FloatArray:
        out = np.zeros((segments, samples, joints))
        if values is not None:
            out[..., slice(None) if column.joint is None else column.joint] = values
        return out

    start = np.zeros((segments, 2 * joints)) if column.initial is None else column.initial
    state = deviation.trajectory(everywhere(column.force)[..., None], start[..., None])[..., 0]
    q, v = state[..., :joints], state[..., joints:]
    effort = everywhere(column.drive) - deviation.stiffness * q - deviation.damping * v
    parts, first = [], 0
    for i, s in enumerate(linear.segments):
        time = problem.simulator.segments[s].time
        signals = [q[i]] if problem.effort_floor is None else [q[i], effort[i]]
        read = np.stack(
            [np.interp(time, trajectory.time[i], x) for x in np.concatenate(signals, axis=1).T],
            axis=1,
        )
        if column.direct is not None:
            read += column.direct[first : first + len(time)]
        first += len(time)
        read[:, joints:] = problem.weigh_efforts(int(s), read[:, joints:])
        if i in linear.starts:
            read[:, :joints] = linear.starts[i].without_initial_error(read[:, :joints])
        parts.append(read)
    stacked, ends = np.concatenate(parts), np.cumsum(linear.bins.counts)
    return np.array([part.mean(axis=0) for part in np.split(stacked, ends[:-1])])


@pytest.mark.parametrize("mode", ["position", "effort"])
@pytest.mark.parametrize("measured", [False, True], ids=["no effort sensor", "effort sensor"])
@pytest.mark.parametrize(
    "make",
    [
        [random_columns],
        [random_columns_of_one_joint],
        [random_columns, random_columns_of_one_joint],
    ],
    ids=["forces at all joints", "forces at one joint", "both"],
)
def test_sensor_readings_equal_those_of_each_stamp(mode: str, measured: bool, make: Makes) -> None:
    problem = problem_of(mode, {})
    if measured:
        problem = with_efforts(problem)
    linear = Linearization(problem, EMPTY, problem.fit)
    assert bool(linear.starts) is (mode == "effort")
    columns = [c for each in make for c in each(linear, len(problem.signal_floor))]
    for column, found in zip(columns, linear.readings.bin_means(columns), strict=True):
        expected = readings_at_each_stamp(linear, column)
        assert found.shape == expected.shape
        assert found == pytest.approx(expected, rel=1e-5, abs=1e-5 * np.abs(expected).max())
