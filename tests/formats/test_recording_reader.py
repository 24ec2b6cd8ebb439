"""MCAP recordings of every layout give the same numbers as independent decoders."""

from __future__ import annotations

import itertools
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_files import BARE, SCHEMA, START, Message, mcap, put, sines
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer as Ros2Writer

from pytest_twin.errors import LimitError, RecordingError
from pytest_twin.formats import limits
from pytest_twin.formats.joint_state import SCHEMA_TEXT
from pytest_twin.formats.mcap import JointSeries, Recording, read_recording, write_recording

QUANTITIES = ("position", "velocity", "effort")
RECORDINGS = Path(
    os.environ.get("TWIN_RECORDINGS", Path(__file__).parents[3] / "shared" / "recordings")
)


def decoded_by_ros2_support(path: Path, topic: str) -> list[tuple[int, int, Any]]:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [
            (
                message.log_time,
                decoded.header.stamp.sec * 10**9 + decoded.header.stamp.nanosec,
                decoded,
            )
            for _, _, message, decoded in reader.iter_decoded_messages(
                topics=[topic], log_time_order=False
            )
        ]


def assert_same_as_ros2_support(recording: Recording) -> None:
    for series in recording.series.values():
        others = decoded_by_ros2_support(recording.path, series.topic)
        assert len(others) == len(series.stamp)
        for row, (log_time, stamp, other) in enumerate(others):
            assert (series.log_time[row], series.stamp[row]) == (log_time, stamp)
            for name in QUANTITIES:
                table, theirs = getattr(series, name), list(getattr(other, name))
                if not theirs:
                    assert table is None or np.isnan(table[row]).all()
                    continue
                by_name = dict(zip(other.name, theirs, strict=True))
                assert table[row].tolist() == [by_name[joint] for joint in series.names]


def assert_sines(recording: Recording, count: int) -> None:
    state = recording.series["state"]
    assert recording.damage == ()
    assert state.names == ("shoulder", "elbow")
    assert state.stamp.tolist() == [START + index * 10_000_000 for index in range(count)]
    for name in QUANTITIES:
        expected = [getattr(message, name) for message in sines(count)]
        np.testing.assert_array_equal(getattr(state, name), expected)


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("options", [{}, BARE, {"chunk_size": 500}, {"use_chunking": False}])
def test_every_mcap_layout_and_compression_is_read(
    tmp_path: Path, compression: CompressionType, options: dict[str, Any]
) -> None:
    data = mcap(sines(50), compression=compression, **options)
    assert_sines(read_recording(put(tmp_path, data)), 50)


@pytest.mark.parametrize(("encoding", "order"), [("cdr", "<"), ("cdr", ">"), ("json", "<")])
def test_every_message_encoding_is_read(tmp_path: Path, encoding: str, order: str) -> None:
    data = mcap(sines(50), encoding=encoding, order=order)
    assert_sines(read_recording(put(tmp_path, data)), 50)


def test_json_messages_need_no_schema_and_may_contain_null(tmp_path: Path) -> None:
    message = Message(START, extra={"position": [None, 2]})
    recording = read_recording(put(tmp_path, mcap([message], encoding="json", schema=None)))
    np.testing.assert_array_equal(recording.series["state"].position, [[math.nan, 2.0]])
    assert "position is not finite in 1 messages" in str(recording.damage[0])


_NUMBERS = st.floats(allow_nan=False)


@st.composite
def _messages(draw: st.DrawFn) -> list[Message]:
    names = draw(
        st.lists(
            st.text(st.characters(codec="utf-8"), min_size=1, max_size=9).filter(str.isprintable),
            min_size=1,
            max_size=4,
            unique=True,
        )
    )
    found = []
    for index in range(draw(st.integers(1, 12))):
        order = draw(st.permutations(names))
        filled = [draw(st.booleans()) for _ in QUANTITIES]
        values = [tuple(draw(_NUMBERS) for _ in names) if fill else () for fill in filled]
        found.append(
            Message(
                START + 1000 * index,
                tuple(order),
                *values,
                frame_id=draw(st.sampled_from(["", "base", "é"])),
                topic=draw(st.sampled_from(["/joint_states", "/joint_commands", "/other"])),
            )
        )
    return found


