"""Roles of recordings, from their metadata."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pytest_twin.errors import RecordingError

FIT, HELD_OUT, FINAL = "fit", "held_out", "final"
"""``fit``: parameters are estimated from it. ``held_out``: its prediction validates the fit.
``final``: it tests the result once, and is used for nothing else."""


def refuse_final(metadata: Mapping[str, str], path: Path, use: str) -> None:
    """Refuse a recording with the role ``final`` for any use but the test of ranges.

    Args:
        use: the intended use, as a noun phrase.

    Raises:
        RecordingError: its role is ``final``.
    """
    if metadata.get("role") == FINAL:
        raise RecordingError(
            f"a final recording only checks ranges: it is not used for {use}",
            path=path,
            where="metadata 'trial': role",
            value=FINAL,
            expected=f"a recording of another role; {FINAL} ones check pytest-twin randomize",
        )
