"""A twin and its release as version 0.1 of 26 November 2026 wrote them (`twin_of_0_1/`)."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest

from pytest_twin.gate.specs import load_golden, spec_paths
from pytest_twin.release.check import baseline, check
from pytest_twin.twin import load_twin

WRITTEN = Path(__file__).parent / "twin_of_0_1"
SOON = datetime(2026, 12, 24, tzinfo=UTC)


@pytest.fixture
def twin(tmp_path: Path) -> Path:
    return shutil.copytree(WRITTEN, tmp_path / "twin")


def test_a_release_of_an_older_version_holds_and_is_the_baseline_of_the_gate(twin: Path) -> None:
    verdict = check(twin / "releases" / "0001", now=SOON)
    assert verdict.problems == ()
    assert verdict.release is not None
    assert [golden.split("@")[0] for golden in sorted(verdict.release.goldens)] == [
        "golden/limits/limits",
        "golden/mass_properties/mass_properties",
    ]
    newest = baseline(twin, now=SOON)
    assert newest.release is not None
    assert (newest.release.number, newest.problems) == (1, ())


def test_one_changed_byte_of_an_older_release_is_found(twin: Path) -> None:
    model = twin / "releases/0001/files/pendulum.xml"
    model.write_bytes(model.read_bytes().replace(b'mass="1"', b'mass="2"'))
    verdict = check(twin / "releases" / "0001", now=SOON)
    assert any("pendulum.xml" in problem.text for problem in verdict.problems)


def test_an_older_twin_and_its_goldens_are_read(twin: Path) -> None:
    read = load_twin(twin / "twin.yaml")
    assert read.name == "pendulum"
    kinds = {load_golden(path, read).kind for path in spec_paths(read)}
    assert kinds == {"limits", "mass_properties"}
