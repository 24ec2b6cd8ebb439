"""Children import installed modules, and none that lies beside a robot's files."""

from __future__ import annotations

import ast
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import pytest_twin
from pytest_twin.realization import Sandbox
from pytest_twin.realization import import_path as policy
from pytest_twin.realization.confinement import why_not_confined
from pytest_twin.realization.import_path import import_path, is_installed

PACKAGE = Path(pytest_twin.__file__).parent
MODEL = """\
<mujoco>
  <worldbody>
    <body name="link">
      <joint name="hinge" range="-1 1" limited="true"/>
      <geom type="box" size="0.1 0.1 0.1" mass="1"/>
    </body>
  </worldbody>
</mujoco>
"""
COLLIDING = (
    *("json.py", "token.py", "numpy.py", "resource.py", "sitecustomize.py", "usercustomize.py"),
    *("yaml/__init__.py", "mujoco/__init__.py", "lxml/__init__.py", "matplotlib/__init__.py"),
)
MARK = "import pathlib; pathlib.Path(__file__).parent.joinpath('MARK').touch(); raise SystemExit(9)"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a model, and modules whose names collide; each leaves a mark when imported."""
    for name in COLLIDING:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(MARK)
    (tmp_path / "model.xml").write_text(MODEL)
    return tmp_path


def imported(folder: Path) -> list[Path]:
    return sorted(folder.rglob("MARK"))


def starts_of_processes() -> dict[str, list[str]]:
    """Module of the package -> the calls in it that start, replace or copy a process."""
    names = {
        "Popen", "run", "call", "check_call", "check_output", "system", "popen", "fork", "forkpty",
        "posix_spawn", "posix_spawnp", "startfile", "Process", "Pool", "ProcessPoolExecutor",
        "create_subprocess_exec", "create_subprocess_shell", "run_path", "run_module", "Client",
    }  # fmt: skip
    modules = {"subprocess", "os", "multiprocessing", "asyncio", "runpy", "futures", "dask"}
    found: dict[str, list[str]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            called, owner = node.func.attr, node.func.value
            starts = called in names or called.startswith(("exec", "spawn"))
            if starts and isinstance(owner, ast.Name) and owner.id in modules:
                found.setdefault(path.relative_to(PACKAGE).as_posix(), []).append(
                    f"{owner.id}.{called}"
                )
    return found


def test_only_these_modules_start_processes() -> None:
    """A new place must start its children as the sandbox does, or copy this process."""
    assert starts_of_processes() == {
        # git, which imports no Python module.
        "commands/affected_robots.py": ["subprocess.run"],
        # The Python of another environment, in its isolated mode (-I): this one's path is not its.
        "export/foreign_engine.py": ["subprocess.run"],
        "realization/confinement.py": ["os.execv"],
        # The workers of Dask are started by the user; functions are sent to them.
        "realization/executor.py": ["dask.Client"],
        "realization/forks.py": ["os.fork"],
        "realization/sandbox.py": ["subprocess.Popen"],
    }
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.List) and "sys.executable" in ast.unparse(node):
                assert ast.unparse(node).startswith("[sys.executable, '-P', '-m', "), path
    imports = [p for p in PACKAGE.rglob("*.py") if "multiprocessing" in p.read_text("utf-8")]
    assert imports == []


@pytest.mark.parametrize("place", [".", "below", "link"])
def test_the_working_folder_and_all_below_it_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    work, other = tmp_path / "work", tmp_path / "other"
    (work / "below").mkdir(parents=True)
    other.mkdir()
    (other / "link").symlink_to(work)
    entry = str(other / "link" if place == "link" else work / place)
    monkeypatch.setattr(sys, "path", ["", entry, str(other), *sys.path])
    monkeypatch.chdir(work)
    assert entry not in import_path()
    assert "" not in import_path()
    assert str(other) in import_path()
    monkeypatch.chdir(other)
    assert entry not in import_path([work])


def test_the_folder_of_a_twin_is_left_out_wherever_the_command_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    twin, work = tmp_path / "twin", tmp_path / "work"
    (twin / "lib").mkdir(parents=True)
    work.mkdir()
    (twin / "twin.yaml").write_text("model: model.xml\n")
    monkeypatch.setattr(sys, "path", [str(twin), str(twin / "lib"), *sys.path])
    monkeypatch.setenv("PYTHONPATH", f"{twin}{os.pathsep}{twin / 'lib'}")
    (twin / "lib" / "forged-1.0.dist-info").mkdir()
    monkeypatch.chdir(work)
    assert not any(entry.startswith(str(twin)) for entry in import_path())


def test_an_overlay_in_pythonpath_is_kept_with_its_distributions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A workspace of colcon: the twin is in ``src``, installed packages are in ``install``."""
    overlay = tmp_path / "install" / "cell" / "lib" / "python3" / "site-packages"
    (overlay / "cell-1.0-py3.egg-info").mkdir(parents=True)
    plain, named = tmp_path / "scripts", [str(overlay), str(tmp_path / "scripts")]
    plain.mkdir()
    monkeypatch.setattr(sys, "path", [*named, *sys.path])
    monkeypatch.chdir(tmp_path)
    assert not set(named) & set(import_path())
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(named))
    assert import_path()[0] == str(overlay)
    assert str(plain) not in import_path()
    # A distribution that somebody puts into the working folder itself does not open it.
    (tmp_path / "forged-1.0.dist-info").mkdir()
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert str(tmp_path) not in import_path()


