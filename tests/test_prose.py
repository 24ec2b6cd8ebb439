"""Documents, messages and docstrings are spelled right and use the plain words of the project."""

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
    """A checkout with the check and its lists alone."""
    shutil.copytree(PROSE, tmp_path / "docs" / "prose")
    return tmp_path


def check(*files: Path, root: Path = ROOT) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(root / "docs" / "prose" / "check.py"), *map(str, files)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_everything_that_people_read_is_spelled_right_and_plain() -> None:
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
def test_a_misspelled_word_and_a_phrase_are_found_with_what_to_write(
    checkout: Path, text: str, told: str
) -> None:
    page = checkout / "docs" / "page.md"
    page.write_text(f"# A page\n\n{text}\n")
    done = check(page, root=checkout)
    assert done.returncode == 1
    assert f"docs/page.md:3: {told}" in done.stdout
