"""Estimate zero and scale of encoders from efforts, which depend on the true angles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.sensing import EncoderBias, EncoderScale
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.effort_scale import payload_parameters
from pytest_twin.identification.effort.essential_parameters import SIGNIFICANT, shrinkage
from pytest_twin.identification.effort.filtering import Filter
from pytest_twin.identification.effort.least_squares import (
    LinearProblem,
    Solution,
    is_determined,
    solve,
    widened,
)
from pytest_twin.identification.effort.recording_rows import encoder_slopes
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.identification.motions import entry
from pytest_twin.identification.regressor import BaseParameters, Regressor
from pytest_twin.realization import Realization

BIAS, SCALE = EncoderBias.id, EncoderScale.id
_WIDEST = 0.05
"""Half width (rad, m or fraction) above which the motion does not determine an encoder error. It is
3 degrees, an error that is visible at the robot's alignment marks."""


@dataclass(frozen=True, slots=True)
class EncoderError:
    """One error of an encoder: measured = (1 + scale) q + bias.

    Attributes:
        joint: joint of the encoder.
        kind: ``encoder_bias`` or ``encoder_scale``.
        value: bias in rad or m, or relative scale error.
        half_width: half width of the 95 % interval.
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
class EncoderErrors:
    """Encoder errors estimated from efforts.

    Attributes:
        readings: errors that the motion determines, significant or not.
        undetermined: (joint, kind) of the others.
        corrected: errors that were removed from the recordings.
    """

    readings: tuple[EncoderError, ...] = ()
    undetermined: tuple[tuple[str, str], ...] = ()
    corrected: tuple[EncoderError, ...] = ()

    @property
    def wrong(self) -> tuple[EncoderError, ...]:
        """Errors that differ significantly from zero."""
        return tuple(one for one in self.readings if one.is_significant)

    def value_of(self, joint: str, kind: str) -> float:
        """Return the value of one error; 0 if the motion does not determine it."""
        same = [one.value for one in self.readings if (one.joint, one.kind) == (joint, kind)]
        return same[0] if same else 0.0


def encoders_of(
    realization: Realization,
    recordings: Sequence[MeasuredRecording],
    regressor: Regressor,
    base: BaseParameters,
    problem: LinearProblem,
    values: FloatArray,
    chosen: Filter,
) -> EncoderErrors:
    """Estimate the errors of all encoders to first order, together with all other parameters.

    A zero of the last joint is equivalent to a rotation of its link's centre of mass and is
    undetermined without a known payload. Errors that the motion does not determine are left out,
    the least accurate first.

    Args:
        realization: nominal model, with the twin that states payloads.
        regressor, base: regressor and base parameters of the robot.
        problem: problem with all columns that the motion excites.
        values: (b,) fitted base parameters at which efforts are differentiated.
    """
    names = [(joint, kind) for joint in regressor.joints for kind in (BIAS, SCALE)]
    own = slopes_of(realization, recordings, regressor, base, values, chosen, names)
    free = problem.matrix.shape[2]
    kept = list(range(len(names)))
    while kept:
        columns = np.concatenate([problem.matrix, own[..., kept]], axis=2)
        dry = np.zeros((len(problem.dry), len(kept)), dtype=bool)
        both = replace(problem, matrix=columns, dry=np.hstack([problem.dry, dry]), instrument=None)
        # Columns that the motion hardly excites are removed before the solution.
        shown = is_determined(columns, both)[free:]
        if not shown.all():
            kept = [k for k, seen in zip(kept, shown, strict=True) if seen]
            continue
        found = solve(both)
        half = found.half_width[free:]
        if half.max() <= _WIDEST:
            readings = tuple(
                EncoderError(*names[k], float(value), float(width))
                for k, value, width in zip(kept, found.values[free:], half, strict=True)
            )
            return EncoderErrors(readings, tuple(n for k, n in enumerate(names) if k not in kept))
        kept.pop(int(np.argmax(half)))
    return EncoderErrors((), tuple(names))


def widen_by_encoder_errors(
    problem: LinearProblem, solution: Solution, slopes: FloatArray, encoders: EncoderErrors
) -> Solution:
    """A solution whose covariance and intervals allow for errors of the encoders.

    Corrected errors contribute the width of their own intervals. The others are fixed at zero and
    contribute by their estimates b, shrunk as far as they may be noise of deviation s: a true error
    has mean q b and variance q s^2. The share q is the larger of that of all estimates together
    (:func:`~.essential.shrinkage`) and that of a prior as wide as the estimate, b^2 / (b^2 + s^2),
    so that one error among right encoders counts. On 28 drawn arms with errors the intervals hold
    93.9 % of the parameters, with the first share alone 87.9 %; on 20 arms without, 99.0 % and
    96.6 %.

    Args:
        problem: problem with the columns of the solution.
        solution: fit at the corrected positions, as if these were exact.
        slopes: (n, joints, k) derivatives of the efforts by the errors (:func:`slopes_of`).
    """
    value = np.array([one.value for one in encoders.readings])
    std = np.array([one.half_width for one in encoders.readings]) / Z95
    corrected = {(one.joint, one.kind) for one in encoders.corrected}
    known = np.array([(one.joint, one.kind) in corrected for one in encoders.readings])
    t = value / std
    share = np.maximum(shrinkage(t[~known]), t**2 / (1.0 + t**2))
    size = np.where(known, std, np.hypot(share * value, np.sqrt(share) * std))
    return widened(problem, solution, slopes * size)


def slopes_of(
    realization: Realization,
    recordings: Sequence[MeasuredRecording],
    regressor: Regressor,
    base: BaseParameters,
    values: FloatArray,
    chosen: Filter,
    names: Sequence[tuple[str, str]],
) -> FloatArray:
    """(n, joints, k) change of the predicted effort with each error of an encoder.

    Args:
        realization, recordings, regressor, base, values, chosen: as for :func:`encoders_of`.
        names: joint and kind of each error.
    """
    whole = np.zeros(len(regressor.columns))
    whole[base.independent] = values
    carried = [payload_parameters(realization, regressor, one) for one in recordings]
    each = [whole if one is None else whole + one for one in carried]
    zeros, scales = encoder_slopes(recordings, regressor, chosen, each)
    of_kind = {BIAS: zeros, SCALE: scales}
    columns = [of_kind[kind][:, :, regressor.joints.index(joint)] for joint, kind in names]
    return np.stack(columns, axis=2)


def without_errors(
    recordings: Sequence[MeasuredRecording], readings: Sequence[EncoderError]
) -> tuple[MeasuredRecording, ...]:
    """Return the recordings with positions corrected for known encoder errors."""
    return tuple(replace(one, position=_true(one, readings)) for one in recordings)


def describe_errors(readings: Sequence[EncoderError], slides: Mapping[str, bool]) -> str:
    """Describe encoder errors as text."""
    words = []
    for one in readings:
        if one.kind == SCALE:
            percent = f"{100 * one.value:+.2f} % (± {100 * one.half_width:.2f})"
            words.append(f"angles of {one.joint} read {percent} too much")
        else:
            unit = "mm" if slides[one.joint] else "mrad"
            words.append(
                f"zero of {one.joint} reads {1e3 * one.value:+.1f} {unit} "
                f"(± {1e3 * one.half_width:.1f})"
            )
    return ", ".join(words)


def _true(recording: MeasuredRecording, readings: Sequence[EncoderError]) -> FloatArray:
    position = recording.position.copy()
    for kind in (BIAS, SCALE):
        for one in readings:
            column = recording.joints.index(one.joint)
            if one.kind == kind == BIAS:
                position[:, column] -= one.value
            elif one.kind == kind:
                position[:, column] /= 1.0 + one.value
    return position


def undetermined_entries(undetermined: Sequence[tuple[str, str]]) -> list[dict[str, str]]:
    """Return entries of ``unobservable`` in ``identification.json``, with the required motion."""
    motion = {
        BIAS: "hold a known payload (payloads: in twin.yaml) in poses all over the range of {}",
        SCALE: "hold poses over the whole range of {}, with and without a known payload",
    }
    return [
        entry(f"{joint}.{kind}", motion[kind].format(joint), "payload")
        for joint, kind in undetermined
    ]
