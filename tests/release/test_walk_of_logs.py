"""One motion, logged as each program logs it, means the same to every command."""

from __future__ import annotations

import gzip
import json
import shutil
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from release_twins import MakeRelease

from pytest_twin import cli
from pytest_twin.formats.mcap import read_recording, write_recording
from pytest_twin.formats.recording import TOPICS, JointSeries

sys.path.append(str(Path(__file__).parents[1] / "formats"))

import ros_messages as ros
from bag_files import MCAP, SQLITE, write_bag
from lerobot_files import JOINTS, write_dataset
from mcap_files import START, Message, cdr, mcap
from test_foxglove_messages import as_json, protobuf

FPS = 50
ARM = """<mujoco><compiler angle="radian"/><option timestep="0.002"/>
<worldbody><body name="link1" pos="0 0 0.2"><joint name="shoulder_pan" axis="0 1 0" damping="{}"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="1"/>
<body name="link2" pos="0.3 0 0"><joint name="elbow_flex" axis="0 1 0" damping="0.5"/>
<geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.5"/></body></body></worldbody>
<actuator><position name="a" joint="shoulder_pan" kp="60" kv="3"/>
<position name="b" joint="elbow_flex" kp="30" kv="1"/></actuator></mujoco>"""


class Motion:
    """States and commands at 50 Hz; the plant has more damping than the model."""

    def __init__(self, folder: Path, rate: float) -> None:
        self.model = folder / "arm.xml"
        self.model.write_text(ARM.format(1.0))
        plant = folder / "plant.xml"
        plant.write_text(ARM.format(1.5))
        time = np.arange(2 * FPS) / FPS
        self.stamp = START + np.rint(1e9 * time).astype(np.int64)
        self.command = np.column_stack([0.4 * np.sin(rate * time), 0.3 * np.cos(3.0 * time)])
        sent = self.series("/joint_commands", self.command)
        first = self.series("/joint_states", np.tile(self.command[0], (len(time), 1)))
        write_recording(folder / "sent.mcap", [sent, first])
        predicted = folder / "predicted.mcap"
        assert replay(plant, folder / "sent.mcap", predicted)
        state = read_recording(predicted).series["state"].position
        assert state is not None
        self.state = state

    def series(self, topic: str, position: np.ndarray) -> JointSeries:
        return JointSeries(topic, JOINTS, self.stamp, self.stamp, position, None, None)

    def messages(self) -> list[Message]:
        rows = zip(self.stamp.tolist(), self.state.tolist(), self.command.tolist(), strict=True)
        return [
            Message(at, JOINTS, tuple(values), topic=topic)
            for at, *both in rows
            for topic, values in zip(TOPICS.values(), both, strict=True)
        ]


def replay(model: Path, recording: Path, out: Path, *options: str) -> dict[str, float]:
    assert cli.main(["replay", str(model), str(recording), "--out", str(out), *options]) == 0
    result = json.loads(out.with_suffix(".json").read_text())
    return {name: one.get("rms", 0.0) for name, one in result["joints"].items()}


def csv(motion: Motion, headings: tuple[str, ...], separator: str = ",", point: str = ".") -> str:
    time = (motion.stamp - START) * 1e-9
    rows = np.column_stack([time, motion.state, motion.command]).tolist()
    lines = [separator.join(repr(value).replace(".", point) for value in row) for row in rows]
    return "\n".join([separator.join(headings), *lines]) + "\n"


OWN = ("time", *(f"{j}.position" for j in JOINTS), *(f"{j}.command" for j in JOINTS))
PLOTJUGGLER = ("__time", *(f"/joint_{of}/{j}/position" for of in ("states", "commands")
                           for j in JOINTS))  # fmt: skip


