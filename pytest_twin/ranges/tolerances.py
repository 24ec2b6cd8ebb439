"""Add declared manufacturing tolerances, which one measured robot cannot reveal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue, mjcf_fields
from pytest_twin.effects.base import si_unit
from pytest_twin.effects.sensing import EncoderBias
from pytest_twin.effects.timing import CommandDelay
from pytest_twin.ranges.bodies import AXES, Body, bodies_of
from pytest_twin.ranges.calibrated_zeros import encoder_zero
from pytest_twin.ranges.distribution import Coordinate, Source
from pytest_twin.ranges.identified_coordinates import RecordCoordinates, joint_coordinate
from pytest_twin.ranges_spec import Tolerance
from pytest_twin.realization import Realization
from pytest_twin.realization.patch import suggest
from pytest_twin.twin import Twin

_UNIFORM = np.sqrt(3.0)
"""Ratio of half width to standard deviation of a uniform distribution."""


def with_tolerances(
    found: RecordCoordinates, twin: Twin, realization: Realization
) -> RecordCoordinates:
    """Return the collected coordinates with declared tolerances added to the covariance.

    A tolerance is a uniform distribution of the stated half width, whose variance is added. A
    tolerance of a mass scales the whole inertia of the body.

    Raises:
        SpecError: the model lacks a parameter, or a relative tolerance refers to the value zero.
    """
    for at, tolerance in enumerate(twin.ranges.tolerances):
        where = f"ranges.tolerance.{at}"
        if tolerance.parameter.endswith(".mass"):
            found = _of_mass(found, tolerance, where, twin, realization)
        else:
            found = _of_parameter(found, tolerance, where, twin, realization)
    return found


def _of_mass(
    found: RecordCoordinates, tolerance: Tolerance, where: str, twin: Twin, realization: Realization
) -> RecordCoordinates:
    name = tolerance.parameter.removesuffix(".mass")
    bodies = {body.name: body for body in bodies_of(realization, _joints(realization))}
    if name not in bodies:
        raise twin.error(
            f"{where}.parameter",
            "no body of this name has a mass that a joint carries",
            value=name,
            expected=suggest(name, tuple(bodies)),
        )
    body = bodies[name]
    share = tolerance.half_width
    if not tolerance.is_relative:
        share /= float(body.rigid(np.zeros((1, len(AXES))))[0][0])
    std = share / _UNIFORM
    known = [one.name for one in found.coordinates]
    missing = [
        Coordinate(f"{name}.inertia.{axis}", "1", 0.0, 0.0, joint=body.joint, body=name, index=k)
        for k, axis in enumerate(AXES)
        if f"{name}.inertia.{axis}" not in known
    ]
    grown = _append_coordinates(
        found, missing, body if name not in {b.name for b in found.bodies} else None
    )
    places = [one.name for one in grown.coordinates]
    step = np.zeros(len(places))
    step[[places.index(f"{name}.inertia.{axis}") for axis in AXES]] = std * body.scaling
    return _add_covariance(grown, np.outer(step, step), tolerance.parameter)


def _of_parameter(
    found: RecordCoordinates, tolerance: Tolerance, where: str, twin: Twin, realization: Realization
) -> RecordCoordinates:
    names = [one.name for one in found.coordinates]
    if tolerance.parameter not in names:
        found = _append_coordinates(found, [_declared(tolerance, where, twin, realization)], None)
        names.append(tolerance.parameter)
    place = names.index(tolerance.parameter)
    std = tolerance.half_width / _UNIFORM
    if tolerance.is_relative:
        mean = found.coordinates[place].mean
        if mean == 0.0:
            raise twin.error(
                f"{where}.relative",
                "a relative tolerance of a value that is zero",
                value=tolerance.parameter,
                expected=f"absolute: half width in {found.coordinates[place].unit}",
            )
        std *= abs(mean)
    step = np.zeros(len(names))
    step[place] = std
    return _add_covariance(found, np.outer(step, step), tolerance.parameter)


def _declared(tolerance: Tolerance, where: str, twin: Twin, realization: Realization) -> Coordinate:
    """Return the coordinate of a parameter that no record has."""
    joint, _, kind = tolerance.parameter.rpartition(".")
    structure = realization.structure
    kinds = (*mjcf_fields(), CommandDelay.id, EncoderBias.id)
    if joint not in _joints(realization) or kind not in kinds:
        raise twin.error(
            f"{where}.parameter",
            "no such parameter",
            value=tolerance.parameter,
            expected=f"JOINT.KIND with a joint of the model and one of {', '.join(kinds)}, or "
            "BODY.mass",
        )
    slide = structure.joint_type[joint] == "slide"
    if kind in mjcf_fields():
        quantity = catalogue()[kind].parameters[0].quantity
        return joint_coordinate(realization, joint, kind, si_unit(quantity, slide))
    if kind == EncoderBias.id:
        return encoder_zero(joint, structure)
    return Coordinate(
        tolerance.parameter, "s", 0.0, 0.0, 0.0, joint=joint, effect=kind, parameter="delay"
    )


def _joints(realization: Realization) -> list[str]:
    return [name for name, kind in realization.structure.joint_type.items()
            if kind in ("hinge", "slide")]  # fmt: skip


def _append_coordinates(
    found: RecordCoordinates, more: Sequence[Coordinate], body: Body | None
) -> RecordCoordinates:
    before = len(found.coordinates)
    covariance: FloatArray = np.zeros((before + len(more),) * 2)
    covariance[:before, :before] = found.covariance
    return replace(
        found,
        coordinates=[*found.coordinates, *more],
        covariance=covariance,
        bodies=[*found.bodies, *([] if body is None else [body])],
    )


def _add_covariance(
    found: RecordCoordinates, covariance: FloatArray, name: str
) -> RecordCoordinates:
    std = np.sqrt(np.diag(covariance))
    return replace(
        found,
        coordinates=[
            one
            if own == 0.0
            else replace(one, sources=(*one.sources, Source("tolerance", name, float(own))))
            for one, own in zip(found.coordinates, std, strict=True)
        ],
        covariance=found.covariance + covariance,
    )
