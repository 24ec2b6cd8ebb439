"""Building of the estimation problem from trials: segments, noise floors and scales."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.free_initial_state import FreeInitialStates, free_initial_states
from pytest_twin.diagnosis.initial_velocity import choose_initial_velocity
from pytest_twin.diagnosis.noise import (
    effort_noise,
    effort_noise_of_quiet_samples,
    effort_resolution,
    largest_noise,
    timing_noise,
)
from pytest_twin.diagnosis.prepare_settings import PREPARE
from pytest_twin.diagnosis.problem import (
    REFINE,
    Problem,
    joint_scales,
    replay_nominal,
    step_errors,
)
from pytest_twin.diagnosis.stiction_weights import stiction_weights
from pytest_twin.diagnosis.temperature import (
    ColdFractions,
    cold_fraction_of_trial,
    cold_fractions_of,
)
from pytest_twin.diagnosis.windows import WINDOW, Cutting, segments_of
from pytest_twin.effects.active_effects import EffectValues
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.contact_geoms import CONTACT_DISTANCE, ContactGeoms
from pytest_twin.effects.segment import Predicted, Segment
from pytest_twin.errors import RecordingError
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Scales, effect_values
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial

NOISE = "sensor noise and quantization"
STEP = "discretization of the simulator"
# A command within this share of a step from its ends counts as sent between two steps.
_EDGE = 1e-3


@dataclass(frozen=True, slots=True)
class PreparedProblem:
    """A problem, with the trials and settings from which it was built.

    Attributes:
        segment_trial: index of the trial of each segment.
        floor_parts: source of noise -> (joints,) standard deviation, rad or m.
        cold_fractions: normalized temperatures of the trials; empty if they are not known.
        substeps: substeps of the simulation that made the recordings, as in
            :class:`SimulationSettings`.
        window: length in s of the windows that motions are cut into, as in :func:`prepare`.
    """

    problem: Problem
    segment_trial: tuple[int, ...]
    floor_parts: dict[str, FloatArray]
    cold_fractions: ColdFractions
    substeps: int = 0
    window: float | None = None

    def with_lower_floor(self, hypothesis: Hypothesis) -> PreparedProblem | None:
        """The same problem with the noise floor that the discretization error at a hypothesis has.

        The nominal model may diverge from the recordings (for example without a drive's
        saturation), and its discretization error is then large. A better hypothesis has a smaller
        one.

        Returns:
            The problem with a far lower floor at some joints; the floors of other joints are
            unchanged. None if no floor is far lower.
        """
        problem = self.problem.at(hypothesis)
        if len(problem.discretization_error) < len(problem.simulator.segments):
            return None
        noise = self.floor_parts[NOISE]
        steps = discretization_rms(problem)
        floor = _noise_floor(noise, problem, steps)
        before = _noise_floor(noise, problem, self.floor_parts[STEP])
        # A joint with a stuck encoder has a floor that is not the sum of its parts; it is kept.
        lower = (floor < PREPARE.far_lower * before) & np.isclose(problem.floor, before)
        if not lower.any():
            return None
        return replace(
            self,
            problem=replace(self.problem, floor=np.where(lower, floor, problem.floor)),
            floor_parts=self.floor_parts | {STEP: np.where(lower, steps, self.floor_parts[STEP])},
        )


@dataclass(frozen=True, slots=True)
class SimulationSettings:
    """Settings of the simulation that are not part of the model.

    Attributes:
        cold_fractions: normalized temperatures of an earlier diagnosis; empty to take them from the
            trials.
        fixed: effects in addition to the model, values (1, joints) of :func:`shared_joints`.
        has_friction_creep: whether a joint creeps under dry friction, as with MuJoCo's default
            constraint.
        substeps: if a simulation made the recordings: its steps for each step of the model. The
            recordings then contain its discretization error. 0 for recordings of a robot.
        scales: reference scales of the parameters; None to compute them from the recordings.
    """

    cold_fractions: ColdFractions = field(default_factory=dict)
    fixed: EffectValues | None = None
    has_friction_creep: bool = False
    substeps: int = 0
    scales: Scales | None = None


_DEFAULT_SETTINGS = SimulationSettings()


def prepare(
    realization: Realization,
    fit: Sequence[Trial],
    held_out: Sequence[Trial],
    *,
    threads: int = 0,
    window: float | None = None,
    contact: ContactGeoms | None = None,
    settings: SimulationSettings = _DEFAULT_SETTINGS,
) -> PreparedProblem:
    """Build the problem of explaining ``fit`` and predicting ``held_out``.

    Args:
        fit, held_out: trials that are fitted, and trials that are predicted only.
        threads: threads of the simulation; 0 for all cores.
        window: length in s of the windows that motions are cut into. It is halved if the
            discretization error is too large. None: only motions under effort commands are cut.
        contact: surfaces from which all windows keep a distance; None for no restriction.

    Raises:
        RecordingError: model and recordings share no joint, or no motion to fit keeps the distance
            from ``contact``.
        SpecError: a controller, payload or actuator is missing in the model.
    """
    trials = [*fit, *held_out]
    joints = shared_joints(realization, trials)
    fixed, substeps = settings.fixed, settings.substeps
    cold_fractions = settings.cold_fractions or cold_fractions_of(trials)
    cutting = Cutting(window, skips_hole=True, contact=contact)
    cut = _cut_trials(
        realization, trials, joints, cutting, cold_fractions, settings.has_friction_creep
    )
    owner = cut.owner
    is_fit = np.array(owner) < len(fit)
    if not is_fit.any():
        raise RecordingError(
            "the robot is close to a surface all the time",
            path=trials[0].path,
            expected=f"motion at least {CONTACT_DISTANCE:g} m away from all surfaces",
        )
    recorded_noise = largest_noise(cut.segments, [s.position for s in cut.segments], owner)
    segments = choose_initial_velocity(
        cut.segments, cut.moving, joints, recorded_noise, threads=threads, fixed=fixed
    )
    noise = _replace_zero_noise(recorded_noise)
    simulator = BatchSimulator(segments, joints, threads=threads, refine=substeps or 1, fixed=fixed)
    finer = (substeps or 1) * REFINE
    refined = BatchSimulator(segments, joints, threads=threads, refine=finer, fixed=fixed)
    nominal = replay_nominal(simulator)
    effort_floor: FloatArray | None = None
    if _has_signed_efforts(segments, nominal):
        effort_floor = effort_noise(segments, nominal, owner)
    scales = settings.scales or joint_scales(simulator, nominal)
    discretization_error = step_errors(nominal, replay_nominal(refined))
    allowed = np.maximum(PREPARE.wild * noise, PREPARE.wild_share * scales.of["position"])
    changed = _rms([add.position for add in discretization_error.values()], len(joints))
    if window in (None, WINDOW) and _needs_shorter_windows(segments, changed, allowed):
        return prepare(
            realization, fit, held_out,
            threads=threads, window=0.5 * WINDOW, contact=contact,
            settings=replace(settings, cold_fractions=cold_fractions, scales=scales),
        )  # fmt: skip
    find_starts: Callable[[Hypothesis], FreeInitialStates] | None = None
    if any(s.starts_in_motion or s.mode != "position" for s in segments):
        find_starts = partial(
            free_initial_states, segments, joints, noise, threads, scales=scales, fixed=fixed
        )
    problem = Problem(
        simulator, np.flatnonzero(is_fit), np.flatnonzero(~is_fit), noise, scales, effort_floor,
        refined=None if substeps else refined, find_starts=find_starts, start_noise=noise,
        step_left=_step_left(simulator, substeps),
    ).at_nominal({} if substeps else discretization_error)  # fmt: skip
    for _ in range(PREPARE.passes if segments[0].mode == "effort" else 1):
        # The weights depend on the noise floor, and the floor on the weights: alternate.
        steps = changed if substeps else discretization_rms(problem)
        problem = replace(problem, floor=_noise_floor(noise, problem, steps))
        if segments[0].mode == "effort":
            problem = replace(problem, position_weights=stiction_weights(problem))
    if effort_floor is not None:
        problem = _with_efforts(problem, nominal, owner, effort_floor)
    parts = {
        NOISE: noise,
        # With rare fast motion, the mean square of the timing noise can exceed the typical noise.
        "of it, sample timing": np.minimum(timing_noise(segments, owner), noise),
        STEP: steps,
    }
    return PreparedProblem(problem, tuple(owner), parts, cold_fractions, substeps, window)


def _step_left(simulator: BatchSimulator, substeps: int) -> float:
    """Share of the discretization error that remains after the correction, 0 to 1."""
    if substeps:
        return PREPARE.step_of_simulation
    if simulator.segments[0].mode == "effort":
        return PREPARE.step_with_jumps
    if simulator.models.contact.world.size:
        return PREPARE.step_with_impacts
    return PREPARE.step_left


@dataclass(frozen=True, slots=True)
class _CutTrials:
    """Trials cut into segments.

    Attributes:
        segments: segments of all trials.
        owner: index of the trial of each segment.
        moving: index of a segment that starts at rest -> the same segment with an initial velocity
            from its first samples.
    """

    segments: list[Segment]
    owner: list[int]
    moving: dict[int, Segment]


def _cut_trials(
    realization: Realization,
    trials: Sequence[Trial],
    joints: Sequence[str],
    cutting: Cutting,
    cold_fractions: ColdFractions,
    has_friction_creep: bool,
) -> _CutTrials:
    """Segments of all trials; those without velocities also with an estimated initial velocity."""
    cut = _CutTrials([], [], {})
    for i, trial in enumerate(trials):
        cold = cold_fraction_of_trial(cold_fractions, trial)
        made = segments_of(
            realization,
            trial,
            i,
            joints,
            cutting,
            cold_fraction=cold,
            has_friction_creep=has_friction_creep,
        )
        if not made:
            continue
        if made[0].velocity is None and made[0].mode == "position" and not made[0].starts_in_motion:
            # The restriction to motion far from contact applies to windows only.
            moving = replace(cutting, estimates_velocity=True, contact=None)
            (cut.moving[len(cut.segments)],) = segments_of(
                realization,
                trial,
                i,
                joints,
                moving,
                cold_fraction=cold,
                has_friction_creep=has_friction_creep,
            )
        cut.segments.extend(made)
        cut.owner.extend([i] * len(made))
    return cut


def _with_efforts(
    problem: Problem, nominal: Sequence[Predicted], owner: Sequence[int], effort_floor: FloatArray
) -> Problem:
    """The problem with efforts, weighted by sensor noise and the uncertainty of the prediction."""
    segments = problem.simulator.segments
    if segments[0].mode == "effort":
        # The drive delivers the commanded effort; its time is uncertain by one sample.
        jumps = [_largest_neighbour_difference(p.effort) for p in nominal]
    else:
        if problem.discretization_error:
            effort_floor = np.minimum(
                effort_floor, effort_noise_of_quiet_samples(problem, nominal, owner)
            )
        jumps = _effort_uncertainties(problem, nominal)
    sensor_noise = np.maximum(effort_floor, effort_resolution(segments))
    return _with_effort_weights(problem, sensor_noise, jumps)


def _has_signed_efforts(segments: Sequence[Segment], nominal: Sequence[Predicted]) -> bool:
    """Whether every recording has finite efforts with a sign.

    Some drivers publish the magnitude of a current. It is never negative, although the model's
    effort is.
    """
    lowest, modelled = np.inf, np.inf
    for segment, predicted in zip(segments, nominal, strict=True):
        if segment.effort is None or not np.isfinite(segment.effort).all():
            return False
        lowest = min(lowest, float(segment.effort.min()))
        highest = np.abs(predicted.effort).max()
        modelled = min(modelled, float(predicted.effort.min() + PREPARE.unsigned * highest))
    return lowest < 0.0 or not modelled < 0.0


def _replace_zero_noise(noise: FloatArray) -> FloatArray:
    """(joints,) noise; joints with zero noise, which hardly move, have the largest of the others.

    If all are zero, the precision of single-precision numbers is used.
    """
    usual = float(noise.max()) or float(np.finfo(np.float32).eps)
    replaced: FloatArray = np.where(noise > 0.0, noise, usual)
    return replaced


def _needs_shorter_windows(
    segments: Sequence[Segment], steps: FloatArray, allowed: FloatArray
) -> bool:
    """Whether the discretization error requires shorter windows, and half of one is long enough."""
    enough = float(np.median([len(s.time) for s in segments])) >= 2 * PREPARE.fewest_samples
    return all(s.starts_in_motion for s in segments) and enough and bool((steps > allowed).any())


def discretization_rms(problem: Problem) -> FloatArray:
    """(joints,) RMS discretization error of the model's step, rad or m.

    Under effort commands it is weighted like the residuals, and the part that free initial states
    explain is subtracted.
    """
    changes = []
    for i, add in problem.discretization_error.items():
        change = add.position
        if problem.simulator.segments[i].mode == "effort":
            start = problem.starts.get(i)
            change = change if start is None else start.without_initial_error(change)
            change = change * problem.position_weights.get(i, 1.0)
        changes.append(change)
    return _rms(changes, len(problem.joints))


def _rms(changes: Sequence[FloatArray], joints: int) -> FloatArray:
    """(joints,) RMS over all samples; 0 if there are none."""
    if not changes:
        return np.zeros(joints)
    found: FloatArray = np.sqrt(np.mean(np.concatenate(changes) ** 2, axis=0))
    return found


def _noise_floor(noise: FloatArray, problem: Problem, steps: FloatArray) -> FloatArray:
    """(joints,) noise floor from sensor noise and the remaining discretization error."""
    floor: FloatArray = np.hypot(noise, problem.step_left * steps)
    return floor


def shared_joints(realization: Realization, trials: Sequence[Trial]) -> tuple[str, ...]:
    """Names of the model's hinges and slides that all trials have, in the model's order.

    Raises:
        RecordingError: no joint is in the model and in all trials.
    """
    scalar = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    model = realization.model
    joints = tuple(
        j
        for j in realization.joints
        if int(model.jnt_type[realization.joint_index(j)]) in scalar
        and all(j in t.joints for t in trials)
    )
    if not joints:
        raise RecordingError(
            "no joint of the model is in all recordings",
            path=trials[0].path,
            value=", ".join(trials[0].joints),
            expected=", ".join(realization.joints),
        )
    return joints


def _with_effort_weights(
    problem: Problem, noise: FloatArray, jumps: Sequence[FloatArray]
) -> Problem:
    """The problem with efforts, weighted by their noise and their uncertainty near command jumps.

    Args:
        noise: (joints,) standard deviation of the sensor, N*m or N.
        jumps: for each segment, (samples, joints) uncertainty of the prediction, N*m or N.
    """
    weights = {i: 1.0 / np.sqrt(1.0 + (jump / noise) ** 2) for i, jump in enumerate(jumps)}
    return replace(problem, effort_floor=noise, effort_weights=weights)


def _effort_uncertainties(problem: Problem, nominal: Sequence[Predicted]) -> list[FloatArray]:
    """For each segment, (samples, joints) uncertainty of the predicted effort, N*m or N.

    A servo's effort jumps with each command, and the stamps do not show whether the sensor was read
    one step before or after the jump. The discretization error is a second contribution.
    """
    simulator, out = problem.simulator, list[FloatArray]()
    around = [_has_new_command(s, simulator.timestep, 1) for s in simulator.segments]
    rows = np.array([i for i, near in enumerate(around) if near.any()], dtype=np.int64)
    values = effect_values([EMPTY] * len(rows), len(problem.joints), problem.scales)
    found = simulator.efforts_at_neighbouring_steps(rows, values) if len(rows) else []
    shifted = dict(zip(rows.tolist(), found, strict=True))
    for i, segment in enumerate(simulator.segments):
        within = _has_new_command(segment, simulator.timestep, 0)
        jump: FloatArray = within * _largest_neighbour_difference(nominal[i].effort)
        if i in shifted:
            effort, earlier, later = shifted[i]
            change = np.maximum(np.abs(earlier - effort), np.abs(later - effort))
            jump = np.maximum(jump, around[i] * change)
        error = problem.discretization_error.get(i)
        out.append(jump if error is None else np.maximum(jump, np.abs(error.effort)))
    return out


def _has_new_command(segment: Segment, step: float, around: int) -> NDArray[np.bool_]:
    """(samples, joints) whether a command changes close to a sample.

    Close means within the model step of the sample, or at most ``around`` steps from it. Within
    such a step the simulated drive gets the mean of both commands; the real one got one of them.

    Args:
        step: time step of the model, s.
        around: number of steps.
    """
    if segment.is_interpolated:
        return np.zeros((len(segment.time), segment.command.shape[1]), dtype=bool)
    first = segment.start + step * np.floor((segment.time - segment.start) / step)
    change = np.diff(segment.command, axis=0, prepend=segment.command[:1]) != 0.0
    # What was commanded before the first command is not recorded.
    change[0] = True
    changes = np.vstack([np.zeros((1, change.shape[1]), int), np.cumsum(change, axis=0)])
    early, late = (
        np.searchsorted(segment.command_time, first + part * step, side="right")
        for part in (_EDGE - around, 1.0 - _EDGE + around)
    )
    is_new: NDArray[np.bool_] = changes[late] > changes[early]
    return is_new


def _largest_neighbour_difference(effort: FloatArray) -> FloatArray:
    """(samples, joints) largest absolute difference to a neighbouring sample."""
    change = np.abs(np.diff(effort, axis=0))
    none = np.zeros((1, effort.shape[1]))
    largest: FloatArray = np.maximum(np.vstack([none, change]), np.vstack([change, none]))
    return largest
