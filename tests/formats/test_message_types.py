"""Commands and states in ros2_control messages in CDR, ROS 1 and JSON encoding."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import ros_messages as ros
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from mcap_files import START, Message, cdr, put

from pytest_twin.errors import FormatError, RecordingError, TwinError
from pytest_twin.formats.recording import JointSeries, Recording
from pytest_twin.formats.recordings import read_one

NAN = np.nan
MS = 1_000_000
JOINTS = ("a", "b")


def bag(
    messages: Iterable[tuple[str, str, int, bytes]], encoding: str = "cdr", *, long: bool = True
) -> bytes:
    """An MCAP file of (topic, type, log time in ns, message) tuples."""
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start(profile="ros2", library="test")
    channels: dict[str, int] = {}
    for topic, kind, log_time, data in messages:
        if topic not in channels:
            name = kind if long else kind.replace("/msg/", "/")
            schema = writer.register_schema(name, "ros2msg", b"x")
            channels[topic] = writer.register_channel(topic, encoding, schema)
        writer.add_message(channels[topic], log_time, data, log_time)
    writer.finish()
    return stream.getvalue()


def read(folder: Path, data: bytes, **topics: str) -> Recording:
    return read_one(put(folder, data), topics)


@pytest.mark.parametrize("old", [True, False])
@pytest.mark.parametrize("long", [True, False])
def test_a_controller_state_is_read_as_command_and_state(
    tmp_path: Path, old: bool, long: bool
) -> None:
    messages = [
        (
            "/jtc",
            ros.CONTROLLER_STATE,
            START + k * MS + 5,
            ros.controller_state(
                START + k * MS,
                JOINTS,
                ros.point([k + 0.1, -k], [1.0, 2.0]),
                ros.point([k + 0.2, -k], (), [3.0, 4.0]),
                old=old,
            ),
        )
        for k in range(5)
    ]
    recording = read(tmp_path, bag(messages, long=long), state="/jtc", command="/jtc")
    command, state = recording.series["command"], recording.series["state"]
    assert command.names == state.names == JOINTS
    assert state.stamp.tolist() == [START + k * MS for k in range(5)]
    assert state.log_time.tolist() == [START + k * MS + 5 for k in range(5)]
    np.testing.assert_array_equal(command.position, [[k + 0.1, -k] for k in range(5)])
    np.testing.assert_array_equal(command.velocity, [[1.0, 2.0]] * 5)
    assert command.effort is None
    np.testing.assert_array_equal(state.position, [[k + 0.2, -k] for k in range(5)])
    np.testing.assert_array_equal(state.effort, [[3.0, 4.0]] * 5)
    assert recording.damage == ()
    (topic,) = recording.topics
    assert (topic.type, topic.messages, topic.joints) == (ros.CONTROLLER_STATE, 5, JOINTS)


def test_dynamic_joint_states_may_have_different_interfaces_per_joint(tmp_path: Path) -> None:
    joints = {
        "a": {"velocity": 1.5, "position": 0.5, "temperature": 40.0},
        "b": {"position": -0.5},
        "gripper": {"voltage": 12.0},
    }
    messages = [("/d", ros.DYNAMIC, START + k, ros.dynamic(START + k, joints)) for k in range(3)]
    state = read(tmp_path, bag(messages), state="/d").series["state"]
    assert state.names == ("a", "b", "gripper")
    np.testing.assert_array_equal(state.position, [[0.5, -0.5, NAN]] * 3)
    np.testing.assert_array_equal(state.velocity, [[1.5, NAN, NAN]] * 3)
    assert state.effort is None


@pytest.mark.parametrize(
    ("topic", "labels", "names", "filled"),
    [
        ("/c", ("a", "b"), ("a", "b"), ("position", "velocity", "effort")),
        ("/c", (), ("0", "1"), ("position", "velocity", "effort")),
        ("/c", ("joints",), ("0", "1"), ("position", "velocity", "effort")),
        ("/forward_velocity_controller/commands", (), ("0", "1"), ("velocity",)),
        ("/joint_group_effort_controller/commands", ("a", "b"), ("a", "b"), ("effort",)),
    ],
)
def test_array_commands_are_named_by_labels_or_index_with_notes(
    tmp_path: Path,
    topic: str,
    labels: tuple[str, ...],
    names: tuple[str, ...],
    filled: tuple[str, ...],
) -> None:
    messages = [(topic, ros.ARRAY, START + k * MS, ros.array([k, k + 1], labels)) for k in range(3)]
    recording = read(tmp_path, bag(messages), command=topic)
    command = recording.series["command"]
    assert command.names == names
    assert command.stamp.tolist() == command.log_time.tolist()
    for quantity in ("position", "velocity", "effort"):
        table = getattr(command, quantity)
        if quantity in filled:
            np.testing.assert_array_equal(table, [[0, 1], [1, 2], [2, 3]])
        else:
            assert table is None
    assert recording.damage == ()
    said = " ".join(recording.notes)
    assert "has no stamp: the recorder's log time is used" in said
    assert ("positions, velocities or efforts" in said) == (len(filled) == 1)
    assert ("numbered 0 to" in said) == (names == ("0", "1"))


def points(*rows: tuple[int, float]) -> list[object]:
    return [ros.point([value, -value], after=after * MS) for after, value in rows]


def test_a_new_trajectory_replaces_the_rest_of_the_previous_one(tmp_path: Path) -> None:
    messages = [
        (
            "/t",
            ros.TRAJECTORY,
            START + 7,
            ros.trajectory(START, JOINTS, points((100, 1.0), (200, 2.0), (300, 3.0))),
        ),
        (
            "/t",
            ros.TRAJECTORY,
            START + 250 * MS,
            ros.trajectory(START + 250 * MS, JOINTS, points((50, 9.0))),
        ),
    ]
    recording = read(tmp_path, bag(messages), command="/t")
    command = recording.series["command"]
    assert ((command.stamp - START) // MS).tolist() == [0, 100, 200, 250, 300]
    np.testing.assert_allclose(command.position, [[1, -1], [1, -1], [2, -2], [2.5, -2.5], [9, -9]])
    assert ((command.log_time[:2] - START) % MS).tolist() == [7, 7]
    assert recording.metadata == {"command_between": "interpolated"}


def test_a_finished_trajectory_holds_its_last_point(tmp_path: Path) -> None:
    messages = [
        ("/t", ros.TRAJECTORY, START, ros.trajectory(START, JOINTS, points((0, 1.0), (10, 2.0)))),
        (
            "/t",
            ros.TRAJECTORY,
            START + 50 * MS,
            ros.trajectory(START + 50 * MS, JOINTS, points((0, 5.0), (10, 6.0))),
        ),
    ]
    command = read(tmp_path, bag(messages), command="/t").series["command"]
    assert (command.stamp - START).tolist() == [0, 10 * MS, 50 * MS - 1, 50 * MS, 60 * MS]
    assert command.position is not None
    assert command.position[:, 0].tolist() == [1, 2, 2, 5, 6]


def test_a_trajectory_without_stamp_starts_at_its_log_time(tmp_path: Path) -> None:
    data = bag([("/t", ros.TRAJECTORY, START, ros.trajectory(0, JOINTS, points((10, 1.0))))])
    recording = read(tmp_path, data, command="/t")
    assert recording.series["command"].stamp.tolist() == [START, START + 10 * MS]
    assert "1 trajectories without header.stamp begin when the recorder" in recording.notes[0]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([], "no points: this commands a stop"),
        (points((20, 1.0), (10, 2.0)), "time_from_start does not increase"),
        (points((10, 1.0), (10, 2.0)), "time_from_start does not increase"),
        ([ros.point([1.0], after=1)], "1 values of position for 2 joints"),
        ([ros.point([1.0, np.inf], after=1)], "position of 'b' in point 0 is not finite"),
        ([ros.point(after=1)], "point 0 has no positions, velocities or effort"),
        (
            [ros.point([1.0, 2.0], after=1), ros.point((), [1.0, 2.0], after=2)],
            "point 1 has no positions, the first point has",
        ),
        (
            [ros.point([1.0, 2.0], accelerations=[0.0, 0.0], after=1)],
            "point 0 has accelerations without velocities",
        ),
    ],
)
def test_an_invalid_trajectory_is_refused_with_the_reason(
    tmp_path: Path, given: list[object], words: str
) -> None:
    data = bag([("/t", ros.TRAJECTORY, START, ros.trajectory(START, JOINTS, given))])
    with pytest.raises(RecordingError) as caught:
        read(tmp_path, data, command="/t")
    assert words in str(caught.value)


def test_joint_states_in_ros_1_encoding_are_read(tmp_path: Path) -> None:
    messages = [
        ("/js", ros.JOINT_STATE, START + k, ros.ros1_joint_state(START + k, JOINTS, [k, 2 * k]))
        for k in range(4)
    ]
    state = read(tmp_path, bag(messages, "ros1", long=False), state="/js").series["state"]
    assert state.names == JOINTS
    assert state.stamp.tolist() == [START + k for k in range(4)]
    np.testing.assert_array_equal(state.position, [[k, 2 * k] for k in range(4)])


@pytest.mark.parametrize("stamp", [START, 0])
@pytest.mark.parametrize(("in_goal", "encoding"), [(False, "ros1"), (True, "ros1"), (True, "cdr")])
def test_trajectories_of_ros_1_are_played_as_those_of_ros_2(
    tmp_path: Path, in_goal: bool, encoding: str, stamp: int
) -> None:
    setpoints = [
        ros.point([0.1, 0.2], [0.5, -0.5], after=100 * MS),
        ros.point([0.3, 0.2], [0.0, 0.0], after=300 * MS),
    ]
    kind = ros.GOAL if in_goal else ros.TRAJECTORY
    sent = ros.ros1_trajectory(stamp, JOINTS, setpoints, in_goal=in_goal, encoding=encoding)

    def command(encoding: str, kind: str, message: bytes) -> JointSeries:
        state = ros.ros1_joint_state if encoding == "ros1" else ros.joint_state
        times = [START + k * MS for k in range(400)]
        states = [("/js", ros.JOINT_STATE, at, state(at, JOINTS, [0.0, 0.0])) for at in times]
        data = bag([*states, ("/c", kind, START + 5 * MS, message)], encoding)
        return read(tmp_path, data, state="/js", command="/c").series["command"]

    old = command(encoding, kind, sent)
    new = command("cdr", ros.TRAJECTORY, ros.trajectory(stamp, JOINTS, setpoints))
    assert old.from_trajectories
    np.testing.assert_array_equal(old.stamp, new.stamp)
    np.testing.assert_array_equal(old.position, new.position)
    np.testing.assert_array_equal(old.velocity, new.velocity)
    # Between its points the controller follows a cubic.
    at = int(np.searchsorted(old.stamp, (stamp or START + 5 * MS) + 200 * MS))
    assert old.position is not None
    assert old.position[at, 0] == pytest.approx(0.2 + 0.2 * 0.5 / 8, abs=1e-3)


def test_a_bag_of_ros_1_is_refused_with_the_command_that_converts_it(tmp_path: Path) -> None:
    path = tmp_path / "run.bag"
    path.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    with pytest.raises(FormatError) as caught:
        read_one(path)
    assert "a bag of ROS 1, which is not read" in str(caught.value)
    assert "rosbags-convert --src run.bag --dst run" in str(caught.value)


STAMP = {"stamp": {"sec": START // 10**9, "nanosec": 5}}


@pytest.mark.parametrize(
    ("kind", "message", "position"),
    [
        (
            ros.CONTROLLER_STATE,
            ros.as_json(
                header=STAMP,
                joint_names=JOINTS,
                reference={"positions": [1, 2]},
                feedback={"positions": [3, 4]},
            ),
            [1, 2],
        ),
        (
            ros.CONTROLLER_STATE,
            ros.as_json(header=STAMP, joint_names=JOINTS, desired={"positions": [1, 2]}),
            [1, 2],
        ),
        (
            ros.DYNAMIC,
            ros.as_json(
                header=STAMP,
                joint_names=JOINTS,
                interface_values=[
                    {"interface_names": ["position"], "values": [1]},
                    {"interface_names": ["velocity", "position"], "values": [0, 2]},
                ],
            ),
            [1, 2],
        ),
        (
            ros.ARRAY,
            ros.as_json(layout={"dim": [{"label": "a"}, {"label": "b"}]}, data=[1, 2]),
            [1, 2],
        ),
        (
            ros.TRAJECTORY,
            ros.as_json(
                header=STAMP,
                joint_names=JOINTS,
                points=[{"positions": [1, 2], "time_from_start": {"sec": 0, "nanosec": 1}}],
            ),
            [1, 2],
        ),
    ],
)
def test_each_message_type_is_read_from_json(
    tmp_path: Path, kind: str, message: bytes, position: list[float]
) -> None:
    command = read(tmp_path, bag([("/c", kind, START, message)], "json"), command="/c")
    series = command.series["command"]
    assert series.names == JOINTS
    assert series.position is not None
    np.testing.assert_array_equal(series.position[-1], position)


def test_topics_that_are_not_read_are_listed_with_roles_and_joints(tmp_path: Path) -> None:
    messages = [
        ("/js", ros.JOINT_STATE, START, cdr(Message(START, JOINTS, (1.0, 2.0), (3.0, 4.0)))),
        ("/arm/commands", ros.ARRAY, START, ros.array([1.0], ("a",))),
        ("/tf", "tf2_msgs/msg/TFMessage", START, b"\0\1\0\0\0\0\0\0"),
    ]
    recording = read(tmp_path, bag(messages), state="/joint_states", command="/joint_commands")
    assert recording.series == {}
    found = {topic.name: (topic.roles, topic.joints, topic.filled) for topic in recording.topics}
    assert found == {
        "/js": (("state", "command"), JOINTS, ("position", "velocity")),
        "/arm/commands": (("command",), ("a",), ("position", "velocity", "effort")),
        "/tf": ((), (), ()),
    }


SEEDS = {
    ros.CONTROLLER_STATE: ros.controller_state(
        START, JOINTS, ros.point([1, 2]), ros.point([3, 4]), old=False
    ),
    ros.DYNAMIC: ros.dynamic(START, {"a": {"position": 1.0}, "b": {"effort": 2.0}}),
    ros.ARRAY: ros.array([1.0, 2.0], JOINTS),
    ros.TRAJECTORY: ros.trajectory(START, JOINTS, points((0, 1.0), (10, 2.0))),
}


def error_of(path: Path) -> TwinError | None:
    try:
        read_one(path, {"command": "/c"})
    except TwinError as error:
        return error
    return None


@pytest.mark.parametrize("kind", list(SEEDS))
@settings(
    max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_modified_messages_are_read_or_raise_a_typed_error(
    kind: str, data: st.DataObject, tmp_path: Path
) -> None:
    message = bytearray(SEEDS[kind])
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(message) - 1))
        message[at : at + 4] = data.draw(
            st.sampled_from([b"\xff" * 4, b"\0" * 4, b"\xff\xff\xff\x7f", b"\1\0\0\0", b""])
        )
    del message[data.draw(st.integers(4, len(message))) :]
    encoding = data.draw(st.sampled_from(["cdr", "ros1"]))
    path = put(tmp_path, bag([("/c", kind, START, bytes(message))], encoding))
    error = error_of(path)
    assert error is None or error.path == path
