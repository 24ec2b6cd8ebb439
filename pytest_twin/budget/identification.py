"""Uncertain parameters of an identification: forces, shifts of joint positions, and effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.budget.effect_parameters import EffectParameter, effect_parameter
from pytest_twin.budget.propagate import (
    Spread,
    first_order,
    normal_draws,
    root_of,
    sample_displacement,
)
from pytest_twin.budget.shifts import NO_RULE, Shift, shift_of
from pytest_twin.budget.task import Task
from pytest_twin.calibration.chain import ChainParameters, forward
from pytest_twin.calibration.transform_derivatives import TransformWithJacobian
from pytest_twin.diagnosis.patched.model import read_patched_model
from pytest_twin.formats.identification_record import IdentificationRecord
from pytest_twin.identification.regressor import Regressor, SharedMotor
from pytest_twin.realization import Realization
from pytest_twin.realization.ideal_sensors import load_at
from pytest_twin.signals import NO_SIGNALS
from pytest_twin.twin import FitEntry

_ROUNDING = 1e-9
"""Fraction of the largest effort below which an effort is zero."""
_GRAVITY = frozenset({"m", "mx", "my", "mz"})


@dataclass(frozen=True)
class IdentifiedParameters:
    """Unknowns of one identification.

    Attributes:
        entry: the record in the twin.
        names: (f + s + e,) parameters: first those that act as a force, then those that shift a
            joint, then those of effects.
        covariance: (f + s + e, f + s + e) covariance, in their units.
        columns: (f,) columns of the forces in the regressor.
        regressor: regressor of the identified joints.
        shifts: (s,) shifts of joints by delays, encoder zeros, gears and gains.
        effects: (e,) parameters of effects beside the MJCF; they move the frame in replays only.
        left_out: parameters that do not move the frame, with the reason.
    """

    entry: FitEntry
    names: tuple[str, ...]
    covariance: FloatArray
    columns: tuple[int, ...]
    regressor: Regressor
    shifts: tuple[Shift, ...]
    effects: tuple[EffectParameter, ...]
    left_out: tuple[str, ...]

    @property
    def forces(self) -> FloatArray:
        """(f, f) covariance of the parameters that act as a force."""
        count = len(self.columns)
        return self.covariance[:count, :count]


def identified_parameters(
    entry: FitEntry, task: Task, realization: Realization
) -> IdentifiedParameters:
    """Return the parameters of an identification that move a task's frame."""
    record = entry.record
    regressor = regressor_of(record, realization, task.chain.joints)
    column_of = columns_of(record, regressor)
    kept, columns, shifting, shifts, left_out = [], [], [], [], []
    acting, effects = [], []
    patched = read_patched_model(realization)
    for at, name in enumerate(record.covariance_names):
        joint = name.partition(".")[0]
        rule = shift_of(name, record, realization) if joint in task.chain.joints else NO_RULE
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
        elif isinstance(rule, Shift) and rule.of_pose.by == "velocity" and task.velocity is None:
            left_out.append(f"{name}: no speed is known; budget: recordings: gives it")
        elif isinstance(rule, Shift):
            shifting.append(at)
            shifts.append(rule)
        elif (own := effect_parameter(name, realization, patched)) is None or own.is_in_mjcf:
            left_out.append(f"{name}: {rule}")
        elif task.trial is None:
            left_out.append(f"{name}: no motion is known; budget: recordings: gives one")
        else:
            acting.append(at)
            effects.append(own)
    left_out += [
        f"{name}: stated without a covariance, and no motion of the robot depends on it"
        for name in record.values
        if name not in record.covariance_names
    ]
    matrix = np.reshape(record.covariance, (len(record.covariance_names),) * 2)
    kept += [*shifting, *acting]
    return IdentifiedParameters(
        entry,
        tuple(record.covariance_names[at] for at in kept),
        matrix[np.ix_(kept, kept)],
        tuple(columns),
        regressor,
        tuple(shifts),
        tuple(effects),
        tuple(left_out),
    )


def regressor_of(
    record: IdentificationRecord, realization: Realization, otherwise: Sequence[str]
) -> Regressor:
    """Return the regressor of a record's joints, or of ``otherwise`` if it names none."""
    structure = realization.structure
    joints = [name for name in _joints_of(record) if name in structure.joint_type]
    signals = NO_SIGNALS if realization.twin is None else realization.twin.recordings.signals
    shared = [
        SharedMotor(joint, own.joint, own.ratio)
        for joint in joints
        if (own := signals.of(joint).shared) is not None
    ]
    return Regressor(realization, joints or otherwise, shared)


def columns_of(record: IdentificationRecord, regressor: Regressor) -> dict[str, int]:
    """Return parameter of a record -> column of the regressor.

    A base parameter multiplies the column of its first term; the columns of the other terms depend
    linearly on it.
    """
    by_name = {column.name: at for at, column in enumerate(regressor.columns)}
    # Symbols number the joints of the record; with a joint left out the numbers would differ.
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
    """Return the joints in the order in which the record's symbols number them."""
    return list(record.held_out) or list(record.position_rms)


def displacement_by_shifts(
    found: IdentifiedParameters, task: Task, realization: Realization
) -> tuple[Spread, Spread] | None:
    """Return the frame's displacement by joint shifts, to first order and by draws, or None.

    The load of a gear or a servo is the gravity effort of the links at each pose.
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
                if shift.of_pose.by in ("load", "side")
                else still[:, at],
            )
            for shift, at in pairs
        ]
    )
    own = slice(len(found.columns), len(found.columns) + len(found.shifts))
    root = root_of(found.covariance[own, own], found.entry.record.path)
    every = ChainParameters(count, np.zeros(count), tuple(range(count)))

    def at(step: FloatArray) -> TransformWithJacobian:
        readings = task.readings.copy()
        for k, joint in enumerate(places):
            readings[:, joint] += rates[:, k] * step[k]
        moving = forward(task.chain, readings, every)
        scale = (task.chain.signs[places] * rates)[:, None]
        turn, shift = moving.turn[:, :, places] * scale, moving.shift[:, :, places] * scale
        return TransformWithJacobian(moving.rotation, moving.position, turn, shift)

    return first_order(at(np.zeros(len(places))), root), sample_displacement(at, normal_draws(root))


def gravity_effort(found: IdentifiedParameters, task: Task) -> dict[str, float]:
    """Return joint -> RMS error of its static effort over the poses, N*m or N."""
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
    # Gravity about a vertical axis is zero up to rounding.
    rms[rms < _ROUNDING * rms.max(initial=0.0)] = 0.0
    return dict(zip(joints, rms.tolist(), strict=True))
