"""Check spelling and plain words of documents and code.

    python docs/prose/check.py [FILE ...]

Without files: the pages, README, CHANGELOG, CONTRIBUTING, the package, the examples, the
benchmarks and the tests. codespell does both: once with its own dictionary, once with the phrases
of ``plain_words.txt``. Tests misspell words on purpose, so only their phrases are checked.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
PLACES = (
    "docs", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "pytest_twin", "examples", "benchmarks",
    "tests",
)  # fmt: skip
SUFFIXES = (".md", ".py", ".j2", ".toml", ".json")
PHRASES = HERE / "plain_words.txt"
LISTS_OF_PHRASES = ("test_prose.py", "test_messages.py", "test_audit_words.py")
"""Tests that name phrases to avoid."""


def problems(files: Sequence[Path]) -> list[str]:
    """Each misspelled word and each phrase with a plainer form: file, line, words, suggestion."""
    phrases = [line.split("->")[0] for line in PHRASES.read_text("utf-8").splitlines()]
    return [
        *_codespell([f for f in files if not f.is_relative_to(ROOT / "tests")]),
        *_codespell(files, "--dictionary", str(PHRASES), "--regex", _pattern(phrases)),
    ]


def checked(words: Sequence[str]) -> list[Path]:
    """The files of a command line that are checked; without any, all of them."""
    places = [Path(word).resolve() for word in words] or [ROOT / place for place in PLACES]
    found = [f for p in places for f in ([p] if p.is_file() else sorted(p.rglob("*")))]
    homes = [ROOT / place for place in PLACES]
    return [
        file
        for file in found
        if file.suffix in SUFFIXES
        and any(file.is_relative_to(home) for home in homes)
        and "generated" not in file.parts
        and file.name not in LISTS_OF_PHRASES
    ]


def _pattern(phrases: Sequence[str]) -> str:
    longest_first = sorted(phrases, key=len, reverse=True)
    return rf"(?i)\b(?:{'|'.join(map(re.escape, longest_first))})\b"


def _codespell(files: Sequence[Path], *options: str) -> list[str]:
    if not files:
        return []
    names = [str(file.relative_to(ROOT)) for file in files]
    command = [sys.executable, "-m", "codespell_lib", "--quiet-level", "3", *options, *names]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if run.returncode not in (0, 65) and not run.stdout:
        raise RuntimeError(run.stderr)
    return run.stdout.splitlines()


if __name__ == "__main__":
    found = problems(checked(sys.argv[1:]))
    for line in found:
        print(line)
    sys.exit(bool(found))
