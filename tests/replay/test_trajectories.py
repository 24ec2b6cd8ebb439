"""``JointTrajectory`` commands: the prediction follows the course that the controller commands."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from pytest_twin import cli
from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import JointSeries
from pytest_twin.trial import make_trial, recording_at

pytestmark = pytest.mark.usefixtures("commands_in_process")
INPUTS = Path(__file__).parent / "trajectories"
NOISE = 0.0004
"""rad. Standard deviation of the recorded positions."""


@pytest.mark.parametrize("name", ["linear", "cubic", "cubic_once", "cubic_target_only", "servo"])
def test_a_trajectory_is_predicted_to_the_noise(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "predicted.mcap"
    arguments = ["replay", str(INPUTS / "arm.xml"), str(INPUTS / f"{name}.mcap")]
    assert cli.main([*arguments, "--out", str(out)]) == 0
    summary = json.loads(out.with_suffix(".json").read_text())
    assert max(joint["rms"] for joint in summary["joints"].values()) < 1.5 * NOISE
    assert summary["marks"] == []
    assert "not used: velocity" not in capsys.readouterr().out


def test_show_counts_the_setpoints_of_trajectories(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["show", str(INPUTS / "arm.xml"), str(INPUTS / "linear.mcap")]) == 0
    assert "setpoints of trajectories of 2 joints" in capsys.readouterr().out


def test_converted_trajectories_replay_alike(tmp_path: Path) -> None:
    converted = tmp_path / "converted.mcap"
    assert cli.main(["convert", str(INPUTS / "cubic.mcap"), "--out", str(converted)]) == 0
    rms = []
    for number, file in enumerate((INPUTS / "cubic.mcap", converted)):
        out = tmp_path / f"{number}.mcap"
        assert cli.main(["replay", str(INPUTS / "arm.xml"), str(file), "--out", str(out)]) == 0
        rms.append(json.loads(out.with_suffix(".json").read_text())["joints"]["j1"]["rms"])
    assert rms[1] == pytest.approx(rms[0], rel=1e-6)


PERIOD = 0.008
"""s. Update period of a controller that holds its setpoints."""
TOPICS = {"state": "/joint_states", "command": "/joint_commands"}


def held_setpoints(folder: Path, metadata: dict[str, str] | None = None) -> Path:
    """The trajectories of ``cubic.mcap``, played by a controller that updates every 8 ms."""
    given = make_trial(recording_at(INPUTS / "cubic.mcap", TOPICS))
    model = mujoco.MjModel.from_xml_path(str(INPUTS / "arm.xml"))
    model.opt.timestep = 0.0005
    data = mujoco.MjData(model)
    data.qpos[:] = given.position[0]
    random = np.random.default_rng(4)
    first = float(given.command_time[0])
    every = round(float(np.median(np.diff(given.time))) / model.opt.timestep)
    rows = []
    for step in range(every * len(given.time)):
        time = step * model.opt.timestep
        update = first + PERIOD * np.floor((time - first) / PERIOD + 1e-9)
        if step % every == 0:
            rows.append(data.qpos + NOISE * random.standard_normal(model.nq))
        data.ctrl[:] = given.setpoint.at(np.array([max(update, first)]))[0]
        mujoco.mj_step(model, data)
    stamp = given.start + np.rint(np.arange(len(rows)) * every * 5e5).astype(np.int64)
    states = JointSeries("/joint_states", given.joints, stamp, stamp, np.array(rows), None, None)
    write_recording(folder / "states.mcap", [states], metadata or {})
    # The messages of the trajectories go beside the new states as they are.
    with (
        (INPUTS / "cubic.mcap").open("rb") as source,
        (folder / "states.mcap").open("rb") as made,
        (folder / "log.mcap").open("wb") as target,
    ):
        writer = Writer(target)
        writer.start()
        for file, topic in ((made, "/joint_states"), (source, "/joint_commands")):
            channel = None
            for schema, old, message in make_reader(file).iter_messages(topics=[topic]):
                if channel is None:
                    schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channel = writer.register_channel(topic, old.message_encoding, schema_id)
                writer.add_message(channel, message.log_time, message.data, message.publish_time)
        if metadata:
            writer.add_metadata("trial", metadata)
        writer.finish()
    return folder / "log.mcap"


def test_a_controller_that_holds_its_setpoints_is_asked_for_and_honoured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = held_setpoints(tmp_path), tmp_path / "p.mcap"
    arguments = ["replay", str(INPUTS / "arm.xml"), str(log), "--out", str(out)]

    def rms(*options: str) -> float:
        assert cli.main([*arguments, *options]) == 0
        summary = json.loads(out.with_suffix(".json").read_text())
        return max(joint["rms"] for joint in summary["joints"].values())

    assert rms() > 5.0 * NOISE
    assert "--controller-period SECONDS, or controller_period in twin.yaml" in (
        capsys.readouterr().out
    )
    assert rms("--controller-period", str(PERIOD)) < 1.5 * NOISE
    assert "the controller holds each setpoint of its trajectories for 8 ms" in (
        capsys.readouterr().out
    )


def test_the_period_may_be_in_the_metadata_or_in_the_twin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = str(held_setpoints(tmp_path, {"controller_period": "0.008"}))
    words = "the controller holds each setpoint of its trajectories for 8 ms"
    assert cli.main(["show", str(INPUTS / "arm.xml"), log]) == 0
    assert words in capsys.readouterr().out
    (tmp_path / "arm.xml").write_text((INPUTS / "arm.xml").read_text())
    (tmp_path / "twin.yaml").write_text("name: a\nmodel: arm.xml\ncontroller_period: 0.004\n")
    assert cli.main(["show", str(tmp_path / "twin.yaml"), log]) == 0
    assert words.replace("8 ms", "4 ms") in capsys.readouterr().out
    wrong = str(held_setpoints(tmp_path, {"controller_period": "fast"}))
    assert cli.main(["replay", str(INPUTS / "arm.xml"), wrong, "--out", str(tmp_path / "p.mcap")])
    assert "controller_period of the trial's metadata is no period (got 'fast' s" in (
        capsys.readouterr().err
    )
