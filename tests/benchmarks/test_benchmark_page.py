"""The benchmark page is generated from records with date, revision and machine."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def run(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a script of the benchmarks folder as a command."""
    return subprocess.run(
        [sys.executable, str(BENCHMARKS / script), *arguments], capture_output=True, text=True
    )


def test_a_record_contains_output_date_revision_and_machine(tmp_path: Path) -> None:
    done = run("record.py", "--results", str(tmp_path), "staleness", "--help")
    assert done.returncode == 0, done.stderr
    one = json.loads((tmp_path / "staleness.json").read_text())
    assert one["command"] == "python benchmarks/staleness.py --help"
    assert "--edits" in one["output"]
    assert len(one["date"]) == len("2026-01-01")
    assert one["machine"]["cores"] == os.cpu_count()
    assert {"mujoco", "numpy", "scipy"} == set(one["machine"]["packages"])
    assert one["processor_seconds"] > 0.0

    page = tmp_path / "page.md"
    assert run("page.py", "--results", str(tmp_path), "--page", str(page)).returncode == 0
    text = page.read_text()
    for word in (one["command"], one["date"], one["revision"], one["machine"]["processor"]):
        assert word in text
    assert one["output"].rstrip() in text
    assert "`benchmarks/collection.py`:" in text.split("## Without a record")[1]
    assert "`benchmarks/staleness.py`:" not in text.split("## Without a record")[1]


def test_a_failed_benchmark_is_shown_with_its_exit_status(tmp_path: Path) -> None:
    done = run("record.py", "--results", str(tmp_path), "staleness", "--edits", "many")
    assert done.returncode == 2
    page = tmp_path / "page.md"
    run("page.py", "--results", str(tmp_path), "--page", str(page))
    assert "**exit status 2**" in page.read_text()
    assert "invalid int value: 'many'" in page.read_text()


def test_an_unknown_benchmark_is_refused_with_an_example(tmp_path: Path) -> None:
    done = run("record.py", "--results", str(tmp_path), "stale")
    assert done.returncode != 0
    assert "'stale' is no script in" in done.stderr
    assert "expected for example 'staleness'" in done.stderr


@pytest.mark.skipif(not (BENCHMARKS / "results").is_dir(), reason="no records in this checkout")
def test_the_page_in_the_docs_matches_the_records(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    run("page.py", "--page", str(page))
    assert page.read_text() == (BENCHMARKS.parent / "docs" / "benchmarks.md").read_text()
