"""The direction of imports; no file of ours reaches into pytest's internals."""

from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent


def test_rooms_import_only_from_below() -> None:
    result = subprocess.run(
        [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.returncode == 0, result.stdout + result.stderr


def test_nothing_imports_pytest_internals() -> None:
    internal = re.compile(r"^\s*(from|import)\s+_pytest\b", re.MULTILINE)
    offenders = [
        str(path)
        for folder in ("pytest_twin", "tests", "golden")
        for path in (PROJECT / folder).rglob("*.py")
        if internal.search(path.read_text())
    ]
    assert offenders == []


def test_modules_of_tests_have_names_of_their_own() -> None:
    """Pytest imports them by bare name: a second one of the same name is refused."""
    names = Counter(path.name for path in (PROJECT / "tests").rglob("test_*.py"))
    assert [name for name, times in names.items() if times > 1] == []


LOADS = re.compile(r"\b(from_xml_\w+|from_file|from_string|buildModelFrom\w+)\(")
STEPS = re.compile(r"\bmj_step\(|\bBatch\((?:self\.)?model|\bBatch\(models\[")
STEPPED_IN = {
    "checks/joint_direction.py",
    "checks/limits_bench.py",
    "diagnosis/hidden_state.py",
    "effects/batch_models.py",
    "properties/dynamics.py",
    "replay.py",
    "replay_forced.py",
}


def places_of(pattern: re.Pattern[str]) -> set[str]:
    package = PROJECT / "pytest_twin"
    return {
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        if pattern.search(path.read_text())
    }


def test_models_are_loaded_in_the_room_that_the_docs_name() -> None:
    named = ("realization/", "asset/loss/", "properties/")
    assert [place for place in places_of(LOADS) if not place.startswith(named)] == []


def test_simulators_are_stepped_in_few_places() -> None:
    elsewhere = {p for p in places_of(STEPS) if not p.startswith("realization/")}
    assert elsewhere == STEPPED_IN


def test_no_plant_shares_code_with_the_package() -> None:
    concealed = (PROJECT / "benchmarks" / "concealed").glob("*.py")
    plants = [
        *(PROJECT / "golden" / "make").glob("*.py"),
        # Cases from real recordings have no plant: they read and write recordings of a robot.
        *(p for p in concealed if not p.name.startswith(("real_", "injections"))),
    ]
    assert len(plants) >= 6
    for path in plants:
        assert not re.search(r"^\s*(from|import)\s+pytest_twin\b", path.read_text(), re.MULTILINE)
