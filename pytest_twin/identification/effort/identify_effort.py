"""Staged identification from measured effort."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.sensing import EffortScale
from pytest_twin.errors import RecordingError
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.delay import LAG, Delay, delay_of, without_delay
from pytest_twin.identification.effort.drift import drifts
from pytest_twin.identification.effort.drive_gains import as_torques, drive_gains
from pytest_twin.identification.effort.effort_scale import (
    Scale,
    divide_by_scales,
    known_payload,
    payload_effort,
    payload_scales,
)
from pytest_twin.identification.effort.encoders import (
    EncoderError,
    EncoderErrors,
    describe_errors,
    encoders_of,
    slopes_of,
    widen_by_encoder_errors,
    without_errors,
)
from pytest_twin.identification.effort.essential_parameters import (
    EssentialParameters,
    find_essential_parameters,
)
from pytest_twin.identification.effort.estimate import INSTRUMENTS, EffortEstimate, estimate
from pytest_twin.identification.effort.filtering import Filter, choose_filter
from pytest_twin.identification.effort.groups import EXCLUDES, dry_of, stages_of
from pytest_twin.identification.effort.impossible_drives import impossible_drives
from pytest_twin.identification.effort.input_mistakes import (
    InputMistake,
    find_mistakes,
    unless_checked,
)
from pytest_twin.identification.effort.instruments import (
    instruments_of,
    solve_instrumental,
    with_commanded_motion,
)
from pytest_twin.identification.effort.least_squares import (
    LinearProblem,
    Solution,
    information,
    linear_problem,
    solve,
    weight_rows,
    widened,
)
from pytest_twin.identification.effort.position_mistakes import position_mistakes
from pytest_twin.identification.effort.recording_rows import RecordingRows, sample
from pytest_twin.identification.effort.stage_comparison import (
    EffortError,
    compare_stages,
    errors_of,
    with_data,
)
from pytest_twin.identification.effort.written_parameters import LinearFit, confirm_stages
from pytest_twin.identification.full_parameters import FullParameters
from pytest_twin.identification.measured_recordings import MeasuredRecording, MeasuredRecordings
from pytest_twin.identification.regressor import (
    BaseParameters,
    Regressor,
    SharedMotor,
    base_of,
    structural_base,
)
from pytest_twin.identification.stages import HeldOut, Stage, StageName, judge_stage
from pytest_twin.realization import Realization
from pytest_twin.signals import Signals
from pytest_twin.time_limit import skips

_ROUNDS = 6
"""Largest number of encoder errors that are corrected in sequence."""
_FARTHEST = 1.0
"""Largest encoder error that is corrected, rad, m or fraction. Each step is linearized."""
_ENOUGH_FRICTION = 0.05
"""Fraction of a joint's effort above which dry friction is relevant."""
_REFINEMENTS = 3
"""Number of estimates of a delay, each linearized about the previous one."""
_SHORTEST_LAG = 0.3
"""Smallest phase lag, rad, at the highest fitted frequency for distinguishing a filter from a
delay. Below it the filter attenuates by less than 5 % and acts like a delay."""
_LESS_NOISE = 0.05
"""Relative reduction of the residual for which a filter is preferred to a delay, the simpler
model."""


