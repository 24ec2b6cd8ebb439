"""Simulate many varied robots under the commands of recordings."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.delays import effects_outside_mjcf, without_delays
from pytest_twin.diagnosis.patched.model import AppliedEffect, PatchedModel
from pytest_twin.diagnosis.patched.replay import fixed_values, whole_segment
from pytest_twin.diagnosis.problem import REFINE, add_step_error, step_error
from pytest_twin.diagnosis.temperature import cold_fraction_of_trial
from pytest_twin.effects import catalogue
from pytest_twin.effects.actuation import TorqueSaturation
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Predicted, Segment
from pytest_twin.effects.sensing import EncoderBias
from pytest_twin.effects.transmission import JointSpring
from pytest_twin.errors import LimitError
from pytest_twin.ranges.bodies import Body, write_bodies
from pytest_twin.ranges.distribution import Coordinate
from pytest_twin.realization import Realization
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.realization.inputs import JOINT_TRANSMISSIONS
from pytest_twin.time_limit import skips
from pytest_twin.trial import Trial
from pytest_twin.words import counted

ROWS = 64
"""Largest number of robots in one batch. A time limit or a stop ends the simulation between two."""
_BATCH_SHARE = 0.25
"""Fraction of the child process's memory for one batch."""
_BATCH_ARRAYS = 12
"""Arrays of doubles, for all steps and joints of a robot, that a batch holds: motion, commands and
copies. Measured: 6 to 8, with and without effects between steps, for 5,000 and 20,000 steps."""
_TRACE_SHARE = 1 / 32
"""Fraction of the memory for the traces of all robots in single precision. Quantiles and ranks need
about ten arrays of that size in double precision."""
_FEWEST_SAMPLES = 64
"""Smallest number of compared samples of a recording. Neighbouring samples are correlated: the
coverage of a recording has the information of tens of independent ones."""

_NO_LIMIT = 1e-12
"""Reciprocal of an effort limit, 1/(N*m) or 1/N, below which a drive has none."""

Values = dict[str, dict[str, FloatArray]]


@dataclass(frozen=True)
class Traces:
    """Measured and simulated traces of one recording.

    Attributes:
        joints: (j,) names of the joints.
        time: (n,) s; evenly chosen from the recording's stamps if all do not fit in memory.
        measured: (n, j) measured positions, rad or m.
        robots: (robots, n, j) simulated positions without sensor noise, in single precision; NaN if
            the simulation diverged.
        slides: prismatic joints, in m.
    """

    trial: Trial
    joints: tuple[str, ...]
    time: FloatArray
    measured: FloatArray
    robots: NDArray[np.float32]
    slides: frozenset[str] = frozenset()


