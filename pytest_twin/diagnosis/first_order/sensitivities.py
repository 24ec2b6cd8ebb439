"""First-order sensitivities of the prediction to every candidate effect, without simulation.

Each law gives the force that it adds along the measured motion. The linearized dynamics turn forces
into changes of position. Sensors and clocks change the reading itself. In contact the linearization
is not valid, and candidates are simulated instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.law_forces import Forces, LawForces, state_force_derivatives
from pytest_twin.diagnosis.first_order.linearized_dynamics import (
    LinearizedDynamics,
    linearize_dynamics,
)
from pytest_twin.diagnosis.first_order.measured_trajectory import (
    MeasuredTrajectory,
    measured_trajectory,
)
from pytest_twin.diagnosis.first_order.rigid_terms import (
    InverseDynamics,
    RigidTerms,
    changes_bodies,
    changes_gravity,
    rigid_terms,
    upsample,
)
from pytest_twin.diagnosis.first_order.sensor_readings import ReadingChange, SensorReadings
from pytest_twin.diagnosis.free_initial_state import (
    FreeInitialState,
    count_free_states,
    free_initial_state,
)
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.active_effects import (
    STEP_HOOKS,
    ActiveEffects,
    add_fixed_effects,
    sort_by_hook_order,
)
from pytest_twin.effects.base import Effect, Values
from pytest_twin.effects.proposal import starting_sizes
from pytest_twin.estimation.deadline import check_deadline
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term, absent_values, effect_values
from pytest_twin.realization.executor import Forks
from pytest_twin.realization.forks import free_cores

_FORCE_HOOKS = ("gains", "command_latency", "sample_time", "fields", "separates", *STEP_HOOKS)
_TermsOfEffect = tuple[Term, ...]
"""Candidates of one effect at several joints."""
SIMULATED_CANDIDATES = 16
"""Number of candidates that are simulated at every starting size, if the robot has contact."""


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """Sensitivity of the prediction to a candidate, for one choice of its shape parameters.

    Attributes:
        start: parameters at which the change was computed, with every amplitude on.
        amplitude_indices: indices of the parameters that switch the effect on.
        change: (bins, signals, amplitudes) prediction with one amplitude on, minus the prediction
            without the effect.
    """

    term: Term
    start: FloatArray
    amplitude_indices: tuple[int, ...]
    change: FloatArray


Sizes = Sequence[tuple[FloatArray, tuple[int, ...]]]
"""Parameters of a term, and the indices of those that switch it on."""


def starting_grid(term: Term) -> list[tuple[FloatArray, tuple[int, ...]]]:
    """Starting sizes of a term, those of its first form first.

    Returns:
        Pairs of parameters, in multiples of their references, and the indices of the parameters
        that switch the effect on.
    """
    return [(size, term.amplitude_indices(size)) for size in starting_sizes(term.law)]


def starts_in_first_form(term: Term) -> list[FloatArray]:
    """Starting sizes of a term in its first form; in all forms if they have the same parameters."""
    sizes = [start for start, _ in starting_grid(term)]
    choices = [k for k, p in enumerate(term.parameters) if p.choice and term.law.has_forms]
    return [s for s in sizes if np.array_equal(s[choices], sizes[0][choices])]


def simulated_sensitivities(
    problem: Problem,
    terms: Sequence[Term],
    segments: NDArray[np.int64],
    hypothesis: Hypothesis,
    residual: FloatArray,
    closest: int = SIMULATED_CANDIDATES,
) -> list[Sensitivity]:
    """Sensitivities by simulation: every candidate at one size, the best ones at all sizes.

    Args:
        terms: candidates that the hypothesis lacks.
        segments: indices of the segments that are simulated.
        hypothesis: the best hypothesis so far.
        residual: (bins, signals) residual of the hypothesis, by which candidates are ranked.
        closest: number of candidates that are simulated at all sizes.
    """
    sizes = {t: starting_grid(t) for t in terms}
    middle = {t: len(starts_in_first_form(t)) // 2 for t in sizes}
    found = _simulate_sizes(
        problem, [(t, sizes[t][middle[t]]) for t in terms], segments, hypothesis
    )
    weight = 1.0 / (np.mean(residual**2, axis=0) + problem.signal_floor**2)
    order = sorted(found, key=lambda r: -_explained_square(r.change, residual, weight))
    best = [r.term for r in order[:closest]]
    other_sizes = [(t, s) for t in best for k, s in enumerate(sizes[t]) if k != middle[t]]
    return found + _simulate_sizes(problem, other_sizes, segments, hypothesis)


def _explained_square(change: FloatArray, residual: FloatArray, weight: FloatArray) -> float:
    """Reduction of the weighted squared residual by a least-squares fit of the changes.

    Args:
        change: (bins, signals, amplitudes).
        residual: (bins, signals).
        weight: (signals,) reciprocal variances.
    """
    root = np.sqrt(weight)
    a = (change * root[:, None]).reshape(-1, change.shape[2]).astype(np.float64)
    b = (residual * root).ravel()
    return float(np.linalg.norm(a @ np.linalg.lstsq(a, b, rcond=None)[0]) ** 2)


def _simulate_sizes(
    problem: Problem,
    sizes: Sequence[tuple[Term, tuple[FloatArray, tuple[int, ...]]]],
    segments: NDArray[np.int64],
    hypothesis: Hypothesis,
) -> list[Sensitivity]:
    """Sensitivities at given sizes, simulated in one batch."""
    if not sizes:
        return []
    rows: list[Hypothesis] = [hypothesis]
    plan: list[tuple[Term, FloatArray, tuple[int, ...]]] = []
    for term, (full, amplitude_indices) in sizes:
        plan.append((term, full, amplitude_indices))
        for s in amplitude_indices:
            rows.append(
                hypothesis.with_term(term, _with_single_amplitude(full, amplitude_indices, s))
            )
    binned = bins(problem, segments)
    found = [binned.mean(r) for r in problem.residuals(rows, segments)]
    at, out = 1, []
    for term, start, amplitude_indices in plan:
        change = np.stack(
            [found[0] - found[at + k] for k in range(len(amplitude_indices))], axis=-1
        )
        at += len(amplitude_indices)
        if np.isfinite(change).all():
            out.append(Sensitivity(term, start, amplitude_indices, change.astype(np.float32)))
    return out


def _with_single_amplitude(
    full: FloatArray, amplitude_indices: tuple[int, ...], amplitude: int
) -> FloatArray:
    """Parameters with only one amplitude, the others zero."""
    alone = full.copy()
    alone[[k for k in amplitude_indices if k != amplitude]] = 0.0
    return alone


def sensitivities_around(
    linear: Linearization | None,
    problem: Problem,
    terms: Sequence[Term],
    segments: NDArray[np.int64],
    hypothesis: Hypothesis,
    residual: FloatArray,
) -> tuple[list[Sensitivity], FloatArray]:
    """First-order sensitivities of every candidate at a hypothesis.

    Args:
        linear: linearization around the hypothesis, or None.
        terms: candidates that the hypothesis lacks.
        residual: (samples, signals) residual of the hypothesis on the segments.

    Returns:
        The sensitivities, and the residual of the hypothesis, (bins, signals).
    """
    if linear is None:
        binned = bins(problem, segments).mean(residual)
        return simulated_sensitivities(problem, terms, segments, hypothesis, binned), binned
    return linear.sensitivities(terms), linear.residual(residual)


def linearize(
    problem: Problem, segments: NDArray[np.int64], hypothesis: Hypothesis
) -> Linearization | None:
    """The linearization around a hypothesis; None if the robot can touch a surface.

    The end of a search and the comparisons after it ask for the same one.
    """
    if problem.simulator.models.contact.world.size:
        return None
    linear, is_known = problem.cached(
        hypothesis, segments, lambda: Linearization(problem, hypothesis, segments)
    )
    if is_known:
        problem.count_trajectories(hypothesis, segments)
    return linear


class Linearization:
    """Linearization of a problem around one hypothesis, along the measured motion.

    Args:
        hypothesis: the hypothesis around which the prediction is linearized.
    """

    def __init__(
        self,
        problem: Problem,
        hypothesis: Hypothesis,
        segments: NDArray[np.int64],
    ) -> None:
        self.problem = problem
        self.simulator = problem.simulator
        self.segments = segments
        joints = len(problem.joints)
        self.own = add_fixed_effects(
            effect_values([hypothesis], joints, problem.scales), self.simulator.fixed, 1
        )
        self.trajectory: MeasuredTrajectory = measured_trajectory(problem, hypothesis, segments)
        active = sort_by_hook_order(self.own)
        self.rigid: RigidTerms = rigid_terms(self.simulator, self.trajectory, active)[0]
        self.efforts = InverseDynamics(self.simulator, self.trajectory)
        (self.own_effort,) = self.efforts.of(active, 1)
        self.laws = LawForces(self.simulator, self.trajectory, self.rigid)
        self.base: Forces = self.laws.forces(active, 1)
        predicted = LawForces(self.simulator, self.trajectory.predicted, self.rigid).forces(
            active, 1
        )
        self.dynamics: LinearizedDynamics = linearize_dynamics(
            self.simulator, self.trajectory, active, self.base, predicted,
            state_force_derivatives(self.simulator, self.trajectory, self.rigid, active),
        )  # fmt: skip
        self.bins = bins(problem, segments)
        self.readings = SensorReadings(problem, self.trajectory, self.dynamics, self.bins)
        self.starts = self._free_initial_states()
        self.readings.subtract_free_states(self.starts)
        self._sensitivities: dict[tuple[Term, ...], list[Sensitivity]] = {}

    def residual(self, residual: FloatArray) -> FloatArray:
        """Bin means (bins, signals) of a (samples, signals) residual.

        As in the sensitivities, positions are weighted, and the part that free initial states
        explain is subtracted.
        """
        joints = len(self.problem.joints)
        out, at = residual.copy(), 0
        for i, s in enumerate(self.segments):
            segment = self.simulator.segments[s]
            n = len(segment.time)
            if i in self.starts:
                error = self.starts[i].without_initial_error(
                    segment.position - self.trajectory.reading[i]
                )
                out[at : at + n, :joints] = error * self.problem.position_weights.get(int(s), 1.0)
            at += n
        return self.bins.mean(out)

    def _free_initial_states(self) -> dict[int, FreeInitialState]:
        """Free initial states of the segments, with their response by the linearized dynamics."""
        if self.problem.find_starts is None:
            return {}
        segments, samples, joints = self.trajectory.position.shape
        unit = np.tile(np.eye(2 * joints), (segments, 1, 1))
        none = np.zeros((segments, samples, joints, 2 * joints))
        state = self.dynamics.trajectory(none, unit)
        out = {}
        for i, s in enumerate(self.segments):
            segment = self.simulator.segments[s]
            free = count_free_states(segment)
            if free:
                response = self.readings.at_stamps(i, state[i, :, :joints, :free])
                response = response.reshape(-1, free)
                out[i] = free_initial_state(response, segment, self.problem.start_noise)
        return out

    # -- candidates

    def sensitivities(self, terms: Sequence[Term]) -> list[Sensitivity]:
        """Sensitivities of all candidates.

        Those of one effect are computed together, and so are those of all effects whose forces are
        evaluated step by step: each step has a fixed cost.

        Raises:
            OutOfTime: the time of the search is over.
        """
        check_deadline()
        by_effect: dict[str, list[Term]] = {}
        for term in sorted(terms, key=lambda t: t.effect):
            by_effect.setdefault(term.effect, []).append(term)
        cores = free_cores(self.simulator.threads)
        if cores > 1:
            self.precompute_rigid_efforts([
                EMPTY.with_term(t, start) for each in by_effect.values() for t in each
                for start, _ in starting_grid(t)
            ])  # fmt: skip
        groups = [tuple(each) for each in by_effect.values()]
        new = [g for g in groups if g not in self._sensitivities]
        batches = self._batches(new, cores)
        found = Forks(cores).map(self._compute_effects, batches)
        for batch, each in zip(batches, found, strict=True):
            self._sensitivities.update(zip(batch, each, strict=True))
        return [response for group in groups for response in self._sensitivities[group]]

    def _batches(self, groups: Sequence[_TermsOfEffect], cores: int) -> list[list[_TermsOfEffect]]:
        """Candidates of each effect, in batches that are computed together, slow ones first."""
        remembers = any(e.remembers for e, _ in sort_by_hook_order(self.own))
        stepwise = [g for g in groups if remembers or g[0].law.remembers]
        stepwise.sort(key=lambda g: g[0].law.overrides("gear"), reverse=True)
        together = [stepwise[i::cores] for i in range(min(cores, len(stepwise)))]
        return [*together, *([g] for g in groups if g not in stepwise)]

    def _compute_effects(self, groups: Sequence[_TermsOfEffect]) -> list[list[Sensitivity]]:
        """Sensitivities of each effect at several joints, at the sizes of its grid."""
        plans = [(terms, starting_grid(terms[0])) for terms in groups]
        return [
            self._compute_plan(terms, sizes, added)
            for (terms, sizes), added in zip(plans, self._added_forces(plans), strict=True)
        ]

    def _added_forces(
        self, plans: Sequence[tuple[Sequence[Term], Sizes]]
    ) -> list[tuple[FloatArray, FloatArray] | None]:
        """Changes of total force and drive effort by each effect, (rows, segments, samples, joints)
        each, N*m or N; None for an effect that changes neither.
        """
        joints, scales = len(self.problem.joints), self.problem.scales
        values, parts, count = dict[int, dict[str, FloatArray]](), dict[int, slice](), 0
        for k, (terms, sizes) in enumerate(plans):
            if terms[0].law.overrides(*_FORCE_HOOKS):
                rows = [
                    _with_single_amplitude(full, amplitude_indices, s)
                    for full, amplitude_indices in sizes
                    for s in amplitude_indices
                ]
                values[k] = self._values(terms[0].law, rows, terms)
                parts[k] = slice(count, count + len(rows))
                count += len(rows)
        if not parts:
            return [None] * len(plans)
        every = self._repeat_own_values(count)
        for k, part in parts.items():
            effect = plans[k][0][0].law
            absent = {p.name: absent_values(p, joints, scales) for p in effect.parameters}
            own = every.setdefault(
                effect.id, {name: np.tile(x, (count, 1)) for name, x in absent.items()}
            )
            for name, x in values[k].items():
                own[name][part] = x
        total, drive = self.laws.changes(
            sort_by_hook_order(every), count, sort_by_hook_order(self.own), self.base
        )
        return [
            (total[parts[k]], drive[parts[k]]) if k in parts else None for k in range(len(plans))
        ]

    def at_sizes(self, terms: Sequence[Term], sizes: Sizes) -> list[Sensitivity]:
        """Sensitivities of one effect at several joints, at given sizes."""
        return self._compute_plan(terms, sizes, *self._added_forces([(terms, sizes)]))

    def _compute_plan(
        self,
        terms: Sequence[Term],
        sizes: Sizes,
        added: tuple[FloatArray, FloatArray] | None,
    ) -> list[Sensitivity]:
        """As :meth:`at_sizes`, with the result of :meth:`_added_forces`."""
        out: list[Sensitivity] = []
        plan: list[tuple[Term, FloatArray, tuple[int, ...]]] = []
        columns: list[ReadingChange] = []
        for term, start, amplitude_indices, found in self._columns(terms, sizes, added):
            plan.append((term, start, amplitude_indices))
            columns += found
        changes = self.readings.bin_means(columns)
        at, seen = 0, set[tuple[Term, bytes]]()
        for term, start, amplitude_indices in plan:
            change = np.stack(changes[at : at + len(amplitude_indices)], axis=-1)
            at += len(amplitude_indices)
            # Forces that act longer than the recordings have the same response.
            same = term, sha256(change.tobytes()).digest()
            if np.isfinite(change).all() and change.any() and same not in seen:
                seen.add(same)
                out.append(Sensitivity(term, start, amplitude_indices, change))
        return out

    def _columns(
        self,
        terms: Sequence[Term],
        sizes: Sizes,
        added: tuple[FloatArray, FloatArray] | None,
    ) -> list[tuple[Term, FloatArray, tuple[int, ...], list[ReadingChange]]]:
        """Columns of one effect at several joints; all joints are computed at once."""
        effect = terms[0].law
        rows = [
            _with_single_amplitude(full, amplitude_indices, s)
            for full, amplitude_indices in sizes
            for s in amplitude_indices
        ]
        values = self._values(effect, rows, terms)
        joints = len(self.problem.joints)
        heavy = changes_bodies(effect, values, joints)
        masses: dict[int, list[FloatArray]] = {}
        if heavy:
            masses = self._rigid_forces(effect, rows, terms)
        out = []
        for term in terms:
            j = term.joint
            row = 0
            for full, amplitude_indices in sizes:
                columns = []
                for _ in amplitude_indices:
                    column = self._reading_change(effect, values, row, j)
                    if added is not None:
                        column.joint = None if j < 0 else j
                        column.force, column.drive = (
                            x[row] if j < 0 else x[row, ..., j] for x in added
                        )
                    if heavy:
                        column = column.at_all_joints(joints)
                        extra = masses[j][row]
                        column.force = extra if column.force is None else column.force + extra
                    columns.append(column)
                    row += 1
                out.append((term, full, amplitude_indices, columns))
        return out

    def _values(
        self, effect: Effect, rows: Sequence[FloatArray], terms: Sequence[Term]
    ) -> dict[str, FloatArray]:
        """Parameters of an effect, (rows, joints) each, SI units.

        Candidate joints have the sizes of the row, in addition to fixed effects; other joints have
        those of the hypothesis.
        """
        joints, scales = len(self.problem.joints), self.problem.scales
        out = {
            p.name: np.tile(absent_values(p, joints, scales), (len(rows), 1))
            for p in effect.parameters
        }
        for i, p in enumerate(effect.parameters):
            for term in terms:
                column = slice(None) if term.joint < 0 else slice(term.joint, term.joint + 1)
                out[p.name][:, column] = [[r[i] * scales.value(p, term.joint)] for r in rows]
        fixed = self.simulator.fixed.get(effect.id)
        if fixed is not None:
            out = dict(
                add_fixed_effects({effect.id: out}, {effect.id: fixed}, len(rows))[effect.id]
            )
        own = self.own.get(effect.id)
        if own is not None and all(term.joint >= 0 for term in terms):
            others = [j for j in range(joints) if j not in {term.joint for term in terms}]
            for name, array in out.items():
                array[:, others] = own[name][:, others]
        return out

    def _repeat_own_values(self, rows: int) -> dict[str, Values]:
        """The hypothesis's parameters, repeated for each row."""
        return {
            e: {n: np.repeat(x, rows, axis=0) for n, x in v.items()} for e, v in self.own.items()
        }

    def _rigid_forces(
        self, effect: Effect, rows: Sequence[FloatArray], terms: Sequence[Term]
    ) -> dict[int, list[FloatArray]]:
        """Joint -> row -> (segments, samples, joints) force from changed masses, N m or N."""
        samples = self.trajectory.position.shape[1]
        each = [self._values(effect, rows, [term]) for term in terms]
        values = {n: np.concatenate([e[n] for e in each]) for n in each[0]}
        copies = len(rows) * len(terms)
        active = sort_by_hook_order({**self._repeat_own_values(copies), effect.id: values})
        efforts = self.efforts.of(active, copies)
        forces = [-upsample(e - self.own_effort, self.rigid.at, samples) for e in efforts]
        return {
            term.joint: forces[i * len(rows) : (i + 1) * len(rows)] for i, term in enumerate(terms)
        }

    def _reading_change(
        self, effect: Effect, values: Values, row: int, joint: int
    ) -> ReadingChange:
        """Direct change of the readings, and of the initial state, by a sensor or clock effect."""
        if not _sensor_effects([(effect, values)]):
            return ReadingChange()
        direct, initial = self._readings_shifted_by(
            effect, {n: x[row : row + 1] for n, x in values.items()}, joint
        )
        fixed = self.simulator.fixed.get(effect.id)
        if fixed is not None:
            # The prediction already has what is fixed.
            known_direct, known_initial = self._readings_shifted_by(effect, fixed, joint)
            direct, initial = direct - known_direct, initial - known_initial
        return ReadingChange(initial=initial if initial.any() else None, direct=direct)

    def _readings_shifted_by(
        self, effect: Effect, of_row: Values, joint: int
    ) -> tuple[FloatArray, FloatArray]:
        """Change of the readings at a joint, and of the initial state, by a sensor or clock effect.

        Args:
            of_row: (1, joints) parameters.
        """
        direct = []
        for i, s in enumerate(self.segments):
            segment = self.simulator.segments[s]
            n = len(self.problem.joints)
            stamps = np.repeat(segment.time[None, :, None], n, axis=2)
            # The predicted motion, because the measured one already contains the sensor errors.
            position = self.trajectory.reading[i][None]
            velocity = self._interpolate(self.trajectory.predicted_velocity[i], i, stamps[0])[None]
            moved, _ = effect.sense(stamps, position, velocity, of_row)
            change = moved - position
            if effect.overrides("sample_time"):
                late = self.simulator.true_reading_times(
                    self.segments[i : i + 1], stamps, [(effect, of_row)]
                )
                grid_q = self.trajectory.predicted_position[i]
                change = (
                    change
                    + (
                        self._interpolate(grid_q, i, late[0])
                        - self._interpolate(grid_q, i, stamps[0])
                    )[None]
                )
            change = _only_at_joint(change[0], joint)
            if self.problem.effort_floor is not None and segment.effort is not None:
                measured = segment.effort[None]
                effort = effect.sense_effort(measured, of_row)[0] - segment.effort
                if effect.overrides("sample_time"):
                    effort = effort + self._effort_at(i, late[0]) - self.trajectory.effort[i]
                change = np.concatenate([change, _only_at_joint(effort, joint)], axis=1)
            direct.append(change)
        q0 = np.array([self.simulator.segments[s].initial_position for s in self.segments])
        v0 = np.array([self.simulator.segments[s].initial_velocity for s in self.segments])
        repeated = {n: np.repeat(x, len(q0), axis=0) for n, x in of_row.items()}
        q, v = effect.unsense(q0, v0, repeated)
        initial = np.concatenate(
            [_only_at_joint(q - q0, joint), _only_at_joint(v - v0, joint)], axis=1
        )
        return np.concatenate(direct), initial

    def _interpolate(self, values: FloatArray, i: int, stamps: FloatArray) -> FloatArray:
        """(samples, joints) values of segment ``i``, interpolated linearly at (stamps, joints)."""
        time = self.trajectory.time[i]
        return np.stack(
            [np.interp(stamps[:, j], time, values[:, j]) for j in range(values.shape[1])], axis=1
        )

    def _effort_at(self, i: int, taken: FloatArray) -> FloatArray:
        """(stamps, joints) predicted efforts of segment ``i`` at other times, N m or N.

        Args:
            i: index among the linearized segments.
            taken: (stamps, joints) times in s; efforts are interpolated linearly.
        """
        effort, stamps = self.trajectory.effort[i], self.simulator.segments[self.segments[i]].time
        own = np.repeat(stamps[None, :, None], effort.shape[1], axis=2)
        own = self.simulator.true_reading_times(
            self.segments[i : i + 1], own, _sensor_effects(sort_by_hook_order(self.own))
        )[0]
        return np.stack(
            [np.interp(taken[:, j], own[:, j], effort[:, j]) for j in range(effort.shape[1])],
            axis=1,
        )

    # -- whole hypotheses

    def precompute_rigid_efforts(self, hypotheses: Sequence[Hypothesis]) -> None:
        """Compute the rigid-body efforts of hypotheses once, before processes are forked."""
        joints = len(self.problem.joints)
        values = effect_values(hypotheses, joints, self.problem.scales)
        self.efforts.precompute_parts(
            [
                (e, v) for e, v in sort_by_hook_order(values)
                if changes_bodies(e, v, joints) and not changes_gravity(e, v, joints)
            ],
            len(hypotheses),
        )  # fmt: skip

    def differences(self, hypotheses: Sequence[Hypothesis]) -> list[FloatArray]:
        """Readings of each hypothesis minus those of the linearized one, (bins, signals).

        The forces of the laws are exact along the measured motion. Only the resulting deviations
        are linearized.
        """
        joints, copies = len(self.problem.joints), len(hypotheses)
        values = add_fixed_effects(
            effect_values(hypotheses, joints, self.problem.scales), self.simulator.fixed, copies
        )
        active = sort_by_hook_order(values)
        total, drive = self.laws.changes(active, copies, sort_by_hook_order(self.own), self.base)
        columns = [ReadingChange(total[k], drive[k]) for k in range(copies)]
        if any(changes_bodies(e, v, joints) for e, v in (*active, *sort_by_hook_order(self.own))):
            samples = self.trajectory.position.shape[1]
            efforts = self.efforts.of(active, copies)
            for column, effort in zip(columns, efforts, strict=True):
                assert column.force is not None
                column.force = column.force - upsample(
                    effort - self.own_effort, self.rigid.at, samples
                )
        base_reading, base_start = self._predicted_readings(
            _sensor_effects(sort_by_hook_order(self.own)), 0
        )
        sensing, known = _sensor_effects(active), dict[bytes, tuple[FloatArray, FloatArray]]()
        for k, column in enumerate(columns):
            # Few hypotheses differ in their sensor effects.
            key = b"".join(x[k].tobytes() for _, v in sensing for x in v.values())
            if key not in known:
                reading, start = self._predicted_readings(sensing, k)
                known[key] = reading - base_reading, start - base_start
            column.direct, column.initial = known[key]
        return self.readings.bin_means(columns)

    def _predicted_readings(self, active: ActiveEffects, row: int) -> tuple[FloatArray, FloatArray]:
        """Sensor readings of the predicted motion, and the true initial state.

        Args:
            active: sensor and clock effects, values (rows, joints).
            row: the row of their values.

        Returns:
            (stamps of all segments, signals) readings, and (segments, 2 joints) initial states.
        """
        of_row = [(e, {n: x[row : row + 1] for n, x in v.items()}) for e, v in active]
        n = len(self.problem.joints)
        out = []
        for i, s in enumerate(self.segments):
            segment = self.simulator.segments[s]
            stamps = np.repeat(segment.time[None, :, None], n, axis=2)
            stamps = self.simulator.true_reading_times(self.segments[i : i + 1], stamps, of_row)
            position = self._interpolate(self.trajectory.predicted_position[i], i, stamps[0])[None]
            velocity = self._interpolate(self.trajectory.predicted_velocity[i], i, stamps[0])[None]
            measured = segment.effort is not None and self.problem.effort_floor is not None
            effort = position
            if measured and segment.effort is not None:
                late = self._effort_at(i, stamps[0]) - self.trajectory.effort[i]
                effort = (segment.effort + late)[None]
            for effect, v in of_row:
                position, velocity = effect.sense(stamps, position, velocity, v)
                effort = effect.sense_effort(effort, v)
            signals = [position[0], effort[0]] if measured else [position[0]]
            out.append(np.concatenate(signals, axis=1))
        q = np.array([self.simulator.segments[s].initial_position for s in self.segments])
        v0 = np.array([self.simulator.segments[s].initial_velocity for s in self.segments])
        for effect, v in reversed(of_row):
            q, v0 = effect.unsense(q, v0, {k: np.repeat(x, len(q), axis=0) for k, x in v.items()})
        return np.concatenate(out), np.concatenate([q, v0], axis=1)


def _sensor_effects(active: ActiveEffects) -> ActiveEffects:
    """The effects that change sensor readings."""
    return [
        (e, v) for e, v in active
        if e.overrides("sense", "sense_effort", "sample_time", "unsense")
    ]  # fmt: skip


def _only_at_joint(values: FloatArray, joint: int) -> FloatArray:
    """(..., joints) values that are zero except at one joint; unchanged for the robot (-1)."""
    if joint < 0:
        return values
    out = np.zeros_like(values)
    out[..., joint] = values[..., joint]
    return out