@dataclass(frozen=True)
class EffortResult:
    """Result of an identification from measured effort.

    Attributes:
        regressor: regressor of the robot, with nominal parameters.
        base: base parameters of the joints whose effort is known.
        fitted: fit of the essential parameters.
        stage_of: (b,) stage of each base parameter.
        errors: joint -> error of the written model on held-out recordings, or on the fitted ones if
            nothing is held out.
        nominal: joint -> the same error with nominal parameters.
        least_squares: joint -> the same error with all base parameters by least squares, without
            omissions and without the conditions of physical bodies.
        without_effort: joints whose effort is unknown.
        unobservable: base parameters that the motion does not move.
        structural: base parameters that some motion could show; ``base`` are those of this motion.
        unsure: base parameters that are omitted, but may be as large as their nominal values.
        physical: full, physically consistent parameters, which are written.
        samples: rows of the fitted recordings.
        held_out: rows of the held-out recordings.
        delay: delay of the efforts, if one was found.
        scales: joint -> recorded over true effort, if known payloads determine it.
        gains: joint -> recorded current per N*m (N), if known payloads determine it.
        estimate: estimator and the check of its intervals.
        encoders: zeros and scales of encoders.
        suspected: suspected mistakes of the input.
    """

    regressor: Regressor
    base: BaseParameters
    fitted: EssentialParameters
    stages: tuple[Stage, ...]
    stage_of: tuple[StageName, ...]
    errors: dict[str, EffortError]
    nominal: dict[str, EffortError]
    least_squares: dict[str, EffortError]
    without_effort: tuple[str, ...]
    unobservable: NDArray[np.bool_]
    structural: BaseParameters
    unsure: NDArray[np.bool_]
    physical: FullParameters
    filter: Filter
    samples: tuple[RecordingRows, ...]
    held_out: tuple[RecordingRows, ...]
    delay: Delay | None
    suspected: tuple[InputMistake, ...]
    notes: tuple[str, ...]
    estimate: EffortEstimate
    encoders: EncoderErrors = field(default_factory=EncoderErrors)
    scales: Mapping[str, Scale] = field(default_factory=dict)
    gains: Mapping[str, Scale] = field(default_factory=dict)

    @property
    def used_scales(self) -> dict[str, Scale]:
        """Joint -> scale by which its recorded effort was divided."""
        drive = next((stage for stage in self.stages if stage.name == "drive"), None)
        if drive is not None and drive.state == "rejected":
            return dict(self.gains)
        return {**{j: s for j, s in self.scales.items() if s.is_significant}, **self.gains}


def has_effort(measured: MeasuredRecordings) -> bool:
    """Whether a fitted recording has a usable effort of a joint."""
    return any(bool(np.isfinite(one.effort).any()) for one in measured.fit)


def identify_effort(
    realization: Realization, measured: MeasuredRecordings, signals: Signals
) -> EffortResult:
    """Fit the inverse dynamics to recordings with efforts.

    Args:
        measured: recordings of the same joints.
        signals: meaning of the recorded signals.

    Raises:
        RecordingError: no joint has a usable effort.
        SpecError: the twin does not state a payload.
    """
    gains = drive_gains(realization, measured, _shared_motors(measured.fit[0].joints, signals))
    if not gains:
        return _identify_in_stages(realization, measured, signals)
    torques = MeasuredRecordings(
        as_torques(measured.fit, gains), as_torques(measured.held_out, gains)
    )
    before, _ = _identify(realization, measured, signals)
    found = _identify_in_stages(realization, torques, signals)
    words = ", ".join(f"{joint} {gain.value:.4g} A/(N*m)" for joint, gain in gains.items())
    stage = _scale_stage(
        f"recorded current per torque, from known payloads: {words}", gains, before, found
    )
    if stage.state != "accepted":
        return _identify_in_stages(realization, measured, signals)
    own = next(s for s in found.stages if s.name == "drive")
    stage = replace(stage, parameters=(*stage.parameters, *own.parameters), data=own.data)
    found = _widen_by_scale_errors(realization, torques, found, gains)
    return replace(
        found,
        stages=tuple(stage if s.name == "drive" else s for s in found.stages),
        gains=_correct_gains(gains, found.scales),
        scales={joint: scale for joint, scale in found.scales.items() if joint not in gains},
    )


def _scale_stage(
    why: str, joints: Iterable[str], before: EffortResult, after: EffortResult
) -> Stage:
    """The drive stage of effort scales, judged by the held-out errors before and after them."""
    return judge_stage(
        Stage(
            "drive", "accepted", why,
            tuple(f"{joint}.{EffortScale.id}" for joint in joints), None, EXCLUDES["drive"],
        ),
        HeldOut(mean_relative(before.errors), mean_relative(after.errors), "relative effort"),
    )  # fmt: skip


def _correct_gains(gains: Mapping[str, Scale], scales: Mapping[str, Scale]) -> dict[str, Scale]:
    """Return the gains times the scales that were found after them, where these differ from 1."""
    return {
        joint: Scale(gain.value * scales[joint].value, gain.half_width * scales[joint].value)
        if joint in scales and scales[joint].is_significant
        else gain
        for joint, gain in gains.items()
    }


