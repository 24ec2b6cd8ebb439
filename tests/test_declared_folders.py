"""``--root`` and ``--package`` hold for every command that reads models."""

from __future__ import annotations

from pathlib import Path

import pytest

from pytest_twin.cli import COMMANDS, main, parser
from pytest_twin.formats.declared_inputs import declared_inputs

# Commands without a model; those that read data have --root alone.
NO_MODEL = {"completion", "demo", "effects", "intake", "rollback", "verify"}
DATA_ALONE = {"convert", "stamp"}


@pytest.mark.parametrize("command", [c for c in COMMANDS if c not in NO_MODEL])
def test_every_command_that_reads_models_takes_root_and_package(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        parser([command]).parse_args([command, "--help"])
    text = capsys.readouterr().out
    assert "--root DIR" in text
    assert ("--package NAME=DIR" in text) == (command not in DATA_ALONE)


def test_folders_are_declared_while_the_command_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = {}

    def run(args: object) -> int:
        seen["here"] = declared_inputs()
        return 0

    monkeypatch.setattr("pytest_twin.commands.audit.run", run)
    robot = tmp_path / "link.urdf"
    robot.symlink_to(tmp_path / "elsewhere.urdf")
    (tmp_path / "mine").mkdir()
    assert (
        main(["audit", str(robot), "--root", str(tmp_path), "--package", f"arm={tmp_path}/mine"])
        == 0
    )
    assert seen["here"].roots == (tmp_path, tmp_path / "elsewhere.urdf")
    assert seen["here"].packages == {"arm": tmp_path / "mine"}
    assert declared_inputs().roots == ()
