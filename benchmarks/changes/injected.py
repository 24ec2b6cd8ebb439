"""Add laws to the efforts of real recordings, and compare them with recordings without.

The laws are added to the linear rows. The scatter between recordings is estimated once for each
choice of new recordings, because a law that is the same in all of them is no scatter.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.stats

from pytest_twin.changes.background import Contrast, Rows
from pytest_twin.changes.comparison import SURE_OF_NAME, is_unpredicted
from pytest_twin.changes.evidence import evidence_of
from pytest_twin.changes.motor_types import TypeLaw
from pytest_twin.changes.naming import Naming, best_possible
from pytest_twin.changes.prepared import Prepared, prepare
from pytest_twin.changes.recordings import at_one_rate
from pytest_twin.changes.tool_load import with_tool_load
from pytest_twin.identification.effort.filtering import Filter
from pytest_twin.identification.effort.law_columns import EffortLaws, Shape
from pytest_twin.identification.effort.laws_along import LawsAlong, band_of, rms_of
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.realization import Realization

SIZES = (0.25, 0.5, 1.0, 2.0)
NEW = 3
BELOW_NYQUIST = 0.4
"""Largest cutoff of a filter, relative to the sampling rate."""
LEVEL = 0.05
IDENTIFIED = (
    "inertial_parameters", "armature", "viscous_friction", "coulomb_friction", "effort_bias",
)  # fmt: skip
ONE_AMPLITUDE = ("inertial_parameters", "gear_efficiency", "thermal_friction")
LAST_AMPLITUDE = ("stribeck_friction", "motor_load_friction")
"""Laws whose first amplitude is dry friction or a load, which are laws of their own."""


@dataclass(frozen=True)
class Robot:
    """Rows of all recordings.

    Attributes:
        along: the laws along recordings.
        recordings: the recordings of the rows.
        shapes: every law at every joint, in every shape.
        residual: (joints,) RMS residual after an identification, N*m.
    """

    along: LawsAlong
    recordings: tuple[MeasuredRecording, ...]
    shapes: tuple[Shape, ...]
    rows: Rows
    residual: np.ndarray

    @property
    def count(self) -> int:
        """Number of recordings."""
        return len(self.rows.parts)

    @property
    def laws(self) -> EffortLaws:
        """The laws that efforts show."""
        return self.along.laws

    def recorded_effort_of(self, i: int, amplitudes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Stamps, and (n, joints) effort of amplitudes as a recording has it, N*m or N.

        Only the motion is low-passed: the rows have laws whose effort was filtered, and filtered
        twice a law would be a weaker one.
        """
        one = self.recordings[i]
        unfiltered = Filter(self.along.chosen.cutoff, BELOW_NYQUIST * one.rate, one.rate)
        (part,) = replace(self.along, chosen=unfiltered).rows([one])
        efforts = [
            matrix @ (self.rows.scale * amplitudes)[columns]
            for matrix, columns in zip(part.matrix, part.columns, strict=True)
        ]
        return part.time, np.stack(efforts, axis=1)


def robot_of(realization: Realization, recordings: Sequence[MeasuredRecording]) -> Robot:
    """Evaluate every law along recordings."""
    every = at_one_rate(recordings)
    along = LawsAlong.of(realization, every, band_of(every))
    effort = rms_of([one.effort for one in every])
    # A joint without a measured effort has no residual, so no case.
    parts, shapes, count = with_tool_load(along.laws, along.rows(every))
    rows = Rows.of(parts, np.where(effort > 0.0, effort, 1.0), count)
    return Robot(along, tuple(every), shapes, rows, identified_residual(shapes, rows))


def identified_residual(shapes: Sequence[Shape], rows: Rows) -> np.ndarray:
    """(joints,) RMS residual after an identification, N*m."""
    count = len(rows.scale)
    columns = sorted({
        int(c) for s in shapes if s.term.effect in IDENTIFIED for c in s.indices
    })  # fmt: skip
    matrix, vector = np.zeros((count, count)), np.zeros(count)
    for j, sums in enumerate(rows.sums_of(range(len(rows.parts)))):
        matrix[np.ix_(sums.columns, sums.columns)] += sums.matrix / rows.size[j] ** 2
        vector[sums.columns] += sums.vector / rows.size[j] ** 2
    square = matrix[np.ix_(columns, columns)]
    ridge = 1e-6 * np.trace(square) / len(columns) * np.eye(len(columns))
    amplitudes = np.zeros(count)
    amplitudes[columns] = np.linalg.solve(square + ridge, vector[columns])
    return rows.residual_rms(range(len(rows.parts)), amplitudes)


