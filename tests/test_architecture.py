"""Architecture: allowed import directions, loading and stepping of simulators."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parent.parent


def test_packages_import_only_from_lower_layers() -> None:
    result = subprocess.run(
        [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.returncode == 0, result.stdout + result.stderr


def test_nothing_imports_pytest_internals() -> None:
    """But for one function: what pytest makes of a source is compared with its cache."""
    internal = re.compile(r"^\s*(from|import)\s+_pytest\b", re.MULTILINE)
    offenders = [
        path.relative_to(PROJECT).as_posix()
        for folder in ("pytest_twin", "tests", "golden")
        for path in (PROJECT / folder).rglob("*.py")
        if internal.search(path.read_text())
    ]
    assert offenders == ["pytest_twin/session/bytecode.py"]


def test_module_names_of_tests_are_unique() -> None:
    """pytest imports test modules by their bare name and refuses duplicates."""
    names = Counter(path.name for path in (PROJECT / "tests").rglob("test_*.py"))
    assert [name for name, times in names.items() if times > 1] == []


LOADS = re.compile(r"\b(from_xml_\w+|from_file|from_string|buildModelFrom\w+)\(")
STEPS = re.compile(r"\bmj_step\(|\bnew_batch\(")
IMPORTS = re.compile(r"^\s*(?:import|from) (?:mujoco|pinocchio|coal)\b", re.MULTILINE)
PAGE = PROJECT / "docs" / "architecture.md"


def documented(use: str) -> tuple[str, ...]:
    """Folders and modules in the list of the page that begins with the word ``use``."""
    section = PAGE.read_text("utf-8").partition("## Where simulators are used")[2]
    (line,) = re.findall(rf"^- \*\*{use}\*\*(.*(?:\n  .*)*)", section, re.MULTILINE)
    return tuple(re.findall(r"`([^`]+)`", line))


def undocumented(pattern: re.Pattern[str], *uses: str) -> list[str]:
    named = tuple(place for use in uses for place in documented(use))
    return [place for place in places_of(pattern) if not place.startswith(named)]


def places_of(pattern: re.Pattern[str]) -> set[str]:
    package = PROJECT / "pytest_twin"
    return {
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        if pattern.search(path.read_text())
    }


def test_models_are_loaded_only_in_the_documented_folders() -> None:
    assert undocumented(LOADS, "Loaded") == []


def test_simulators_are_stepped_only_in_the_documented_places() -> None:
    assert undocumented(STEPS, "Stepped") == []


def test_simulators_are_imported_only_in_the_documented_places() -> None:
    assert undocumented(IMPORTS, "Loaded", "Stepped", "Imported") == []


@pytest.mark.parametrize(
    ("use", "pattern"), [("Loaded", LOADS), ("Stepped", STEPS), ("Imported", IMPORTS)]
)
def test_every_documented_place_uses_a_simulator(use: str, pattern: re.Pattern[str]) -> None:
    used = places_of(pattern)
    idle = [place for place in documented(use) if not any(u.startswith(place) for u in used)]
    assert idle == []


def test_the_table_of_folders_has_every_module_in_the_order_of_the_import_layers() -> None:
    tool = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]
    layers = [layer.split(" | ") for layer in tool["contracts"][0]["layers"]]
    level = {name.removeprefix("pytest_twin."): i for i, one in enumerate(layers) for name in one}
    table = PAGE.read_text("utf-8").partition("| folder or module | content |")[2].split("\n\n")[0]
    rows = [
        re.findall(r"`([^`]+?)(?:/|\.py)`", row.split("|")[1]) for row in table.splitlines()[2:]
    ]
    named = [name for row in rows for name in row]
    assert sorted(named) == sorted(
        path.stem
        for path in (PROJECT / "pytest_twin").iterdir()
        if path.name not in ("__init__.py", "__pycache__", "py.typed", "schemas")
    )
    levels = [level[name] for name in named]
    assert levels == sorted(levels)


def test_a_diagnosis_imports_neither_distributions_nor_filters_of_scipy() -> None:
    """Their import takes 0.6 s, longer than the first answer of a small diagnosis."""
    code = (
        "import sys, pytest_twin.diagnosis.diagnose, pytest_twin.report.diagnosis_plots;"
        "import numpy, pytest_twin.metrics.recorded_frequency as r;"
        "assert r.recorded_response(*numpy.random.default_rng(0).normal(size=(2, 999)), 100.0);"
        "print(sorted({'scipy.signal', 'scipy.stats'} & {*sys.modules}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_worker_of_the_gate_imports_nothing_of_scipy() -> None:
    """The import takes 0.25 s, as long as all others of the worker; checks import what they use."""
    code = "import sys, pytest_twin.gate.worker; print('scipy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_benchmark_plants_share_no_code_with_the_package() -> None:
    concealed = (PROJECT / "benchmarks" / "concealed").glob("*.py")
    plants = [
        *(PROJECT / "golden" / "make").glob("*.py"),
        # Cases from real recordings have no simulated plant: they read and write recordings.
        *(p for p in concealed if not p.name.startswith(("real_", "injections"))),
    ]
    assert len(plants) >= 6
    for path in plants:
        assert not re.search(r"^\s*(from|import)\s+pytest_twin\b", path.read_text(), re.MULTILINE)


def test_benchmarks_use_names_that_the_helpers_of_tests_define() -> None:
    """Benchmarks import helper modules of tests, and no type checker reads them."""
    helpers = {path.stem: path for path in (PROJECT / "tests").rglob("*.py")}
    missing = []
    for path in sorted((PROJECT / "benchmarks").rglob("*.py")):
        tree = ast.parse(path.read_text("utf-8"))
        here = {p.stem for p in path.parent.glob("*.py")}
        imported = {
            alias.asname or alias.name: alias.name
            for node in ast.walk(tree)
            if isinstance(node, ast.Import)
            for alias in node.names
            if alias.name in helpers and alias.name not in here
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                module = imported.get(node.value.id)
                if module and node.attr not in _names_of(helpers[module]):
                    missing.append(f"{path.name}: {module}.{node.attr}")
    assert missing == []


@functools.cache
def _names_of(module: Path) -> set[str]:
    """Names of a module's functions, classes, constants and imports."""
    tree = ast.parse(module.read_text("utf-8"))
    names = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            names |= {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names |= {alias.asname or alias.name for alias in node.names}
    return names


OTHER_MEANINGS = {
    "payload": "key of a trial's metadata and of twin.yaml; mechanism of excite",
    "armature": "attribute of an MJCF joint",
    "backlash": "mechanism of excite in twin.yaml",
    "clock_drift": "key of a calibration record",
}
"""Words that are an effect's id and also something else."""


def test_no_module_outside_the_effects_lists_an_effect_by_its_id() -> None:
    """A law of another package is in no list: commands treat an effect by its traits alone."""
    with (PROJECT / "pyproject.toml").open("rb") as file:
        points = tomllib.load(file)["project"]["entry-points"]["pytest_twin.effects"]
    package = PROJECT / "pytest_twin"
    # Files that users get import nothing of pytest-twin.
    standalone = package / "ranges" / "written"
    found = [
        f"{path.relative_to(package)}:{node.lineno} {node.value}"
        for path in sorted(package.rglob("*.py"))
        if not path.is_relative_to(package / "effects") and not path.is_relative_to(standalone)
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and node.value in points.keys() - OTHER_MEANINGS.keys()
    ]
    assert found == []
