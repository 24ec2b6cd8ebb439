"""Recordings of every format are read by one function with the same numbers."""

from __future__ import annotations

import os
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_files import FILE, MCAP, MESSAGE, SQLITE, STORAGE, write_bag
from mcap_files import START, Message, mcap, sines

from pytest_twin.errors import FormatError, LimitError, PathError, TwinError
from pytest_twin.formats import limits
from pytest_twin.formats.recording import JointSeries, Recording
from pytest_twin.formats.recordings import read_one, read_recordings
from pytest_twin.formats.ros_serialization import QUANTITIES

MESSAGES = [
    message
    for pair in zip(sines(40), sines(40, "/joint_commands"), strict=True)
    for message in pair
]


def assert_same(found: Recording, expected: Recording) -> None:
    assert set(found.series) == set(expected.series)
    for role, one in found.series.items():
        other = expected.series[role]
        assert one.names == other.names
        for name in ("stamp", "log_time", *QUANTITIES):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.fixture
def expected(tmp_path: Path) -> Recording:
    path = tmp_path / "expected.mcap"
    path.write_bytes(mcap(MESSAGES))
    return read_one(path)


@pytest.mark.parametrize(
    ("storage", "compression"),
    [
        (SQLITE, None),
        (SQLITE, FILE),
        (SQLITE, MESSAGE),
        (MCAP, None),
        (MCAP, FILE),
        (MCAP, MESSAGE),
        (MCAP, STORAGE),
    ],
)
def test_bags_of_every_storage_and_compression_are_read(
    tmp_path: Path, expected: Recording, storage: object, compression: object
) -> None:
    folder = write_bag(tmp_path / "bag", MESSAGES, storage, compression, {"role": "fit"})  # type: ignore[arg-type]
    recording = read_one(folder)
    assert_same(recording, expected)
    assert recording.damage == ()
    assert recording.metadata == {"role": "fit"}
    assert {topic.name: topic.messages for topic in recording.topics} == {
        "/chatter": 80,
        "/joint_commands": 40,
        "/joint_states": 40,
    }


@pytest.mark.parametrize("storage", [SQLITE, MCAP])
@pytest.mark.parametrize("compression", [None, FILE, MESSAGE])
def test_a_file_of_a_bag_is_read_without_its_folder(
    tmp_path: Path, expected: Recording, storage: object, compression: object
) -> None:
    folder = write_bag(tmp_path / "bag", MESSAGES, storage, compression)  # type: ignore[arg-type]
    (file,) = (p for p in folder.iterdir() if p.name != "metadata.yaml")
    assert_same(read_one(file), expected)


def test_a_bag_with_several_files_is_one_recording(tmp_path: Path, expected: Recording) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    names = [f"bag_{number}.mcap" for number in (0, 1, 10)]
    for name, part in zip(names, (MESSAGES[:30], MESSAGES[30:50], MESSAGES[50:]), strict=True):
        (folder / name).write_bytes(mcap(part))
    written = "".join(f"    - {name}\n" for name in names)
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n"
        f"  relative_file_paths:\n{written}"
    )
    assert_same(read_one(folder), expected)
    (folder / "metadata.yaml").unlink()
    recording = read_one(folder)
    assert_same(recording, expected)
    assert str(recording.damage[0]).startswith("metadata.yaml: missing: the recorder was killed")


def test_a_folder_with_several_recordings_is_refused_as_a_bag(tmp_path: Path) -> None:
    for name in ("fit.mcap", "held_out.mcap"):
        (tmp_path / name).write_bytes(mcap(sines(3)))
    with pytest.raises(FormatError) as caught:
        read_one(tmp_path)
    assert "holds files of several recordings and no metadata.yaml (got 'fit.mcap, held_out" in str(
        caught.value
    )


def test_old_metadata_with_folder_in_the_file_names_is_read(
    tmp_path: Path, expected: Recording
) -> None:
    folder = write_bag(tmp_path / "bag", MESSAGES)
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("- bag.db3", "- bag/bag.db3"))
    assert_same(read_one(folder), expected)