def _identify_in_stages(
    realization: Realization, measured: MeasuredRecordings, signals: Signals
) -> EffortResult:
    found, late = _identify(realization, measured, signals)
    if skips("stages delay, encoder and effort scale"):
        return found
    if any(one.is_fatal for one in found.suspected):
        why = "not estimated: a mistake of the input is suspected, and would pass for it"
        skipped: tuple[StageName, ...] = ("delay", "encoder")
        before = (Stage(n, "not_observable", why, (), None, EXCLUDES[n]) for n in skipped)
        return replace(found, stages=(*before, *found.stages))
    moved, found, delay = _with_delay(realization, measured, signals, found, late)
    right, found, encoder = _with_encoders(realization, moved, signals, found)
    if found.encoders.corrected:
        measured = _at_true_positions(measured, found.encoders.corrected)
        measured, found, delay = _repeat_delay_stage(
            realization, (measured, right), signals, found, delay
        )
    else:
        measured = right
    found = replace(found, stages=(delay, encoder, *found.stages))
    found = _with_scales(realization, measured, signals, found)
    rejected = any(one.name == "drive" and one.state == "rejected" for one in found.stages)
    off = {j: s for j, s in found.scales.items() if s.is_significant and not rejected}
    return _widen_by_scale_errors(
        realization, measured, _widen_by_encoder_errors(realization, measured, found), off
    )


def _with_delay(
    realization: Realization,
    measured: MeasuredRecordings,
    signals: Signals,
    found: EffortResult,
    late: Delay | None,
) -> tuple[MeasuredRecordings, EffortResult, Stage]:
    """Run the delay stage: efforts are shifted if that reduces the held-out error."""
    if late is None or not late.is_significant:
        why = "the efforts are not stamped later than the motion, as far as the motion shows"
        stage = Stage("delay", "not_observable", why, (), None, EXCLUDES["delay"])
        return measured, found, stage
    moved, again, late = _remove_delay(realization, measured, signals, late)
    turn = 2.0 * np.pi * found.filter.parallel * late.value
    said = (
        f"efforts are stamped {1e3 * late.value:+.2f} ms (± {1e3 * late.half_width:.2f}) later "
        "than the motion"
    )
    if turn > _SHORTEST_LAG:
        lagged = _remove_delay(realization, measured, signals, replace(late, name=LAG))
        if _log_noise(lagged[1]) < _log_noise(again) - _LESS_NOISE:
            moved, again, late = lagged
            said = (
                f"efforts pass a low-pass filter with a time constant of {1e3 * late.value:.2f} ms "
                f"(± {1e3 * late.half_width:.2f}), {0.5 / np.pi / late.value:.3g} Hz"
            )
    stage = judge_stage(
        Stage("delay", "accepted", said, (late.name,), None, EXCLUDES["delay"]),
        HeldOut(mean_relative(found.errors), mean_relative(again.errors), "relative effort"),
    )
    if stage.state != "accepted":
        return measured, found, stage
    return moved, replace(again, delay=late), stage


def _remove_delay(
    realization: Realization, measured: MeasuredRecordings, signals: Signals, late: Delay
) -> tuple[MeasuredRecordings, EffortResult, Delay]:
    """Remove a delay or lag; return the recordings, their identification and the refined delay."""
    for _ in range(_REFINEMENTS):
        moved = MeasuredRecordings(
            without_delay(measured.fit, late.value, late.name),
            without_delay(measured.held_out, late.value, late.name),
        )
        again, rest = _identify(realization, moved, signals)
        if rest is None or not rest.is_significant:
            return moved, again, late
        late = Delay(late.value + rest.value, rest.half_width, late.name)
    return moved, again, late


def _log_noise(found: EffortResult) -> float:
    """Return the mean logarithm of the residuals' standard deviations."""
    noise = found.fitted.solution.noise
    return float(np.mean(np.log(noise[np.isfinite(noise) & (noise > 0.0)])))


