"""Ways to compute how well motions tell two hypotheses apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import SpecError
from pytest_twin.estimation.hypothesis import Hypothesis, Scales
from pytest_twin.excitation.approved_robot import ApprovedRobot
from pytest_twin.excitation.closed_loop import servo_modes
from pytest_twin.excitation.discrimination import (
    Imitation,
    Separation,
    repeats,
    separations,
    sum_of_squares,
    truths_of,
)
from pytest_twin.excitation.hypotheses import Diagnosed, Rival, fitted_values
from pytest_twin.excitation.motion import Motion
from pytest_twin.excitation.responses import Noise, Responses
from pytest_twin.identification.effort.law_columns import EffortRows, Shape
from pytest_twin.identification.effort.laws_along import LawsAlong, band_of
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.identification.regressor.regressor import Regressor


class Separator(Protocol):
    """Tells how well motions separate two hypotheses.

    Attributes:
        noise: what no model explains.
    """

    noise: Noise

    def separations(self, motions: Sequence[Motion]) -> list[Separation]:
        """How well each motion separates them."""

    def truths(self) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
        """Parameters that are taken for true, as ``diagnosis.json`` writes them."""


class SimulatedSeparator:
    """Separates hypotheses by the motion of the model's servos; the first motions fix the truths.

    Args:
        noise: what no model explains.
    """

    def __init__(self, robot: ApprovedRobot, rivals: tuple[Rival, Rival], noise: Noise) -> None:
        self._robot, self._rivals, self.noise = robot, rivals, noise
        self._fixed: tuple[Scales, tuple[Hypothesis, Hypothesis]] | None = None

    def separations(self, motions: Sequence[Motion]) -> list[Separation]:
        """How well each motion separates them."""
        scales = None if self._fixed is None else self._fixed[0]
        responses = Responses(
            self._robot.realization, self._robot.approved, motions, self.noise, scales
        )
        if self._fixed is None:
            self._fixed = responses.scales, truths_of(responses, self._rivals)
        return separations(responses, self._rivals, self._fixed[1])

    def truths(self) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
        """Parameters that are taken for true, as ``diagnosis.json`` writes them."""
        if self._fixed is None:
            return {}, {}
        scales, (first, second) = self._fixed
        slides = [joint.is_slide for joint in self._robot.approved.joints]
        return fitted_values(first, scales, slides), fitted_values(second, scales, slides)


class EffortSeparator:
    """Separates hypotheses by the efforts of a robot that follows its commands exactly.

    The effort is linear in the amplitudes of a law, so that its best imitation is a linear fit in
    each of its shapes; nothing is simulated.

    Args:
        noise: what no model explains.
    """

    def __init__(self, robot: ApprovedRobot, rivals: tuple[Rival, Rival], noise: Noise) -> None:
        self._robot, self._rivals, self.noise = robot, rivals, noise
        self._along: LawsAlong | None = None
        self._fixed: tuple[tuple[Shape, FloatArray], tuple[Shape, FloatArray]] | None = None

    def separations(self, motions: Sequence[Motion]) -> list[Separation]:
        """How well each motion separates them.

        Raises:
            SpecError: efforts along a motion do not show one of the hypotheses.
        """
        recordings = [followed(motion, self._robot.regressor) for motion in motions]
        if self._along is None:
            band = band_of(recordings)
            self._along = LawsAlong.of(self._robot.realization, recordings, band)
        rows = self._along.rows(recordings)
        if self._fixed is None:
            self._fixed = self._assumed(rows)
        first, second = self._fixed
        return [
            Separation((self._imitated(one, first, self._rivals[1]),
                        self._imitated(one, second, self._rivals[0])))
            for one in rows
        ]  # fmt: skip

    def truths(self) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
        """Parameters that are taken for true, as ``diagnosis.json`` writes them."""
        if self._fixed is None or self._along is None:
            return {}, {}
        slides = [joint.is_slide for joint in self._robot.approved.joints]
        scales = self._along.laws.scales
        first, second = (self._hypothesis(*one) for one in self._fixed)
        return fitted_values(first, scales, slides), fitted_values(second, scales, slides)

    def _assumed(
        self, rows: Sequence[EffortRows]
    ) -> tuple[tuple[Shape, FloatArray], tuple[Shape, FloatArray]]:
        """Shapes and amplitudes that are taken for true, as ``discrimination.truths_of``."""
        first, second = self._rivals
        known, other = (second, first) if second.diagnosed and not first.diagnosed else self._rivals
        truth = self._typical(known)
        imitation = self._typical(other)
        if not other.diagnosed:
            imitations = [self._imitated(one, truth, other) for one in rows]
            if not all(repeats(one) for one in imitations):
                most = max(range(len(rows)), key=lambda i: sum_of_squares(imitations[i].effect))
                imitation = self._fit(rows[most], self._effort(rows[most], *truth), other)
        return (truth, imitation) if known is first else (imitation, truth)

    def _shapes(self, rival: Rival) -> list[Shape]:
        assert self._along is not None
        shapes = [shape for shape in self._along.laws.shapes if shape.term == rival.term]
        if not shapes:
            raise SpecError(
                "the model has no servos, and efforts along a given motion do not show this",
                where="--separate", value=rival.name,
                expected="a model with a position or velocity servo on every joint",
            )  # fmt: skip
        return shapes

    def _typical(self, rival: Rival) -> tuple[Shape, FloatArray]:
        """Shape and amplitudes of a diagnosis, else typical ones."""
        assert self._along is not None
        scales = self._along.laws.scales
        theta = rival.assumed(scales).theta
        sizes = np.array([scales.value(p, rival.term.joint) for p in rival.term.parameters])
        shapes = self._shapes(rival)
        fixed = [[k for k in range(len(theta)) if k not in shape.columns] for shape in shapes]
        distance = [
            float(np.abs(shape.values[k] / sizes[k] - theta[k]).sum())
            for shape, k in zip(shapes, fixed, strict=True)
        ]
        shape = shapes[int(np.argmin(distance))]
        return shape, np.array([theta[k] * sizes[k] for k in shape.columns])

    def _effort(self, rows: EffortRows, shape: Shape, amplitudes: FloatArray) -> FloatArray:
        """(n, joints) effort of a law, in standard deviations of the noise."""
        assert self.noise.effort is not None
        return effort_of(rows, shape, amplitudes) / self.noise.effort

    def _fit(self, rows: EffortRows, target: FloatArray, rival: Rival) -> tuple[Shape, FloatArray]:
        """Shape and amplitudes of a hypothesis whose effort is closest to ``target``."""
        best: tuple[Shape, FloatArray] | None = None
        least = np.inf
        for shape in self._shapes(rival):
            unit = np.eye(len(shape.columns))
            matrix = np.stack([self._effort(rows, shape, one).ravel() for one in unit], axis=1)
            amplitudes = np.asarray(
                np.linalg.lstsq(matrix, target.ravel(), rcond=None)[0], dtype=np.float64
            )
            left = sum_of_squares(target.ravel() - matrix @ amplitudes)
            if best is None or left < least:
                best, least = (shape, amplitudes), left
        assert best is not None
        return best

    def _imitated(
        self, rows: EffortRows, truth: tuple[Shape, FloatArray], rival: Rival
    ) -> Imitation:
        target = self._effort(rows, *truth)
        imitation = self._fit(rows, target, rival)
        difference = target - self._effort(rows, *imitation)
        return Imitation(self._hypothesis(*truth), self._hypothesis(*imitation), difference, target)

    def _hypothesis(self, shape: Shape, amplitudes: FloatArray) -> Hypothesis:
        assert self._along is not None
        values = shape.values.copy()
        values[list(shape.columns)] = amplitudes
        scales = self._along.laws.scales
        sizes = [scales.value(p, shape.term.joint) for p in shape.term.parameters]
        return Hypothesis((shape.term,), values / np.array(sizes))


def effort_of(rows: EffortRows, shape: Shape, amplitudes: FloatArray) -> FloatArray:
    """(n, joints) effort of a law with some amplitudes, N*m or N."""
    effort = np.zeros((len(rows.time), len(rows.columns)))
    for column, amplitude in zip(shape.columns.values(), amplitudes, strict=True):
        for j, columns in enumerate(rows.columns):
            for at in np.flatnonzero(columns == column):
                effort[:, j] += amplitude * rows.matrix[j][:, at]
    return effort


def separator_of(
    robot: ApprovedRobot, rivals: tuple[Rival, Rival], diagnosed: Diagnosed | None
) -> Separator:
    """Return the way to separate hypotheses of a robot: by its servos, or by its efforts."""
    if servo_modes(robot.realization, robot.approved.names) is None:
        left = {} if diagnosed is None else diagnosed.effort_noise
        effort = [
            left.get(name, own)
            for name, own in zip(robot.approved.names, robot.noise.effort, strict=True)
        ]
        return EffortSeparator(robot, rivals, Noise(None, np.array(effort)))
    return SimulatedSeparator(robot, rivals, noise_of_signals(robot, diagnosed))


def noise_of_signals(robot: ApprovedRobot, diagnosed: Diagnosed | None) -> Noise:
    """Return what no model explains: the sensors' noise, and what a diagnosis leaves.

    Efforts count only where their noise is known, because other robots do not measure them.
    """
    names, noise = robot.approved.names, robot.noise
    left = {} if diagnosed is None else diagnosed.noise
    position = np.array([left.get(n, s) for n, s in zip(names, noise.position, strict=True)])
    effort_left = {} if diagnosed is None else diagnosed.effort_noise
    measured = [
        name in effort_left or source != "assumed"
        for name, source in zip(names, noise.effort_source, strict=True)
    ]
    if not all(measured):
        return Noise(position, None)
    effort = [effort_left.get(n, s) for n, s in zip(names, noise.effort, strict=True)]
    return Noise(position, np.array(effort))


def followed(motion: Motion, regressor: Regressor) -> MeasuredRecording:
    """The recording of a robot that follows a motion exactly, with the efforts of its model."""
    states = motion.position, motion.velocity, motion.acceleration
    effort = regressor.matrix(*states) @ regressor.prior
    none = np.zeros(len(regressor.joints))
    return MeasuredRecording(
        Path(motion.name), 0.0, regressor.joints, motion.time, motion.position, None, effort,
        none > 0.0, none + np.inf, {},
    )  # fmt: skip
