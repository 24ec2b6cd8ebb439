"""What an identification leaves uncertain: forces, and what shifts a joint along its way."""

from __future__ import annotations

from collections.abc import Sequence
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
from pytest_twin.budget.shifts import DELAYS, NO_RULE, Shift, shift_of
from pytest_twin.budget.task import Task
from pytest_twin.calibration.chain import ChainParameters, forward
from pytest_twin.calibration.tangent import Moving
from pytest_twin.formats.identification_record import IdentificationRecord
from pytest_twin.identification.regressor import Regressor, SharedMotor
from pytest_twin.realization import Realization
from pytest_twin.realization.sensed import load_at
from pytest_twin.signals import NO_SIGNALS
from pytest_twin.twin import FitEntry

_ROUNDING = 1e-9
"""Share of the largest effort below which an effort is zero."""
_GRAVITY = frozenset({"m", "mx", "my", "mz"})


@dataclass(frozen=True)
class Identified:
    """Unknowns of one identification.

    Attributes:
        entry: the record in the twin.
        names: (f + s,) parameters: those that act as a force, then those that shift a joint.
        covariance: (f + s, f + s) in their units.
        columns: (f,) their columns of the regressor.
        regressor: of the joints that were identified.
        shifts: (s,) what delays, encoder zeros, gears and gains do to their joints.
        left_out: what moves nothing here, and why.
    """

    entry: FitEntry
    names: tuple[str, ...]
    covariance: FloatArray
    columns: tuple[int, ...]
    regressor: Regressor
    shifts: tuple[Shift, ...]
    left_out: tuple[str, ...]

    @property
    def forces(self) -> FloatArray:
        """(f, f) covariance of what acts as a force."""
        count = len(self.columns)
        return self.covariance[:count, :count]


def identified(entry: FitEntry, task: Task, realization: Realization) -> Identified:
    """The parameters of an identification that move a task's frame."""
    record = entry.record
    regressor = regressor_of(record, realization, task.chain.joints)
    column_of = columns_of(record, regressor)
    kept, columns, shifting, shifts, left_out = [], [], [], [], []
    for at, name in enumerate(record.covariance_names):
        joint, _, effect = name.partition(".")
        rule = (
            shift_of(name, record.values.get(name, 0.0), record.units.get(name, ""), realization)
            if joint in task.chain.joints
            else NO_RULE
        )
        column = column_of.get(name)
        if name not in record.values:
            left_out.append(f"{name}: the twin does not use it (its stage is not accepted)")
        elif column is not None:
            unit = regressor.columns[column].unit
            if record.units.get(name, unit) == unit:
                kept.append(at)
                columns.append(column)
            else:
                left_out.append(f"{name}: in {record.units[name]}, of which no torque is known")
        elif effect in DELAYS and joint in task.chain.joints and task.velocity is None:
            left_out.append(f"{name}: no speed is known; budget: recordings: gives it")
        elif isinstance(rule, Shift):
            shifting.append(at)
            shifts.append(rule)
        else:
            left_out.append(f"{name}: {rule}")
    left_out += [
        f"{name}: stated without a covariance, and no motion of the robot depends on it"
        for name in record.values
        if name not in record.covariance_names
    ]
    matrix = np.reshape(record.covariance, (len(record.covariance_names),) * 2)
    kept += shifting
    return Identified(
        entry,
        tuple(record.covariance_names[at] for at in kept),
        matrix[np.ix_(kept, kept)],
        tuple(columns),
        regressor,
        tuple(shifts),
        tuple(left_out),
    )


def regressor_of(
    record: IdentificationRecord, realization: Realization, otherwise: Sequence[str]
) -> Regressor:
    """The regressor of the joints that a record identified; of ``otherwise`` where it has none."""
    structure = realization.structure
    joints = [name for name in _joints_of(record) if name in structure.joint_type]
    signals = NO_SIGNALS if realization.twin is None else realization.twin.signals
    shared = [
        SharedMotor(joint, own.joint, own.ratio)
        for joint in joints
        if (own := signals.of(joint).shared) is not None
    ]
    return Regressor(realization, joints or otherwise, shared)


def columns_of(record: IdentificationRecord, regressor: Regressor) -> dict[str, int]:
    """Parameter of a record -> the column of the regressor that it multiplies.

    A base parameter multiplies the column of its first term; those of the other terms depend on it.
    """
    by_name = {column.name: at for at, column in enumerate(regressor.columns)}
    # Symbols count the joints of the record; with one left out they would count others.
    own = _joints_of(record)
    counted = not record.without_effort and len(own) in (0, len(regressor.joints))
    by_symbol = {column.symbol: at for at, column in enumerate(regressor.columns) if counted}
    found = {}
    for name in record.covariance_names:
        column = by_name.get(name, by_symbol.get(name.split(" ")[0]))
        if column is not None:
            found[name] = column
    return found


def _joints_of(record: IdentificationRecord) -> list[str]:
    """Joints in the order in which the record's symbols count them."""
    return list(record.held_out) or list(record.position_rms)


def displaced(
    found: Identified, task: Task, realization: Realization
) -> tuple[Spread, Spread] | None:
    """What shifts joints does to the frame, to first order and by draws; None where nothing does.

    The load of a gear or a servo is the gravity of the links at each pose.
    """
    if not found.shifts:
        return None
    count = len(task.chain.joints)
    places = [task.chain.joints.index(one.joint) for one in found.shifts]
    velocity = np.zeros_like(task.readings) if task.velocity is None else task.velocity
    pairs = zip(found.shifts, places, strict=True)
    position = task.chain.signs * task.readings + task.chain.offsets
    still = np.zeros_like(position)
    rates = np.column_stack(
        [
            shift.rate(
                velocity[:, at],
                task.chain.signs[at]
                * load_at(
                    realization, shift.joint, tuple(task.chain.joints), position, still, still
                )[:, 0]
                if shift.by in ("load", "side")
                else still[:, at],
            )
            for shift, at in pairs
        ]
    )
    forces = len(found.columns)
    root = root_of(found.covariance[forces:, forces:], found.entry.record.path)
    every = ChainParameters(count, np.zeros(count), tuple(range(count)))

    def at(step: FloatArray) -> Moving:
        readings = task.readings.copy()
        for k, joint in enumerate(places):
            readings[:, joint] += rates[:, k] * step[k]
        moving = forward(task.chain, readings, every)
        scale = (task.chain.signs[places] * rates)[:, None]
        turn, shift = moving.turn[:, :, places] * scale, moving.shift[:, :, places] * scale
        return Moving(moving.rotation, moving.position, turn, shift)

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
    root = root_of(found.forces, found.entry.record.path)[heavy]
    rms = np.sqrt(np.sum((slopes @ root) ** 2, axis=2).mean(axis=0))
    # Gravity along a vertical axis leaves rounding alone.
    rms[rms < _ROUNDING * rms.max(initial=0.0)] = 0.0
    return dict(zip(joints, rms.tolist(), strict=True))
