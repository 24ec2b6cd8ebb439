"""Signs of columns that were mistaken for others: recorded twice, exchanged or reversed.

Without a model, these show only if the joints move differently. If they move alike, there is no
note.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.trial.trial import Trial
from pytest_twin.words import join_words

_MOVED = 0.02
"""rad or m. Standard deviation below which a joint does not show what it follows."""
_FEWEST = 50
"""Samples below which a correlation shows nothing."""
_AGAINST, _FOLLOWS, _UNRELATED = -0.8, 0.95, 0.6
"""Correlation below which a signal runs against another one, above which it follows it, and below
which it does not."""
_HARDLY, _GAINS, _OFFSET, _STEADY = 0.3, (0.7, 1.4), 0.3, 0.3
"""Correlation below which a joint hardly follows its command; factors with which drives follow;
median deviation, rad or m, beyond a deflection under load, and its relative spread if constant."""
_LEAST_GAIN = 0.3
"""Share of a command's motion. A drive that is commanded beyond its bandwidth also runs against its
commands, and follows less of them."""


def column_mistakes(trial: Trial) -> list[str]:
    """Return a note for each column that seems to be another joint's, or reversed."""
    if len(trial.time) < _FEWEST:
        return []
    notes = _repeated("positions", trial.joints, trial.position)
    notes += _repeated("commands", trial.command_joints, trial.command)
    sent = trial.setpoint.at(trial.time)
    position = np.full(sent.shape, np.nan)
    for column, joint in enumerate(trial.command_joints):
        if joint in trial.joints and trial.command_modes[column] == "position":
            position[:, column] = trial.position[:, trial.joints.index(joint)]
    mistaken = _mistaken("command", trial.command_joints, sent, position)
    notes += mistaken or _other_meaning(trial.command_joints, sent, position)
    if trial.velocity is not None:
        interval = np.diff(trial.time)[:, None]
        travelled = np.cumsum(0.5 * (trial.velocity[1:] + trial.velocity[:-1]) * interval, axis=0)
        notes += _mistaken("velocity", trial.joints, travelled, trial.position[1:])
    return notes


def _other_meaning(joints: Sequence[str], command: FloatArray, position: FloatArray) -> list[str]:
    """Notes on position commands, (n, joints), that are not where the positions are."""
    notes = []
    for joint, sent, seen in zip(joints, command.T, position.T, strict=True):
        if not np.isfinite(sent).all() or not np.isfinite(seen).all() or seen.std() < _MOVED:
            continue
        if sent.std() == 0.0:
            continue
        related = float(np.corrcoef(seen, sent)[0, 1])
        factor = related * float(seen.std() / sent.std())
        offset = seen - sent
        middle = float(np.median(offset))
        words = ""
        if abs(related) < _HARDLY:
            words = (
                f"hardly follows its position command (correlation {related:.2f}): commands of "
                "another motion, increments, or another clock"
            )
        elif related > _FOLLOWS and not _GAINS[0] < factor < _GAINS[1]:
            words = f"follows {factor:.3g} times its position command: another unit, or a gear"
        elif abs(middle) > _OFFSET and offset.std() < _STEADY * abs(middle):
            words = f"is {middle:.3g} away from its position command throughout: another zero"
        if words:
            notes.append(f"the position of {joint!r} {words}?")
    return notes


def _repeated(what: str, joints: Sequence[str], values: FloatArray) -> list[str]:
    """Notes on joints that move by the same numbers."""
    notes = []
    for first in range(len(joints)):
        same = [
            joints[other]
            for other in range(first + 1, len(joints))
            if np.array_equal(values[:, first], values[:, other], equal_nan=True)
        ]
        if same and np.nanstd(values[:, first]) > _MOVED:
            notes.append(
                f"the {what} of {join_words([joints[first], *same])} are the same numbers in every "
                "message: unless the joints are coupled, one column was recorded twice"
            )
            break
    return notes


def _mistaken(
    what: str, joints: Sequence[str], given: FloatArray, position: FloatArray
) -> list[str]:
    """Notes on positions that do not follow what is ``given`` for them, (n, joints) rad or m."""
    known = np.isfinite(given).all(axis=0) & np.isfinite(position).all(axis=0)
    spread, travel = given.std(axis=0), position.std(axis=0)
    columns = np.flatnonzero(known & (spread > _MOVED) & (travel > _MOVED))
    if not len(columns):
        return []
    names = [joints[column] for column in columns.tolist()]
    related = np.corrcoef(position[:, columns].T, given[:, columns].T)
    related = np.atleast_2d(related[: len(columns), len(columns) :])
    notes = []
    for row, joint in enumerate(names):
        own, best = float(related[row, row]), int(np.argmax(related[row]))
        gain = float(travel[columns[row]] / spread[columns[row]])
        if own < _AGAINST and gain > _LEAST_GAIN:
            notes.append(
                f"the position of {joint!r} runs against its {what} (correlation {own:.2f}): the "
                "sign of one of them seems to be reversed; move the joint by hand and look"
            )
        elif related[row, best] > _FOLLOWS and own < _UNRELATED:
            notes.append(
                f"the position of {joint!r} follows the {what} of {names[best]!r} (correlation "
                f"{related[row, best]:.2f}; its own {own:.2f}): names or columns seem to be "
                "exchanged; --joints or --columns says which is which"
            )
        elif what == "velocity" and own > _FOLLOWS and not _GAINS[0] < gain < _GAINS[1]:
            notes.append(
                f"the position of {joint!r} moves {gain:.3g} times as far as its velocity says: "
                "they are in different units (degrees, rpm, encoder counts), or one is before the "
                "gear; convert the velocity, or leave it out"
            )
    return notes
