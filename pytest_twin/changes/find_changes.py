"""Find what changed in a robot between two sets of recordings with measured effort."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.changes.background import Rows
from pytest_twin.changes.comparison import Comparison, compare
from pytest_twin.changes.effort_units import refuse_contradicted, refuse_other_unit
from pytest_twin.changes.recordings import (
    FEWEST_SESSIONS,
    Compared,
    at_one_rate,
    in_parts,
    sessions_of,
)
from pytest_twin.changes.scatter import INDEPENDENT
from pytest_twin.changes.tool_load import is_tool_load, with_tool_load
from pytest_twin.errors import RecordingError, SpecError, TwinError
from pytest_twin.identification.effort.law_columns import EffortLaws, Shape
from pytest_twin.identification.effort.laws_along import LawsAlong, band_of, rms_of
from pytest_twin.realization import Realization


@dataclass(frozen=True)
class Changes:
    """What changed between two sets of recordings.

    Attributes:
        laws: the laws of the catalogue that efforts show.
        rows: all recordings: earlier, later, held out.
        comparison: score, threshold and changes.
        before, new, held_out: their indices among ``rows``.
        sessions: how earlier sessions were distinguished, such as ``8 recordings``.
        removed: share of the squared held-out residual that the changes remove; None without one.
        notes: one line each.
    """

    laws: EffortLaws
    rows: Rows
    comparison: Comparison
    before: tuple[int, ...]
    new: tuple[int, ...]
    held_out: tuple[int, ...]
    sessions: str
    removed: float | None
    notes: tuple[str, ...]


def find_changes(realization: Realization, compared: Compared, level: float) -> Changes:
    """Compare later recordings with earlier ones by measured effort.

    Args:
        level: probability of an alarm if nothing changed, such as 0.05.

    Raises:
        RecordingError: the efforts of the new recordings have another unit.
    """
    notes = list(compared.notes)
    refuse_contradicted(realization, compared.before)
    before = list(compared.before)
    sessions, words = sessions_of(before)
    if len(sessions) < FEWEST_SESSIONS:
        before = in_parts(before)
        sessions, words = [[i] for i in range(len(before))], f"{len(before)} parts of recordings"
        notes.append(
            f"fewer than {FEWEST_SESSIONS} earlier recordings: they are compared in parts, which "
            "share their conditions, so alarms are more frequent than the level; record more"
        )
    every = at_one_rate([*before, *compared.new, *compared.held_out])
    before = every[: len(before)]
    along = LawsAlong.of(realization, before, band_of(every))
    laws = along.laws
    parts, shapes, count = with_tool_load(laws, along.rows(every))
    known = np.isfinite(np.concatenate([part.effort for part in parts])).any(axis=0)
    size = np.where(known, rms_of([one.effort for one in before]), 1.0)
    rows = Rows.of(
        parts, size, count, largest_changes(laws, shapes, count), not_negative(shapes, count)
    )
    first, last = len(before), len(before) + len(compared.new)
    refuse_other_unit(rows, range(first, last), size)
    _refuse_short(rows, sessions, shapes)
    later, _ = sessions_of(compared.new)
    comparison = compare(
        rows, sessions, [[first + i for i in own] for own in later], shapes, level,
        motors_of(realization, laws.joints),
    )  # fmt: skip
    notes += extrapolation_notes(comparison, laws.joints, level)
    lost = [
        j
        for j, rms, effort in zip(laws.joints, comparison.usual, size, strict=True)
        if rms >= effort
    ]
    if lost:
        notes.append(
            f"the earlier recordings do not predict each other at {', '.join(lost)}: no change is "
            "named there; record motions that repeat"
        )
    notes += unlike_notes(comparison, laws.joints)
    held_out = range(last, len(every))
    return Changes(
        laws, rows, comparison, tuple(range(first)), tuple(range(first, last)), tuple(held_out),
        words, _removed(rows, comparison, held_out), tuple(dict.fromkeys(notes)),
    )  # fmt: skip


def largest_changes(laws: EffortLaws, shapes: Sequence[Shape], count: int) -> FloatArray:
    """(columns,) largest possible change of each amplitude, SI units.

    Both values of a changed amplitude lie within the bounds of the catalogue. A column that several
    laws share has the widest.
    """
    largest = np.zeros(count)
    for shape in shapes:
        if is_tool_load(shape):
            largest[shape.indices] = np.inf
            continue
        for k, column in shape.columns.items():
            p = shape.term.parameters[k]
            width = (p.upper - p.lower) * laws.scales.value(p, max(shape.term.joint, 0))
            largest[column] = max(largest[column], width)
    return largest


def not_negative(shapes: Sequence[Shape], count: int) -> NDArray[np.bool_]:
    """(columns,) whether no law that has the amplitude admits a negative value of it."""
    positive, any_sign = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    for shape in shapes:
        if is_tool_load(shape):
            any_sign[shape.indices] = True
            continue
        for k, column in shape.columns.items():
            p = shape.term.parameters[k]
            (positive if p.lower == p.neutral else any_sign)[column] = True
    return positive & ~any_sign


def extrapolation_notes(comparison: Comparison, joints: Sequence[str], level: float) -> list[str]:
    """A line if the earlier recordings predict the new motion less well than their own."""
    usual_level = comparison.null.threshold(level)
    if comparison.threshold <= usual_level:
        return []
    joint = int(comparison.uncertainty.argmax())
    return [
        f"the earlier recordings predict the new motion of {joints[joint]} "
        f"{np.sqrt(comparison.uncertainty[joint]):.1f} times less precisely than their own: the "
        f"alarm level is {comparison.threshold:.1f} instead of {usual_level:.1f}; repeat an "
        "earlier motion"
    ]


def unlike_notes(comparison: Comparison, joints: Sequence[str]) -> list[str]:
    """A line if the new recordings have a part that no law describes and that is new."""
    unlike = [joint for joint, new in zip(joints, comparison.unlike, strict=True) if new]
    if not unlike:
        return []
    return [
        f"what no law describes has grown at {', '.join(unlike)}: something changed there that the "
        "catalogue lacks"
    ]


def motors_of(realization: Realization, joints: Sequence[str]) -> dict[str, list[int]]:
    """Motor type -> indices of its joints among those of the recordings.

    Raises:
        SpecError: ``motors:`` of the twin names a joint that the model lacks.
    """
    twin = realization.twin
    motors: dict[str, list[int]] = {}
    if twin is None:
        return motors
    path = twin.path
    for motor, names in twin.motors.items():
        where = f"motors.{motor}"
        try:
            for name in names:
                realization.joint_index(name)
        except TwinError as error:
            raise SpecError(f"{error}", path=path, where=where) from error
        motors[motor] = [joints.index(name) for name in names if name in joints]
    return motors


def _refuse_short(rows: Rows, sessions: Sequence[Sequence[int]], shapes: Sequence[Shape]) -> None:
    """Refuse earlier sessions with fewer independent values than a joint has laws."""
    laws = max(Counter(term.joint for term in {shape.term for shape in shapes}).values())
    needed = int(np.ceil(laws / INDEPENDENT))
    for session in sessions:
        samples = max(sums.samples for sums in rows.sums_of(session))
        if samples < needed:
            recording = rows.parts[session[0]].recording
            seconds = sum(float(rows.parts[i].recording.time[-1]) for i in session)
            raise RecordingError(
                "too short for what is usual: a joint has more laws than independent values here",
                path=recording.path,
                where=f"{seconds:.2g} s from {recording.start:.3g} s",
                value=f"{samples} rows after filtering, {laws} laws",
                expected=f"{needed} rows or more in each earlier recording or part, about "
                f"{seconds * needed / samples:.2g} s",
            )


def _removed(rows: Rows, comparison: Comparison, held_out: range) -> float | None:
    """Share of the squared held-out residual that the changes remove, all joints alike."""
    if not held_out or not comparison.changes:
        return None
    mean = comparison.background.mean
    changed = mean.copy()
    for change in comparison.changes:
        changed[change.shape.indices] += change.value
    without, with_changes = (
        np.concatenate(rows.residuals(held_out, amplitudes)) for amplitudes in (mean, changed)
    )
    weight = 1.0 / comparison.usual**2
    return 1.0 - float((with_changes**2).mean(axis=0) @ weight) / float(
        (without**2).mean(axis=0) @ weight
    )