def _with_encoders(
    realization: Realization, measured: MeasuredRecordings, signals: Signals, found: EffortResult
) -> tuple[MeasuredRecordings, EffortResult, Stage]:
    """Run the encoder stage: positions are corrected if that reduces the held-out error."""
    excludes = EXCLUDES["encoder"]
    slides = dict(zip(found.regressor.joints, found.regressor.slides, strict=True))
    said = _encoders(realization, measured, found)
    found = replace(found, encoders=said)
    if not said.wrong:
        why = "no zero and no scale of an encoder differs from the model's, as far as efforts show"
        if not said.readings:
            why = (
                "the motion does not distinguish zeros and scales of encoders from parameters of "
                "links"
            )
        return measured, found, Stage("encoder", "not_observable", why, (), None, excludes)
    right, again, left = measured, found, said
    applied: dict[tuple[str, str], EncoderError] = {}
    for _ in range(_ROUNDS):
        # Only the most significant error is corrected, since it biases the estimates of the others.
        fresh = [one for one in left.wrong if (one.joint, one.kind) not in applied]
        applied = {
            key: replace(one, value=one.value + left.value_of(*key)) for key, one in applied.items()
        }
        if fresh:
            clearest = max(fresh, key=lambda one: abs(one.value) / one.half_width)
            applied[clearest.joint, clearest.kind] = clearest
        readings = tuple(applied.values())
        if max(abs(one.value) for one in readings) > _FARTHEST:
            why = (
                f"{describe_errors(readings, slides)}: too large to be estimated from efforts; "
                "check the joint at its alignment marks"
            )
            return measured, found, Stage("encoder", "rejected", why, (), None, excludes)
        right = _at_true_positions(measured, readings)
        again, _ = _identify(realization, right, signals)
        left = _encoders(realization, right, again)
        if not any((one.joint, one.kind) not in applied for one in left.wrong):
            break
    stage = judge_stage(
        Stage(
            "encoder", "accepted", describe_errors(readings, slides),
            tuple(f"{one.joint}.{one.kind}" for one in readings), None, excludes,
        ),
        HeldOut(mean_relative(found.errors), mean_relative(again.errors), "relative effort"),
    )  # fmt: skip
    told = replace(
        left,
        readings=tuple(
            replace(one, value=one.value + applied[one.joint, one.kind].value)
            if (one.joint, one.kind) in applied
            else one
            for one in left.readings
        ),
    )
    if stage.state != "accepted":
        return measured, found, stage
    told = replace(told, corrected=readings)
    return right, replace(again, delay=found.delay, encoders=told), stage


def _at_true_positions(
    measured: MeasuredRecordings, readings: Sequence[EncoderError]
) -> MeasuredRecordings:
    return MeasuredRecordings(
        without_errors(measured.fit, readings), without_errors(measured.held_out, readings)
    )


def _repeat_delay_stage(
    realization: Realization,
    recordings: tuple[MeasuredRecordings, MeasuredRecordings],
    signals: Signals,
    found: EffortResult,
    delay: Stage,
) -> tuple[MeasuredRecordings, EffortResult, Stage]:
    """Repeat the delay stage if corrected encoders change its result.

    Args:
        recordings: recordings with corrected positions, with and without the delay.
        signals: meaning of the recorded signals.
        found, delay: identification without the delay, and the stage of the delay.
    """
    recorded, moved = recordings
    first, late = _identify(realization, recorded, signals)
    again, result, stage = _with_delay(realization, recorded, signals, first, late)
    if stage.state != "accepted" or result.delay is None:
        return moved, found, delay
    before = found.delay
    if before is not None and abs(result.delay.value - before.value) <= before.half_width:
        return moved, found, delay
    why = f"encoders that were corrected change it: {stage.why}"
    return (
        again,
        replace(result, encoders=found.encoders),
        replace(stage, state="reopened", why=why),
    )


def _encoders(
    realization: Realization, measured: MeasuredRecordings, found: EffortResult
) -> EncoderErrors:
    shown = _problem(found.samples, found.regressor, found.base)
    return encoders_of(
        realization, measured.fit, found.regressor, found.base,
        shown.only(np.flatnonzero(~found.unobservable)), found.fitted.values, found.filter,
    )  # fmt: skip


