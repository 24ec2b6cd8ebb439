"""LeRobot data sets: both layouts, episodes as recordings, units."""

from __future__ import annotations

import json
import math
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot_files import JOINTS, episode, write_dataset

from pytest_twin.errors import FormatError, LimitError, PathError, RecordingError, TwinError
from pytest_twin.formats import limits
from pytest_twin.formats.recordings import read_one, read_recordings

EPISODES = [episode(0, 120), episode(1, 80), episode(2, 100)]


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_each_episode_is_a_recording(tmp_path: Path, version: str, dtype: str) -> None:
    recordings = read_recordings(write_dataset(tmp_path / "set", EPISODES, version, dtype=dtype))
    assert [r.path.name for r in recordings] == [f"episode_00000{n}" for n in range(3)]
    for recording, expected in zip(recordings, EPISODES, strict=True):
        assert set(recording.series) == {"state", "command"}
        for role, key in (("state", "state"), ("command", "action")):
            series = recording.series[role]
            assert series.names == JOINTS
            np.testing.assert_array_equal(series.position, expected[key].astype(dtype))
            assert series.velocity is None
            assert series.effort is None
            assert series.stamp.tolist() == [k * 20_000_000 for k in range(len(series.stamp))]
        assert recording.metadata == {"robot_type": "so101_follower"}


def test_single_precision_timestamps_are_replaced_by_exact_frame_times(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "set", [episode(0, 9000, fps=30)], fps=30)
    stamp = read_one(folder).series["state"].stamp
    assert stamp[8999] == round(8999 / 30 * 1e9)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["a.pos", "b.pos"], ("a", "b")),
        (["main_a", "main_b"], ("main_a", "main_b")),
        ({"motors": ["a", "b"]}, ("a", "b")),
        ([["a", "b"]], ("a", "b")),
        (None, ("0", "1")),
        (["dim"], ("0", "1")),
    ],
)
def test_joint_names_are_read_from_every_form_of_info_json(
    tmp_path: Path, names: Any, expected: tuple[str, ...]
) -> None:
    recording = read_one(write_dataset(tmp_path / "set", EPISODES[:1], names=names))
    assert recording.series["state"].names == expected
    assert any("does not name each" in note for note in recording.notes) == (expected[0] == "0")


def test_position_and_velocity_are_recognized_by_name_suffixes(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "set", EPISODES[:1], names=["a.pos", "a.vel"])
    state = read_one(folder).series["state"]
    assert state.names == ("a",)
    np.testing.assert_array_equal(state.position, EPISODES[0]["state"][:, :1])
    np.testing.assert_array_equal(state.velocity, EPISODES[0]["state"][:, 1:])


DEGREES = 180.0 / math.pi


@pytest.mark.parametrize(
    ("scale", "info", "units", "said"),
    [
        (1.0, {}, None, "no unit is declared and no value is beyond 3: rad"),
        (DEGREES, {}, None, "no unit is declared, values reach 171.9: degrees"),
        (DEGREES, {"units": "degrees"}, None, None),
        (1.0, {"units": "rad"}, None, None),
        (DEGREES, {"units": "rad"}, "deg", None),
        (1.0, {"units": "degrees"}, "rad", None),
    ],
)
def test_the_angle_unit_is_declared_or_inferred_with_a_note(
    tmp_path: Path, scale: float, info: dict[str, str], units: str | None, said: str | None
) -> None:
    folder = write_dataset(tmp_path / "set", EPISODES, scale=scale, **info)
    recordings = read_recordings(folder, units=units)
    for recording, expected in zip(recordings, EPISODES, strict=True):
        np.testing.assert_allclose(
            recording.series["state"].position, expected["state"], rtol=1e-14
        )
    notes = " ".join(recordings[0].notes)
    assert (said in notes) if said else ("unit" not in notes)


def test_values_that_may_be_percent_of_the_range_are_noted(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "set", EPISODES[:1], scale=50.0)
    assert any("per cent of each joint's calibrated range" in n for n in read_one(folder).notes)


def test_an_unknown_unit_is_refused(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "set", EPISODES[:1], units="turns")
    with pytest.raises(FormatError, match=r"not a unit of joint angles .got 'turns'"):
        read_one(folder)


def test_episodes_of_splits_other_than_train_are_held_out(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "set", EPISODES, splits={"train": "0:2", "test": "2:3"})
    roles = [recording.metadata["role"] for recording in read_recordings(folder)]
    assert roles == ["fit", "fit", "held_out"]


def test_reading_one_recording_of_a_data_set_with_several_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"holds several recordings .got '3 episodes'"):
        read_one(write_dataset(tmp_path / "set", EPISODES))


def test_without_pyarrow_the_error_names_the_package_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_dataset(tmp_path / "set", EPISODES)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(FormatError, match=r"pip install 'pytest-twin\[lerobot\]'"):
        read_recordings(folder)


