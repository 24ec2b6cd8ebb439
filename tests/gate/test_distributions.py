"""Versions of installed distributions, and digests of their code."""

from __future__ import annotations

import json
import sys
from importlib import metadata
from pathlib import Path

import pytest

from pytest_twin.gate.distributions import code_sha256, installed_version


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of an editable distribution ``cell_tasks`` with one module."""
    info = tmp_path / "cell_tasks-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: cell_tasks\nVersion: 1.0\n")
    (info / "top_level.txt").write_text("cell_tasks\n")
    (info / "direct_url.json").write_text(
        json.dumps({"url": tmp_path.as_uri(), "dir_info": {"editable": True}})
    )
    (tmp_path / "cell_tasks.py").write_text("REACH = 1\n")
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    return tmp_path


def test_the_version_of_an_editable_installation_follows_its_source(cell: Path) -> None:
    before = installed_version("cell_tasks")
    assert before.startswith("1.0 editable ")
    assert installed_version("cell_tasks") == before
    (cell / "cell_tasks.py").write_text("REACH = 2\n")
    assert installed_version("cell_tasks") != before
    assert installed_version("no-such-distribution") == "absent"


def test_the_digest_of_installed_code_is_that_of_its_record_without_scripts(cell: Path) -> None:
    info = cell / "cell_tasks-1.0.dist-info"
    (info / "direct_url.json").unlink()
    module = "cell_tasks.py,sha256=abc,10\n"
    digests = []
    for script in ("one", "other"):
        (info / "RECORD").write_text(f"{module}../../../bin/cell,sha256={script},9\n")
        digests.append(code_sha256(metadata.distribution("cell_tasks"), ["cell_tasks"]))
    assert digests[0] == digests[1]
    (info / "RECORD").write_text(module.replace("abc", "abd"))
    assert code_sha256(metadata.distribution("cell_tasks"), ["cell_tasks"]) != digests[0]
