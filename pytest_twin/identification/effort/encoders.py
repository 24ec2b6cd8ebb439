"""Zero and scale of each encoder, from the effort: gravity and coupling act at the true angle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.essential import SIGNIFICANT
from pytest_twin.identification.effort.filtering import Filter
from pytest_twin.identification.effort.least_squares import Linear, moved_by, solve
from pytest_twin.identification.effort.sampled import predicted
from pytest_twin.identification.effort.scale import payload_parameters
from pytest_twin.identification.measured import Measured
from pytest_twin.identification.regressor import BaseParameters, Regressor
from pytest_twin.realization import Realization

BIAS, SCALE = "encoder_bias", "encoder_scale"
_STEP = 1e-4
"""rad, m, or share: of the central difference. Its error is 1e-9 of the slope, below which nothing
counts as determined; that of a difference to one side would pass for a motion."""
_WIDEST = 0.05
"""Half width (rad, m, or share) beyond which the motion does not determine an encoder: 3 degrees,
which a person sees at the robot's marks."""


@dataclass(frozen=True, slots=True)
class Reading:
    """One error of an encoder: measured = (1 + scale) q + bias.

    Attributes:
        joint: whose encoder.
        kind: ``encoder_bias`` or ``encoder_scale``.
        value: rad or m; of a scale a share.
        half_width: of the 95 % interval.
    """

    joint: str
    kind: str
    value: float
    half_width: float

    @property
    def is_significant(self) -> bool:
        """Whether it differs from zero."""
        return abs(self.value) * Z95 >= SIGNIFICANT * self.half_width


@dataclass(frozen=True, slots=True)
class Encoders:
    """What the efforts say of the encoders.

    Attributes:
        readings: those that the motion determines, whether they differ from zero or not.
        undetermined: (joint, kind) of the others.
        corrected: those of the readings that were taken out of the recordings.
    """

    readings: tuple[Reading, ...] = ()
    undetermined: tuple[tuple[str, str], ...] = ()
    corrected: tuple[Reading, ...] = ()

    @property
    def wrong(self) -> tuple[Reading, ...]:
        """Those that differ from zero."""
        return tuple(one for one in self.readings if one.is_significant)

    def value_of(self, joint: str, kind: str) -> float:
        """Of one reading; 0 where the motion does not determine it."""
        same = [one.value for one in self.readings if (one.joint, one.kind) == (joint, kind)]
        return same[0] if same else 0.0


def encoders_of(
    realization: Realization,
    recordings: Sequence[Measured],
    regressor: Regressor,
    base: BaseParameters,
    problem: Linear,
    values: FloatArray,
    chosen: Filter,
) -> Encoders:
    """Errors of all encoders to first order, with all parameters of the problem free beside them.

    A zero of the last joint is a turn of its link's centre of mass and stays undetermined without a
    known payload. Errors that the motion does not determine are left out, the least known first.

    Args:
        realization: the nominal model, with the twin that states payloads.
        recordings: those that are fitted.
        regressor, base: of the robot.
        problem: all columns that the motion shows.
        values: (b,) fitted base parameters, about which efforts are differentiated.
        chosen: how motion is filtered.
    """
    whole = np.zeros(len(regressor.columns))
    whole[base.independent] = values
    names = [(joint, kind) for joint in regressor.joints for kind in (BIAS, SCALE)]
    carried = [payload_parameters(realization, regressor, one) for one in recordings]
    each = [whole if one is None else whole + one for one in carried]
    slopes = []
    for joint, kind in names:
        ends = []
        for step in (_STEP, -_STEP):
            moved = without_errors(recordings, [Reading(joint, kind, step, 0.0)])
            ends.append(np.concatenate(predicted(moved, regressor, chosen, each)))
        slopes.append((ends[0] - ends[1]) / (2.0 * _STEP))
    own = np.stack(slopes, axis=2)
    free = problem.matrix.shape[2]
    kept = list(range(len(names)))
    while kept:
        columns = np.concatenate([problem.matrix, own[..., kept]], axis=2)
        dry = np.zeros((len(problem.dry), len(kept)), dtype=bool)
        both = replace(problem, matrix=columns, dry=np.hstack([problem.dry, dry]), instrument=None)
        # What the motion hardly shows goes before anything is solved.
        shown = moved_by(columns, both)[free:]
        if not shown.all():
            kept = [k for k, seen in zip(kept, shown, strict=True) if seen]
            continue
        found = solve(both)
        half = found.half_width[free:]
        if half.max() <= _WIDEST:
            readings = tuple(
                Reading(*names[k], float(value), float(width))
                for k, value, width in zip(kept, found.values[free:], half, strict=True)
            )
            return Encoders(readings, tuple(n for k, n in enumerate(names) if k not in kept))
        kept.pop(int(np.argmax(half)))
    return Encoders((), tuple(names))


def without_errors(
    recordings: Sequence[Measured], readings: Sequence[Reading]
) -> tuple[Measured, ...]:
    """The recordings at the true positions, as far as they are known."""
    return tuple(replace(one, position=_true(one, readings)) for one in recordings)


def said(readings: Sequence[Reading], slides: Mapping[str, bool]) -> str:
    """Errors in words."""
    words = []
    for one in readings:
        if one.kind == SCALE:
            percent = f"{100 * one.value:+.2f} % (± {100 * one.half_width:.2f})"
            words.append(f"angles of {one.joint} read {percent} too much")
        else:
            unit = "mm" if slides[one.joint] else "mrad"
            words.append(
                f"{one.joint} reads {1e3 * one.value:+.1f} {unit} (± {1e3 * one.half_width:.1f}) "
                "beside its zero"
            )
    return ", ".join(words)


def _true(recording: Measured, readings: Sequence[Reading]) -> FloatArray:
    position = recording.position.copy()
    for kind in (BIAS, SCALE):
        for one in readings:
            column = recording.joints.index(one.joint)
            if one.kind == kind == BIAS:
                position[:, column] -= one.value
            elif one.kind == kind:
                position[:, column] /= 1.0 + one.value
    return position


def undetermined_words(undetermined: Sequence[tuple[str, str]]) -> list[dict[str, str]]:
    """As ``unobservable`` of ``identification.json`` has them, with the motion that would tell."""
    motion = {
        BIAS: "hold a known payload (payloads: in twin.yaml) in poses all over the range of {}",
        SCALE: "hold poses over the whole range of {}, with and without a known payload",
    }
    return [
        {"expression": f"{joint}.{kind}", "motion": motion[kind].format(joint)}
        for joint, kind in undetermined
    ]
