"""Wrenches, IMU readings and poses in CDR and JSON encoding."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import sensor_bags

from pytest_twin.errors import RecordingError
from pytest_twin.formats.pose_tracks import read_pose_tracks
from pytest_twin.formats.ros_serialization import MessageError
from pytest_twin.formats.sensor_bag import SensorCollector, gather_sensors
from pytest_twin.formats.stamped_readings import (
    IMU,
    WRENCH,
    pose_of_json,
    reading_of,
    reading_of_json,
)

START = 1_700_000_000_000_000_000
STAMPS = START + 10_000_000 * np.arange(4)
VALUES = np.arange(24.0).reshape(4, 6) / 7.0
POSES = np.hstack([np.arange(12.0).reshape(4, 3), np.tile([0.0, 0.6, 0.0, 0.8], (4, 1))])


@pytest.mark.parametrize("encoding", ["cdr", "json"])
def test_readings_in_both_encodings_equal_the_written_values(encoding: str, tmp_path: Path) -> None:
    path = sensor_bags.write(
        tmp_path / "a.mcap",
        {
            "/ft": (sensor_bags.WRENCH, STAMPS, VALUES),
            "/imu": (sensor_bags.IMU, STAMPS, VALUES),
            "/cube": (sensor_bags.POSE, STAMPS, POSES),
        },
        encoding,
    )
    bag = gather_sensors(SensorCollector(path, {}))
    for topic in ("/ft", "/imu"):
        assert [one.stamp for one in bag.readings[topic]] == STAMPS.tolist()
        assert np.array([one.values for one in bag.readings[topic]]) == pytest.approx(VALUES)
        assert bag.readings[topic][0].frame == "sensor"
    (track,) = read_pose_tracks(path)
    assert track.position == pytest.approx(POSES[:, :3])
    assert track.quaternion[0] == pytest.approx([0.8, 0.0, 0.6, 0.0])
    assert track.time == pytest.approx(0.01 * np.arange(4))


@pytest.mark.parametrize("kind", [WRENCH, IMU])
def test_a_truncated_sensor_message_is_refused(kind: str) -> None:
    made = sensor_bags.message(kind, START, VALUES[1])
    whole = bytes(sensor_bags.STORE.serialize_cdr(made, kind))
    assert reading_of(whole, kind, "cdr").values == pytest.approx(VALUES[1])
    for size in range(0, len(whole) - 1, 3):
        with pytest.raises(MessageError):
            reading_of(whole[:size], kind, "cdr")
    with pytest.raises(MessageError, match="left over"):
        reading_of(whole + bytes(16), kind, "cdr")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"[]", "not a JSON object"),
        (b'{"wrench": 3}', "wrench is not an object"),
        (b'{"wrench": {"force": {"x": 1, "y": "2", "z": 3}, "torque": {}}}', "not a number"),
        (b'{"wrench": {"force": {"x": 1, "y": 1e999, "z": 3}, '
         b'"torque": {"x": 0, "y": 0, "z": 0}}}', "not finite"),
        (b'{"wrench": {"force": {"x": 1, "y": true, "z": 3}, "torque": {}}}', "not a number"),
    ],
)  # fmt: skip
def test_an_invalid_json_wrench_is_refused(text: bytes, words: str) -> None:
    with pytest.raises(MessageError, match=words):
        reading_of_json(text, WRENCH)


def test_a_pose_needs_a_quaternion_of_length_one() -> None:
    text = (
        b'{"pose": {"position": {"x": 0, "y": 0, "z": 0}, '
        b'"orientation": {"x": 0, "y": 0, "z": 0, "w": 2}}}'
    )
    with pytest.raises(MessageError, match="length 1"):
        pose_of_json(text)


def test_several_pose_topics_require_a_choice(tmp_path: Path) -> None:
    both = dict.fromkeys(("/cube", "/hand"), (sensor_bags.POSE, STAMPS, POSES))
    path = sensor_bags.write(tmp_path / "a.mcap", both)
    with pytest.raises(RecordingError, match="several topics of poses"):
        read_pose_tracks(path)
    assert len(read_pose_tracks(path, "/hand")) == 1
