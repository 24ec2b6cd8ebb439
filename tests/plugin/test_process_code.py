"""A release lists the code of the process that ran its goldens, and a change makes them stale."""

from __future__ import annotations

import importlib.util
import json
import marshal
import py_compile
import shutil
import subprocess
import sys
import token
from pathlib import Path

import pluggy
import pytest

from pytest_twin import release
from pytest_twin.session.process_code import _is_copy_of_installed

MARK = "import pathlib; pathlib.Path(__file__).parent.joinpath('MARK').touch()\n"
HOOKS = "import helper\n\ndef pytest_runtest_makereport(item, call):\n    pass\n"


def released_parts(folder, number: int = 1) -> dict[str, dict]:
    verdict = release.check(folder.root / "releases" / f"{number:04d}")
    assert verdict.release is not None
    assert verdict.holds, verdict.problems
    return {ident: dict(part.content) for ident, part in verdict.release.parts.items()}


def run_as_user(folder, flag: str, *, module: bool = False) -> subprocess.CompletedProcess[str]:
    """Run ``pytest`` or ``python -m pytest``; pytester's own runs name the folder in PYTHONPATH."""
    start = ["-m", "pytest"] if module else [str(Path(sys.executable).parent / "pytest")]
    return subprocess.run(
        [sys.executable, *start, "-p", "no:cacheprovider", flag],
        cwd=folder.root, capture_output=True, text=True, timeout=100,
    )  # fmt: skip


def stale(folder, *arguments: str) -> list[str]:
    """Lines of --twin-why about stale goldens."""
    result = folder.run_apart("--twin-why", *arguments)
    return [line for line in result.outlines if "process:" in line or "plugin:" in line]


def with_code(folder) -> None:
    """A twin with conftest.py, a module that it imports, a configuration and a test."""
    folder.write("conftest.py", HOOKS)
    folder.write("helper.py", "VALUE = 1\n")
    folder.write(
        "pytest.ini",
        "[pytest]\n# a comment\naddopts = -p local_plugin -p trimesh.util\npythonpath = .\n",
    )
    folder.write("local_plugin.py", "")
    folder.write("tests/test_cell.py", "def test_cell():\n    pass\n")


def test_a_release_lists_conftest_modules_configuration_and_plugins(recorded) -> None:
    with_code(recorded)
    recorded.run_apart("--twin-release").assert_outcomes(passed=3)
    parts = released_parts(recorded)
    assert parts["process:pytest.ini"]["options"]["addopts"] == "-p local_plugin -p trimesh.util"
    for name in ("conftest.py", "helper.py", "local_plugin.py"):
        assert len(parts[f"process:{name}"]["sha256"]) == 64
        assert (recorded.root / "releases/0001/files" / name).is_file()
    # A test module is listed, and a changed test makes no golden stale.
    assert "process:tests/test_cell.py" not in parts
    assert (recorded.root / "releases/0001/files/tests/test_cell.py").is_file()
    for name in ("pytest-xdist", "trimesh"):
        assert set(parts[f"plugin:{name}"]) == {"version", "sha256"}

    assert stale(recorded) == []
    # Another selection and other options do not load the same code; the proof stands.
    assert stale(recorded, "-p", "no:xdist", "golden/fk") == []
    recorded.write("tests/test_cell.py", "def test_cell():\n    assert True\n")
    recorded.edit("pytest.ini", "# a comment\n", "")
    assert stale(recorded) == []
    recorded.write("golden/conftest.py", "")
    assert stale(recorded) == []

    recorded.edit("helper.py", "VALUE = 1", "VALUE = 2")
    assert any("process:helper.py" in line and "sha256" in line for line in stale(recorded))
    recorded.edit("helper.py", "VALUE = 2", "VALUE = 1")
    (recorded.root / "pytest.ini").write_text("[pytest]\naddopts = -q\n")
    assert any("process:pytest.ini" in line for line in stale(recorded))


def test_a_removed_conftest_makes_its_goldens_stale(recorded) -> None:
    recorded.write("golden/fk/conftest.py", "")
    recorded.run_apart("--twin-release").assert_outcomes(passed=2)
    assert "process:golden/fk/conftest.py" in released_parts(recorded)
    (recorded.root / "golden/fk/conftest.py").unlink()
    assert stale(recorded) != []


def test_the_workers_of_xdist_report_the_code_that_they_load(recorded) -> None:
    recorded.write("golden/fk/conftest.py", "")
    result = recorded.run_apart("--twin-release", "-n", "1")
    result.assert_outcomes(passed=2)
    assert "process:golden/fk/conftest.py" in released_parts(recorded)


def test_a_module_that_hides_one_of_the_library_prevents_a_release(recorded) -> None:
    recorded.write("token.py", MARK)
    # pytest puts the folder of a conftest.py on the import path.
    recorded.write("conftest.py", "")
    done = run_as_user(recorded, "--twin-release")
    hidden = "token.py: hides the installed module 'token' in this process (expected another name)"
    assert hidden in done.stdout
    assert recorded.releases == []


def test_a_copy_of_an_installed_module_hides_nothing(recorded) -> None:
    """As a checkout does whose own pytest-twin is installed."""
    recorded.write("conftest.py", "")
    recorded.write("token.py", Path(token.__file__).read_text(encoding="utf-8"))
    done = run_as_user(recorded, "--twin-release")
    assert done.returncode == 0, done.stdout
    recorded.write("token.py", Path(token.__file__).read_text(encoding="utf-8") + MARK)
    done = run_as_user(recorded, "--twin-release")
    assert "hides the installed module 'token'" in done.stdout
    recorded.write("pyproject.toml", "")
    done = run_as_user(recorded, "--twin-release")
    assert f"(expected the files of the installed one: pip install {recorded.root})" in done.stdout