@settings(max_examples=50, deadline=None)
@given(messages=_messages())
def test_random_messages_equal_those_decoded_by_mcap_ros2_support(
    tmp_path_factory: pytest.TempPathFactory, messages: list[Message]
) -> None:
    path = tmp_path_factory.mktemp("any") / "trial.mcap"
    with path.open("wb") as stream:
        writer = Ros2Writer(stream)
        schema = writer.register_msgdef(SCHEMA, SCHEMA_TEXT)
        for message in messages:
            sec, nanosec = divmod(message.stamp, 10**9)
            fields = {
                "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": message.frame_id},
                "name": list(message.names),
                **{name: list(getattr(message, name)) for name in QUANTITIES},
            }
            writer.write_message(message.topic, schema, fields, message.stamp, message.stamp)
        writer.finish()
    recording = read_recording(path)
    assert {series.topic for series in recording.series.values()} == {
        message.topic for message in messages if message.topic != "/other"
    }
    assert_same_as_ros2_support(recording)


def test_joint_names_in_changing_order_are_aligned(tmp_path: Path) -> None:
    # More orders than the reader tries at a time; all messages have the same size.
    names = ("a", "b", "c", "d")
    value = {"a": 1.0, "b": 2.0, "c": 3.0, "d": 4.0}
    messages = [
        Message(START + 1000 * index, order, tuple(value[name] + index for name in order))
        for index, order in enumerate([*itertools.permutations(names)] * 3)
    ]
    state = read_recording(put(tmp_path, mcap(messages))).series["state"]
    assert state.names == names
    expected = np.array([1.0, 2.0, 3.0, 4.0]) + np.arange(len(messages))[:, None]
    np.testing.assert_array_equal(state.position, expected)


def test_a_quantity_without_any_value_is_none(tmp_path: Path) -> None:
    messages = [
        Message(START, position=(1.0, 2.0)),
        Message(START + 1, position=(1.0, 2.0), effort=(3.0, 4.0)),
    ]
    recording = read_recording(put(tmp_path, mcap(messages)))
    state = recording.series["state"]
    assert state.velocity is None
    np.testing.assert_array_equal(state.effort, [[math.nan, math.nan], [3.0, 4.0]])
    assert "effort is empty in 1 of 2 messages" in str(recording.damage[0])


def test_only_mapped_topics_are_read(tmp_path: Path) -> None:
    messages = [*sines(3, "/a"), *sines(4, "/b"), Message(START, raw=b"\xff", topic="/c")]
    path = put(tmp_path, mcap(messages, use_chunking=False))
    found = read_recording(path, {"state": "/b", "command": "/joint_commands"})
    assert list(found.series) == ["state"]
    assert found.series["state"].topic == "/b"
    assert len(found.series["state"].stamp) == 4


def test_trial_metadata_is_read(tmp_path: Path) -> None:
    data = mcap(sines(1), metadata={"role": "fit", "payload": "kg05"})
    assert read_recording(put(tmp_path, data)).metadata == {"role": "fit", "payload": "kg05"}


def test_messages_of_different_joints_are_merged_into_one_table(tmp_path: Path) -> None:
    messages = [
        Message(START, ("shoulder", "elbow"), (1.0, 2.0)),
        Message(START + 10, ("gripper",), (0.1,)),
        Message(START + 20, ("elbow", "shoulder"), (3.0, 4.0)),
        Message(START + 30, ("wrist", "elbow"), (5.0, 6.0)),
    ]
    recording = read_recording(put(tmp_path, mcap(messages)))
    found = recording.series["state"]
    assert found.names == ("shoulder", "elbow", "gripper", "wrist")
    assert found.stamp.tolist() == [START, START + 10, START + 20, START + 30]
    nan = np.nan
    expected = [[1, 2, nan, nan], [nan, nan, 0.1, nan], [4, 3, nan, nan], [nan, 6, nan, 5]]
    assert found.position is not None
    assert np.array_equal(found.position, expected, equal_nan=True)
    assert recording.damage == ()


