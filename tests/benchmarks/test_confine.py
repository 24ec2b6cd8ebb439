"""A confined blind diagnosis cannot open the truth files."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "concealed"))

import confine

pytestmark = pytest.mark.skipif(not confine.confinable(), reason="this kernel has no Landlock")


@pytest.fixture
def place(tmp_path: Path) -> Path:
    for name in ("cases/case1/model.xml", "cases/case2/model.xml", "truth/case1.json"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("<mujoco/>")
    (tmp_path / "box").mkdir()
    (tmp_path / "cases/case1/link").symlink_to(tmp_path / "truth/case1.json")
    return tmp_path


def confined(place: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """Run a command confined to reading the first case and writing the box."""
    given = ("--read", str(place / "cases/case1"), "--write", str(place / "box"))
    return subprocess.run(
        [sys.executable, str(confine.__file__), *given, "--", *command],
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_a_confined_command_reads_its_case_and_writes_its_output_folder(place: Path) -> None:
    done = confined(
        place, "/bin/cp", str(place / "cases/case1/model.xml"), str(place / "box/copy.xml")
    )
    assert done.returncode == 0, done.stderr
    assert (place / "box/copy.xml").read_text() == "<mujoco/>"


@pytest.mark.parametrize("name", ["truth/case1.json", "cases/case1/link", "cases/case2/model.xml"])
def test_a_confined_command_opens_no_other_file(place: Path, name: str) -> None:
    """The restriction also holds for child processes."""
    child = "import subprocess, sys; sys.exit(subprocess.run(['cat', sys.argv[1]]).returncode)"
    done = confined(place, sys.executable, "-c", child, str(place / name))
    assert done.returncode == 1
    assert "Permission denied" in done.stderr
    assert not done.stdout


@pytest.mark.parametrize("name", ["truth", "cases", "."])
def test_a_confined_command_lists_no_other_folder(place: Path, name: str) -> None:
    done = confined(place, "/bin/ls", str(place / name))
    assert "Permission denied" in done.stderr


def test_a_confined_command_writes_nowhere_else(place: Path) -> None:
    done = confined(place, "/usr/bin/touch", str(place / "cases/case1/new"))
    assert "Permission denied" in done.stderr
