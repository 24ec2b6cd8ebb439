"""Roles that a recording's metadata give it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pytest_twin.errors import RecordingError

FIT, HELD_OUT, FINAL = "fit", "held_out", "final"
"""Parameters are fitted on it; it is predicted to judge the fit; it judges the result, once, and
guides nothing."""


def refuse_final(metadata: Mapping[str, str], path: Path, use: str) -> None:
    """Refuse a recording with the role ``final`` for anything but the check of ranges.

    Args:
        metadata: of the recording.
        path: the recording.
        use: what it would guide, as a noun phrase.

    Raises:
        RecordingError: its role is ``final``.
    """
    if metadata.get("role") == FINAL:
        raise RecordingError(
            f"a final recording guides nothing: it is not used for {use}",
            path=path,
            where="metadata 'trial': role",
            value=FINAL,
            expected=f"a recording of another role; {FINAL} ones check pytest-twin randomize",
        )