def test_the_table_of_messages_with_different_joints_is_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "MCAP", replace(limits.MCAP, samples_count=100))
    messages = [Message(START + k, (f"joint{k}",), (1.0,)) for k in range(11)]
    with pytest.raises(LimitError, match="11 messages that name 11 joints between them"):
        read_recording(put(tmp_path, mcap(messages)))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"schema": "geometry_msgs/msg/Twist"}, "unknown schema (got 'geometry_msgs/msg/Twist'"),
        (
            {"schema": None},
            "unknown schema (got 'none'; expected for role 'state' one of sensor_msgs/msg/Joint",
        ),
        (
            {"encoding": "cbor"},
            "unknown message encoding (got 'cbor'; expected cdr, ros1, json for",
        ),
    ],
)
def test_unknown_message_types_and_encodings_are_an_error(
    tmp_path: Path, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(RecordingError) as caught:
        read_recording(put(tmp_path, mcap(sines(2), **options)))
    assert words in str(caught.value)
    assert caught.value.where == "/joint_states"


def series(topic: str, count: int, **tables: np.ndarray) -> JointSeries:
    stamp = START + np.arange(count) * 1_000_000
    empty = dict.fromkeys(QUANTITIES)
    return JointSeries(topic, ("a", "b"), stamp, stamp + 5, **{**empty, **tables})


def test_written_recordings_are_read_back_and_bitwise_reproducible(tmp_path: Path) -> None:
    values = np.random.default_rng(3).normal(size=(3000, 2))
    values[7] = np.nan
    written = [
        series("/joint_states", 3000, position=values, effort=-values),
        series("/joint_commands", 1500, velocity=values[:1500] * 2),
    ]
    for name in ("one.mcap", "two.mcap"):
        write_recording(tmp_path / name, written, {"role": "fit", "payload": "none"})
    assert (tmp_path / "one.mcap").read_bytes() == (tmp_path / "two.mcap").read_bytes()
    recording = read_recording(tmp_path / "one.mcap")
    assert recording.metadata == {"role": "fit", "payload": "none"}
    for ours, role in zip(written, ("state", "command"), strict=True):
        read = recording.series[role]
        assert read.names == ours.names
        for name in ("stamp", "log_time", *QUANTITIES):
            np.testing.assert_array_equal(getattr(read, name), getattr(ours, name))
    assert_same_as_ros2_support(recording)


def test_a_failed_write_keeps_the_old_recording(tmp_path: Path) -> None:
    path = tmp_path / "trial.mcap"
    write_recording(path, [series("/joint_states", 3, position=np.zeros((3, 2)))])
    before = path.read_bytes()
    with pytest.raises(RecordingError, match="position has another shape"):
        write_recording(path, [series("/joint_states", 3, position=np.zeros((2, 2)))])
    two = series("/joint_states", 3, position=np.zeros((3, 2)))
    with pytest.raises(RecordingError, match="two series have the same topic"):
        write_recording(path, [two, two])
    assert path.read_bytes() == before


@pytest.mark.parametrize("name", ["so101", "xl330", "emps"])
def test_real_recordings_equal_those_decoded_by_mcap_ros2_support(name: str) -> None:
    folder = RECORDINGS / name / "recordings"
    if not folder.is_dir():
        pytest.skip(f"no recordings at {RECORDINGS}; the variable TWIN_RECORDINGS names the place")
    recording = read_recording(min(folder.glob("*.mcap"), key=lambda path: path.stat().st_size))
    assert recording.damage == ()
    assert set(recording.series) == {"state", "command"}
    assert_same_as_ros2_support(recording)
