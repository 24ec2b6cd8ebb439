"""``foxglove.JointStates`` in Protobuf and JSON have the numbers of JointState messages."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer
from mcap_files import START

from pytest_twin.errors import RecordingError
from pytest_twin.formats.foxglove import FoxgloveJointStates
from pytest_twin.formats.recording import Recording
from pytest_twin.formats.recordings import read_one
from pytest_twin.formats.ros_serialization import MessageError

NAMES = ("shoulder", "elbow")
Joint = tuple[str, dict[str, float]]
NUMBERS = {"position": 2, "velocity": 3, "acceleration": 4, "effort": 5}


def varint(value: int) -> bytes:
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*found, value])


def text(number: int, content: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(content)) + content


def protobuf(stamp: int, joints: Sequence[Joint]) -> bytes:
    """A message, encoded field by field without code of the package."""
    sec, nanos = divmod(stamp, 10**9)
    message = text(1, b"\x08" + varint(sec) + b"\x10" + varint(nanos))
    for name, values in joints:
        fields = [varint(NUMBERS[k] << 3 | 1) + struct.pack("<d", v) for k, v in values.items()]
        message += text(2, text(1, name.encode()) + b"".join(fields))
    return message


def as_json(stamp: int, joints: Sequence[Joint]) -> bytes:
    sec, nsec = divmod(stamp, 10**9)
    listed = [{"name": name, **values} for name, values in joints]
    return json.dumps({"timestamp": {"sec": sec, "nsec": nsec}, "joints": listed}).encode()


def write(path: Path, messages: Sequence[tuple[int, bytes]], encoding: str) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("foxglove.JointStates", encoding, b"")
        for topic in ("/joint_states", "/joint_commands"):
            channel = writer.register_channel(topic, encoding, schema)
            for stamp, data in messages:
                writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    return path


def messages(encode: Callable[[int, Sequence[Joint]], bytes]) -> list[tuple[int, bytes]]:
    found = []
    for k in range(50):
        values = [{"position": 0.01 * k + j, "effort": -1.5 * k} for j in range(2)]
        joints = list(zip(NAMES, values, strict=True))
        # Joints may come in another order.
        found.append(
            (START + k * 10**7, encode(START + k * 10**7, joints[:: -1 if k % 7 == 3 else 1]))
        )
    return found


def assert_as_written(found: Recording) -> None:
    for series in found.series.values():
        assert series.names == NAMES
        count = np.arange(50.0)[:, None]
        np.testing.assert_allclose(series.position, 0.01 * count + [0, 1])
        np.testing.assert_allclose(series.effort, -1.5 * count + [0, 0])
        assert series.velocity is None
        assert series.stamp.tolist() == [START + k * 10**7 for k in range(50)]


@pytest.mark.parametrize(("encoding", "encode"), [("protobuf", protobuf), ("json", as_json)])
def test_each_encoding_is_read(
    tmp_path: Path, encoding: str, encode: Callable[[int, Sequence[Joint]], bytes]
) -> None:
    found = read_one(write(tmp_path / "log.mcap", messages(encode), encoding))
    assert_as_written(found)
    assert {topic.joints for topic in found.topics} == {NAMES}


def test_another_encoding_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "log.mcap", messages(protobuf), "flatbuffer")
    with pytest.raises(RecordingError, match=r"expected protobuf, json for foxglove.JointStates"):
        read_one(path)


@given(st.binary(max_size=60), st.integers(0, 200), st.integers(0, 255))
def test_any_bytes_are_decoded_or_refused(noise: bytes, at: int, byte: int) -> None:
    whole = bytearray(protobuf(START, [(name, {"position": 1.0}) for name in NAMES]))
    whole[at % len(whole)] = byte
    data = noise + bytes(whole) + bytes(whole[: at % len(whole)])
    starts = np.array([0, len(noise), len(noise) + len(whole)])
    sizes = np.array([len(noise), len(whole), at % len(whole)])
    for found in FoxgloveJointStates().serialized(data, starts, sizes, "cdr"):
        assert not isinstance(found, tuple) or isinstance(found[1], MessageError)
