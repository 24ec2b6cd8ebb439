"""A twin of the SO-101 arm: the vendor's model and real recordings outside the repository."""

from __future__ import annotations

import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest
from in_process import forked_pytest

HERE = Path(__file__).parent
RECORDINGS = Path(
    os.environ.get("TWIN_RECORDINGS") or HERE.parents[2] / "shared" / "recordings"
).resolve()

TWIN = """\
name: so101
model: {so101}/model.xml
roots:
  so101: {so101}
tcp: gripperframe
"""


def recordings(name: str) -> Path:
    """The folder of one set of recordings; skips with the searched path if it is missing."""
    folder = RECORDINGS / name
    if not folder.is_dir():
        pytest.skip(
            f"no recordings at {folder}: the environment variable TWIN_RECORDINGS says where"
        )
    return folder


@dataclass
class Workshop:
    """A twin in a temporary folder, and a method that runs pytest in it."""

    root: Path
    home: Path

    def pytest(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run pytest in the twin's folder."""
        folders = ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", "XDG_CACHE_HOME")
        environment = os.environ | dict.fromkeys(folders, str(self.home))
        return forked_pytest("-p", "no:cacheprovider", *arguments, cwd=self.root, env=environment)


@pytest.fixture
def so101(tmp_path: Path) -> Workshop:
    """The twin with its declared goldens."""
    folder = recordings("so101")
    root = tmp_path / "so101"
    shutil.copytree(HERE / "golden", root / "golden")
    (root / "twin.yaml").write_text(TWIN.format(so101=folder))
    (tmp_path / "home").mkdir()
    return Workshop(root, tmp_path / "home")
