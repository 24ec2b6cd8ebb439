"""Uncertainty of identified parameters as coordinates of a randomization."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.budget.effect_parameters import effect_parameter
from pytest_twin.budget.identification import columns_of, regressor_of
from pytest_twin.budget.propagate import root_of
from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.effects import catalogue, mjcf_fields
from pytest_twin.errors import FormatError
from pytest_twin.formats.identification_record import IdentificationRecord
from pytest_twin.identification.regressor import Regressor
from pytest_twin.ranges.bodies import AXES, COUNT, Body, bodies_of
from pytest_twin.ranges.distribution import Coordinate
from pytest_twin.realization import Realization
from pytest_twin.realization.inverse_dynamics import INERTIAL

_INSTANTS = 60
"""Number of random joint states of the regressor."""
_RANK = 1e-8
"""Fraction of the largest singular value below which a motion does not excite a combination."""
_SEED = 57
"""Seed of these states, so that ranges can be repeated."""


@dataclass
class RecordCoordinates:
    """Uncertain coordinates of one record.

    Attributes:
        coordinates: (p,) coordinates; their field ``std`` is 0, the covariance has the variances.
        covariance: (p, p) covariance.
        left_out: parameters that are not varied, with the reason.
    """

    name: str
    coordinates: list[Coordinate]
    covariance: FloatArray
    bodies: list[Body] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)


def coordinates_of_record(
    record: IdentificationRecord, realization: Realization, patched: PatchedModel | None
) -> RecordCoordinates:
    """Return the coordinates of an identification, with means from the twin's model.

    Friction and armature are varied directly. Inertial base parameters are combinations of
    parameters of several bodies. The bodies are varied by the smallest change of their coordinates
    (see :mod:`pytest_twin.ranges.bodies`) that causes the same efforts in every motion. Parameters
    that no motion determines keep their values.

    Raises:
        FormatError: the covariance is missing, zero or invalid.
    """
    names = record.covariance_names
    matrix = np.reshape(record.covariance, (len(names),) * 2)
    _refuse_unusable(record, matrix)
    joints = list(realization.structure.joint_type)
    regressor = regressor_of(record, realization, joints)
    columns = columns_of(record, regressor)
    found = RecordCoordinates(record.id, [], np.zeros((0, 0)))
    rows: list[FloatArray] = []
    inertial: list[int] = []
    for at, name in enumerate(names):
        if name not in record.values:
            found.left_out.append(f"{name}: its stage is not accepted")
            continue
        if not matrix[at, at]:
            found.left_out.append(f"{name}: its recordings do not determine it, it keeps its value")
            continue
        column = columns.get(name)
        if column is not None and regressor.columns[column].is_inertial:
            inertial.append(at)
            continue
        coordinate = _coordinate(record, name, column, regressor, realization, patched, found)
        if coordinate is not None:
            found.coordinates.append(coordinate)
            rows.append(np.eye(len(names))[at])
    if inertial:
        bodies, change = _bodies_for(
            realization, regressor, [columns[names[at]] for at in inertial]
        )
        found.bodies = bodies
        for k, body in enumerate(bodies):
            for index in range(COUNT):
                own = change[COUNT * k + index]
                row = np.zeros(len(names))
                row[inertial] = own
                rows.append(row)
                found.coordinates.append(
                    Coordinate(
                        f"{body.name}.inertia.{AXES[index]}", "1", 0.0, 0.0,
                        joint=body.joint, body=body.name, index=index,
                    )
                )  # fmt: skip
    whole = np.array(rows).reshape(len(rows), len(names))
    found.covariance = whole @ matrix @ whole.T
    return found


def _refuse_unusable(record: IdentificationRecord, matrix: FloatArray) -> None:
    if not len(matrix):
        raise FormatError(
            "it has no covariance",
            path=record.path,
            where="covariance",
            expected="a record of pytest-twin identify, which states one",
        )
    root_of(matrix, record.path)


def _coordinate(
    record: IdentificationRecord,
    name: str,
    column: int | None,
    regressor: Regressor,
    realization: Realization,
    patched: PatchedModel | None,
    found: RecordCoordinates,
) -> Coordinate | None:
    """Return the coordinate of a drive parameter or effect; None if it is not varied."""
    if column is not None:
        own = regressor.columns[column]
        if record.units.get(name, own.unit) != own.unit:
            found.left_out.append(f"{name}: in {record.units[name]}, of which no torque is known")
            return None
        law = catalogue().get(own.kind)
        if law is None or law.mjcf_field or law.needs_effort_sensor:
            return _of_joint(realization, own.joint, own.kind, own.unit, name, found)
    place, _, rest = name.partition(".")
    effect, _, _ = rest.partition(".")
    joint = None if place == "robot" else place
    if effect not in catalogue():
        found.left_out.append(f"{name}: no rule of the simulation takes it")
        return None
    own_effect = effect_parameter(name, realization, patched)
    if own_effect is None:
        found.left_out.append(f"{name}: the twin's first realization does not have this effect")
        return None
    relative = own_effect.law.relation == "relative"
    return Coordinate(
        name,
        record.units.get(name, "1"),
        1.0 + own_effect.value if relative else own_effect.value,
        0.0,
        own_effect.lower,
        own_effect.upper,
        joint=joint,
        effect=effect,
        parameter=own_effect.law.name,
        is_relative=relative,
    )


def _of_joint(
    realization: Realization, joint: str, kind: str, unit: str, name: str, found: RecordCoordinates
) -> Coordinate | None:
    if kind not in mjcf_fields():
        found.left_out.append(f"{name}: the twin's model has no such parameter")
        return None
    return joint_coordinate(realization, joint, kind, unit)


def joint_coordinate(realization: Realization, joint: str, kind: str, unit: str) -> Coordinate:
    """Return the coordinate of friction or armature of a joint, with the model's value as mean.

    Args:
        kind: effect whose parameter is added to a field of the model.
    """
    field_name = mjcf_fields()[kind]
    stated = float(
        getattr(realization.model, f"dof_{field_name}")[realization.joint_dof_index(joint)]
    )
    return Coordinate(f"{joint}.{kind}", unit, stated, 0.0, 0.0, joint=joint, field=field_name)


def _bodies_for(
    realization: Realization, regressor: Regressor, columns: Sequence[int]
) -> tuple[list[Body], FloatArray]:
    """Return bodies, and (10 bodies, k) changes of their coordinates per unit of each column."""
    bodies = bodies_of(realization, regressor.joints)
    inertial = [at for at, one in enumerate(regressor.columns) if one.is_inertial]
    place = {(regressor.columns[at].joint, regressor.columns[at].kind): k
             for k, at in enumerate(inertial)}  # fmt: skip
    efforts = _efforts(regressor)[:, inertial]
    change = np.zeros((len(inertial), COUNT * len(bodies)))
    for k, body in enumerate(bodies):
        rows = [place[body.joint, kind] for kind in INERTIAL]
        change[rows, COUNT * k : COUNT * (k + 1)] = body.slope()
    unit = np.zeros((len(inertial), len(columns)))
    for k, column in enumerate(columns):
        unit[inertial.index(column), k] = 1.0
    # The rows are reduced to the combinations that the motion excites.
    _, values, vectors = np.linalg.svd(efforts, full_matrices=False)
    shown = (values[:, None] * vectors)[values > _RANK * values[0]]
    found = np.linalg.pinv(shown @ change, rcond=_RANK) @ (shown @ unit)
    return bodies, np.asarray(found)


def _efforts(regressor: Regressor) -> FloatArray:
    """(rows, p) regressor at random joint states, which excite all combinations."""
    random = np.random.default_rng(_SEED)
    count = len(regressor.joints)
    position, velocity, acceleration = random.uniform(-1.0, 1.0, (3, _INSTANTS, count))
    matrix = regressor.matrix(np.pi * position, 2.0 * velocity, 10.0 * acceleration)
    return np.asarray(matrix.reshape(-1, matrix.shape[2]))
