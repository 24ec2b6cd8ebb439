"""Read all observations of a plan from its tables and recordings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.coincident_markers import ExcludedMeasurement
from pytest_twin.calibration.observations import Observations, load_observations
from pytest_twin.calibration.plan import Plan
from pytest_twin.calibration.recordings.extract import extract, write_table

TABLE = "observations.csv"


@dataclass(frozen=True)
class GatheredObservations:
    """Observations in the files of a plan.

    Attributes:
        observations: observations of all files, concatenated.
        tables: CSV files of the observations; those of recordings were written here.
    """

    observations: Observations
    left_out: tuple[ExcludedMeasurement, ...]
    tables: tuple[Path, ...]


def gather(plan: Plan, folder: Path) -> GatheredObservations:
    """Read the observations of a plan.

    Args:
        plan: plan that names the files.
        folder: folder for tables and images of recordings; each recording has its own subfolder.

    Raises:
        TwinError: a file cannot be used.
    """
    parts: list[Observations] = []
    left_out: list[ExcludedMeasurement] = []
    tables: list[Path] = []
    for number, path in enumerate(plan.observations):
        notes: tuple[str, ...] = ()
        table = path
        if path.suffix.lower() != ".csv":
            place = folder / f"{number}_{path.name.split('.')[0]}"
            found = extract(plan, path, place)
            table = place / TABLE
            write_table(found.rows, table)
            left_out += found.left_out
            notes = found.notes
        one = load_observations(table)
        if one.images is not None and (table is not path or len(plan.observations) > 1):
            images = tuple(str(table.parent / image) if image else "" for image in one.images)
            one = replace(one, images=images)
        parts.append(replace(one, notes=(*one.notes, *notes)))
        tables.append(table)
    return GatheredObservations(concatenate(parts), tuple(left_out), tuple(tables))


def concatenate(parts: Sequence[Observations]) -> Observations:
    """Concatenate the observations of several tables.

    Ids that occur in several tables get the table's number as prefix.
    """
    if len(parts) == 1:
        return parts[0]
    ids = Counter(name for part in parts for name in part.ids)
    sizes = [len(part) for part in parts]

    def numbers(take: Callable[[Observations], FloatArray | None], shape: tuple[int, ...]):  # type: ignore[no-untyped-def]
        found = [take(part) for part in parts]
        if all(one is None for one in found):
            return None
        return np.concatenate(
            [
                np.full((size, *shape), np.nan) if one is None else one
                for one, size in zip(found, sizes, strict=True)
            ]
        )

    def words(take: Callable[[Observations], tuple[str, ...] | None]) -> tuple[str, ...] | None:
        found = [take(part) for part in parts]
        if all(one is None for one in found):
            return None
        return tuple(
            word for one, size in zip(found, sizes, strict=True) for word in (one or ("",) * size)
        )

    joints = dict.fromkeys(name for part in parts for name in part.joints)
    points = dict.fromkeys(name for part in parts for name in part.points)
    return Observations(
        ids=tuple(
            name if ids[name] == 1 else f"{number}/{name}"
            for number, part in enumerate(parts)
            for name in part.ids
        ),
        time=numbers(lambda part: part.time, ()),
        joints={n: numbers(lambda part, n=n: part.joints.get(n), ()) for n in joints},  # type: ignore[misc]
        flange=numbers(lambda part: part.flange, (4, 4)),
        camera_from_target=numbers(lambda part: part.camera_from_target, (4, 4)),
        points={n: numbers(lambda part, n=n: part.points.get(n), (3,)) for n in points},  # type: ignore[misc]
        images=words(lambda part: part.images),
        pivots=words(lambda part: part.pivots),
        payloads=words(lambda part: part.payloads),
        poses=words(lambda part: part.poses),
        approaches=words(lambda part: part.approaches),
        notes=tuple(dict.fromkeys(note for part in parts for note in part.notes)),
    )