def _widen_by_encoder_errors(
    realization: Realization, measured: MeasuredRecordings, found: EffortResult
) -> EffortResult:
    """The result with intervals that allow for errors of the encoders."""
    fitted, readings = found.fitted, found.encoders.readings
    if not readings or not len(fitted.kept):
        return found
    slopes = slopes_of(
        realization, measured.fit, found.regressor, found.base, fitted.values, found.filter,
        [(one.joint, one.kind) for one in readings],
    )  # fmt: skip
    own = _problem(found.samples, found.regressor, found.base).only(fitted.kept)
    solution = widen_by_encoder_errors(own, fitted.solution, slopes, found.encoders)
    return replace(found, fitted=replace(fitted, solution=solution))


def _widen_by_scale_errors(
    realization: Realization,
    measured: MeasuredRecordings,
    found: EffortResult,
    scales: Mapping[str, Scale],
) -> EffortResult:
    """The result with intervals that allow for the errors of effort scales.

    An error of a scale changes all efforts of its joint, those of payloads too.
    """
    fitted = found.fitted
    if not scales or not len(fitted.kept):
        return found
    joints = found.regressor.joints
    relative = np.array([
        scales[j].half_width / (Z95 * scales[j].value) if j in scales else 0.0 for j in joints
    ])  # fmt: skip
    efforts = []
    for recording, rows in zip(measured.fit, found.samples, strict=True):
        carried = payload_effort(realization, found.regressor, recording, rows)
        efforts.append(rows.effort if carried is None else rows.effort + carried)
    problem = _problem(found.samples, found.regressor, found.base).only(fitted.kept)
    whole = np.where(problem.known, np.concatenate(efforts), 0.0) * relative
    slopes = np.stack([np.where(np.arange(len(joints)) == k, whole, 0.0)
                       for k in range(len(joints))], axis=2)  # fmt: skip
    solution = widened(problem, fitted.solution, slopes)
    return replace(found, fitted=replace(fitted, solution=solution))


def _with_scales(
    realization: Realization, measured: MeasuredRecordings, signals: Signals, found: EffortResult
) -> EffortResult:
    """Estimate the effort scales from known payloads, divide efforts by them and repeat the fit."""
    scales = payload_scales(realization, measured.fit, found.regressor, found.filter)
    off = {joint: scale for joint, scale in scales.items() if scale.is_significant}
    found = replace(found, scales=scales)
    if not off:
        return found
    right = MeasuredRecordings(
        divide_by_scales(measured.fit, off), divide_by_scales(measured.held_out, off)
    )
    again, _ = _identify(realization, right, signals)
    words = ", ".join(f"{joint} {scale.value:.3f}" for joint, scale in off.items())
    stage = _scale_stage(
        f"recorded over true effort, from known payloads: {words}", off, found, again
    )
    if stage.state != "accepted":
        return replace(found, stages=tuple(stage if s.name == "drive" else s for s in found.stages))
    assert stage.held_out is not None
    refitted = _stages_after_scaling(found, again, stage.held_out)
    biases = next(s.parameters for s in refitted if s.name == "drive")
    stage = replace(stage, parameters=(*stage.parameters, *biases))
    kept = (*found.stages[:2], *(stage if s.name == "drive" else s for s in refitted))
    return replace(again, stages=kept, delay=found.delay, encoders=found.encoders, scales=scales)


def _stages_after_scaling(
    before: EffortResult, after: EffortResult, held_out: HeldOut
) -> tuple[Stage, ...]:
    """Return the stages after efforts were divided by their scales.

    A stage is reopened if one of its parameters leaves its 95 % interval.

    Args:
        before, after: identifications with recorded and with divided efforts.
        held_out: error of all held-out efforts before and after.
    """
    half = np.zeros(len(before.base))
    half[before.fitted.kept] = before.fitted.solution.half_width
    off = np.abs(after.fitted.values - before.fitted.values)
    moved = {
        after.stage_of[i]
        for i in np.union1d(before.fitted.kept, after.fitted.kept)
        if off[i] > half[i]
    }
    why = (
        "the scale of the efforts, which known payloads show, moves it beyond its 95 % interval, "
        f"and the held-out error of all efforts falls from {100 * held_out.before:.3g} to "
        f"{100 * held_out.after:.3g} %"
    )
    return tuple(
        replace(one, state="reopened", why=f"{why}: {one.why}")
        if one.name in moved and one.state == "accepted"
        else one
        for one in after.stages
    )


