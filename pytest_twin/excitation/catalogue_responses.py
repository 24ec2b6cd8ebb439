"""Readings of every law of the catalogue along a motion, in multiples of the noise.

Each law has a few columns: the change of all readings by the law at its typical sizes. Positions
come from simulations with the model's servos, efforts without servos from the linear regressor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.effects.proposal import starting_sizes
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Scales, Term
from pytest_twin.excitation.approved_robot import ApprovedRobot
from pytest_twin.excitation.closed_loop import servo_modes
from pytest_twin.excitation.motion import Motion
from pytest_twin.excitation.responses import Noise, Responses
from pytest_twin.excitation.separators import effort_of, followed, noise_of_signals
from pytest_twin.identification.effort.laws_along import LawsAlong, band_of

_SIZES = 3
"""Largest number of sizes and shapes of one law that are computed."""
_SAMPLES = 1000
"""Number of samples of a motion that are compared. A law's readings are smooth at this distance."""
_BATCH = 60
"""Number of simulations whose readings are held at full rate."""
_NOT_OF_THE_ROBOT = ("contact", "environment")
"""Families of laws that come from the surroundings: no motion of the robot makes them show."""


@dataclass(frozen=True)
class LawColumns:
    """Columns of some laws along one motion.

    Attributes:
        matrix: (columns, n, signals) change of the readings, in standard deviations of the noise.
        of_term: term -> its columns; the first one is its typical size. A law that no reading
            shows, or whose simulations diverged, is absent.
        parameters: term -> number of parameters that a fit estimates.
    """

    matrix: FloatArray
    of_term: Mapping[Term, Sequence[int]]
    parameters: Mapping[Term, int]


class CatalogueResponses(Protocol):
    """Computes the columns of all laws.

    Attributes:
        noise: what no model explains.
    """

    noise: Noise

    def along(self, motion: Motion) -> LawColumns:
        """Columns of the laws along a motion."""


def terms_of(robot: ApprovedRobot) -> list[Term]:
    """Return every law of the catalogue at every joint where it can act."""
    names = robot.approved.names
    modes = servo_modes(robot.realization, names)
    found = []
    for effect, law in catalogue().items():
        if not law.candidate or law.family in _NOT_OF_THE_ROBOT:
            continue
        if law.scope == "robot":
            found.append(Term(effect, -1))
            continue
        by_command = law.family in ("actuation", "timing")
        for at in range(len(names)):
            if not by_command or modes is None or modes[at] in law.modes:
                found.append(Term(effect, at))
    return found


def responses_of(robot: ApprovedRobot, terms: Sequence[Term]) -> CatalogueResponses:
    """Return the way to compute columns: by the model's servos, or by efforts without them."""
    if servo_modes(robot.realization, robot.approved.names) is None:
        return OfEfforts(robot, terms)
    return _OfServos(robot, terms)


class _OfServos:
    def __init__(self, robot: ApprovedRobot, terms: Sequence[Term]) -> None:
        self._robot, self._terms = robot, terms
        self.noise = noise_of_signals(robot, None)
        self._scales: Scales | None = None

    def along(self, motion: Motion) -> LawColumns:
        """Columns of the laws along a motion; the first motion fixes their typical sizes."""
        robot = self._robot
        responses = Responses(robot.realization, robot.approved, [motion], self.noise, self._scales)
        self._scales = responses.scales
        hypotheses = [Hypothesis((term,), size) for term in self._terms for size in _sizes(term)]
        step = max(1, responses.lengths[0] // _SAMPLES)
        nominal = responses.of([(0, EMPTY)])[0][::step]
        matrix = np.empty((len(hypotheses), *nominal.shape))
        for first in range(0, len(hypotheses), _BATCH):
            some = hypotheses[first : first + _BATCH]
            for k, one in enumerate(responses.of([(0, h) for h in some])):
                matrix[first + k] = one[::step] - nominal
        return _columns(
            matrix, [h.terms[0] for h in hypotheses], [h.free_count for h in hypotheses]
        )


class OfEfforts:
    """Efforts of the laws along a given motion, linear in their amplitudes.

    Args:
        terms: laws at joints; those that efforts cannot show, or only as another law, are left out.
    """

    def __init__(self, robot: ApprovedRobot, terms: Sequence[Term]) -> None:
        self._robot, self._terms = robot, frozenset(terms)
        self._effort_noise = np.array(robot.noise.effort)
        self.noise = Noise(None, self._effort_noise)
        self._laws: LawsAlong | None = None

    def along(self, motion: Motion) -> LawColumns:
        """Columns of the laws along a motion; the first motion fixes their typical sizes."""
        recording = followed(motion, self._robot.regressor)
        if self._laws is None:
            self._laws = LawsAlong.of(self._robot.realization, [recording], band_of([recording]))
        (rows,) = self._laws.rows([recording])
        scales = self._laws.laws.scales
        columns, terms, counts = [], [], []
        for shape in self._laws.laws.shapes:
            if shape.term not in self._terms:
                continue
            amplitudes = np.array([
                shape.term.parameters[k].starts[0] * scales.value(
                    shape.term.parameters[k], shape.term.joint)
                for k in shape.columns
            ])  # fmt: skip
            # All amplitudes at once are the typical law; each by itself is a direction of its fit.
            parts = [amplitudes] if len(amplitudes) == 1 else [amplitudes, *np.diag(amplitudes)]
            for part in parts:
                columns.append(effort_of(rows, shape, part) / self._effort_noise)
                terms.append(shape.term)
                counts.append(len(shape.columns))
        return _columns(np.array(columns), terms, counts)


def _sizes(term: Term) -> list[FloatArray]:
    """Some sizes of a law, the middle one first."""
    sizes = starting_sizes(term.law)
    others = np.linspace(0, len(sizes) - 1, _SIZES).round().astype(int)
    return [sizes[i] for i in dict.fromkeys([len(sizes) // 2, *others.tolist()])][:_SIZES]


def _columns(matrix: FloatArray, terms: Sequence[Term], counts: Sequence[int]) -> LawColumns:
    of_term: dict[Term, list[int]] = {}
    parameters: dict[Term, int] = {}
    for at, (term, count) in enumerate(zip(terms, counts, strict=True)):
        if np.isfinite(matrix[at]).all():
            of_term.setdefault(term, []).append(at)
            parameters[term] = max(count, parameters.get(term, 0))
    return LawColumns(np.nan_to_num(matrix, posinf=0.0, neginf=0.0), of_term, parameters)
