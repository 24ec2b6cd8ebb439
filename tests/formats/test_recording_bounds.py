"""Small files that unpack to large data are refused early with the limit."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zstandard
from bag_files import MESSAGE, SQLITE, write_bag
from mcap_files import DECLARED, END, HEADER, START, Message, chunk, mcap, message_record, sines

from pytest_twin.errors import LimitError
from pytest_twin.formats import limits
from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import JointSeries
from pytest_twin.formats.recordings import read_one

MIB = 2**20


def zeros() -> bytes:
    """An MCAP file of 0.5 MiB that unpacks to 16 GiB of zeros."""
    part = bytes(128 * MIB)
    packed = zstandard.ZstdCompressor(level=1).compress(part)
    return HEADER + DECLARED + chunk(part, compression="zstd", packed=packed) * 128 + END


def messages(channel: int) -> bytes:
    """An MCAP file of some 10 KiB with millions of empty messages."""
    empty = message_record(Message(0, raw=b""), channel)[: 9 + 22]
    empty = empty[:1] + (22).to_bytes(8, "little") + empty[9:]
    part = empty * (100 * MIB // len(empty))
    packed = zstandard.ZstdCompressor(level=1).compress(part)
    return HEADER + DECLARED + chunk(part, compression="zstd", packed=packed) * 5 + END


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (zeros, "too large after decompression for a file of"),
        (lambda: messages(1), "too many messages for a file of"),
        (lambda: messages(9), "too many messages for a file of"),
    ],
    ids=["zeros", "messages", "undeclared channel"],
)
def test_a_decompression_bomb_in_mcap_is_refused_early(
    tmp_path: Path, content: Callable[[], bytes], words: str
) -> None:
    path = tmp_path / "small.mcap"
    path.write_bytes(content())
    assert path.stat().st_size < MIB
    began = time.process_time()
    with pytest.raises(LimitError) as caught:
        read_one(path)
    assert words in str(caught.value)
    assert "expected at most" in str(caught.value)
    assert time.process_time() - began < 5.0


def test_a_recording_of_joints_at_rest_at_1_khz_is_far_below_the_limits(tmp_path: Path) -> None:
    count, joints = 20_000, 30
    still = np.zeros((count, joints))
    stamp = 1_700_000_000_000_000_000 + np.arange(count) * 1_000_000
    names = tuple(f"joint_{k}" for k in range(joints))
    path = tmp_path / "still.mcap"
    write_recording(path, [JointSeries("/joint_states", names, stamp, stamp, still, still, still)])
    size = path.stat().st_size
    plain = count * 8 * 3 * joints
    assert plain / size < limits.MCAP.uncompressed_ratio / 10
    assert size / count > limits.MCAP.packed_message_bytes * 10
    assert len(read_one(path).series["state"].stamp) == count


def test_compressed_messages_are_limited_individually_and_in_total(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packed = zstandard.ZstdCompressor().compress(bytes(2 * MIB))
    path = tmp_path / "packed.mcap"
    path.write_bytes(mcap([replace(one, raw=packed) for one in sines(40)]))
    monkeypatch.setattr(limits, "MCAP", replace(limits.MCAP, message_bytes=MIB))
    with pytest.raises(LimitError, match=r"a compressed message is too large .got 2097152 bytes"):
        read_one(path)
    monkeypatch.setattr(
        limits, "MCAP", replace(limits.MCAP, message_bytes=4 * MIB, uncompressed_bytes=20 * MIB)
    )
    with pytest.raises(LimitError, match="a compressed message is too large"):
        read_one(path)


def test_only_the_damaged_compressed_message_is_lost(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "bag", sines(20), SQLITE, MESSAGE)
    connection = sqlite3.connect(folder / "bag.db3")
    connection.execute(
        "UPDATE messages SET data = substr(data, 1, 12) WHERE topic_id = "
        "(SELECT id FROM topics WHERE name = '/joint_states') AND timestamp = ?",
        (START,),
    )
    connection.commit()
    connection.close()
    recording = read_one(folder)
    assert len(recording.series["state"].stamp) == 19
    assert "1 of 20 messages are lost, they cannot be decoded" in str(recording.damage[0])


def test_metadata_without_a_checksum_is_noted(tmp_path: Path) -> None:
    said = "no checksum covers it"
    path = tmp_path / "trial.mcap"
    for guarded in (True, False):
        path.write_bytes(mcap(sines(3), metadata={"payload": "kg05"}, enable_data_crcs=guarded))
        recording = read_one(path)
        assert recording.damage == ()
        assert any(said in note for note in recording.notes) == (not guarded)
    path.write_bytes(mcap(sines(3)))
    assert read_one(path).notes == ()