def test_an_editable_installation_is_kept_behind_the_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site, project = tmp_path / "site", tmp_path / "project"
    site.mkdir()
    project.mkdir()
    (site / "cell.pth").write_text(f"# cell\nimport sys\n{project}\n")
    monkeypatch.setattr(policy.site, "getsitepackages", lambda: [str(site)])
    policy._library_folders.cache_clear()
    policy._editable_folders.cache_clear()
    library = str(Path(os.__file__).parent)
    try:
        monkeypatch.chdir(project)
        monkeypatch.setattr(sys, "path", [str(project), library, str(site), str(project)])
        assert import_path() == [library, str(site), str(project)]
        assert not is_installed(project / "src")
    finally:
        monkeypatch.undo()
        policy._library_folders.cache_clear()
        policy._editable_folders.cache_clear()


@pytest.mark.parametrize("confined", [False, True])
def test_a_child_imports_nothing_from_the_folder_it_works_in(
    folder: Path, importable_functions: Path, monkeypatch: pytest.MonkeyPatch, confined: bool
) -> None:
    if confined and (reason := why_not_confined()):
        pytest.skip(reason)
    overlay = folder.parent / f"{folder.name}-overlay"
    overlay.mkdir()
    (overlay / "only_in_overlay.py").write_text("PLACE = 'overlay'\n")
    monkeypatch.setattr(sys, "path", [str(folder), str(overlay), *sys.path])
    monkeypatch.setenv("PYTHONPATH", f"{folder}{os.pathsep}{overlay}")
    roots = [folder, importable_functions] if confined else None
    with Sandbox(seconds=60, cwd=folder, confined_to=roots) as sandbox:
        names = ["json", "numpy", "yaml", "mujoco", "matplotlib", "only_in_overlay"]
        files = sandbox.call("sandboxed:files_of_modules", {"names": names})
    assert not any(Path(file).is_relative_to(folder) for file in files.values())
    assert Path(files["only_in_overlay"]) == overlay / "only_in_overlay.py"
    assert imported(folder) == []


PLAN = """\
calibration: cell
observations: poses.csv
estimate: [hand_eye, base_world]
camera: {mount: hand}
accept: {translation: 0.002}
"""


def poses() -> str:
    """Eight poses of a flange, with a camera on it and a target at the base, without noise."""
    names = ("x", "y", "z", "qw", "qx", "qy", "qz")
    heads = [f"{what}.{name}" for what in ("flange", "camera_from_target") for name in names]
    rows = [",".join(("id", *heads))]
    for k in range(8):
        angle, axis = 0.3 + 0.2 * k, np.eye(3)[k % 3]
        turn = (math.cos(angle / 2.0), *(math.sin(angle / 2.0) * axis))
        back = (turn[0], *(-value for value in turn[1:]))
        rows.append(",".join(map(str, (k, 0.0, 0.0, 0.0, *turn, 0.0, 0.0, 0.0, *back))))
    return "\n".join(rows) + "\n"


@pytest.mark.parametrize(
    ("command", "module"),
    [("audit model.xml", False), ("audit model.xml", True), ("calibrate plan.yaml", False),
     ("budget .", False)],
)  # fmt: skip
def test_a_command_in_a_folder_with_colliding_names_imports_none_of_them(
    folder: Path, module: bool, command: str
) -> None:
    (folder / "plan.yaml").write_text(PLAN)
    (folder / "poses.csv").write_text(poses())
    (folder / "twin.yaml").write_text("model: model.xml\n")
    start = (
        ["-m", "pytest_twin.cli"] if module else [str(Path(sys.executable).parent / "pytest-twin")]
    )
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, *start, *command.split(), "--out", "out"],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=100,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert imported(folder) == []
