"""Split recordings into those to fit and those that test the fit: whole ones, never samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from pytest_twin.errors import RecordingError
from pytest_twin.trial.roles import HELD_OUT

ONE_HELD_OUT_OF = 4
"""One recording of so many is held out if no role is given."""
NOTHING_HELD_OUT = (
    "nothing is held out: no result can be accepted; make a second recording and name it with "
    "--held-out"
)
_Recording = TypeVar("_Recording")


def split_by_role(
    recordings: Sequence[_Recording],
    held_out: Sequence[_Recording],
    role_of: Callable[[_Recording], str | None],
    path_of: Callable[[_Recording], Path],
    notes: list[str],
    is_named: bool,
) -> tuple[list[_Recording], list[_Recording]]:
    """Return the recordings to fit, and the held-out ones.

    ``held_out`` decides if a person named some, else the roles of the recordings; else the last of
    every four recordings is held out.

    Args:
        recordings: those that are not named as held out.
        held_out: those that are.
        role_of, path_of: role in the metadata, and file, of a recording.
        notes: list to which a line on the choice is added.
        is_named: whether a person named held-out recordings, of which some may be unusable.

    Raises:
        RecordingError: there is none to fit.
    """
    fit, aside = list(recordings), list(held_out)
    if not is_named:
        aside = [one for one in fit if role_of(one) == HELD_OUT]
        if not aside and len(fit) > 1:
            aside = fit[-max(1, len(fit) // ONE_HELD_OUT_OF) :]
            names = ", ".join(path_of(one).name for one in aside)
            notes.append(f"held out (chosen automatically): {names}; choose with --held-out")
        fit = [one for one in fit if all(one is not other for other in aside)]
    if not fit:
        raise RecordingError(
            "no recording remains to fit",
            path=path_of(aside[0]) if aside else None,
            expected="at least one RECORDING that is not under --held-out",
        )
    if not aside:
        notes.append(NOTHING_HELD_OUT)
    return fit, aside
