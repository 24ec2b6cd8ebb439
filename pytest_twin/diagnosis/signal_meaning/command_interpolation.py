"""Interpolation of commands between two stamps, by a likelihood ratio over whole recordings.

``held``, ``interpolated`` and ``ramped`` setpoints differ in their mean delay (half a period, none,
one period) and in their shape. An error of the model would hide or mimic such a difference, so the
smooth parameters of every joint are fitted under each assumption, with delays. A setpoint that acts
later than assumed is then a delay, and not identifiable at high command rates. A setpoint that acts
before its stamp cannot be a delay.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.signal_meaning.fact import Fact, unknown
from pytest_twin.diagnosis.signal_meaning.settings import INTERPOLATION
from pytest_twin.estimation.score import effective_samples
from pytest_twin.recording_options import COMMAND_BETWEEN, CommandBetween

MEAN_DELAY: Mapping[CommandBetween, float] = {"held": 0.5, "interpolated": 0.0, "ramped": 1.0}
"""Mean delay of a setpoint behind the straight line through its stamps, in command periods."""


@dataclass(frozen=True, slots=True)
class AssumptionResiduals:
    """Position residuals under one assumption.

    Attributes:
        residual: (samples, joints) rad or m, with parameters from the other recordings.
        nominal: (joints,) RMS residual of the nominal model, rad or m.
        has_converged: whether the fit has converged.
        delay: (joints,) fitted delay of the commands, s.
    """

    residual: FloatArray
    nominal: FloatArray
    has_converged: bool
    delay: FloatArray


@dataclass(frozen=True, slots=True)
class CommandInterpolation:
    """The answer for recordings with one command period.

    Attributes:
        possible: assumptions that are not ruled out.
        period: command period, s.
        default: assumption that is used without an answer.
    """

    fact: Fact
    possible: tuple[CommandBetween, ...]
    period: float
    default: CommandBetween = "held"

    @property
    def assumed(self) -> CommandBetween:
        """The answer; if it is open, the assumption that is used."""
        return next((b for b in COMMAND_BETWEEN if b == self.fact.value), self.default)

    def delay_change(self, than: CommandBetween) -> tuple[float, float]:
        """Smallest and largest change of a delay in s if another possible assumption is true.

        Both are 0 if only one assumption is possible.

        Args:
            than: assumption under which the delay was found.
        """
        if len(self.possible) == 1:
            return 0.0, 0.0
        shifts = [self.period * (MEAN_DELAY[than] - MEAN_DELAY[b]) for b in self.possible]
        return min(0.0, *shifts), max(0.0, *shifts)


def decide_interpolation(
    left: Mapping[CommandBetween, AssumptionResiduals],
    lengths: Sequence[int],
    owner: Sequence[int],
    noise: FloatArray,
    period: float,
) -> CommandInterpolation:
    """Choose between assumptions by their residuals.

    An alternative is ruled out if three conditions hold: the log-likelihood ratio over all
    recordings is at least ``ruled_out``, it is positive for each recording, and the ratio of mean
    squared residuals is at most ``less`` at some joint.

    Args:
        left: assumption -> its residuals.
        lengths: number of samples of each segment.
        owner: index of the recording of each segment.
        noise: (joints,) encoder noise, rad or m.
        period: command period, s.
    """
    usable = {b: x for b, x in left.items() if np.isfinite(x.residual).all()}
    if not usable:
        return CommandInterpolation(
            unknown("the model diverges under these commands"), COMMAND_BETWEEN, period,
            "held" if "held" in left else next(iter(left)),
        )  # fmt: skip
    rms = {b: np.sqrt(np.mean(x.residual**2, axis=0)) for b, x in usable.items()}
    log_levels = {b: log_rms(x.residual, noise) for b, x in usable.items()}
    best = min(log_levels, key=lambda b: log_levels[b])
    possible, nats = [best], np.inf
    for other in usable:
        if other == best:
            continue
        ratio = _ratio(usable[best].residual, usable[other].residual, lengths, owner, noise)
        later = period * (MEAN_DELAY[other] - MEAN_DELAY[best])
        if _is_ruled_out(usable[best], usable[other], ratio, noise, later):
            nats = min(nats, float(ratio.sum()))
        else:
            possible.append(other)
    words = _describe(rms, noise)
    if len(possible) == 1:
        confidence = 1.0 - 0.5 * float(np.exp(-min(nats, 20.0) / 2.0))
        return CommandInterpolation(
            Fact(best, min(confidence, 0.999), "data", words), (best,), period
        )
    by_model = _decided_by_model(usable, possible, rms, noise)
    if by_model is not None:
        words += f"; the model itself needs no correction if commands are {by_model}"
        return CommandInterpolation(
            Fact(by_model, INTERPOLATION.most_by_model, "data", words), (by_model,), period
        )
    return CommandInterpolation(
        unknown(f"{words}: {' and '.join(sorted(possible))} explain the positions equally well"),
        tuple(possible), period, _default_interpolation(usable, possible, noise),
    )  # fmt: skip


def log_rms(residual: FloatArray, noise: FloatArray) -> float:
    """Sum over joints of the logarithm of the RMS residual, which is at least the noise.

    Args:
        residual: (samples, joints) rad or m.
        noise: (joints,) the same.
    """
    rms = np.sqrt(np.mean(residual**2, axis=0))
    return float(np.sum(np.log(np.maximum(rms, noise))))


def _ratio(
    best: FloatArray, other: FloatArray, lengths: Sequence[int], owner: Sequence[int],
    noise: FloatArray,
) -> FloatArray:  # fmt: skip
    """(recordings,) log-likelihood ratios, with the smaller effective sample size of both."""
    ends = np.cumsum([0, *lengths])
    found = []
    for recording in dict.fromkeys(owner):
        mine = [i for i, o in enumerate(owner) if o == recording]
        rows = np.concatenate([np.arange(ends[i], ends[i + 1]) for i in mine])
        each = [lengths[i] for i in mine]
        squares, counts = [], []
        for residual in (best[rows], other[rows]):
            squares.append(np.maximum(np.mean(residual**2, axis=0), noise**2))
            counts.append(effective_samples(residual, each))
        fewer = np.minimum(*counts)
        found.append(0.5 * float(np.sum(fewer * np.log(squares[1] / squares[0]))))
    return np.array(found)


def _is_ruled_out(
    best: AssumptionResiduals,
    other: AssumptionResiduals,
    ratio: FloatArray,
    noise: FloatArray,
    later: float,
) -> bool:
    """Whether an alternative is ruled out.

    Args:
        best, other: residuals of the best assumption and of the alternative.
        ratio: (recordings,) log-likelihood ratios.
        noise: (joints,) encoder noise, rad or m.
        later: mean delay of the alternative relative to the best assumption, s. If the fitted delay
            is closer to it than to zero, other physics may explain the rest, so a larger difference
            is required.
    """
    square = [np.maximum(np.mean(x.residual**2, axis=0), noise**2) for x in (best, other)]
    share = square[0] / square[1]
    joint = int(np.argmin(share))
    near = bool(np.sqrt(square[0][joint]) <= INTERPOLATION.near * noise[joint])
    halfway = later > 0.0 and best.delay[joint] > 0.5 * later
    most = (
        INTERPOLATION.less
        if near and other.has_converged and not halfway
        else INTERPOLATION.far_less
    )
    return bool(
        ratio.sum() >= INTERPOLATION.ruled_out and (ratio > 0.0).all() and share[joint] <= most
    )


def _decided_by_model(
    left: Mapping[CommandBetween, AssumptionResiduals],
    possible: Sequence[CommandBetween],
    rms: Mapping[CommandBetween, FloatArray],
    noise: FloatArray,
) -> CommandBetween | None:
    """The only assumption under which the nominal model explains a joint as well as any fit.

    None if joints differ or no joint decides. One controller moves all joints, so a joint without
    model error decides for the others. It has to be far from explained under the alternatives.
    """
    least = np.min([rms[b] for b in possible], axis=0)
    alike = {
        b: (left[b].nominal <= INTERPOLATION.alike * least) & (least <= INTERPOLATION.near * noise)
        for b in possible
    }
    is_only_one = np.sum(list(alike.values()), axis=0) == 1
    second = np.sort([left[b].nominal for b in possible], axis=0)[1]
    decisive = [
        b
        for b in possible
        if (alike[b] & is_only_one & (second >= INTERPOLATION.model_apart * left[b].nominal)).any()
    ]
    return decisive[0] if len(decisive) == 1 else None


def _default_interpolation(
    left: Mapping[CommandBetween, AssumptionResiduals],
    possible: Sequence[CommandBetween],
    noise: FloatArray,
) -> CommandBetween:
    """``interpolated`` if the nominal model is clearly closer to the recordings with it, else
    ``held``.

    If held commands are taken as interpolated, a delay of the commands makes up for it. If a moving
    setpoint is taken as held, it seems to act before its stamp, and no delay makes up for that: the
    search would find effects that the robot does not have. ``held`` is also used if it seems to be
    ruled out and the rest is open: with missing physics, such as another surface, the fits to other
    recordings may predict worse than the model itself.
    """
    if not {"held", "interpolated"} <= set(possible):
        return "held"
    held, moving = (
        float(np.sum(np.log(np.maximum(left[b].nominal, noise)))) for b in ("held", "interpolated")
    )
    return "interpolated" if held - moving > np.log(INTERPOLATION.model_closer) else "held"


def _describe(rms: Mapping[CommandBetween, FloatArray], noise: FloatArray) -> str:
    """RMS residual under each assumption at the joint where they differ most, in words."""
    joint = int(np.argmax(np.ptp(np.array(list(rms.values())), axis=0) / noise))
    each = ", ".join(f"{b} {r[joint] / noise[joint]:.2f}" for b, r in rms.items())
    return (
        f"RMS residual in units of the encoder noise, with the smooth parameters of every joint "
        f"free: {each}"
    )


def cross_validated_residuals(
    residual: FloatArray, steps: Mapping[int, FloatArray], slopes: FloatArray,
    rows: Mapping[int, NDArray[np.int64]],
) -> FloatArray:  # fmt: skip
    """(samples, joints) residuals with parameters from the other recordings, to first order.

    Args:
        residual: (samples, joints) residuals of the fit to all recordings, rad or m.
        steps: recording -> (parameters, joints) change of the fit without this recording.
        slopes: (samples, parameters, joints) derivatives of the prediction.
        rows: recording -> indices of its samples.
    """
    out = residual.copy()
    for recording, mine in rows.items():
        out[mine] -= np.einsum("npj,pj->nj", slopes[mine], steps[recording])
    return out
