"""The estimation problem: segments to simulate, measurements, noise floors and weights."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.free_initial_state import FreeInitialState, FreeInitialStates
from pytest_twin.diagnosis.prepare_settings import PREPARE
from pytest_twin.effects import catalogue
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Predicted, Segment
from pytest_twin.estimation.deadline import check_deadline
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Scales, Term, effect_values
from pytest_twin.servos.prior import ParameterPrior

T = TypeVar("T")
# Hypotheses whose discretization errors are kept in memory.
_CACHED_HYPOTHESES = 16
REFINE = 4
"""Ratio of the model's time step to the finer one that measures its discretization error."""


def step_error(coarse: Predicted, fine: Predicted) -> Predicted:
    """Discretization error of a prediction: exact solution minus coarse prediction.

    Richardson extrapolation from two time steps, for an integrator of first order (Hairer, Norsett,
    Wanner 1993, sec. II.4).

    Args:
        coarse: prediction with the model's time step.
        fine: prediction with a step that is ``REFINE`` times finer.
    """
    whole = REFINE / (REFINE - 1.0)
    return Predicted(
        whole * (fine.position - coarse.position),
        whole * (fine.velocity - coarse.velocity),
        whole * (fine.effort - coarse.effort),
    )


def step_errors(coarse: Sequence[Predicted], fine: Sequence[Predicted]) -> dict[int, Predicted]:
    """Segment -> discretization error of its prediction; only segments where it is finite."""
    errors = (step_error(c, f) for c, f in zip(coarse, fine, strict=True))
    return {i: add for i, add in enumerate(errors) if np.isfinite(add.position).all()}


def add_step_error(coarse: Predicted, error: Predicted, share: float = 1.0) -> Predicted:
    """A prediction plus ``share`` (0 to 1) of its discretization error."""
    return Predicted(
        coarse.position + share * error.position,
        coarse.velocity + share * error.velocity,
        coarse.effort + share * error.effort,
    )


_Key = tuple[tuple[Term, ...], bytes]


@dataclass(frozen=True, slots=True)
class CandidateMask:
    """The effects among which a search chooses.

    Attributes:
        effects: their ids.
        given: ids of those that every model has, such as friction and the gains of a servo.
        last: ids of further effects, which are candidates once a search with the others has ended
            and a residual remains.
        unchanged_joints: names of joints that get no effect of their own.
    """

    effects: frozenset[str]
    given: frozenset[str] = frozenset()
    last: frozenset[str] = frozenset()
    unchanged_joints: frozenset[str] = frozenset()

    def allows(self, effect: str, joint: str | None = None) -> bool:
        """Whether an effect is a candidate at a joint; None for the whole robot."""
        return effect in self.effects and joint not in self.unchanged_joints

    def with_last(self) -> CandidateMask:
        """The mask with all effects as candidates."""
        return replace(self, effects=self.effects | self.last, last=frozenset())


@dataclass(frozen=True, slots=True)
class _Corrections:
    """What :meth:`Problem.at` computes at one hypothesis."""

    simulator: BatchSimulator
    refined: BatchSimulator | None
    discretization_error: Mapping[int, Predicted]
    starts: Mapping[int, FreeInitialState]


