"""Build the joint distribution of a twin's uncertain parameters from its records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import linalg

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.errors import SpecError
from pytest_twin.ranges.bodies import Body
from pytest_twin.ranges.calibrated_zeros import zeros_of
from pytest_twin.ranges.distribution import Coordinate, Distribution, Source, distribution_of
from pytest_twin.ranges.drive_limits import with_bounded_sums, with_passive_joints
from pytest_twin.ranges.identified_coordinates import RecordCoordinates, coordinates_of_record
from pytest_twin.ranges.tolerances import with_tolerances
from pytest_twin.ranges.trials import spread_over_trials
from pytest_twin.realization import Realization
from pytest_twin.twin import Twin

_SMALLEST = 1e-9
"""Smallest standard deviation, as a fraction of the largest with the same unit. Smaller ones are
rounding errors."""


@dataclass(frozen=True)
class UncertainParameters:
    """Parameters that vary between robots.

    Attributes:
        distribution: joint distribution of all coordinates.
        records: kind, id and file of the source records.
        left_out: parameters of records that are not varied, with the reason.
    """

    distribution: Distribution
    bodies: tuple[Body, ...]
    records: tuple[dict[str, str], ...]
    left_out: tuple[str, ...]
    notes: tuple[str, ...]


def collect_uncertain_parameters(
    twin: Twin, realization: Realization, patched: PatchedModel | None
) -> UncertainParameters:
    """Collect uncertain parameters from the records, trials and tolerances of a twin.

    Raises:
        SpecError: the twin has no record, or no parameter of its records varies.
        FormatError: a covariance is missing, zero or invalid.
    """
    parts, records = _of_records(twin, realization, patched)
    if not records and not twin.ranges.trials and not twin.ranges.tolerances:
        raise SpecError(
            "no record states an uncertainty of this twin",
            path=twin.path,
            where="fit",
            expected="identification.json under fit:, or calibration.json under calibrations:; "
            "pytest-twin identify and pytest-twin calibrate write them",
        )
    whole = _combine_records(parts)
    notes: list[str] = []
    whole = spread_over_trials(whole, twin, notes)
    whole = with_tolerances(whole, twin, realization)
    distribution = distribution_of(whole.coordinates, whole.covariance, floor=_SMALLEST)
    if not len(distribution):
        raise SpecError(
            "nothing of this twin's records varies: their covariances are zero",
            path=twin.path,
            where="fit",
            expected="records whose parameters have standard deviations",
        )
    distribution = with_passive_joints(distribution, realization, patched, notes)
    distribution = with_bounded_sums(distribution, patched)
    moving = {one.body for one in distribution.coordinates}
    return UncertainParameters(
        distribution,
        tuple(body for body in whole.bodies if body.name in moving),
        tuple(records),
        tuple(whole.left_out),
        tuple(notes),
    )


def _of_records(
    twin: Twin, realization: Realization, patched: PatchedModel | None
) -> tuple[list[RecordCoordinates], list[dict[str, str]]]:
    """Collect each valid record, the newest first; parameters of later records take precedence."""
    superseded = {name for entry in twin.calibrations for name in entry.supersedes}
    superseded |= {name for fit in twin.fits for name in fit.supersedes}
    parts: list[RecordCoordinates] = []
    records: list[dict[str, str]] = []
    for fit in reversed(twin.fits):
        if fit.record.id not in superseded:
            found = coordinates_of_record(fit.record, realization, patched)
            parts.append(_without(found, parts))
            records.append(_record("identification", fit.record.id, fit.record.path, twin))
    taken: set[str] = set()
    for entry in reversed(twin.calibrations):
        if entry.record.id not in superseded and entry.record.covariance_names:
            found = zeros_of(entry, realization.structure, taken)
            taken |= set(entry.record.joint_zeros)
            parts.append(_without(found, parts))
            records.append(_record("calibration", entry.record.id, entry.record.path, twin))
    return parts, records


def _record(kind: str, ident: str, path: Path, twin: Twin) -> dict[str, str]:
    root = twin.root.resolve()
    place = path.resolve()
    inside = place.is_relative_to(root)
    return {"kind": kind, "id": ident,
            "file": str(place.relative_to(root) if inside else place)}  # fmt: skip


def _without(found: RecordCoordinates, later: Sequence[RecordCoordinates]) -> RecordCoordinates:
    """Remove coordinates that a later record has; a body belongs to one record only."""
    known = {one.name for part in later for one in part.coordinates}
    bodies = {body.name for part in later for body in part.bodies}
    keep = [
        k for k, one in enumerate(found.coordinates)
        if one.name not in known and one.body not in bodies
    ]  # fmt: skip
    lost = {one.body or one.name for k, one in enumerate(found.coordinates) if k not in keep}
    return replace(
        found,
        coordinates=[found.coordinates[k] for k in keep],
        covariance=found.covariance[np.ix_(keep, keep)],
        bodies=[body for body in found.bodies if body.name not in bodies],
        left_out=[*found.left_out, *(f"{name}: a later record has it" for name in sorted(lost))],
    )


def _combine_records(parts: Sequence[RecordCoordinates]) -> RecordCoordinates:
    """Combine all records as independent."""
    covariance: FloatArray = linalg.block_diag(*(part.covariance for part in parts))
    coordinates: list[Coordinate] = []
    for part in parts:
        std = np.sqrt(np.diag(part.covariance).clip(0.0))
        coordinates += [
            replace(one, sources=(Source("covariance", part.name, float(own)),))
            for one, own in zip(part.coordinates, std, strict=True)
        ]
    size = len(coordinates)
    return RecordCoordinates(
        "together",
        coordinates,
        np.reshape(covariance, (size, size)) if size else np.zeros((0, 0)),
        [body for part in parts for body in part.bodies],
        [line for part in parts for line in part.left_out],
    )
