"""The functions that ``pytest_twin`` offers to programs, by the examples in their docstrings."""

from __future__ import annotations

import doctest
import inspect
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import pytest_twin

ROOT = Path(__file__).parents[1]
for room in ("calibration", "identification", "release"):
    sys.path.append(str(ROOT / "tests" / room))

from arms import simulated_effort, true_arm, write_model, write_recording  # noqa: E402
from release_twins import html, make_draft, make_twin  # noqa: E402
from test_calibrate_command import write_cell  # noqa: E402

from pytest_twin import release  # noqa: E402

FUNCTIONS = [n for n in pytest_twin.__all__ if inspect.isfunction(getattr(pytest_twin, n))]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with every file that the examples name."""
    folder = tmp_path_factory.mktemp("library") / "files"
    shutil.copytree(ROOT / "examples" / "carriage", folder)
    write_model(folder, "arm.xml")
    robot = true_arm(folder)
    for name, seed in (("one", 1), ("two", 2), ("check", 3)):
        write_recording(folder / f"{name}.csv", *simulated_effort(robot, seed))
    write_cell(folder)
    cell = make_twin(folder / "cell")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(folder / "user"))
        signer, _ = release.signer(cell)
    release.write(cell, make_draft(cell), signer, html)
    return folder


@pytest.mark.usefixtures("commands_in_process")
@pytest.mark.parametrize(
    "name",
    [
        # The page README.md has the same diagnosis.
        pytest.param(name, marks=pytest.mark.nightly) if name == "diagnose" else name
        for name in FUNCTIONS
    ],
)
def test_the_example_in_the_docstring_of_a_function_runs(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    names = {public: getattr(pytest_twin, public) for public in pytest_twin.__all__}
    [example] = doctest.DocTestFinder(recurse=False).find(
        getattr(pytest_twin, name), name, module=False, globs=names
    )
    assert example.examples, "no example in its docstring"
    with np.printoptions(legacy="1.25"):
        results = doctest.DocTestRunner().run(example)
    assert results.failed == 0, capsys.readouterr().out


@pytest.mark.usefixtures("commands_in_process")
def test_the_example_of_the_docs_runs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    text = (ROOT / "docs" / "how-to" / "library.md").read_text("utf-8")
    examples = "".join(re.findall(r"^```pycon\n(.*?)^```$", text, re.MULTILINE | re.DOTALL))
    example = doctest.DocTestParser().get_doctest(examples, {}, "library.md", None, None)
    assert example.examples
    assert doctest.DocTestRunner().run(example).failed == 0


def test_the_package_is_imported_without_a_simulator() -> None:
    code = (
        "import sys, pytest_twin; "
        "assert 'replay' in dir(pytest_twin); "
        "print({'mujoco', 'numpy', 'pytest_twin.library'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'diagnosee'"):
        pytest_twin.diagnosee  # noqa: B018