@dataclass(slots=True)
class ProblemMemory:
    """What was computed for a problem; it changes no result.

    Attributes:
        corrections: hypothesis -> its corrections, the latest last.
        cached: last result of :meth:`Problem.cached`, with all that it depends on.
        steps_for_initial_states: number of simulated steps that free initial states have cost.
        own_values: values of the nominal model at the joints, SI units.
    """

    corrections: dict[_Key, _Corrections] = field(default_factory=dict)
    cached: tuple[tuple[object, ...], Any] | None = None
    steps_for_initial_states: int = 0
    own_values: dict[str, FloatArray] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Problem:
    """The least-squares problem of a diagnosis: measurements, simulator, noise and weights.

    A prediction depends on nothing but the problem and the hypothesis. :meth:`at` returns the same
    problem with the corrections of another hypothesis.

    Attributes:
        simulator: simulates all segments, fit and held-out.
        fit, held_out: indices of segments. Nothing is held out during the search; after it, the
            test recordings are.
        floor: (joints,) noise floor of positions: the standard deviation that no model can
            explain, rad or m.
        scales: typical sizes of the joints' parameters.
        effort_floor: (joints,) noise floor of efforts, N m or N; None if efforts are not fitted.
        position_weights: segment -> (joints,) weights of positions, with mean square 1. The weight
            is lower where stiction makes the motion unpredictable. It multiplies residuals and
            Jacobians.
        effort_weights: segment -> (samples, joints) weights of efforts. It is 1 where the error of
            an effort is sensor noise only, and lower where the discretization error is larger. It
            multiplies residuals and Jacobians.
        refined: simulates the same segments with a finer step, to measure the discretization error.
        discretization_error: segment -> discretization error of one hypothesis. Every prediction
            is corrected by it (defect correction, Stetter 1978).
        step_left: share of the discretization error that remains after the correction, 0 to 1.
        mask: effects that are candidates; None for all.
        priors: what the twin knows of its servos before any recording.
        starts: segment -> free initial state of the same hypothesis, if an error of the initial
            state would grow.
        find_starts: computes ``starts`` for a hypothesis; None if all initial states are fixed.
        start_noise: (joints,) RMS noise of a position sample, rad or m; it gives the prior of the
            initial states.
        memory: what was computed for this problem and for its copies with other corrections.
    """

    simulator: BatchSimulator
    fit: NDArray[np.int64]
    held_out: NDArray[np.int64]
    floor: FloatArray
    scales: Scales
    effort_floor: FloatArray | None = None
    position_weights: Mapping[int, FloatArray] = field(default_factory=dict)
    effort_weights: Mapping[int, FloatArray] = field(default_factory=dict)
    refined: BatchSimulator | None = None
    discretization_error: Mapping[int, Predicted] = field(default_factory=dict)
    starts: Mapping[int, FreeInitialState] = field(default_factory=dict)
    find_starts: Callable[[Hypothesis], FreeInitialStates] | None = None
    start_noise: FloatArray = field(default_factory=lambda: np.zeros(0))
    step_left: float = PREPARE.step_left
    mask: CandidateMask | None = None
    priors: tuple[ParameterPrior, ...] = ()
    memory: ProblemMemory = field(default_factory=ProblemMemory, repr=False)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, in the order of columns."""
        return self.simulator.joints

    @property
    def simulated_steps(self) -> int:
        """Simulated steps so far, those from the cache included."""
        return sum(simulator.simulated_steps for simulator in self._simulators)

    @property
    def steps_per_simulation(self) -> int:
        """Number of steps in one simulation of all segments."""
        return int(self.simulator.steps.sum())

    @property
    def cached_steps(self) -> int:
        """Steps of :attr:`simulated_steps` that came from the cache."""
        return sum(simulator.cached_steps for simulator in self._simulators)

    @property
    def _simulators(self) -> list[BatchSimulator]:
        return [s for s in (self.simulator, self.refined) if s is not None]

    def has_shape_at_bound(self, hypothesis: Hypothesis, term: Term) -> bool:
        """Whether a shape parameter of a term is at its bound, as in
        :meth:`Hypothesis.has_shape_at_bound`.

        A warm-up time at its upper bound is accepted if the trials differ in temperature: the
        robot then need not warm up within one trial.
        """
        constant_within_trial = (
            catalogue()[term.effect].needs_temperature and self.has_different_temperatures
        )
        values = hypothesis.theta[hypothesis.slice_of(term)]
        shapes = [v for p, v in zip(term.parameters, values, strict=True) if p.neutral is None]
        longest = [p.upper for p in term.parameters if p.neutral is None]
        return hypothesis.has_shape_at_bound(term) and not (
            constant_within_trial and shapes == longest
        )

    @property
    def has_different_temperatures(self) -> bool:
        """Whether the recorded temperatures of the trials differ."""
        return len({s.cold_fraction for s in self.simulator.segments}) > 1

    def predict(
        self, hypotheses: Sequence[Hypothesis], segments: NDArray[np.int64]
    ) -> list[list[Predicted]]:
        """Predictions of every hypothesis on every segment, simulated as one batch.

        A hypothesis whose motion is discontinuous in a parameter has a discontinuous discretization
        error too. It is simulated with the finer step, of which 1 / ``REFINE`` remains to correct.

        Returns:
            One list for each hypothesis, with a prediction for each segment.

        Raises:
            OutOfTime: the time of the search is over.
        """
        check_deadline()
        out: list[list[Predicted]] = [[] for _ in hypotheses]
        for simulator, discontinuous, share in (
            (self.simulator, False, 1.0),
            (self.refined or self.simulator, True, 1.0 / REFINE if self.refined else 1.0),
        ):
            which = [i for i, h in enumerate(hypotheses) if h.is_discontinuous is discontinuous]
            if not which:
                continue
            rows = np.tile(segments, len(which))
            each = [hypotheses[i] for i in which for _ in segments]
            values = effect_values(each, len(self.joints), self.scales)
            flat = [
                self._add_step_error(int(row), p, share)
                for row, p in zip(rows, simulator.simulate(rows, values), strict=True)
            ]
            n = len(segments)
            for k, i in enumerate(which):
                out[i] = flat[k * n : (k + 1) * n]
        return out

    def trajectories_with_readings(
        self, hypothesis: Hypothesis, segments: NDArray[np.int64]
    ) -> tuple[FloatArray, FloatArray, list[Predicted]]:
        """Simulated positions, velocities and predictions of a hypothesis.

        Returns:
            Positions (rad or m) and velocities (rad/s or m/s) before sensor effects, at every step
            of the model, both (segments, steps + 1, joints). Then predictions as of
            :meth:`predict`.
        """
        values = effect_values([hypothesis] * len(segments), len(self.joints), self.scales)
        q, v, read = self.simulator.trajectories_with_readings(segments, values)
        if hypothesis.is_discontinuous:
            return q, v, self.predict([hypothesis], segments)[0]
        return (
            q,
            v,
            [self._add_step_error(int(s), p, 1.0) for s, p in zip(segments, read, strict=True)],
        )

    def count_trajectories(self, hypothesis: Hypothesis, segments: NDArray[np.int64]) -> None:
        """Count the steps of :meth:`trajectories_with_readings`, whose result is known.

        Limits of simulations then do not depend on what is kept.
        """
        self.simulator.count(segments)
        if hypothesis.is_discontinuous:
            (self.refined or self.simulator).count(segments, repeated=True)

    def cached(
        self, hypothesis: Hypothesis, segments: NDArray[np.int64], make: Callable[[], T]
    ) -> tuple[T, bool]:
        """What ``make`` returns for a hypothesis, and whether it is kept from the last call.

        It is kept while hypothesis, segments and the state of the problem are the same.
        """
        state: tuple[object, ...] = (
            *self.simulator.segments, self.simulator, self.refined, self.scales,
            self.position_weights, self.effort_weights, self.discretization_error, self.starts,
            self.find_starts,
        )  # fmt: skip
        noise = self.floor, self.start_noise, self.effort_floor
        values = hypothesis.terms, *(
            None if x is None else x.tobytes() for x in (hypothesis.theta, segments, *noise)
        )  # fmt: skip
        if self.memory.cached is not None:
            (known_values, *known), result = self.memory.cached
            same = len(known) == len(state) and all(map(operator.is_, known, state))
            if known_values == values and same:
                return result, True
        made = make()
        self.memory.cached = (values, *state), made
        return made, False

    def _add_step_error(self, segment: int, p: Predicted, share: float) -> Predicted:
        error = self.discretization_error.get(segment)
        return p if error is None else add_step_error(p, error, share)

    def at_nominal(self, discretization_error: Mapping[int, Predicted]) -> Problem:
        """As :meth:`at` the nominal model, with a discretization error that is already measured."""
        free = self._free_states(EMPTY)
        if not free.motor_shifts:
            self.memory.corrections[_key(EMPTY)] = _Corrections(
                self.simulator, self.refined, discretization_error, free.free
            )
        return self.at(EMPTY)

    def at(self, hypothesis: Hypothesis) -> Problem:
        """The problem with the discretization errors and free initial states of a hypothesis.

        Raises:
            OutOfTime: the time of the search is over.
        """
        key, known = _key(hypothesis), self.memory.corrections
        if key not in known:
            check_deadline()
            if len(known) >= _CACHED_HYPOTHESES:
                known.pop(next(iter(known)))
            known[key] = self._corrections_of(hypothesis)
        found = known[key]
        return replace(
            self, simulator=found.simulator, refined=found.refined,
            discretization_error=found.discretization_error, starts=found.starts,
        )  # fmt: skip

    def with_simulator(self, simulator: BatchSimulator, refined: BatchSimulator | None) -> Problem:
        """The problem with other simulators, of which nothing is computed yet."""
        return replace(self, simulator=simulator, refined=refined, memory=ProblemMemory())

    def _corrections_of(self, hypothesis: Hypothesis) -> _Corrections:
        free = self._free_states(hypothesis)
        simulator = self.simulator.with_motor_shifts(free.motor_shifts)
        if self.refined is None:
            return _Corrections(simulator, None, {}, free.free)
        refined = self.refined.with_motor_shifts(free.motor_shifts)
        rows = self.all_segments
        values = effect_values([hypothesis] * len(rows), len(self.joints), self.scales)
        coarse, fine = (s.simulate(rows, values) for s in (simulator, refined))
        return _Corrections(simulator, refined, step_errors(coarse, fine), free.free)

    def _free_states(self, hypothesis: Hypothesis) -> FreeInitialStates:
        """Compute the free initial states of a hypothesis."""
        if self.find_starts is None:
            return FreeInitialStates(dict(self.starts), {})
        free = self.find_starts(hypothesis)
        self.memory.steps_for_initial_states += free.simulated_steps
        return free

    def residuals(
        self, hypotheses: Sequence[Hypothesis], segments: NDArray[np.int64]
    ) -> list[FloatArray]:
        """Weighted residuals (measured minus predicted) of each hypothesis, (samples, signals)."""
        return [
            self.weigh_positions(errors, segments) for errors in self.errors(hypotheses, segments)
        ]

    def errors(
        self, hypotheses: Sequence[Hypothesis], segments: NDArray[np.int64]
    ) -> list[FloatArray]:
        """Measured minus predicted for each hypothesis, (samples, signals), segments stacked.

        Signals are the joints' positions (rad or m), then their efforts (N m or N) if these are
        fitted. Efforts are weighted by :attr:`effort_weights`, positions are not weighted.
        """
        out = []
        for predictions in self.predict(hypotheses, segments):
            parts = []
            for s, p in zip(segments, predictions, strict=True):
                segment = self.simulator.segments[s]
                error = segment.position - p.position
                start = self.starts.get(int(s))
                columns = [error if start is None else start.without_initial_error(error)]
                if self.effort_floor is not None and segment.effort is not None:
                    columns.append(self.weigh_efforts(int(s), segment.effort - p.effort))
                parts.append(np.concatenate(columns, axis=1))
            out.append(np.concatenate(parts))
        return out

    def weigh_positions(self, stacked: FloatArray, segments: NDArray[np.int64]) -> FloatArray:
        """(samples, signals, ...) of segments, positions multiplied by :attr:`position_weights`."""
        if not self.position_weights:
            return stacked
        weights = self.position_weights_of(segments, self.lengths(segments))
        out = stacked.copy()
        out[:, : len(self.joints)] *= weights.reshape(*weights.shape, *[1] * (stacked.ndim - 2))
        return out

    def position_weights_of(
        self, segments: NDArray[np.int64], lengths: Sequence[int]
    ) -> FloatArray:
        """(samples, joints) weights of positions; ``lengths`` are the samples of each segment."""
        each = np.array([self.position_weights[int(s)] for s in segments])
        weights: FloatArray = np.repeat(each, lengths, axis=0)
        return weights

    def weigh_efforts(self, segment: int, effort: FloatArray) -> FloatArray:
        """(samples, joints, ...) differences of efforts, multiplied by :attr:`effort_weights`."""
        weights = self.effort_weights.get(segment)
        if weights is None:
            return effort
        weighted: FloatArray = effort * weights.reshape(*weights.shape, *[1] * (effort.ndim - 2))
        return weighted

    @property
    def signal_floor(self) -> FloatArray:
        """(signals,) noise floors: positions in rad or m, then efforts in N m or N."""
        if self.effort_floor is None:
            return self.floor
        return np.concatenate([self.floor, self.effort_floor])

    @property
    def all_segments(self) -> NDArray[np.int64]:
        """Indices of all segments."""
        return np.arange(len(self.simulator.segments))

    @property
    def tested_segments(self) -> NDArray[np.int64]:
        """Held-out segments, or fit segments if none is held out; effects are compared on them."""
        return self.held_out if len(self.held_out) else self.fit

    @property
    def is_in_test(self) -> NDArray[np.bool_]:
        """(samples,) of all segments: whether each belongs to one of :attr:`tested_segments`."""
        inside: NDArray[np.bool_] = np.repeat(
            np.isin(self.all_segments, self.tested_segments), self.lengths(self.all_segments)
        )
        return inside

    def weights(self, left: FloatArray) -> FloatArray:
        """(signals,) reciprocal standard deviations from mean squared residuals ``left``."""
        weights: FloatArray = 1.0 / np.sqrt(left + self.signal_floor**2)
        return weights

    def lengths(self, segments: NDArray[np.int64]) -> list[int]:
        """Number of samples of each segment."""
        return [len(self.simulator.segments[s].time) for s in segments]


def _key(hypothesis: Hypothesis) -> _Key:
    return hypothesis.terms, hypothesis.theta.tobytes()


def replay_nominal(simulator: BatchSimulator) -> list[Predicted]:
    """Predictions of every segment by the nominal model."""
    count = len(simulator.segments)
    values = effect_values([EMPTY] * count, len(simulator.joints), Scales({}))
    return simulator.simulate(np.arange(count), values)


def joint_scales(simulator: BatchSimulator, nominal: Sequence[Predicted]) -> Scales:
    """Typical sizes of each joint's parameters in SI units.

    They come from the measured motion, the model's inertia and the nominal prediction.

    Args:
        nominal: prediction of each segment by the nominal model.
    """
    joints, segments = len(simulator.joints), simulator.segments
    model = segments[0].model

    def rms(values: list[FloatArray]) -> FloatArray:
        stacked = np.concatenate(values)
        known = np.maximum(np.isfinite(stacked).sum(axis=0), 1)
        out: FloatArray = np.sqrt(np.nansum(stacked**2, axis=0) / known)
        return out

    effort = np.maximum(rms([p.effort for p in nominal]), 1e-4)
    measured = [np.gradient(s.position, np.maximum(s.time, 0.0) + 1e-12 * np.arange(len(s.time)),
                            axis=0) for s in segments]  # fmt: skip
    velocity = np.maximum(rms(measured), 1e-3)
    position = np.maximum(np.concatenate([s.position for s in segments]).std(axis=0), 1e-2)
    data = mujoco.MjData(model)
    mass = np.zeros((model.nv, model.nv))
    inertia = np.zeros(joints)
    for s in segments:
        middle = len(s.position) // 2
        if s.base is not None:
            s.base.place(data, float(s.time[middle]))
        data.qpos[simulator.layout.qpos_index] = s.position[middle]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        inertia = np.maximum(inertia, np.diag(mass)[simulator.layout.dof_index])
    rate = rms([_slope(s.command, s.command_time) for s in segments])
    effort_rate = rms([
        _slope(p.effort, s.time) for s, p in zip(segments, nominal, strict=True)
    ])  # fmt: skip
    # If the nominal model diverges, its efforts are not finite.
    size = np.concatenate([np.abs(p.effort) for p in nominal])
    peak = np.max(np.where(np.isfinite(size), size, 0.0), axis=0)
    modes = np.array([segments[0].mode_of(j) for j in range(joints)])
    command = np.where(
        modes == "position",
        rms([_tracking_error(s) for s in segments]),
        rms([s.command for s in segments]),
    )
    # The commanded velocity, or the measured one if commands are efforts.
    commanded_velocity = np.select(
        [modes == "position", modes == "velocity"], [rate, command], velocity
    )
    ones = np.ones(joints)
    return Scales(
        {
            "one": ones,
            "twelfth": ones * max(float(s.time[-1]) for s in segments) / 12.0,
            "effort": effort,
            "velocity": velocity,
            "position": position,
            "damping": effort / velocity,
            "stiffness": effort / position,
            "drag": effort / velocity**2,
            "inertia": inertia,
            "compliance": position / effort,
            "slowness": 1.0
            / np.maximum(np.nan_to_num(rate), np.where(modes == "effort", effort, velocity)),
            "effort_slowness": 1.0 / np.maximum(np.nan_to_num(effort_rate), effort),
            "inverse_velocity": 1.0 / np.maximum(np.nan_to_num(commanded_velocity), velocity),
            "inverse_effort": 1.0 / np.maximum(peak, 1e-4),
            "command": np.maximum(np.nan_to_num(command), 1e-4),
            "mass": ones * max(simulator.layout.tool_mass, 0.05),
            "clearance": 0.01 * ones,
            "length": ones * simulator.layout.tool_length,
            "gyration": simulator.layout.gyration,
        }
    )


def _slope(values: FloatArray, time: FloatArray) -> FloatArray:
    """(samples - 1, joints) difference quotients between samples, per s."""
    slope: FloatArray = np.diff(values, axis=0) / np.maximum(np.diff(time), 1e-4)[:, None]
    return slope


def _tracking_error(segment: Segment) -> FloatArray:
    """(samples, joints) setpoint minus measured position, rad or m."""
    error: FloatArray = segment.setpoint.at(segment.time) - segment.position
    return error