def test_a_package_is_a_copy_with_equal_files_only(
    tmp_path: Path, pytestconfig: pytest.Config
) -> None:
    def is_copy() -> bool:
        return _is_copy_of_installed("pluggy", copy, sys.path, pytestconfig)

    package = Path(pluggy.__file__).parent
    copy = tmp_path / "pluggy"
    shutil.copytree(package, copy, ignore=shutil.ignore_patterns("__pycache__"))
    assert is_copy()
    # Python runs a compiled module in place of its source where the module says so.
    compiled = copy / "__pycache__" / "_hooks.pyc"
    compiled.parent.mkdir()
    compiled.write_bytes(b"")
    assert not is_copy()
    compiled.unlink()
    # What Python keeps of the copy itself, and a cache that Python no longer runs, change nothing.
    cache = Path(py_compile.compile(str(copy / "_hooks.py")))
    assert is_copy()
    other = Path(py_compile.compile(str(copy / "_manager.py"))).read_bytes()
    cache.write_bytes(other)
    assert is_copy()
    cache.write_bytes(header_for(copy / "_hooks.py") + other[16:])
    assert not is_copy()
    cache.unlink()
    # What pytest keeps of it is compared in the same way.
    tag = f"{sys.implementation.cache_tag}-pytest-{pytest.__version__}"
    of_pytest = cache.with_name(f"_hooks.{tag}.pyc")
    of_pytest.write_bytes(header_for(copy / "_hooks.py") + other[16:])
    assert not is_copy()


def header_for(source: Path) -> bytes:
    """Start of a cache that Python runs in place of ``source``."""
    # With the hash of the source, which Python compares (PEP 552).
    return (
        importlib.util.MAGIC_NUMBER
        + b"\x03\0\0\0"
        + importlib.util.source_hash(source.read_bytes())
    )


def test_a_forged_bytecode_cache_prevents_a_release(recorded) -> None:
    """Python runs the cache; the release would list the source, which is harmless."""
    recorded.write("conftest.py", "import helper\n")
    helper = recorded.write("helper.py", "VALUE = 1\n")
    cache = Path(importlib.util.cache_from_source(str(helper)))
    cache.parent.mkdir()
    code = compile("VALUE = 2\n", str(helper), "exec")
    cache.write_bytes(header_for(helper) + marshal.dumps(code))
    done = run_as_user(recorded, "--twin-release")
    assert f"{cache}: is not the bytecode of helper.py, and Python runs it" in done.stdout
    assert recorded.releases == []


def test_a_forged_cache_of_pytest_prevents_a_release(recorded) -> None:
    """pytest runs its own cache, in which the assertions are rewritten."""
    conftest = recorded.write("conftest.py", "def sound(value):\n    assert value == 1, value\n")
    for _ in range(2):
        assert run_as_user(recorded, "--twin-release").returncode == 0
    (cache,) = (recorded.root / "__pycache__").glob("conftest.*-pytest-*.pyc")
    code = compile("VALUE = 2\n", str(conftest), "exec")
    cache.write_bytes(header_for(conftest) + marshal.dumps(code))
    done = run_as_user(recorded, "--twin-release")
    assert f"{cache}: is not the bytecode of conftest.py, and Python runs it" in done.stdout
    assert len(recorded.releases) == 1


@pytest.mark.nightly
def test_bytecode_caches_of_test_modules_prevent_no_release(recorded) -> None:
    recorded.write("conftest.py", "import helper\n")
    recorded.write("helper.py", "VALUE = 1\n")
    recorded.write("test_arm.py", "import helper\n\ndef test_it():\n    assert helper.VALUE\n")
    for module in (True, False, True):
        done = run_as_user(recorded, "--twin-release", module=module)
        assert done.returncode == 0, done.stdout
    assert list((recorded.root / "__pycache__").glob("helper.*.pyc"))


@pytest.mark.parametrize("module", [False, True])
def test_colliding_names_in_a_twin_break_no_run(
    recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: bool
) -> None:
    """Folders of a robot may be called `yaml`, and scripts `numpy.py`."""
    overlay = tmp_path / "overlay"
    (overlay / "cell_messages").mkdir(parents=True)
    (overlay / "cell_messages" / "__init__.py").write_text("")
    for name in ("numpy.py", "yaml/__init__.py", "jinja2/__init__.py", "lxml.py", "mujoco.py"):
        recorded.write(name, MARK)
    recorded.task("overlay", "import cell_messages, json\nreturn {'reach': 1.0}")
    monkeypatch.setenv("PYTHONPATH", str(overlay))
    done = run_as_user(recorded, "--twin-update", module=module)
    assert done.returncode == 0, done.stdout + done.stderr
    done = run_as_user(recorded, "--twin-release", module=module)
    assert "3 passed" in done.stdout, done.stdout + done.stderr
    assert (done.returncode == 0) is not module, done.stdout
    assert list(recorded.root.rglob("MARK")) == []
    assert ("hides the installed module 'numpy'" in done.stdout) is module


def test_results_state_the_process_of_then(recorded) -> None:
    """A conftest.py that was added later is not listed for the golden that ran before."""
    recorded.run_apart("--twin-release").assert_outcomes(passed=2)
    recorded.write("conftest.py", "")
    recorded.edit("golden/fk/home.yaml", "position: 0.1 mm", "position: 0.2 mm")
    recorded.run_apart("--twin-release").assert_outcomes(passed=1)
    text = (recorded.root / "releases/0002/results.json").read_text()
    parts = {golden["outcome"]["golden"]: golden["parts"] for golden in json.loads(text)["goldens"]}
    assert "process:conftest.py" in parts["golden/fk/home"]
    assert "process:conftest.py" not in parts["golden/mass/arm"]