class VariedRobots:
    """Simulation of robots with different coordinates.

    Args:
        patched: effects added by a diagnosis or an identification, if any.
        coordinates: (p,) coordinates in which robots differ.
        memory_bytes: memory for the traces of all robots.
    """

    def __init__(
        self,
        realization: Realization,
        patched: PatchedModel | None,
        coordinates: Sequence[Coordinate],
        bodies: Sequence[Body],
        memory_bytes: int,
    ) -> None:
        self.realization, self.patched = realization, patched
        self._stepped = without_delays(realization)
        self._outside_mjcf = effects_outside_mjcf(realization, patched)
        self.coordinates, self.bodies = tuple(coordinates), tuple(bodies)
        self._memory_bytes = memory_bytes
        self.steps = 0
        """Number of engine steps so far, over all robots."""
        self.seconds = 0.0
        """Wall-clock time of these steps, s."""

    def joints_of(self, trial: Trial) -> tuple[str, ...]:
        """Return the joints whose motion is predicted."""
        return trial.joints if self.patched is None else self.patched.joints

    def carrying(self, joint: str) -> list[str]:
        """Return a joint and the joints that carry its link."""
        model = self.realization.model
        body = int(model.jnt_bodyid[model.joint(joint).id])
        found: list[str] = []
        while body > 0:
            first = int(model.body_jntadr[body])
            here = range(first, first + int(model.body_jntnum[body]))
            found += [str(model.joint(index).name) for index in here]
            body = int(model.body_parentid[body])
        return found

    def simulate(
        self,
        trials: Sequence[Trial],
        draws: FloatArray,
        progress: Callable[[float], None] = lambda done: None,
    ) -> list[Traces]:
        """Simulate every trial for every robot.

        At the time limit, trials without a robot are left out, and robots that some of the others
        lack.

        Args:
            trials: trials, of which only commands and initial states are used.
            draws: (robots, p) values of the coordinates.
            progress: called with the fraction done.

        Raises:
            LimitError: not even the fewest samples fit in memory.
        """
        counts = self.sample_counts(trials, len(draws))
        found: list[Traces] = []
        for done, (trial, count) in enumerate(zip(trials, counts, strict=True)):

            def report(fraction: float, done: int = done) -> None:
                progress((done + fraction) / len(trials))

            if skips(f"the robots of {trial.name}"):
                continue
            found.append(self._one(trial, draws, count, report))
        common = min((len(one.robots) for one in found), default=0)
        return [replace(one, robots=one.robots[:common]) for one in found]

    def sample_counts(self, trials: Sequence[Trial], robots: int) -> list[int]:
        """Return the number of samples of each trial that are compared: as many as fit in memory.

        Raises:
            LimitError: not even the fewest samples fit.
        """
        most_values = int(_TRACE_SHARE * self._memory_bytes // 4)
        columns = [len(self.joints_of(trial)) for trial in trials]
        whole = sum(len(t.time) * c for t, c in zip(trials, columns, strict=True))
        fraction = min(1.0, most_values / (robots * whole))
        counts = [
            min(len(t.time), max(_FEWEST_SAMPLES, int(fraction * len(t.time)))) for t in trials
        ]
        needed = sum(n * c for n, c in zip(counts, columns, strict=True))
        if fraction < 1.0 and robots * needed > 2 * most_values:
            raise LimitError(
                "the traces of so many robots do not fit in memory",
                path=trials[0].path,
                where="draws",
                value=robots,
                expected=f"at most {2 * most_values // needed} for "
                f"{counted(len(trials), 'recording')}",
            )
        return counts

    def _one(
        self, trial: Trial, draws: FloatArray, count: int, progress: Callable[[float], None]
    ) -> Traces:
        joints = self.joints_of(trial)
        cold = (
            1.0
            if self.patched is None
            else cold_fraction_of_trial(self.patched.cold_fractions, trial)
        )
        has_friction_creep = self.patched is None or self.patched.has_friction_creep
        segment = whole_segment(
            self._stepped, trial, joints, cold, has_friction_creep=has_friction_creep
        )
        encoders = Encoders.of(calibration_of(self.realization), joints)
        shift = self._correction(segment, joints)
        count = min(count, len(segment.time))
        chosen = np.linspace(0, len(segment.time) - 1, count).round().astype(np.int64)
        robots = np.empty((len(draws), count, len(joints)), dtype=np.float32)
        started = time.perf_counter()
        for rows, predicted in self._chunks(segment, joints, draws):
            for row, one in zip(rows, predicted, strict=True):
                robots[row] = encoders.read_position(one.position[chosen] + shift[chosen])
            progress(rows.stop / len(draws))
            if rows.stop < len(draws) and skips(f"more robots of {trial.name}"):
                robots = robots[: rows.stop]
                break
        self.seconds += time.perf_counter() - started
        measured = encoders.read_position(segment.position[chosen])
        kinds = self.realization.structure.joint_type
        slides = frozenset(joint for joint in joints if kinds[joint] == "slide")
        return Traces(trial, joints, segment.time[chosen], measured, robots, slides)

    def _chunks(
        self, segment: Segment, joints: Sequence[str], draws: FloatArray
    ) -> Iterator[tuple[range, list[Predicted]]]:
        refine = self.patched.substeps if self.patched is not None and self.patched.substeps else 1
        timestep = float(segment.model.opt.timestep) / refine
        steps = (segment.time[-1] - segment.start) / timestep + 2
        of_robot = 8 * _BATCH_ARRAYS * steps * len(joints)
        in_batch = int(np.clip(_BATCH_SHARE * self._memory_bytes // of_robot, 1, ROWS))
        for begin in range(0, len(draws), in_batch):
            rows = range(begin, min(begin + in_batch, len(draws)))
            own = draws[rows.start : rows.stop]
            models = self._models(segment.model, own)
            segments = [replace(segment, model=model) for model in models]
            simulator = BatchSimulator(segments, joints, refine=refine)
            predicted = simulator.simulate(np.arange(len(own)), self._values(own, joints))
            self.steps += simulator.simulated_steps
            yield rows, predicted

    def _correction(self, segment: Segment, joints: Sequence[str]) -> FloatArray:
        """(n, j) time-step error, which the replay of a patched model subtracts, rad or m."""
        if self.patched is None or self.patched.substeps:
            return np.zeros_like(segment.position)
        values = fixed_values(self._outside_mjcf, joints, 1)
        coarse, fine = (
            BatchSimulator([segment], joints, refine=refine).simulate(
                np.zeros(1, dtype=int), values
            )[0]
            for refine in (1, REFINE)
        )
        if not (np.isfinite(fine.position).all() and np.isfinite(coarse.position).all()):
            return np.zeros_like(segment.position)
        return add_step_error(coarse, step_error(coarse, fine)).position - coarse.position

    def _models(self, model: mujoco.MjModel, draws: FloatArray) -> list[mujoco.MjModel]:
        """Return a model for each robot, with the constants that depend on its values."""
        models = [copy.copy(model) for _ in draws]
        for column, one in enumerate(self.coordinates):
            if one.field is not None and one.joint is not None:
                dof = self.realization.joint_dof_index(one.joint)
                for changed, value in zip(models, draws[:, column], strict=True):
                    getattr(changed, f"dof_{one.field}")[dof] = value
            elif one.effect == TorqueSaturation.id and self._written(one) is not None:
                self._limit_efforts(models, one, draws[:, column])
        for body in self.bodies:
            columns = [k for k, c in enumerate(self.coordinates) if c.body == body.name]
            x = np.zeros((len(draws), 10))
            x[:, [self.coordinates[k].index for k in columns]] = draws[:, columns]
            write_bodies(models, body, x)
        # A batch of several models computes these constants, a batch of one does not.
        data = mujoco.MjData(model)
        for changed in models:
            mujoco.mj_setConst(changed, data)
        return models

    def _limit_efforts(
        self, models: Sequence[mujoco.MjModel], one: Coordinate, inverse: FloatArray
    ) -> None:
        """Write the effort limit of each robot: the model contains the twin's own.

        An end of a range that is narrower than the twin's limit belongs to the nominal model. It
        stays where the robot's limit is wider.
        """
        written = self._written(one)
        assert written is not None
        model = models[0]
        for actuator in range(model.nactuator):
            joint = int(model.actuator_trnid[actuator, 0])
            is_drive = int(model.actuator_trntype[actuator]) in JOINT_TRANSMISSIONS
            if not (is_drive and model.joint(joint).name == one.joint):
                continue
            gear = abs(float(model.actuator_gear[model.actuator_outadr[actuator], 0]))
            ends = model.actuator_forcerange[actuator].copy()
            of_twin = 1.0 / (written.values["inverse_limit"] * gear)
            is_limit = np.isclose(np.abs(ends), of_twin, rtol=1e-6)
            for changed, value in zip(models, inverse, strict=True):
                limit = 1.0 / (max(value, _NO_LIMIT) * gear)
                own = np.where(is_limit, np.sign(ends) * limit, np.clip(ends, -limit, limit))
                changed.actuator_forcerange[actuator] = own

    def _values(self, draws: FloatArray, joints: Sequence[str]) -> Values:
        """Return effect parameters, (robots, joints) each: values of the twin plus variations."""
        rows = len(draws)
        values: Values = {
            effect: {name: np.array(v) for name, v in own.items()}
            for effect, own in fixed_values(self._outside_mjcf, joints, rows).items()
        }
        for column, one in enumerate(self.coordinates):
            if one.effect is None or one.parameter is None:
                continue
            if one.effect == TorqueSaturation.id and self._written(one) is not None:
                continue
            place: slice | list[int] = slice(None)
            if one.joint is not None:
                if one.joint not in joints:
                    continue
                place = [list(joints).index(one.joint)]
            self._put(values, one, draws[:, column], place, len(joints))
        return values

    def _put(
        self,
        values: Values,
        one: Coordinate,
        drawn: FloatArray,
        place: slice | list[int],
        joints: int,
    ) -> None:
        assert one.effect is not None
        assert one.parameter is not None
        law = catalogue()[one.effect]
        rows = len(drawn)
        if one.effect not in values:
            values[one.effect] = {
                p.name: np.full((rows, joints), p.absent_value) for p in law.parameters
            }
            if one.effect == EncoderBias.id:
                # The servo controls the encoder reading.
                values[one.effect]["in_loop"][:] = 1.0
        array = values[one.effect][one.parameter]
        written = self._written(one)
        if one.is_relative:
            array[:, place] = (drawn / (1.0 + written.values[one.parameter]) - 1.0
                               if written else drawn - 1.0)[:, None]  # fmt: skip
        elif written is not None:
            # The model contains the twin's value, so the effect adds the difference.
            more = drawn - written.values[one.parameter]
            array[:, place] = more[:, None]
            if (one.effect, one.parameter) == (JointSpring.id, "stiffness"):
                # The model turns a preload into an angle of rest, at which the difference acts too.
                values[one.effect]["preload"][:, place] -= (more * self._rest(one))[:, None]
        elif one.is_deviation:
            array[:, place] += drawn[:, None]
        else:
            array[:, place] = drawn[:, None]

    def _rest(self, one: Coordinate) -> float:
        """Return the position at which the model's spring of a joint is at rest, rad or m."""
        assert one.joint is not None
        return float(
            self.realization.model.qpos_spring[self.realization.joint_qpos_index(one.joint)]
        )

    def _written(self, one: Coordinate) -> AppliedEffect | None:
        """Return the effect if the simulated model contains it in its fields, else None."""
        if self.patched is None:
            return None
        beside = {(e.effect, e.joint) for e in self._outside_mjcf}
        for effect in self.patched.effects:
            if (effect.effect, effect.joint) == (one.effect, one.joint) and effect.is_in_mjcf:
                return None if (one.effect, one.joint) in beside else effect
        return None
