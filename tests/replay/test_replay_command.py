"""``pytest-twin replay``: written files, and one-line errors for unusable input."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from replay_trials import ARM, series

from pytest_twin import cli
from pytest_twin.formats.mcap import read_recording, write_recording
from pytest_twin.open_loop import replay
from pytest_twin.realization import load
from pytest_twin.trial import make_trial
from pytest_twin.twin import load_twin

JOINTS = ("shoulder", "elbow")
# The first two tests keep the child process of the command.
IN_PROCESS = pytest.mark.usefixtures("commands_in_process")
TWIN = "name: arm\nmodel: arm.xml\ncontrollers: {soft: {shoulder: {kp: 60}}}\n"


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    rng = np.random.default_rng(5)
    time = np.cumsum(rng.uniform(0.005, 0.015, 150))
    command = np.column_stack([0.4 * np.sin(3 * time), -0.2 * np.sin(5 * time)])
    state = series("/js", JOINTS, time, position=np.tile([0.1, -0.1], (150, 1)))
    sent = series("/jc", JOINTS, time - 0.003, position=command)
    write_recording(tmp_path / "moves.mcap", [state, sent], {"controller": "soft", "role": "fit"})
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "twin.yaml").write_text(TWIN + "topics: {state: /js, command: /jc}\n")
    return tmp_path


def test_the_prediction_is_written_at_the_recorded_stamps(
    arm: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = arm / "out.mcap"
    arguments = ["replay", str(arm / "twin.yaml"), str(arm / "moves.mcap"), "--out", str(out)]
    assert cli.main(arguments) == 0
    twin = load_twin(arm / "twin.yaml")
    trial = make_trial(read_recording(arm / "moves.mcap", twin.topics))
    (expected,) = replay(load(arm / "arm.xml", twin=twin), [trial])
    written = read_recording(out)
    state = written.series["state"]
    assert set(written.series) == {"state"}
    assert (state.topic, state.names) == ("/joint_states", JOINTS)
    assert np.array_equal(state.stamp, trial.stamps)
    assert np.array_equal(state.log_time, trial.stamps)
    for name in ("position", "velocity", "effort"):
        assert np.array_equal(getattr(state, name), getattr(expected, name))
    assert written.metadata == {"controller": "soft", "role": "fit"}
    summary = json.loads((arm / "out.json").read_text())
    residual = expected.position - trial.position
    assert summary["joints"]["elbow"]["rms"] == np.sqrt(np.mean(residual[:, 1] ** 2))
    assert summary["joints"]["shoulder"]["max"] == np.abs(residual[:, 0]).max()
    assert summary["samples"] == 150
    assert summary["trial"]["controller"] == "soft"
    said = capsys.readouterr()
    assert "150 states over" in said.out
    assert said.err == ""


def test_a_diverging_simulation_is_reported_in_one_line(
    arm: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wild = ARM.replace('kp="80" kv="4" forcerange="-10 10"', 'kp="1e9" kv="0"')
    (arm / "wild.xml").write_text(wild.replace("implicitfast", "Euler"))
    arguments = ["replay", str(arm / "wild.xml"), str(arm / "moves.mcap"), "--out",
                 str(arm / "o.mcap"), "--topics", "state=/js,command=/jc"]  # fmt: skip
    assert cli.main(arguments) == 2
    error = capsys.readouterr().err
    assert (
        "wild.xml: joint 'shoulder': the acceleration diverged 0 s after the first state" in error
    )
    assert not (arm / "o.mcap").exists()


@IN_PROCESS
def test_only_the_first_state_is_read(arm: Path) -> None:
    recorded = read_recording(arm / "moves.mcap", {"state": "/js", "command": "/jc"})
    state = recorded.series["state"]
    assert state.position is not None
    moved = state.position + np.concatenate([[0.0], np.full(149, 0.7)])[:, None]
    other = series("/js", JOINTS, (state.stamp - 1_700_000_000_000_000_000) * 1e-9, position=moved)
    write_recording(arm / "other.mcap", [other, recorded.series["command"]], recorded.metadata)
    for name in ("moves", "other"):
        assert cli.main(
            ["replay", str(arm / "twin.yaml"), str(arm / f"{name}.mcap"),
             "--out", str(arm / f"{name}_out.mcap")]
        ) == 0  # fmt: skip
    assert (arm / "moves_out.mcap").read_bytes() == (arm / "other_out.mcap").read_bytes()


@IN_PROCESS
def test_a_bare_model_is_replayed_with_topics_from_the_option(
    arm: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["replay", str(arm / "arm.xml"), str(arm / "moves.mcap"), "--out",
                 str(arm / "o.mcap"), "--topics", "state=/js,command=/jc"]  # fmt: skip
    assert cli.main(arguments) == 0
    assert (
        "note: moves.mcap names controller 'soft', which no twin.yaml declares: the nominal model "
        "was stepped"
    ) in capsys.readouterr().out


@IN_PROCESS
@pytest.mark.parametrize("name", ["twin.yaml", "model.xml"])
def test_the_output_folder_of_diagnose_is_accepted_as_model(arm: Path, name: str) -> None:
    folder = arm / "diagnosis"
    (folder / "realization").mkdir(parents=True)
    shutil.copy(arm / "arm.xml", folder / "realization" / "arm.xml")
    source = "twin.yaml" if name == "twin.yaml" else "arm.xml"
    shutil.copy(arm / source, folder / "realization" / name)
    arguments = ["replay", str(folder), str(arm / "moves.mcap"), "--out", str(arm / "o.mcap"),
                 "--topics", "state=/js,command=/jc"]  # fmt: skip
    assert cli.main(arguments) == 0
    assert json.loads((arm / "o.json").read_text())["model"].endswith(f"realization/{name}")


@IN_PROCESS
@pytest.mark.parametrize(
    ("model", "recording", "out", "words"),
    [
        ("none.xml", "moves.mcap", "o.mcap", "none.xml: no such model"),
        ("moves.mcap", "moves.mcap", "o.mcap", "moves.mcap: not a model that can be replayed"),
        ("empty", "moves.mcap", "o.mcap", "empty: no model in this folder (expected realization"),
        ("twin.yaml", "none.mcap", "o.mcap", "none.mcap: "),
        ("twin.yaml", "arm.xml", "o.mcap", "arm.xml: no recording that can be read"),
        ("arm.xml", "moves.mcap", "o.mcap", "moves.mcap: state: no state messages"),
        (
            "other.xml",
            "moves.mcap",
            "o.mcap",
            "the model has none of these joints (got 'shoulder, elbow'",
        ),
        ("twin.yaml", "moves.mcap", "moves.mcap", "would overwrite the recording itself"),
        ("twin.yaml", "moves.mcap", "o.csv", "o.csv: not a file name of a recording"),
        ("twin.yaml", "moves.mcap", "no/o.mcap", "no: no such folder"),
        ("broken.xml", "moves.mcap", "o.mcap", "broken.xml"),
    ],
)
def test_replay_reports_unusable_input_in_one_line_and_writes_no_file(
    arm: Path, model: str, recording: str, out: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (arm / "empty").mkdir()
    (arm / "broken.xml").write_text("<mujoco><worldbody><body></mujoco>")
    (arm / "other.xml").write_text(ARM.replace('"shoulder"', '"hip"').replace('"elbow"', '"knee"'))
    before = sorted(arm.rglob("*"))
    topics = ["--topics", "state=/js,command=/jc"] if model == "other.xml" else []
    arguments = ["replay", str(arm / model), str(arm / recording), "--out", str(arm / out), *topics]
    assert cli.main(arguments) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("pytest-twin replay: ")
    assert words in said.err
    assert said.err.count("\n") == 1
    assert sorted(arm.rglob("*")) == before


@pytest.mark.parametrize("text", ["state", "joint=/x", "state=/x,state=/y", "state="])
def test_an_invalid_topics_option_is_refused(
    text: str, arm: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["replay", "a.xml", "b.mcap", "--out", "c.mcap", "--topics", text])
    assert ended.value.code == 2
    assert "expected state=/x,command=/y or one of them" in capsys.readouterr().err