def drawn_amplitudes(
    robot: Robot,
    shapes: Sequence[Shape],
    joint: int,
    new: Sequence[int],
    random: np.random.Generator,
) -> np.ndarray:
    """(columns,) amplitudes of one law whose effort at its joint is the residual (r = 1)."""
    shape = shapes[random.integers(len(shapes))]
    effect, count = shape.term.effect, len(shape.columns)
    sums = robot.rows.sums_of(new)[joint]
    at = np.searchsorted(sums.columns, shape.indices)
    square = sums.matrix[np.ix_(at, at)] / sums.samples
    direction = random.normal(size=count) / np.sqrt(np.diag(square))
    if effect in ("asymmetric_friction", "directional_viscous_friction"):
        # One direction of motion only.
        direction = np.array([1.0, random.choice([-1.0, 1.0])]) / robot.rows.scale[shape.indices]
    elif effect in ONE_AMPLITUDE:
        direction = np.eye(count)[random.integers(count)]
    elif effect in LAST_AMPLITUDE:
        direction = np.eye(count)[-1]
    elif effect == "position_dependent_friction":
        direction[0] = 0.0
    amplitudes = np.zeros(len(robot.rows.scale))
    size = random.choice([-1.0, 1.0]) * robot.residual[joint]
    amplitudes[shape.indices] = direction * size / np.sqrt(direction @ square @ direction)
    return amplitudes


@dataclass(frozen=True)
class Outcome:
    """Answer of one case; effect and joint are empty where nothing is named.

    Attributes:
        evidence: name -> number from which a calibrator may judge the name.
    """

    effect: str
    joint: int
    named: str
    named_joint: int
    confidence: float
    score: float
    threshold: float
    evidence: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_right(self) -> bool:
        """Whether effect and joint are right."""
        return (self.named, self.named_joint) == (self.effect, self.joint)


def in_process(
    robot: Robot, choices: Sequence[tuple[int, ...]], seed: int, sizes: Sequence[float] = SIZES
) -> dict[float, list[Outcome]]:
    """Size r -> outcomes; r = 0 has one for each choice."""
    outcomes: dict[float, list[Outcome]] = {r: [] for r in (0.0, *sizes)}
    shapes = robot.shapes
    by_law: dict[tuple[str, int], list[Shape]] = {}
    for shape in shapes:
        if shape.term.effect != "inertial_parameters" or len(shape.columns) == 1:
            by_law.setdefault((shape.term.effect, shape.term.joint), []).append(shape)
    for new in choices:
        random = np.random.default_rng([seed, *new])
        earlier = [[i] for i in range(robot.count) if i not in new]
        prepared = prepare(robot.rows, earlier, [[i] for i in new], shapes)
        for (effect, joint), candidates in by_law.items():
            if joint < 0 or not robot.residual[joint]:
                continue
            amplitudes = drawn_amplitudes(robot, candidates, joint, new, random)
            for r, of_size in outcomes.items():
                if r == 0.0 and of_size and of_size[-1].effect == str(new):
                    continue
                law = (effect if r else str(new), joint)
                of_size.append(answer(robot, prepared, (), law, r * amplitudes, new))
    return outcomes


def answer(
    robot: Robot,
    prepared: Prepared,
    types: Sequence[TypeLaw],
    law: tuple[str, int],
    amplitudes: np.ndarray,
    new: Sequence[int],
) -> Outcome:
    """Compare when amplitudes are added to the new recordings.

    Args:
        law: effect and joint that are added.
    """
    shapes, tempering = robot.shapes, prepared.tempering
    change = robot.rows.residual_rms(new, prepared.background.mean - amplitudes)
    contrast, naming = (
        Contrast(shown.information, shown.vector + shown.information @ amplitudes)
        for shown in prepared.contrasts(change)
    )
    evidence = evidence_of(contrast, shapes, tempering.inflation)
    likeliest = best_possible(naming, shapes, types, tempering, robot.rows, prepared.background)
    named = likeliest.changes
    first = named[0]
    joint = first.shape.term.joint
    if first.motor is not None:
        joint = next(law.term.joint for law in types if law.motor == first.motor)
    return Outcome(
        *law, first.shape.term.effect, joint,
        0.0 if is_unpredicted(named, prepared, robot.rows.size) else first.confidence,
        prepared.tempering.score(shapes, evidence), prepared.threshold(LEVEL),
        evidence_of_name(robot, likeliest, naming, evidence, new),
    )  # fmt: skip


