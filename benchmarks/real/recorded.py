"""Find the recordings of real machines."""

from __future__ import annotations

import os
from pathlib import Path

_RECORDINGS = Path(
    os.environ.get("TWIN_RECORDINGS") or Path(__file__).resolve().parents[3] / "shared/recordings"
)


def folder_of(machine: str) -> Path:
    """Return the folder of a machine's recordings.

    Raises:
        SystemExit: the folder does not exist.
    """
    folder = _RECORDINGS / machine
    if not folder.is_dir():
        raise SystemExit(f"no recordings at {folder}: the variable TWIN_RECORDINGS says where")
    return folder
