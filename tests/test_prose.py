"""The prose check finds misspellings and vague phrases, and the project has none."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("codespell_lib", reason="the extra 'test' is not installed")

ROOT = Path(__file__).parents[1]
PROSE = ROOT / "docs" / "prose"


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder that contains only the prose check and its word lists."""
    shutil.copytree(PROSE, tmp_path / "docs" / "prose")
    return tmp_path


def check(*files: Path, root: Path = ROOT) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(root / "docs" / "prose" / "check.py"), *map(str, files)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_the_prose_of_the_project_passes_the_check() -> None:
    done = check()
    assert (done.returncode, done.stdout) == (0, ""), done.stdout + done.stderr


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("the stifness of a servo", "stifness ==> stiffness"),
        ("What is left is noise.", "What is left ==> What remains"),
        ("The golden rests on a part.", "rests on ==> depends on"),
    ],
)
def test_misspelt_words_and_vague_phrases_are_found_with_a_replacement(
    checkout: Path, text: str, told: str
) -> None:
    page = checkout / "docs" / "page.md"
    page.write_text(f"# A page\n\n{text}\n")
    done = check(page, root=checkout)
    assert done.returncode == 1
    assert f"docs/page.md:3: {told}" in done.stdout
