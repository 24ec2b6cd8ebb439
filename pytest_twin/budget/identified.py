"""What an identification leaves uncertain: forces, encoder zeros, delays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.budget.propagate import (
    Spread,
    first_order,
    normal_draws,
    root_of,
    sampled,
)
from pytest_twin.budget.task import Task
from pytest_twin.calibration.chain import ChainParameters, forward
from pytest_twin.calibration.tangent import Moving
from pytest_twin.formats.identification_record import IdentificationRecord
from pytest_twin.identification.regressor import Regressor, SharedMotor
from pytest_twin.realization import Realization
from pytest_twin.signals import NO_SIGNALS
from pytest_twin.twin import FitEntry

_DELAYS = ("command_delay", "sensor_delay")
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