def mean_relative(errors: Mapping[str, EffortError]) -> float:
    """Mean over the joints of the relative error of the effort."""
    return float(np.mean([error.relative for error in errors.values()]))


def _identify(
    realization: Realization, measured: MeasuredRecordings, signals: Signals
) -> tuple[EffortResult, Delay | None]:
    """Run the stages after the delay; return the result and the remaining delay."""
    everything = (*measured.fit, *measured.held_out)
    joints = everything[0].joints
    unscaled = [j for k, j in enumerate(joints) if any(m.unscaled[k] for m in measured.fit)]
    shared = _shared_motors(joints, signals)
    regressor = Regressor(
        realization, joints, shared, unscaled,
        has_moving_base=measured.fit[0].base is not None,
    )  # fmt: skip
    chosen = choose_filter(measured.fit)
    regressors = [
        _regressor_with_payload(realization, regressor, one, shared, unscaled) for one in everything
    ]
    sampled = sample(everything, regressors, chosen, instruments_of(everything, chosen))
    recorded = np.concatenate([rows.effort for rows in sampled[: len(measured.fit)]])
    for recording, rows in zip(everything, sampled, strict=True):
        carried = payload_effort(realization, regressor, recording, rows)
        if carried is not None:
            rows.effort[...] -= carried
    fit, held = sampled[: len(measured.fit)], sampled[len(measured.fit) :]
    known = np.array([
        any(np.isfinite(s.effort[:, k]).any() for s in fit) for k in range(len(joints))
    ])  # fmt: skip
    if not known.any():
        raise RecordingError(
            "no joint has an effort that can be used",
            path=measured.fit[0].path,
            value="; ".join(measured.fit[0].notes) or None,
            expected="signed efforts in N*m or signed currents",
        )
    structural = _base(regressor, known)
    base, open_ = _regrouped(structural, _problem(fit, regressor, structural))
    stage_of = stages_of(regressor, base)
    problem = _problem(fit, regressor, base)
    columns = np.flatnonzero(~open_)
    tested = _problem(held or fit, regressor, base)
    shown = problem.only(columns)
    found = estimate(shown, tested.only(columns), find_essential_parameters(shown))
    kept = columns[found.fitted.kept]
    fitted = EssentialParameters(
        kept, np.setdiff1d(np.arange(len(base)), kept), found.fitted.solution
    )
    prior = base.values(regressor.prior)
    # Noise of the measured motion would look like an error of the stages.
    quiet = found.estimator == INSTRUMENTS
    stages = compare_stages(
        with_commanded_motion(problem) if quiet else problem,
        with_commanded_motion(tested) if quiet else tested,
        fitted, stage_of, prior, base, bool(held),
    )  # fmt: skip
    stages = with_data(stages, problem, fitted, stage_of, [rows.name for rows in fit])
    plain = solve(shown, intervals=False)
    if found.estimator == INSTRUMENTS:
        plain = solve_instrumental(shown, plain)
    unsure = _is_uncertain(problem, prior, columns, kept, plain)
    every = np.arange(len(regressor.columns))
    full = linear_problem(held or fit, every, np.zeros((len(joints), len(every)), dtype=bool))
    written, stages = confirm_stages(
        regressor,
        LinearFit(base, problem, fitted, open_, unsure, stage_of, found.estimator == INSTRUMENTS),
        stages, [joint for k, joint in enumerate(joints) if known[k]], full,
    )  # fmt: skip
    rate = 1.0 / float(np.median(np.diff(fit[0].time)))
    along = fitted.solution.values if found.estimator == INSTRUMENTS else None
    late = None
    if len(fitted.kept):
        late = delay_of(problem.only(fitted.kept), recorded, rate, along)
    gears = [signals.of(joint).gear for joint in joints]
    named = dict(zip((base.names[i] for i in columns), plain.values.tolist(), strict=True))
    viscous = {joint: named.get(f"{joint}.viscous_friction", 0.0) for joint in joints}
    mistakes = unless_checked(
        [
            *position_mistakes(realization, measured.fit, gears),
            *find_mistakes(realization, measured.fit, fit, regressor, gears),
            *drifts(shown, plain, fit, viscous),
        ],
        signals,
    )
    if not any(one.is_fatal for one in mistakes):
        # A wrong sign makes friction negative, too.
        mistakes += impossible_drives(base, fitted)
    result = EffortResult(
        regressor=regressor,
        base=base,
        fitted=fitted,
        stages=stages,
        stage_of=tuple(stage_of),
        errors=errors_of(full, written.parameters, joints),
        nominal=errors_of(full, regressor.prior, joints),
        least_squares=errors_of(tested.only(columns), plain.values, joints),
        without_effort=tuple(j for j, k in zip(joints, known, strict=True) if not k),
        unobservable=open_,
        unsure=unsure,
        structural=structural,
        physical=written,
        filter=chosen,
        samples=tuple(fit),
        held_out=tuple(held),
        delay=None,
        suspected=tuple(mistakes),
        notes=tuple(dict.fromkeys(n for m in everything for n in m.notes)),
        estimate=found,
    )
    return result, late


