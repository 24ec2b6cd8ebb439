"""Unsupported operating systems are refused in one line before anything else fails."""

from __future__ import annotations

import subprocess
import sys
from importlib.machinery import ModuleSpec
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from pytest_twin import __version__, cli, systems
from pytest_twin.systems import unsupported_system, unusable_mujoco

WINDOWS = (
    "pytest-twin does not run on Windows, only on Linux and macOS: "
    "use a container or, on Windows, WSL 2"
)


@pytest.fixture
def on_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "win32")
    monkeypatch.setattr("platform.system", lambda: "Windows")


@pytest.mark.parametrize("platform", ["linux", "darwin"])
def test_linux_and_macos_are_supported(monkeypatch: pytest.MonkeyPatch, platform: str) -> None:
    monkeypatch.setattr("sys.platform", platform)
    assert unsupported_system() is None


@pytest.mark.usefixtures("on_windows")
def test_the_command_refuses_windows_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["audit", "arm.urdf"]) == 2
    assert capsys.readouterr().err == WINDOWS + "\n"


@pytest.mark.parametrize(("twin", "status"), [("", 0), ("name: arm\nmodel: arm.xml\n", 2)])
def test_the_plugin_refuses_windows_only_in_projects_with_a_twin(
    tmp_path, twin: str, status: int
) -> None:
    (tmp_path / "test_other.py").write_text("def test_it():\n    pass\n")
    if twin:
        (tmp_path / "twin.yaml").write_text(twin)
    (tmp_path / "run.py").write_text(
        "import pytest, sys, pytest_twin.systems as systems\n"
        f"systems.unsupported_system = lambda: {WINDOWS!r}\n"
        "sys.exit(pytest.main(['-q', '-p', 'no:cacheprovider']))\n"
    )
    done = subprocess.run(
        [sys.executable, "run.py"], cwd=tmp_path, capture_output=True, text=True, timeout=100
    )
    assert done.returncode == status, done.stdout + done.stderr
    assert done.stdout.splitlines().count(WINDOWS) == bool(twin)
    assert "Traceback" not in done.stdout + done.stderr


def test_a_child_process_keeps_a_lower_memory_limit_of_the_system() -> None:
    program = (
        "import resource\n"
        "resource.setrlimit(resource.RLIMIT_AS, (4 * 2**30, 4 * 2**30))\n"
        "resource.setrlimit(resource.RLIMIT_CPU, (60, 90))\n"
        "from pytest_twin.realization.sandbox import Sandbox\n"
        "with Sandbox() as sandbox:\n"
        "    print(sandbox.call('pytest_twin.systems:unsupported_system'))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=100
    )
    assert done.stdout == "None\n", done.stderr


@pytest.fixture
def install_mujoco(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Function that replaces the installed MuJoCo: its version, None for none, and its files."""

    def install(installed: str | None, *files: str) -> None:
        def version(name: str) -> str:
            if installed is None:
                raise PackageNotFoundError(name)
            return installed

        folder = tmp_path / "mujoco"
        folder.mkdir()
        for file in files:
            (folder / file).touch()
        spec = ModuleSpec("mujoco", None, is_package=True)
        spec.submodule_search_locations = [str(folder)]
        monkeypatch.setattr(systems, "version", version)
        monkeypatch.setattr(systems, "find_spec", lambda name: spec if installed else None)

    return install


COMPILED = "_structs.cpython-311-x86_64-linux-gnu.so"


@pytest.mark.parametrize(
    ("installed", "files", "problem"),
    [
        (None, (), "MuJoCo is not installed: pip install 'mujoco>=3.11'"),
        ("3.3.0", (COMPILED,), "MuJoCo 3.3.0 is installed, and pytest-twin needs 3.11 or newer: "),
        ("4.0.0", ("__init__.py",), "uninstall first: pip uninstall -y mujoco mujoco-core"),
    ],
    ids=["absent", "too old", "upgraded in place"],
)
def test_a_mujoco_that_cannot_be_used_is_refused_with_the_repair(
    install_mujoco,
    capsys: pytest.CaptureFixture[str],
    installed: str | None,
    files: tuple[str, ...],
    problem: str,
) -> None:
    install_mujoco(installed, *files)
    assert cli.main(["audit", "arm.urdf"]) == 2
    error = capsys.readouterr().err
    assert problem in error
    assert error.count("\n") == 1
    with pytest.raises(SystemExit, match="0"):
        cli.main(["--version"])
    assert capsys.readouterr().out == f"pytest-twin {__version__}\n"


@pytest.mark.parametrize("version", ["3.11.0", "3.17.0", "4.0.0", "5.1.0rc1"])
def test_a_mujoco_with_its_compiled_part_is_used(install_mujoco, version: str) -> None:
    install_mujoco(version, "__init__.py", COMPILED)
    assert unusable_mujoco() is None