def test_messages_missing_against_the_count_in_the_metadata_are_noted(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "bag", MESSAGES)
    with sqlite3.connect(folder / "bag.db3") as connection:
        connection.execute("DELETE FROM messages WHERE id > 120")
    connection.close()
    said = [str(note) for note in read_one(folder).damage]
    assert "/joint_states: 30 of 40 messages that metadata.yaml counts" in said


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("../secret.db3", "path leaves the declared roots"),
        ("../../etc/passwd", "path leaves the declared roots"),
        ("/etc/passwd", "path leaves the declared roots"),
        ("link.db3", "path leaves the declared roots"),
        ("pipe.db3", "not a regular file but a pipe"),
        ("missing.db3", "no such file"),
        ("", "empty path"),
    ],
)
def test_bag_metadata_may_name_only_files_in_its_own_folder(
    tmp_path: Path, name: str, words: str
) -> None:
    folder = write_bag(tmp_path / "bag", MESSAGES)
    shutil.copy(folder / "bag.db3", tmp_path / "secret.db3")
    (folder / "link.db3").symlink_to(tmp_path / "secret.db3")
    os.mkfifo(folder / "pipe.db3")
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("bag.db3", f'"{name}"'))
    with pytest.raises(PathError) as caught:
        read_one(folder)
    assert words in str(caught.value)
    assert caught.value.path == metadata


def test_links_missing_paths_and_other_files_are_refused(tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    (data / "link").symlink_to(write_bag(tmp_path / "bag", MESSAGES))
    with pytest.raises(PathError, match="is a link to another folder"):
        read_one(data / "link")
    with pytest.raises(PathError, match="no such file or folder"):
        read_one(tmp_path / "nothing")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(FormatError, match=r"no recording that can be read .expected an MCAP file"):
        read_one(tmp_path / "notes.txt")


# -- malicious SQLite files -------------------------------------------------------------------


def database(folder: Path, script: str) -> Path:
    path = folder / "hostile.db3"
    connection = sqlite3.connect(path)
    connection.executescript(script)
    connection.close()
    return path


TOPICS = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
    "INSERT INTO topics VALUES(1, '/joint_states', 'sensor_msgs/msg/JointState', 'cdr');"
)
MESSAGES_TABLE = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
)
ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n)"


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("CREATE TABLE other(x);", "'topics' is not a plain table"),
        (
            TOPICS + f"CREATE VIEW messages AS {ENDLESS} SELECT 1 AS topic_id, x AS timestamp, "
            "x AS data, x AS id FROM n;",
            "'messages' is not a plain table",
        ),
        (
            TOPICS + "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp "
            "INTEGER, data BLOB GENERATED ALWAYS AS (zeroblob(100000000)));",
            "'messages' is not a plain table",
        ),
        (TOPICS + "CREATE TABLE messages(id INTEGER PRIMARY KEY);", "no such column"),
        (
            TOPICS + MESSAGES_TABLE + "INSERT INTO messages VALUES(1, 1, 'x', 'y');",
            "is not a message",
        ),
    ],
)
def test_sqlite_files_that_are_not_bags_are_refused(
    tmp_path: Path, script: str, words: str
) -> None:
    with pytest.raises(FormatError) as caught:
        read_one(database(tmp_path, script))
    assert words in str(caught.value)


