"""Values without joint names in another order than the model's are not taken in silence."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from foreign_logs import ARM, TRUE_RMS, recorded, replayed, trial_of, write

from pytest_twin import cli
from pytest_twin.checks.replay import Replay
from pytest_twin.errors import RecordingError
from pytest_twin.gate.specs import load_golden
from pytest_twin.realization import load
from pytest_twin.replay_order import doubt_of_order
from pytest_twin.twin import load_twin


@pytest.mark.usefixtures("commands_in_process")
def test_another_order_is_suspected_and_its_mapping_gives_the_right_replay(tmp_path: Path) -> None:
    swapped = {
        role: replace(one, position=one.position[:, ::-1], names=("0", "1"))  # type: ignore[index]
        for role, one in recorded().items()
    }
    log = write(tmp_path / "log.mcap", swapped)
    _, notes = replayed(log, tmp_path)
    suspicion = [note for note in notes if "the order of the joints may be j2, j1" in note]
    assert len(suspicion) == 1
    rms, notes = replayed(log, tmp_path, "--joints", "0=j2,1=j1")
    assert rms == pytest.approx(TRUE_RMS, abs=1e-4)
    assert not any("order of the joints" in note for note in notes)


def test_the_right_order_is_not_suspected(tmp_path: Path) -> None:
    unnamed = {role: replace(one, names=("0", "1")) for role, one in recorded().items()}
    trial = trial_of(write(tmp_path / "log.mcap", unnamed))
    assert trial.unnamed == {"state", "command"}
    assert doubt_of_order(load(ARM), trial) is None
    named = trial_of(write(tmp_path / "named.mcap", recorded()))
    assert named.unnamed == frozenset()


@pytest.mark.usefixtures("commands_in_process")
def test_every_command_says_the_doubt(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    swapped = {
        role: replace(one, position=one.position[:, ::-1], names=("0", "1"))  # type: ignore[index]
        for role, one in recorded().items()
    }
    log = str(write(tmp_path / "log.mcap", swapped))
    words = (
        "the joints are not named, and may be in another order",
        "the order of the joints may be j2, j1: it predicts the motion with",
        "--joints 0=j2,1=j1, or in the assumed order --joints 0=j1,1=j2",
    )
    assert cli.main(["show", str(ARM), log]) == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in words)
    for command in ("diagnose", "identify"):
        assert cli.main([command, str(ARM), log, "--out", str(tmp_path / command)]) == 2
        error = capsys.readouterr().err.splitlines()[-1]
        assert all(word in error for word in words)


def test_a_replay_golden_does_not_take_another_order(tmp_path: Path) -> None:
    unnamed = {
        role: replace(one, position=one.position[:, ::-1], names=("0", "1"))  # type: ignore[index]
        for role, one in recorded().items()
    }
    write(tmp_path / "log.mcap", unnamed)
    (tmp_path / ARM.name).write_text(ARM.read_text())
    (tmp_path / "twin.yaml").write_text(f"name: arm\nmodel: {ARM.name}\n")
    (tmp_path / "replay.yaml").write_text(
        "schema: 1\nkind: replay\ntarget: {recording: log.mcap}\ntolerance: {angle_rms: 1 rad}\n"
    )
    twin = load_twin(tmp_path / "twin.yaml")
    robot = load(tmp_path / ARM.name, twin=twin)
    spec = load_golden(tmp_path / "replay.yaml", twin)
    with pytest.raises(RecordingError, match="may be in another order"):
        Replay().trials(spec, robot)


@pytest.mark.usefixtures("commands_in_process")
def test_a_named_order_is_taken_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    swapped = {role: replace(one, names=("0", "1")) for role, one in recorded().items()}
    log = str(write(tmp_path / "log.mcap", swapped))
    assert cli.main(["show", str(ARM), log, "--joints", "0=j2,1=j1"]) == 0
    assert "in another order" not in capsys.readouterr().out