def evidence_of_name(
    robot: Robot,
    likeliest: Naming,
    contrast: Contrast,
    evidence: np.ndarray,
    new: Sequence[int],
) -> dict[str, float]:
    """What a calibrator may judge a name from.

    ``log_odds`` of the likeliest law, ``gap`` to the next (log of the ratio), ``log_size`` of its
    effort relative to the residual, ``collinearity`` (largest canonical correlation of the two laws
    along the new motions, with the background marginalized) and ``new``, the number of recordings.
    """
    first, *rest = likeliest.candidates
    change = likeliest.changes[0]
    amplitudes = np.zeros(len(robot.rows.scale))
    amplitudes[change.shape.indices] = change.value
    effort = np.concatenate([robot.rows.effort_of(i, amplitudes) for i in new])
    size = np.sqrt(np.mean(effort**2, axis=0)) / np.where(
        robot.residual > 0, robot.residual, np.inf
    )
    second = rest[0]
    of_second = [
        max((k for k, shape in enumerate(robot.shapes) if shape.term == term),
            key=lambda k: evidence[k])
        for term in second.terms
    ]  # fmt: skip
    own = change.shape.indices
    other = np.unique(np.concatenate([robot.shapes[k].indices for k in of_second]))
    parts = [np.linalg.pinv(_root(contrast.information[np.ix_(c, c)])) for c in (own, other)]
    cosines = parts[0] @ contrast.information[np.ix_(own, other)] @ parts[1]
    likely, unlikely, next_likely = (
        float(np.log(max(share, 1e-9)))
        for share in (first.probability, 1.0 - first.probability, second.probability)
    )
    return {
        "log_odds": likely - unlikely,
        "gap": likely - next_likely,
        "log_size": float(np.log(max(size.max(), 1e-3))),
        "collinearity": float(min(np.linalg.norm(cosines, 2), 1.0)),
        "new": float(len(new)),
    }


def _root(matrix: np.ndarray) -> np.ndarray:
    """Square root of a positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def interval(count: int, total: int) -> str:
    """Exact (Clopper-Pearson) interval of a share in percent."""
    test = scipy.stats.binomtest(count, total).proportion_ci(0.95, "exact")
    return f"{100 * test.low:.0f} to {100 * test.high:.0f} %"


def show(title: str, outcomes: Sequence[Outcome]) -> None:
    """Print the figures of cases of one size."""
    total = len(outcomes)
    right = sum(o.is_right for o in outcomes)
    joint = sum(o.named_joint == o.joint for o in outcomes)
    alarms = sum(o.score > o.threshold for o in outcomes)
    named = [o for o in outcomes if o.score > o.threshold and o.confidence >= SURE_OF_NAME]
    sure = [o for o in named if o.confidence >= 0.9]
    print(
        f"{title:<16} {total:5d} cases | first {100 * right / total:3.0f} % | joint "
        f"{100 * joint / total:3.0f} % | alarm {100 * alarms / total:3.0f} % | named "
        f"{100 * len(named) / total:3.0f} %, right {sum(o.is_right for o in named)} | at 0.9 "
        f"{len(sure)}, right {sum(o.is_right for o in sure)}"
    )


BINS = (0.5, 0.7, 0.9, 0.97, 1.0)
"""Bounds of the confidences that are compared with the shares of right names."""


def show_reliability(outcomes: Sequence[Outcome]) -> None:
    """Print how often names above the alarm level are right, by their confidence."""
    named = [o for o in outcomes if o.score > o.threshold and o.confidence >= SURE_OF_NAME]
    for low, high in itertools.pairwise(BINS):
        own = [o for o in named if low <= o.confidence < high or o.confidence == high == 1.0]
        if own:
            right = sum(o.is_right for o in own)
            mean = sum(o.confidence for o in own) / len(own)
            print(
                f"  confidence {low:g} to {high:g}: {len(own)} names, {mean:.2f} on average, right "
                f"{right / len(own):.2f} ({interval(right, len(own))})"
            )
