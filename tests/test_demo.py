"""``pytest-twin demo`` copies what the package brings, to be run without a checkout."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from pytest_twin import cli
from pytest_twin.commands import demo

ROOT = Path(__file__).parents[1]


def test_the_demo_is_a_copy_of_arm_and_example(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["demo", str(tmp_path / "new/demo")]) == 0
    assert "pytest --twin-release" in capsys.readouterr().out
    for copied, source in (("arm/golden", "golden"), ("carriage", "examples/carriage")):
        folder = tmp_path / "new/demo" / copied
        files = {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.*")
                 if path.is_file()}  # fmt: skip
        assert Path("twin.yaml") in files
        for path, content in files.items():
            assert content == (ROOT / source / path).read_bytes()
    assert not (tmp_path / "new/demo/arm/golden/make").exists()


def test_a_demo_does_not_write_into_a_folder_that_exists(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["demo", str(tmp_path)]) == 2
    assert "already exists" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_wheel_has_the_files_where_the_command_looks_for_them() -> None:
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    places = build["targets"]["wheel"]["sources"]
    packages = demo._PACKAGE.parent
    assert places == {
        checkout.relative_to(packages).as_posix(): wheel.relative_to(packages).as_posix()
        for wheel, checkout in demo._SOURCES.values()
    }
    assert {f"/{source}" for source in places} <= set(build["include"])