def _shared_motors(joints: Sequence[str], signals: Signals) -> list[SharedMotor]:
    return [
        SharedMotor(j, own.joint, own.ratio)
        for j in joints
        if (own := signals.of(j).shared) is not None
    ]


def _regressor_with_payload(
    realization: Realization,
    regressor: Regressor,
    recording: MeasuredRecording,
    shared: Sequence[SharedMotor],
    unscaled: Sequence[str],
) -> Regressor:
    """Return the regressor of a recording: the nominal bodies that scale a current carry its
    payload.
    """
    payload = known_payload(realization, recording)
    if payload is None or not unscaled:
        return regressor
    variant = realization.variant(payload=payload)
    loaded = Regressor(
        variant, regressor.joints, shared, unscaled, has_moving_base=regressor.has_moving_base
    )
    return loaded if loaded.columns == regressor.columns else regressor


def _base(regressor: Regressor, known: NDArray[np.bool_]) -> BaseParameters:
    """Base parameters of the joints whose effort is known."""
    if known.all():
        return structural_base(regressor)
    matrix = regressor.random_matrix(4 * len(regressor.columns))
    return base_of(matrix[:, known], regressor.columns)


def _problem(
    samples: Sequence[RecordingRows], regressor: Regressor, base: BaseParameters
) -> LinearProblem:
    dry = dry_of(regressor.columns, regressor.joints)[:, base.independent]
    return linear_problem(samples, base.independent, dry)


def _regrouped(
    base: BaseParameters, problem: LinearProblem
) -> tuple[BaseParameters, NDArray[np.bool_]]:
    """Return the base parameters that the motion distinguishes, and True for those at rest."""
    size = np.sqrt(np.sum(problem.effort**2, axis=0) / np.maximum(problem.known.sum(axis=0), 1))
    weight = problem.known / np.where(size > 0, size, 1.0)
    return base.regrouped(weight_rows(problem.matrix, weight))


def _is_uncertain(
    problem: LinearProblem,
    prior: FloatArray,
    columns: NDArray[np.intp],
    kept: NDArray[np.intp],
    full: Solution,
) -> NDArray[np.bool_]:
    """(b,) True for insignificant parameters that may still be relevant.

    Their 95 % interval is wider than the nominal value or, for dry friction, wider than 5 % of the
    joint's effort.

    Args:
        problem: all columns.
        prior: (b,) nominal values.
        columns: columns that the motion excites.
        kept: columns that differ from zero.
        full: fit of all columns that the motion excites.
    """
    shown = problem.only(columns)
    said = information(shown, full.residual, full.weight).covariance(np.arange(len(columns)))
    half = Z95 * np.sqrt(np.diag(said).clip(0.0))
    size = np.sqrt(np.sum(problem.effort**2, axis=0) / np.maximum(problem.known.sum(axis=0), 1))
    allowed = np.abs(prior)[columns]
    found = np.zeros(len(prior), dtype=bool)
    dry = _ENOUGH_FRICTION * (problem.dry * size[:, None]).max(axis=0)[columns]
    limit = np.where(dry > 0.0, dry, allowed)
    found[columns] = (limit > 0.0) & (half > limit)
    found[kept] = False
    return found
