"""What an identification leaves uncertain, and how far that moves the task's frame.

A parameter of the inverse dynamics acts as a force: a robot whose parameters differ by ``d`` from
the model moves as the model does under the added force ``-Y d``, ``Y`` the regressor along the
motion. To first order that force is computed along the nominal motion, one replay for each column
of the covariance's root. The draws change damping, dry friction and armature in the simulator
itself, and add the force of the rest. Without commands to simulate there is no motion, and the
error of the static gravity effort is stated.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.budget.propagate import (
    Spread,
    angles,
    first_order,
    normal_draws,
    root_of,
    sampled,
    spread_of,
)
from pytest_twin.budget.task import Task
from pytest_twin.calibration.chain import ChainParameters, forward
from pytest_twin.calibration.tangent import Moving
from pytest_twin.errors import SimulationError
from pytest_twin.formats.identification_record import IdentificationRecord
from pytest_twin.identification.regressor import Regressor, SharedMotor
from pytest_twin.realization import Realization
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.replay import Replayed, Row, row_of
from pytest_twin.replay_forced import replay_forced
from pytest_twin.signals import NO_SIGNALS
from pytest_twin.trial import Trial
from pytest_twin.twin import FitEntry

DRAWS = 64
"""A power of two; each is a replay. Sobol points then hold a root mean square within 3 %."""
_STEP = 0.1
"""Standard deviations of a finite difference: small beside the curvature of dry friction."""
_DELAYS = ("command_delay", "sensor_delay")
_IN_SIMULATOR = {
    "armature": "dof_armature",
    "viscous_friction": "dof_damping",
    "coulomb_friction": "dof_frictionloss",
}
_ROUNDING = 1e-9
"""Share of the largest effort below which an effort is zero."""
_GRAVITY = frozenset({"m", "mx", "my", "mz"})


@dataclass(frozen=True)
class Identified:
    """Unknowns of one identification.

    Attributes:
        entry: the record in the twin.
        names: (p,) parameters that act as a force.
        covariance: (p, p) in their units.
        columns: (p,) their columns of the regressor.
        regressor: of the joints that were identified.
        zeros: joint of the chain -> standard deviation of its encoder's zero, rad or m.
        delays: joint of the chain -> standard deviation of its delay, s.
        left_out: what moves nothing here, and why.
    """

    entry: FitEntry
    names: tuple[str, ...]
    covariance: FloatArray
    columns: tuple[int, ...]
    regressor: Regressor
    zeros: dict[int, float]
    delays: dict[int, float]
    left_out: tuple[str, ...]


@dataclass(frozen=True)
class Moved:
    """What parameters do to a motion.

    Attributes:
        frame: to first order.
        drawn: by draws.
        joints: joint -> root mean square of its position, rad or m.
    """

    frame: Spread
    drawn: Spread
    joints: dict[str, float]


def identified(entry: FitEntry, task: Task, realization: Realization) -> Identified:
    """The parameters of an identification that move a task's frame."""
    record = entry.record
    structure = realization.structure
    joints = [name for name in _joints_of(record) if name in structure.joint_type]
    signals = NO_SIGNALS if realization.twin is None else realization.twin.signals
    shared = [
        SharedMotor(joint, own.joint, own.ratio)
        for joint in joints
        if (own := signals.of(joint).shared) is not None
    ]
    regressor = Regressor(realization, joints or task.chain.joints, shared)
    by_name = {column.name: at for at, column in enumerate(regressor.columns)}
    by_symbol = {column.symbol: at for at, column in enumerate(regressor.columns)}
    kept, columns, left_out = [], [], []
    zeros: dict[int, float] = {}
    delays: dict[int, float] = {}
    for at, name in enumerate(record.covariance_names):
        joint, _, effect = name.partition(".")
        column = by_name.get(name, by_symbol.get(name.split(" ")[0]))
        deviation = float(np.sqrt(max(record.covariance[at][at], 0.0)))
        if name not in record.values:
            left_out.append(f"{name}: the twin does not use it (its stage is not accepted)")
        elif column is not None:
            unit = regressor.columns[column].unit
            if record.units.get(name, unit) == unit:
                kept.append(at)
                columns.append(column)
            else:
                left_out.append(f"{name}: in {record.units[name]}, of which no torque is known")
        elif effect in _DELAYS and joint in task.chain.joints and task.velocity is not None:
            delays[task.chain.joints.index(joint)] = deviation
        elif effect == "encoder_bias" and joint in task.chain.joints:
            zeros[task.chain.joints.index(joint)] = deviation
        else:
            left_out.append(f"{name}: no rule carries it to the task; its uncertainty is stated")
    left_out += [
        f"{name}: stated without a covariance, and no motion of the robot rests on it"
        for name in record.values
        if name not in record.covariance_names
    ]
    matrix = np.reshape(record.covariance, (len(record.covariance_names),) * 2)
    return Identified(
        entry,
        tuple(record.covariance_names[at] for at in kept),
        matrix[np.ix_(kept, kept)],
        tuple(columns),
        regressor,
        zeros,
        delays,
        tuple(left_out),
    )


