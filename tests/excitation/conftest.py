"""One excitation of the planar arm, shared by several test files."""

from __future__ import annotations

import pytest
from approved_arms import Excited, approved_for_arm, loaded, write_twin

from pytest_twin.excitation import excite as module


@pytest.fixture(scope="session")
def excited(tmp_path_factory: pytest.TempPathFactory) -> Excited:
    folder = tmp_path_factory.mktemp("arm")
    path = write_twin(folder, approved_for_arm())
    (folder / "out").mkdir()
    found = module.excite(*loaded(path))
    answer = module.write_motions(found, path, folder / "out")
    return Excited(folder, found, answer["document"])