def test_a_damaged_sqlite_schema_is_refused(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", MESSAGES) / "bag.db3"
    data = bytearray(path.read_bytes())
    at = data.find(b"CREATE TABLE topics(")
    data[at + 20] = 0xC4
    path.write_bytes(bytes(data))
    with pytest.raises(FormatError, match=r"not an SQLite file of rosbag2|schema is damaged"):
        read_one(path)


def test_sqlite_triggers_do_not_run_and_the_file_is_unchanged(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", MESSAGES) / "bag.db3"
    connection = sqlite3.connect(path)
    connection.execute("CREATE TRIGGER t AFTER UPDATE ON messages BEGIN DELETE FROM messages; END")
    connection.close()
    before = path.read_bytes()
    assert len(read_one(path).series["state"].stamp) == 40
    assert path.read_bytes() == before
    assert {p.name for p in path.parent.iterdir()} == {"bag.db3", "metadata.yaml"}


def test_an_sqlite_file_with_too_many_messages_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_bag(tmp_path / "bag", MESSAGES) / "bag.db3"
    monkeypatch.setattr(limits, "MCAP", replace(limits.MCAP, messages_count=50))
    with pytest.raises(LimitError, match="too many messages for a file of"):
        read_one(path)


def test_a_write_ahead_log_beside_the_file_is_noted(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", MESSAGES) / "bag.db3"
    path.with_name("bag.db3-wal").write_bytes(b"pending")
    assert "its messages are not read" in str(read_one(path).damage[0])


def test_a_truncated_sqlite_file_returns_its_beginning_or_a_typed_error(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", MESSAGES) / "bag.db3"
    data = path.read_bytes()
    left = set()
    for length in range(0, len(data), len(data) // 40):
        path.write_bytes(data[:length])
        try:
            recording = read_one(path)
        except TwinError:
            left.add(-1)
            continue
        state = recording.series.get("state")
        left.add(0 if state is None else len(state.stamp))
        assert recording.damage
    assert -1 in left
    assert len(left) > 2, "a truncated file should return its beginning"


def test_a_zstandard_file_with_too_much_unpacked_data_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import zstandard

    path = tmp_path / "zeros.db3.zstd"
    path.write_bytes(zstandard.ZstdCompressor().compress(bytes(50_000_000)))
    small = replace(limits.MCAP, uncompressed_free_bytes=10_000_000)
    monkeypatch.setattr(limits, "MCAP", small)
    with pytest.raises(LimitError, match="the compressed file is too large after decompression"):
        read_one(path)


def test_readers_of_other_packages_have_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    from pytest_twin.formats import recordings

    class Theirs:
        kind = "theirs"

        def reads(self, path: Path) -> bool:
            return path.suffix == ".csv"

        def read(self, path: Path, asked: object) -> list[Recording]:
            empty = JointSeries(
                "/joint_states", ("a",), np.array([START]), np.array([START]), None, None, None
            )
            return [Recording(path, {"state": empty}, {}, ())]

    class Point:
        def __init__(self, name: str, value: str) -> None:
            self.name, self.value = name, value

        def load(self) -> type:
            return Theirs

    points = [Point("csv", "pytest_twin.formats.recordings.csv:CsvFile"), Point("z", "theirs:X")]
    monkeypatch.setattr(recordings, "entry_points", lambda group: points)
    recordings.readers.cache_clear()
    try:
        assert [reader.kind for reader in recordings.readers()] == ["theirs", "theirs"]
    finally:
        recordings.readers.cache_clear()


def test_a_bag_with_one_message_is_read(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "bag", [Message(START, position=(1.0, 2.0))])
    (recording,) = read_recordings(folder)
    assert recording.series["state"].position is not None
    assert recording.series["state"].position.tolist() == [[1.0, 2.0]]
    assert set(recording.series) == {"state"}


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("name: /joint_states", "name: []", "topic_metadata.name: not the metadata of a topic"),
        ("message_count: 40", "message_count: {}", "message_count: not the metadata of a topic"),
    ],
)
def test_a_topic_of_invalid_bag_metadata_is_refused_with_its_place(
    tmp_path: Path, old: str, new: str, place: str
) -> None:
    folder = write_bag(tmp_path / "bag", MESSAGES)
    metadata = folder / "metadata.yaml"
    head, separator, counts = metadata.read_text().partition("topics_with_message_count:")
    assert old in counts
    metadata.write_text(head + separator + counts.replace(old, new))
    with pytest.raises(FormatError) as caught:
        read_one(folder)
    assert caught.value.path == metadata
    assert place in str(caught.value)
