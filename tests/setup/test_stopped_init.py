"""An init that is killed, or whose output nobody reads, leaves no half twin that looks whole."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from killed import at_every_operation

from pytest_twin.cli import main
from pytest_twin.errors import SpecError
from pytest_twin.formats import atomic, temporary
from pytest_twin.setup import writing
from pytest_twin.twin import UNFINISHED_INIT, load_twin

MODEL = """<mujoco><compiler angle="radian"/><worldbody><body name="link">
  <joint name="knee" axis="0 1 0" range="-1 1"/><geom size=".1"/></body></worldbody></mujoco>"""
WRITTEN = ("twin.yaml", "golden/fk/frames.yaml", "schemas/twin.schema.json", ".gitignore")


def write_twin(folder: Path) -> None:
    with writing.all_or_nothing(folder):
        for name in WRITTEN:
            atomic.make_folder((folder / name).parent)
            atomic.write_text(folder / name, "model: robot.xml\n")
        assert load_twin(folder / "twin.yaml").name


def test_a_twin_whose_init_was_killed_is_refused_and_set_aside(tmp_path: Path) -> None:
    folder = tmp_path / "twin"
    users = folder / "golden" / "notes.txt"

    def fresh_folder() -> None:
        shutil.rmtree(folder, ignore_errors=True)
        users.parent.mkdir(parents=True)
        users.write_text("mine")
        (folder / "robot.xml").write_text(MODEL)

    states = set()

    def check(operations: int) -> None:
        if (folder / UNFINISHED_INIT).is_file():
            with pytest.raises(SpecError, match="init was stopped before this twin was complete"):
                load_twin(folder / "twin.yaml")
            aside = writing.set_aside(folder)
            assert aside is not None
            assert not any((folder / name).exists() for name in WRITTEN)
            names = {p.name for p in aside.rglob("*") if not p.name.startswith(temporary.PREFIX)}
            assert names <= {part for name in WRITTEN for part in Path(name).parts}
            state = "refused"
        elif (folder / "twin.yaml").is_file():
            assert all((folder / name).is_file() for name in WRITTEN), operations
            assert load_twin(folder / "twin.yaml").name
            state = "whole"
        else:
            state = "none"
        states.add(state)
        assert users.read_text() == "mine"
        assert writing.set_aside(folder) is None
        fresh_folder()

    fresh_folder()
    assert at_every_operation(lambda: write_twin(folder), check) > 10
    assert states >= {"refused", "none"}
    assert sorted(p.name for p in folder.iterdir()) == sorted(
        {".gitignore", "golden", "robot.xml", "schemas", "twin.yaml", ".twin"}
    )
    load_twin(folder / "twin.yaml")


def test_init_after_a_killed_one_says_what_it_sets_aside(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "robot.xml").write_text(MODEL)
    mark = tmp_path / ".twin" / "init" / "before.json"
    mark.parent.mkdir(parents=True)
    mark.write_text("[]")
    (tmp_path / "twin.yaml").write_text("model: robot.xml\n")
    assert main(["verify", str(tmp_path)]) == 2
    assert main(["init", str(tmp_path / "robot.xml"), "--out", str(tmp_path)]) == 0
    assert "note: an earlier init was stopped; what it had written is now in" in (
        capsys.readouterr().out
    )
    assert not mark.parent.exists()
    assert main(["init", str(tmp_path / "robot.xml"), "--out", str(tmp_path)]) == 2
    assert "a twin exists already" in capsys.readouterr().err


def test_a_reader_that_closes_the_pipe_does_not_undo_the_twin(tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text(MODEL)
    process = subprocess.Popen(
        [sys.executable, "-m", "pytest_twin.cli", "init", "robot.xml"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert process.stdout is not None
    process.stdout.close()
    assert process.wait(timeout=100) == 141
    assert load_twin(tmp_path / "twin.yaml").name == "robot"
    assert list((tmp_path / "golden").rglob("*.yaml"))