def _joints_of(record: IdentificationRecord) -> list[str]:
    """Joints in the order in which the record's symbols count them."""
    return list(record.held_out) or list(record.position_rms)


def displaced(found: Identified, task: Task) -> tuple[Spread, Spread] | None:
    """What encoder zeros and delays do to the frame, to first order and by draws.

    A delay moves each joint by its velocity times the delay. None where there are neither.
    """
    zeros, delays = found.zeros, found.delays
    if not zeros and not delays:
        return None
    count = len(task.chain.joints)
    none = np.zeros((len(task.readings), 0))
    columns = [np.ones(len(task.readings)) for _ in zeros]
    if delays:
        assert task.velocity is not None
        columns += [task.velocity[:, joint] for joint in delays]
    rates = np.column_stack([none, *columns])
    places = [*zeros, *delays]
    root = np.diag([*zeros.values(), *delays.values()])
    every = ChainParameters(count, np.zeros(count), tuple(range(count)))

    def at(step: FloatArray) -> Moving:
        readings = task.readings.copy()
        for k, joint in enumerate(places):
            readings[:, joint] += rates[:, k] * step[k]
        moving = forward(task.chain, readings, every)
        scale = task.chain.signs[places] * rates
        return Moving(
            moving.rotation,
            moving.position,
            moving.turn[:, :, places] * scale[:, None],
            moving.shift[:, :, places] * scale[:, None],
        )

    return first_order(at(np.zeros(len(places))), root), sampled(at, normal_draws(root))


def gravity_effort(found: Identified, task: Task) -> dict[str, float]:
    """Joint -> root mean square over the poses of its static effort's error, N*m or N."""
    joints = found.regressor.joints
    positions = np.zeros((len(task.readings), len(joints)))
    model = task.chain.signs * task.readings + task.chain.offsets
    for at, joint in enumerate(joints):
        if joint in task.chain.joints:
            positions[:, at] = model[:, task.chain.joints.index(joint)]
    still = np.zeros_like(positions)
    heavy = [k for k, c in enumerate(found.columns) if found.regressor.columns[c].kind in _GRAVITY]
    matrix = found.regressor.matrix(positions, still, still)
    slopes = matrix[:, :, [found.columns[k] for k in heavy]]
    root = root_of(found.covariance, found.entry.record.path)[heavy]
    rms = np.sqrt(np.sum((slopes @ root) ** 2, axis=2).mean(axis=0))
    # Gravity along a vertical axis leaves rounding alone.
    rms[rms < _ROUNDING * rms.max(initial=0.0)] = 0.0
    return dict(zip(joints, rms.tolist(), strict=True))


def moved(found: Identified, task: Task, realization: Realization) -> Moved:
    """How far the parameters move joints and frame along the task's motion.

    Raises:
        SimulationError: a replay diverged.
    """
    assert task.trial is not None
    return _Motion(found, task, realization, task.trial).moved()