# -- malicious data sets ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("info", "words"),
    [
        (
            {"codebase_version": "v1.6"},
            "codebase_version: an unsupported version of LeRobot's format",
        ),
        ({"features": []}, "describes no features"),
        ({"features": {"x": {}}}, "no joint states and no actions"),
        ({"features": {"action": {"shape": [10**9]}}}, "features.action.shape: not a vector"),
        ({"features": {"action": {"shape": [3]}}}, "action: rows of different lengths"),
        ({"data_path": None}, "data_path: does not state the path of the data"),
        ({"data_path": "../{file_index}.parquet"}, "data_path: not a path inside the data set"),
        ({"data_path": "/etc/{file_index}.parquet"}, "data_path: not a path inside the data set"),
        ({"data_path": "{file_index.__class__}.parquet"}, "data_path: not a path"),
        ({"data_path": "no/{file_index}.parquet"}, "data_path: no data file is there"),
    ],
)
def test_a_malicious_info_json_is_refused_in_one_line(
    tmp_path: Path, info: dict[str, Any], words: str
) -> None:
    folder = write_dataset(tmp_path / "set", EPISODES[:1], **info)
    with pytest.raises((FormatError, RecordingError)) as caught:
        read_recordings(folder)
    assert words in str(caught.value)


def test_a_data_file_linked_from_outside_the_folder_is_refused(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "set", EPISODES[:1])
    file = folder / "data" / "chunk-000" / "file-000.parquet"
    file.rename(tmp_path / "elsewhere.parquet")
    file.symlink_to(tmp_path / "elsewhere.parquet")
    with pytest.raises(PathError, match="path leaves the declared roots"):
        read_recordings(folder)


def test_a_data_set_in_the_hugging_face_cache_is_read_through_its_links(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "set", EPISODES)
    blobs, snapshot = tmp_path / "hub/blobs", tmp_path / "hub/snapshots/0123abcd"
    blobs.mkdir(parents=True)
    for number, file in enumerate(sorted(p for p in folder.rglob("*") if p.is_file())):
        link = snapshot / file.relative_to(folder)
        link.parent.mkdir(parents=True, exist_ok=True)
        file.rename(blobs / f"{number:04x}")
        link.symlink_to(os.path.relpath(blobs / f"{number:04x}", link.parent))
    found = read_recordings(snapshot)
    assert len(found) == len(EPISODES)
    assert found[1].series["state"].position is not None


def test_a_parquet_file_with_too_much_unpacked_data_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_dataset(tmp_path / "set", EPISODES[:1])
    monkeypatch.setattr(limits, "PARQUET", replace(limits.PARQUET, uncompressed_bytes=1000))
    with pytest.raises(LimitError, match="too large after decompression"):
        read_recordings(folder)
    monkeypatch.setattr(limits, "MCAP", replace(limits.MCAP, samples_count=100))
    with pytest.raises(LimitError, match="too many values"):
        read_recordings(folder)


def test_wrong_or_missing_columns_are_refused(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "set", EPISODES[:1])
    file = folder / "data" / "chunk-000" / "file-000.parquet"
    table = pq.read_table(file)
    words = pa.array(["x"] * len(table))
    at = table.column_names.index("timestamp")
    pq.write_table(table.set_column(at, "timestamp", words), file)
    with pytest.raises(FormatError, match="timestamp: a column of string"):
        read_recordings(folder)
    pq.write_table(table.drop_columns(["frame_index"]), file)
    with pytest.raises(FormatError, match=r"a column is missing .got 'frame_index'"):
        read_recordings(folder)


def test_a_changed_byte_of_a_parquet_file_raises_at_most_a_typed_error(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "set", EPISODES[:1])
    file = folder / "data" / "chunk-000" / "file-000.parquet"
    data = file.read_bytes()
    rng = np.random.default_rng(4)
    refused = 0
    for at in rng.integers(0, len(data), 150).tolist():
        changed = bytearray(data)
        changed[at] ^= 1 << int(rng.integers(8))
        file.write_bytes(bytes(changed[: at + 1] if at % 5 == 0 else changed))
        try:
            read_recordings(folder)
        except TwinError:
            refused += 1
    assert refused > 10


def test_an_invalid_info_json_is_refused(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "set", EPISODES[:1])
    info = folder / "meta" / "info.json"
    for text in ("", "[]", "{", "[" * 100_000, json.dumps({"codebase_version": "v3.0"})):
        info.write_text(text)
        with pytest.raises(FormatError):
            read_recordings(folder)


@pytest.mark.parametrize(("units", "scale"), [(["deg", "deg"], DEGREES), (["rad", "rad"], 1.0)])
def test_a_unit_may_be_declared_for_each_joint(
    tmp_path: Path, units: list[str], scale: float
) -> None:
    folder = write_dataset(tmp_path / "set", EPISODES[:1], scale=scale, units=units)
    position = read_one(folder).series["state"].position
    np.testing.assert_allclose(position, EPISODES[0]["state"], rtol=1e-14)


def test_units_that_differ_between_joints_are_refused(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "set", EPISODES[:1], units=["deg", "m"])
    with pytest.raises(FormatError, match="one for all joints"):
        read_one(folder)
