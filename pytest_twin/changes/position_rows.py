"""What laws of the catalogue change in the positions of recordings, as rows of a linear model.

The model with the effects that earlier recordings show is linearized along the motion that it
predicts. Each law of the catalogue then has columns: the change of the predicted positions by one
amplitude. Along the measured motion, the laws together would form the equation of motion of the
robot, and so explain any residual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.changes.background import Rows
from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.sensitivities import (
    Sensitivity,
    linearize,
    sensitivities_around,
)
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.verdict import UNSEEN
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.estimation.hypothesis import EMPTY, Scales, Term
from pytest_twin.identification.effort.law_columns import Shape
from pytest_twin.trial import Trial

_LEAST_TRAVEL = 1e-3
"""Smallest RMS travel that scales the residual of a joint, rad or m: a joint at rest has none."""


@dataclass(frozen=True, slots=True)
class PositionRows:
    """Rows of one recording or of a part of it.

    Attributes:
        recording: the recording.
        time: (n,) s from its first state.
        effort: (n, joints) measured minus predicted position, rad or m; the name is that of rows
            of efforts, with which they are compared alike.
        columns: for each joint, (k,) indices of the columns that act on it.
        matrix: for each joint, (n, k) change of the position per unit of these amplitudes.
        bounds: (2, 3, joints) lower and upper bound of position, velocity and acceleration.
    """

    recording: Trial
    time: FloatArray
    effort: FloatArray
    columns: tuple[NDArray[np.intp], ...]
    matrix: tuple[FloatArray, ...]
    bounds: FloatArray


@dataclass(frozen=True, slots=True)
class PositionLaws:
    """Laws and rows of several recordings.

    Attributes:
        joints: names, in the order of the residuals.
        shapes: each law at each joint, in one shape, with its columns.
        parts: rows of each recording, in the order of the trials.
        scales: (columns,) SI value of the amplitude at which a column was computed.
        slides: for each joint, whether it is prismatic.
    """

    joints: tuple[str, ...]
    slides: tuple[bool, ...]
    shapes: tuple[Shape, ...]
    parts: tuple[PositionRows, ...]
    scales: FloatArray

    def rows(self, before: int) -> Rows:
        """The rows with their sums, scaled by the travel of the earlier recordings.

        Args:
            before: number of earlier parts.
        """
        travel = np.sqrt(
            np.mean(
                [np.diff(part.bounds[:, 0], axis=0)[0] ** 2 / 12.0 for part in self.parts[:before]],
                axis=0,
            )
        )
        return Rows.of(self.parts, np.maximum(travel, _LEAST_TRAVEL), len(self.scales))


def position_laws(prepared: PreparedProblem, trials: Sequence[Trial]) -> PositionLaws:
    """Linearize the nominal model of a problem along all its recordings.

    Args:
        prepared: the problem; its nominal model has the effects that are known.
        trials: its recordings.
    """
    problem = prepared.problem.at(EMPTY)
    segments = problem.fit
    (residual,) = problem.residuals([EMPTY], segments)
    terms = [t for t in candidates(problem) if not t.law.is_elastic_transmission]
    widths = bins(problem, segments)
    binned = widths.mean(residual)
    along = _along_prediction(problem)
    linear = linearize(along, segments, EMPTY)
    responses, _ = sensitivities_around(linear, along, terms, segments, EMPTY, residual)
    shapes, columns, amplitudes = _one_shape_each(responses, problem.scales)
    count = len(problem.joints)
    matrix = np.concatenate(columns, axis=2).astype(np.float64)[:, :count]
    seen = problem.floor < UNSEEN
    parts: list[PositionRows] = []
    ends = np.cumsum(widths.lengths)
    every = [problem.simulator.segments[s] for s in segments]
    stamps = widths.mean(np.concatenate([s.time for s in every]))
    positions = widths.mean(np.concatenate([s.position for s in every]))
    for k, trial in enumerate(trials):
        own = [i for i, s in enumerate(segments) if prepared.segment_trial[s] == k]
        at = np.concatenate([np.arange(ends[i] - widths.lengths[i], ends[i]) for i in own])
        parts.append(
            PositionRows(
                trial, stamps[at], np.where(seen, binned[at, :count], np.nan),
                tuple(np.arange(matrix.shape[2]) for _ in range(count)),
                tuple(matrix[at, j] for j in range(count)),
                _bounds(positions[at], stamps[at]),
            )
        )  # fmt: skip
    slides = tuple(map(bool, problem.simulator.layout.slides))
    return PositionLaws(problem.joints, slides, tuple(shapes), tuple(parts), np.array(amplitudes))


def _along_prediction(problem: Problem) -> Problem:
    """The problem with the predicted motion of its nominal model as the measured one."""
    simulator = problem.simulator
    predicted = problem.predict([EMPTY], problem.all_segments)[0]
    segments = [
        replace(s, position=p.position, velocity=None if s.velocity is None else p.velocity)
        for s, p in zip(simulator.segments, predicted, strict=True)
    ]
    return problem.with_simulator(
        BatchSimulator(
            segments, problem.joints, threads=simulator.threads, refine=simulator.refine,
            fixed=simulator.fixed,
        ),
        None,
    )  # fmt: skip


def in_parts(part: PositionRows, count: int) -> list[PositionRows]:
    """Rows of a recording cut into equal parts."""
    return [
        PositionRows(
            part.recording, part.time[rows], part.effort[rows], part.columns,
            tuple(m[rows] for m in part.matrix), part.bounds,
        )
        for rows in np.array_split(np.arange(len(part.time)), count)
    ]  # fmt: skip


def _one_shape_each(
    responses: Sequence[Sensitivity], scales: Scales
) -> tuple[list[Shape], list[FloatArray], list[float]]:
    """For each law and joint its middle shape, with its columns and their SI amplitudes."""
    by_term: dict[Term, list[Sensitivity]] = {}
    for response in responses:
        by_term.setdefault(response.term, []).append(response)
    shapes, columns, amplitudes = list[Shape](), list[FloatArray](), list[float]()
    for term, each in by_term.items():
        response = each[len(each) // 2]
        if not np.isfinite(response.change).all() or not response.change.any():
            continue
        sizes = np.array([scales.value(p, term.joint) for p in term.parameters])
        values = response.start * sizes
        first = len(amplitudes)
        shapes.append(
            Shape(term, values, {k: first + i for i, k in enumerate(response.amplitude_indices)})
        )
        amplitudes += [float(values[k]) for k in response.amplitude_indices]
        columns.append(response.change)
    return shapes, columns, amplitudes


def _bounds(position: FloatArray, time: FloatArray) -> FloatArray:
    """(2, 3, joints) bounds of position, velocity and acceleration."""
    later = time + 1e-9 * np.arange(len(time))
    velocity = np.gradient(position, later, axis=0)
    each = np.stack([position, velocity, np.gradient(velocity, later, axis=0)])
    return np.stack([each.min(axis=1), each.max(axis=1)])
