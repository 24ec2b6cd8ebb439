"""Tell a twin from the fitted model that a command wrote; pytest loads this in every run."""

from __future__ import annotations

from pathlib import Path

from pytest_twin.record_spec import RESULTS_WITH_MODELS

_EFFECTS_FILE = "effects.json"
_REALIZATION = "realization"


def is_fitted_model(twin_file: Path) -> bool:
    """Whether a ``twin.yaml`` belongs to the fitted model of a diagnosis or an identification.

    It states how to simulate this model, and has no goldens of its own.
    """
    folder = twin_file.parent
    if (folder / _EFFECTS_FILE).is_file():
        return True
    return folder.name == _REALIZATION and any(
        (folder.parent / name).is_file() for name in RESULTS_WITH_MODELS
    )
