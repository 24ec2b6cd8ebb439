"""Tell a twin from the fitted model that a command wrote; pytest loads this in every run."""

from __future__ import annotations

from pathlib import Path

_EFFECTS_FILE = "effects.json"
_REALIZATION = "realization"
_RESULTS = ("diagnosis.json", "identification.json")
"""Results of commands that write a fitted model, into the folder ``realization`` next to them."""


def is_fitted_model(twin_file: Path) -> bool:
    """Whether a ``twin.yaml`` belongs to the fitted model of a diagnosis or an identification.

    It states how to simulate this model, and has no goldens of its own.
    """
    folder = twin_file.parent
    if (folder / _EFFECTS_FILE).is_file():
        return True
    return folder.name == _REALIZATION and any(
        (folder.parent / name).is_file() for name in _RESULTS
    )