def bag(path: Path, *topics: tuple[str, str, str, list[tuple[int, bytes]]]) -> Path:
    """An MCAP file of (topic, schema, encoding, messages)."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channels = []
        for topic, schema, encoding, _ in topics:
            kind = "ros2msg" if encoding == "cdr" else encoding
            number = writer.register_schema(schema, kind, b"x")
            channels.append(writer.register_channel(topic, encoding, number))
        listed = [
            (at, channel, data)
            for channel, (*_, messages) in zip(channels, topics, strict=True)
            for at, data in messages
        ]
        for at, channel, data in sorted(listed):
            writer.add_message(channel, at, data, at)
        writer.finish()
    return path


def rows(motion: Motion, encode: Callable[[int, list[float], list[float]], bytes]) -> Any:
    """A message for each row: encode(stamp, state, command)."""
    table = zip(motion.stamp.tolist(), motion.state.tolist(), motion.command.tolist(), strict=True)
    return [(at, encode(at, state, command)) for at, state, command in table]


def states(motion: Motion) -> Any:
    measured = [m for m in motion.messages() if m.topic == "/joint_states"]
    return "/joint_states", ros.JOINT_STATE, "cdr", [(m.stamp, cdr(m)) for m in measured]


def foxglove(motion: Motion, folder: Path, encoding: str) -> Path:
    encode = protobuf if encoding == "protobuf" else as_json

    def joints(values: list[float]) -> list[tuple[str, dict[str, float]]]:
        return [(n, {"position": v}) for n, v in zip(JOINTS, values, strict=True)]

    topics = [
        ("/joint_states", rows(motion, lambda at, state, _: encode(at, joints(state)))),
        ("/joint_commands", rows(motion, lambda at, _, sent: encode(at, joints(sent)))),
    ]
    return bag(
        folder / "log.mcap", *((t, "foxglove.JointStates", encoding, rows_) for t, rows_ in topics)
    )


def written(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def bare_db3(motion: Motion, folder: Path) -> Path:
    whole = write_bag(folder / "bag", motion.messages(), SQLITE)
    (file,) = whole.glob("*.db3")
    return Path(shutil.copy(file, folder / "log.db3"))


def controller_state(motion: Motion, folder: Path, old: bool) -> Path:
    messages = rows(
        motion,
        lambda at, state, sent: ros.controller_state(
            at, JOINTS, ros.point(sent), ros.point(state), old=old
        ),
    )
    return bag(folder / "log.mcap", ("/c/state", ros.CONTROLLER_STATE, "cdr", messages))


def dynamic(motion: Motion, folder: Path) -> Path:
    def message(at: int, values: list[float]) -> bytes:
        return ros.dynamic(at, {n: {"position": v} for n, v in zip(JOINTS, values, strict=True)})

    return bag(
        folder / "log.mcap",
        ("/joint_states", ros.DYNAMIC, "cdr", rows(motion, lambda at, s, _: message(at, s))),
        ("/joint_commands", ros.DYNAMIC, "cdr", rows(motion, lambda at, _, c: message(at, c))),
    )


def array(motion: Motion, folder: Path) -> Path:
    sent = rows(motion, lambda at, _, c: ros.array(c))
    return bag(folder / "log.mcap", states(motion), ("/joint_commands", ros.ARRAY, "cdr", sent))


def trajectories(motion: Motion, folder: Path) -> Path:
    """One point a message, which is reached when the next message arrives."""
    period = 10**9 // FPS
    sent = [
        (at - period, ros.trajectory(at - period, JOINTS, [ros.point(c, after=period)]))
        for at, c in zip(motion.stamp.tolist(), motion.command.tolist(), strict=True)
    ]
    return bag(
        folder / "log.mcap", states(motion), ("/joint_commands", ros.TRAJECTORY, "cdr", sent)
    )


def lerobot(motion: Motion, folder: Path, version: str, scale: float = 1.0) -> Path:
    time = (motion.stamp - START) * 1e-9
    one = {"time": time, "state": motion.state, "action": motion.command}
    return write_dataset(folder / "set", [one], version, fps=FPS, scale=scale)


CONTROLLER = ("--topics", "state=/c/state,command=/c/state")
LOGS: dict[str, tuple[Callable[[Motion, Path], Path], tuple[str, ...]]] = {
    "MCAP, CDR": (lambda m, f: written(f / "log.mcap", mcap(m.messages())), ()),
    "MCAP, JSON": (lambda m, f: written(f / "log.mcap", mcap(m.messages(), encoding="json")), ()),
    "rosbag2, MCAP": (lambda m, f: write_bag(f / "bag", m.messages(), MCAP), ()),
    "rosbag2, SQLite": (lambda m, f: write_bag(f / "bag", m.messages(), SQLITE), ()),
    ".db3": (bare_db3, ()),
    "CSV": (lambda m, f: written(f / "log.csv", csv(m, OWN)), ()),
    "CSV, decimal commas": (lambda m, f: written(f / "log.csv", csv(m, OWN, ";", ",")), ()),
    "CSV, compressed": (
        lambda m, f: written(f / "log.csv.gz", gzip.compress(csv(m, OWN).encode())),
        (),
    ),
    "PlotJuggler": (lambda m, f: written(f / "log.csv", csv(m, PLOTJUGGLER)), ()),
    "foxglove, Protobuf": (lambda m, f: foxglove(m, f, "protobuf"), ()),
    "foxglove, JSON": (lambda m, f: foxglove(m, f, "json"), ()),
    "controller state": (lambda m, f: controller_state(m, f, False), CONTROLLER),
    "controller state of ROS 2 Humble": (lambda m, f: controller_state(m, f, True), CONTROLLER),
    "DynamicJointState": (dynamic, ()),
    "Float64MultiArray": (array, ()),
    "JointTrajectory": (trajectories, ()),
    "LeRobot 2.1": (lambda m, f: lerobot(m, f, "v2.1"), ()),
    "LeRobot 3.0": (lambda m, f: lerobot(m, f, "v3.0"), ()),
    "LeRobot 3.0, degrees": (lambda m, f: lerobot(m, f, "v3.0", 180.0 / np.pi), ("--units", "deg")),
}


@pytest.fixture(scope="module")
def motions(
    commands_in_process: None, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Motion, Motion]:
    """The motion to fit and the one that is held out."""
    folder = tmp_path_factory.mktemp("motions")
    return Motion(folder, 4.0), Motion(folder, 5.0)


def errors(motions: tuple[Motion, Motion], logs: list[Path], out: Path, *options: str) -> Any:
    """Joint -> RMS error (rad) in the replay of each log, and held-out error in their diagnosis."""
    model = motions[0].model
    found = [replay(model, log, out / f"{i}.mcap", *options) for i, log in enumerate(logs)]
    command = ["diagnose", str(model), str(logs[0]), "--held-out", str(logs[1])]
    limit = ["--out", str(out / "diagnosis"), "--seconds", "0.1"]
    assert cli.main([*command, *options, *limit]) in (0, 1)
    diagnosis = json.loads((out / "diagnosis/diagnosis.json").read_text())
    held_out = {joint: one["rms_before"] for joint, one in diagnosis["held_out"].items()}
    return [*found, held_out]


@pytest.fixture(scope="module")
def expected(motions: tuple[Motion, Motion], tmp_path_factory: pytest.TempPathFactory) -> Any:
    """How commands act between their stamps -> errors of plain MCAP files."""
    found = {}
    for between in ("held", "interpolated"):
        folder = tmp_path_factory.mktemp(between)
        logs = [written(folder / f"m{i}.mcap", mcap(m.messages())) for i, m in enumerate(motions)]
        found[between] = errors(motions, logs, folder, "--command-between", between)
    return found


@pytest.mark.parametrize("kind", LOGS)
def test_a_log_of_each_kind_means_the_same_to_every_command(
    kind: str, motions: tuple[Motion, Motion], expected: Any, root: Path, make: MakeRelease,
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    write, options = LOGS[kind]
    between = "interpolated" if kind == "JointTrajectory" else "held"
    make(datetime.now(UTC))
    logs, converted = [], []
    for name, motion in zip(("fit", "held_out"), motions, strict=True):
        (tmp_path / name).mkdir()
        log = write(motion, tmp_path / name)
        logs.append(log)
        converted.append(tmp_path / f"{name}.mcap")
        assert cli.main(["convert", str(log), "--out", str(converted[-1]), *options]) == 0
        assert cli.main(["show", str(log), *options]) == 0
        for data in (log, converted[-1]):
            status = cli.main(["stamp", str(data), "--release", str(root)])
            if status == 0:
                assert cli.main(["verify", str(data)]) == 0
            else:
                assert data == log
                assert "pytest-twin convert writes" in capsys.readouterr().err
    found = errors(motions, logs, tmp_path, *options, "--command-between", between)
    found += [
        replay(motions[0].model, one, tmp_path / "again.mcap", "--command-between", between)
        for one in converted
    ]
    for mine, other in zip(found, [*expected[between], *expected[between][:2]], strict=True):
        assert mine == pytest.approx(other, rel=1e-9)
    if kind.startswith("LeRobot"):
        command = ["check-dataset", str(logs[0]), "--out", str(tmp_path / "checked"), *options]
        assert cli.main(command) == 0
