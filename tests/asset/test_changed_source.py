"""A source that was changed after its intake is reported; realization and release are refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from asset_robots import write_arm

from pytest_twin.cli import main
from pytest_twin.gate.parts import collect_dependencies
from pytest_twin.gate.source_changes import changed_sources
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.twin import load_twin

pytestmark = pytest.mark.usefixtures("commands_in_process")


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A twin of an asset after intake and realization."""
    tmp_path = tmp_path_factory.mktemp("template")
    folder = tmp_path / "twin/asset"
    package = write_arm(tmp_path).parents[1]
    assert main(["intake", str(package), "--out", str(folder)]) == 0
    assert main(["realize", str(folder / "source/urdf/arm.urdf"), "--out", str(folder)]) == 0
    (tmp_path / "twin/twin.yaml").write_text(
        "schema: 1\nname: arm\nmodel: asset/arm.xml\nsource: [asset/source/urdf/arm.urdf]\n"
    )
    return folder.parent


@pytest.fixture
def asset(template: Path, tmp_path: Path) -> Path:
    """The asset folder of a separate copy of the twin for each test."""
    return Path(shutil.copytree(template, tmp_path / "twin")) / "asset"


def reported_changes(asset: Path) -> list[str]:
    return list(changed_sources(load_twin(asset.parent / "twin.yaml")))


def test_for_an_unchanged_source_nothing_is_reported(asset: Path) -> None:
    assert reported_changes(asset) == []


def _edit_urdf(asset: Path) -> str:
    path = asset / "source/urdf/arm.urdf"
    path.chmod(0o644)
    path.write_text(path.read_text().replace('value="2"', 'value="3"'))
    return "source/urdf/arm.urdf was changed"


def _change_mesh(asset: Path) -> str:
    path = asset / "source/meshes/part.stl"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes() + b"\0")
    return "source/meshes/part.stl was changed"


def _remove_mesh(asset: Path) -> str:
    (asset / "source/meshes/part.dae").unlink()
    return "source/meshes/part.dae: no such file"


def _add_file(asset: Path) -> str:
    (asset / "source/urdf/notes.txt").write_text("x")
    return "source/urdf/notes.txt was added"


@pytest.mark.parametrize("change", [_edit_urdf, _change_mesh, _remove_mesh, _add_file])
def test_a_changed_source_is_reported_and_refused_by_release_and_realize(
    asset: Path, change: Callable[[Path], str], capsys: pytest.CaptureFixture[str]
) -> None:
    words = change(asset)
    lines = reported_changes(asset)
    assert len(lines) == 1
    assert f"the source asset has changed since intake: {words}" in lines[0]
    # The gate refuses a release while there are problems.
    with Sandbox() as sandbox:
        problems = collect_dependencies(load_twin(asset.parent / "twin.yaml"), [], sandbox).problems
    assert lines[0] in problems
    capsys.readouterr()
    arguments = ["realize", str(asset / "source/urdf/arm.urdf"), "--out", str(asset)]
    assert main(arguments) == 2
    assert "the source asset has changed since intake" in capsys.readouterr().err
