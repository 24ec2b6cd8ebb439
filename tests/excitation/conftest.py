"""One excitation of the planar arm, which several files look at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from arms import approved_for_arm, loaded, write_twin

from pytest_twin.excitation import excite as module
from pytest_twin.excitation.excite import Excitation


@dataclass(frozen=True)
class Excited:
    """What was designed for the planar arm.

    Attributes:
        folder: of the twin; ``out`` in it has the files.
        found: the motions.
        document: of ``excitation.json``.
    """

    folder: Path
    found: Excitation
    document: dict[str, Any]


@pytest.fixture(scope="session")
def excited(tmp_path_factory: pytest.TempPathFactory) -> Excited:
    folder = tmp_path_factory.mktemp("arm")
    path = write_twin(folder, approved_for_arm())
    (folder / "out").mkdir()
    found = module.excite(*loaded(path))
    answer = module.written(found, path, folder / "out")
    return Excited(folder, found, answer["document"])