class _Motion:
    """The nominal motion of a trial, and what changed parameters make of it."""

    def __init__(
        self, found: Identified, task: Task, realization: Realization, trial: Trial
    ) -> None:
        self.found, self.task, self.realization = found, task, realization
        self.row: Row = row_of(realization, trial)
        self.joints = trial.joints
        self.nominal = self._replay(self.row, lambda time: np.zeros(len(self.joints)))
        encoders = Encoders.of(calibration_of(realization), self.joints)
        self.position = encoders.model_position(self.nominal.position)
        self.velocity = encoders.signed(self.nominal.velocity)
        self.sign = encoders.sign
        self.effort = self._effort()

    def moved(self) -> Moved:
        root = root_of(self.found.covariance, self.found.entry.record.path)
        slopes = np.stack([self._response(column) for column in root.T], axis=2)
        rms = np.sqrt(np.sum(slopes**2, axis=2).mean(axis=0))
        moving = self._frame(self.nominal.position)
        model = self.sign[:, None] * slopes
        spread = _of_slopes(moving, model[:, self._on_chain()])
        draws = normal_draws(root, DRAWS)
        shift, turn = np.zeros((2, len(self.nominal.time)))
        for draw in draws:
            at = self._frame(self._drawn(draw).position)
            shift += np.sum((at.position - moving.position) ** 2, axis=1)
            turn += angles(at.rotation, moving.rotation) ** 2
        drawn = spread_of(shift / len(draws), turn / len(draws))
        return Moved(spread, drawn, dict(zip(self.joints, rms.tolist(), strict=True)))

    def _replay(self, row: Row, force: Callable[[float], FloatArray]) -> Replayed:
        done = replay_forced(row, lambda time, position, velocity: force(time))
        if done.error is not None:
            raise done.error
        if not np.isfinite(done.position).all():
            raise SimulationError(
                "the replay has no position at some stamps",
                path=self.row.source,
                where=self.row.trial.name,
                expected="a recording whose states and commands overlap",
            )
        return done

    def _effort(self) -> FloatArray:
        """(n, j, p) derivative of the joints' effort along the nominal motion."""
        own = self.found.regressor.joints
        n = len(self.nominal.time)
        values = np.zeros((3, n, len(own)))
        acceleration = np.gradient(self.velocity, self.nominal.time, axis=0)
        for at, joint in enumerate(own):
            if joint in self.joints:
                k = self.joints.index(joint)
                for row, series in enumerate((self.position, self.velocity, acceleration)):
                    values[row, :, at] = series[:, k]
        matrix = self.found.regressor.matrix(*values)[:, :, list(self.found.columns)]
        effort = np.zeros((n, len(self.joints), len(self.found.columns)))
        for at, joint in enumerate(own):
            if joint in self.joints:
                effort[:, self.joints.index(joint)] = matrix[:, at]
        return effort

    def _force(self, change: FloatArray) -> Callable[[float], FloatArray]:
        series = -(self.effort @ change)
        time = self.nominal.time

        def force(now: float) -> FloatArray:
            at = min(int(np.searchsorted(time, now, side="right")) - 1, len(time) - 1)
            return np.asarray(series[max(at, 0)])

        return force

    def _response(self, column: FloatArray) -> FloatArray:
        """(n, j) change of the positions by one standard deviation along a column of the root."""
        done = self._replay(self.row, self._force(_STEP * column))
        return np.asarray((done.position - self.nominal.position) / _STEP)

    def _drawn(self, draw: FloatArray) -> Replayed:
        """The motion with one draw: what the simulator has is changed there."""
        model = copy.copy(self.row.model)
        rest = draw.copy()
        for at, column in enumerate(self.found.columns):
            own = self.found.regressor.columns[column]
            field = _IN_SIMULATOR.get(own.kind)
            if field is None or own.joint not in self.realization.joints:
                continue
            dof = self.realization.joint_dof_index(own.joint)
            values = getattr(model, field)
            # A friction that a draw makes negative is none: it is left to the force.
            changed = values[dof] + draw[at]
            if changed >= 0.0:
                values[dof], rest[at] = changed, 0.0
        return self._replay(replace(self.row, model=model), self._force(rest))

    def _on_chain(self) -> list[int]:
        return [self.joints.index(j) for j in self.task.chain.joints if j in self.joints]

    def _frame(self, position: FloatArray) -> Moving:
        """The frame at positions (n, j) of the trial's joints, with derivatives by readings."""
        chain = self.task.chain
        readings = np.zeros((len(position), len(chain.joints)))
        columns: list[int] = []
        for at, joint in enumerate(chain.joints):
            here = joint in self.joints
            columns.append(sum(c >= 0 for c in columns) if here else -1)
            if here:
                readings[:, at] = position[:, self.joints.index(joint)]
        width = sum(c >= 0 for c in columns)
        none = ChainParameters(width, np.zeros(len(chain.joints)), tuple(columns))
        return forward(chain, readings, none)


def _of_slopes(moving: Moving, slopes: FloatArray) -> Spread:
    """Of (n, c, k) changes of the chain's joints by each column of the root."""
    shift = np.sum((moving.shift @ slopes) ** 2, axis=(1, 2))
    turn = np.sum((moving.turn @ slopes) ** 2, axis=(1, 2))
    return spread_of(shift, turn)
