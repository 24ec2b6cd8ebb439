"""Damaged and malicious recordings raise a typed error or report their loss."""

from __future__ import annotations

import random
import struct
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType
from mcap_files import (
    BARE,
    DECLARED,
    END,
    HEADER,
    MAGIC,
    START,
    Message,
    cdr,
    chunk,
    mcap,
    message_record,
    put,
    record,
    sines,
    text,
)

from pytest_twin.errors import FormatError, LimitError, RecordingError, TwinError
from pytest_twin.formats import limits
from pytest_twin.formats import recording as recording_types
from pytest_twin.formats.mcap import Recording, read_recording

ONE, TWO = (message_record(message) for message in sines(3)[1:])


def read(folder: Path, data: bytes) -> Recording:
    return read_recording(put(folder, data))


def positions(recording: Recording) -> list[list[float]]:
    state = recording.series.get("state")
    return [] if state is None or state.position is None else state.position.tolist()


def test_undamaged_files_report_no_damage(tmp_path: Path) -> None:
    for data in (
        HEADER + DECLARED + ONE + END,
        HEADER + chunk(DECLARED + ONE) + END,
        HEADER + chunk(DECLARED) + chunk(ONE) + chunk(b"") + END,
    ):
        recording = read(tmp_path, data)
        assert (recording.damage, positions(recording)) == ((), [[0.1, -0.2]])


@pytest.mark.parametrize("options", [{"chunk_size": 400}, {"use_chunking": False}, BARE])
def test_a_truncated_file_returns_its_beginning_and_reports_damage(
    tmp_path: Path, options: dict
) -> None:  # type: ignore[type-arg]
    data = mcap(sines(12), **options)
    whole = positions(read(tmp_path, data))
    assert len(whole) == 12
    counts = set()
    for length in range(0, len(data), 13):
        try:
            recording = read(tmp_path, data[:length])
        except TwinError:
            assert length < len(MAGIC)
            continue
        found = positions(recording)
        assert found == whole[: len(found)]
        assert recording.damage, f"no damage reported for {length} of {len(data)} bytes"
        counts.add(len(found))
    if options is not BARE:
        assert len(counts) > 3, "a truncated file should return its beginning"


def test_a_truncation_is_reported_with_position_and_lost_bytes(tmp_path: Path) -> None:
    data = HEADER + DECLARED + ONE + ONE
    recording = read(tmp_path, data[:-5])
    start = len(HEADER + DECLARED + ONE)
    lost = len(ONE) - 5
    assert str(recording.damage[0]) == (
        f"byte {start}: a record reaches past the end of the file; "
        f"the last {lost} bytes of the file are lost"
    )


@pytest.mark.parametrize(
    "options",
    [
        {"chunk_size": 300},
        {"chunk_size": 300, "compression": CompressionType.ZSTD},
        {"chunk_size": 300, "compression": CompressionType.LZ4},
        {"use_chunking": False},
    ],
)
def test_every_changed_bit_is_detected_or_without_effect(tmp_path: Path, options: dict) -> None:  # type: ignore[type-arg]
    """All bytes of the data section are covered by a CRC: a change is refused or noted."""
    data = mcap(sines(6), metadata={"role": "fit"}, enable_data_crcs=True, **options)
    sound = read(tmp_path, data)
    assert sound.damage == ()
    chooser = random.Random(5)
    quiet = 0
    for at in range(0, len(data), 3):
        flipped = bytearray(data)
        flipped[at] ^= 1 << chooser.randrange(8)
        try:
            recording = read(tmp_path, bytes(flipped))
        except TwinError:
            continue
        if recording.damage:
            continue
        quiet += 1
        assert positions(recording) == positions(sound), at
        assert recording.metadata == sound.metadata, at
    assert quiet < len(data) / 10


def test_only_the_chunk_with_a_wrong_crc_is_lost(tmp_path: Path) -> None:
    data = bytearray(mcap(sines(9), chunk_size=500))
    at = data.index(struct.pack("<d", -0.2 * 4))
    data[at] ^= 1
    recording = read(tmp_path, bytes(data))
    assert 0 < len(positions(recording)) < 9
    assert [0.4, -0.8] not in positions(recording)
    words = [str(note) for note in recording.damage]
    assert any("its CRC is wrong; the messages logged from" in note for note in words)
    lost = 9 - len(positions(recording))
    assert f"/joint_states: {9 - lost} of 9 messages that the summary counts" in words


def test_a_chunk_missing_against_the_index_is_reported(tmp_path: Path) -> None:
    data = bytearray(mcap(sines(9), chunk_size=500))
    first = len(HEADER)
    assert data[first] == 6
    data[first] = 0x86
    recording = read(tmp_path, bytes(data))
    words = " ".join(str(note) for note in recording.damage)
    assert f"byte {first}: a record of type 134 is not read" in words
    assert f"chunk at byte {first}: is in the index and missing in the data" in words
    assert "of 9 messages that the summary counts" in words


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "not an MCAP file"),
        (b"not a recording at all", "not an MCAP file"),
        (MAGIC[:7] + b"x", "not an MCAP file"),
        (HEADER + chunk(DECLARED + chunk(ONE)) + END, "a chunk inside a chunk"),
        (
            HEADER + DECLARED + DECLARED.replace(b"joint_states", b"joint_statez") + END,
            "channel 1 changes its meaning within the file",
        ),
    ],
)
def test_files_that_violate_the_mcap_format_are_refused(
    tmp_path: Path, data: bytes, words: str
) -> None:
    with pytest.raises(FormatError, match=words):
        read(tmp_path, data)


@pytest.mark.parametrize(
    ("data", "left", "words"),
    [
        (HEADER + DECLARED + ONE, 1, "the recorder did not finish the file: no footer"),
        (HEADER + DECLARED + ONE + END[:-8], 1, "does not end with the MCAP magic"),
        (HEADER + DECLARED + ONE + b"\0" * 50, 1, "a record of type 0"),
        (HEADER + chunk(DECLARED + ONE, compression="brotli") + END, 0, "'brotli' is not known"),
        (HEADER + chunk(DECLARED + ONE, compression="zstd") + END, 0, "cannot be decompressed"),
        (HEADER + chunk(DECLARED + ONE, compression="lz4") + END, 0, "cannot be decompressed"),
        (HEADER + chunk(DECLARED + ONE, length=10**15) + END, 0, "fields are longer than"),
        (HEADER + chunk(DECLARED + ONE[:-3]) + END, 0, "a record is cut off"),
        (HEADER + chunk(DECLARED + ONE + b"\0" * 30) + END, 1, "a record of type 0"),
        (HEADER + chunk(ONE + DECLARED + TWO) + END, 2, ""),
        (HEADER + ONE + DECLARED + TWO + END, 2, ""),
        (HEADER + DECLARED + record(5, b"\0" * 3) + ONE + END, 1, "a message of 3 bytes"),
        (HEADER + DECLARED + ONE + record(5, b"\7" + b"\0" * 30) + END, 1, "is not declared"),
        (HEADER + record(6, b"") + DECLARED + ONE + END, 1, "the chunk is lost"),
        (HEADER + record(12, b"\xff" * 9) + DECLARED + ONE + END, 1, "type 12 is not read"),
        (HEADER + DECLARED + ONE + record(200, b"x") + END, 1, "type 200 is not read"),
        (
            HEADER + DECLARED + ONE + record(15, b"\1\2\3\4") + END[13:],
            1,
            "data section: its CRC is wrong",
        ),
    ],
)
def test_damage_is_reported_and_the_rest_is_read(
    tmp_path: Path, data: bytes, left: int, words: str
) -> None:
    recording = read(tmp_path, data)
    assert len(positions(recording)) == left
    assert words in " | ".join(str(note) for note in recording.damage)
    assert bool(words) == bool(recording.damage)


def test_decompression_bombs_are_refused_before_unpacking(tmp_path: Path) -> None:
    zeros = bytes(50_000_000)
    small_frame = zstandard.ZstdCompressor().compress(zeros)
    no_size = zstandard.ZstdCompressor(write_content_size=False).compress(zeros)
    bombs = {
        "a chunk is too large after decompression": chunk(
            b"", compression="zstd", packed=small_frame, size=2**40
        ),
        "is larger after decompression than it declares": chunk(
            b"", compression="zstd", packed=small_frame, size=100
        ),
        "is larger after decompression than it declares ": chunk(
            b"", compression="zstd", packed=no_size, size=100
        ),
        "is larger after decompression than it declares  ": chunk(
            b"", compression="lz4", packed=lz4.frame.compress(zeros), size=100
        ),
    }
    for words, bomb in bombs.items():
        with pytest.raises(LimitError, match=words.strip()):
            read(tmp_path, HEADER + bomb + END)


def test_a_frame_with_a_huge_stated_size_allocates_no_memory(tmp_path: Path) -> None:
    # Magic, single segment with an 8-byte content size of 2**60, one empty raw block.
    frame = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 2**60) + b"\x01\x00\x00"
    recording = read(tmp_path, HEADER + chunk(b"", compression="zstd", packed=frame, size=9) + END)
    assert "cannot be decompressed" in str(recording.damage[0])


def test_many_small_chunks_are_limited_in_total(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = limits.McapLimits(uncompressed_bytes=1000, records_count=50, messages_count=5)
    monkeypatch.setattr(limits, "MCAP", small)
    with pytest.raises(LimitError, match="too large after decompression"):
        read(tmp_path, HEADER + chunk(bytes(400)) * 3 + END)
    with pytest.raises(LimitError, match="too many records"):
        read(tmp_path, HEADER + record(12, text("x") + b"\0" * 4) * 60 + END)
    with pytest.raises(LimitError, match="too many messages"):
        read(tmp_path, HEADER + DECLARED + ONE * 6 + END)


def test_a_chunk_that_unpacks_to_fewer_bytes_than_stated_is_lost(tmp_path: Path) -> None:
    packed = zstandard.ZstdCompressor(write_content_size=False).compress(DECLARED + ONE)
    size = len(DECLARED + ONE) + 7
    data = HEADER + chunk(b"", compression="zstd", packed=packed, size=size) + END
    assert f"decompresses to {size - 7} of {size} bytes" in str(read(tmp_path, data).damage[0])


def test_compressed_frames_without_a_stated_size_are_read(tmp_path: Path) -> None:
    content = DECLARED + ONE
    no_size = zstandard.ZstdCompressor(write_content_size=False)
    two_frames = no_size.compress(content[:50]) + no_size.compress(content[50:])
    for packed, name in (
        (no_size.compress(content), "zstd"),
        (two_frames, "zstd"),
        (lz4.frame.compress(content, store_size=False), "lz4"),
    ):
        recording = read(tmp_path, HEADER + chunk(content, compression=name, packed=packed) + END)
        assert (recording.damage, positions(recording)) == ((), [[0.1, -0.2]])


def test_the_number_of_damage_notes_is_limited(tmp_path: Path) -> None:
    recording = read(tmp_path, HEADER + record(200, b"") * 1000 + DECLARED + ONE + END)
    assert len(recording.damage) == recording_types._NOTES + 1
    assert str(recording.damage[-1]) == "further on: 960 more places like these"


def states(*stamps: int) -> list[Message]:
    return [
        Message(stamp, position=(float(i), 0.0), log_time=START + i)
        for i, stamp in enumerate(stamps)
    ]


@pytest.mark.parametrize(
    ("stamps", "words"),
    [
        ((5, 7, 6, 8), "/joint_states: 1 stamps go back, first message 2"),
        ((5, 6, 6, 6), "/joint_states: 2 stamps occur twice, first message 2"),
        ((5, 0, 7, 0), "/joint_states: 2 messages without header.stamp, first message 1"),
    ],
)
def test_decreasing_repeated_and_missing_stamps_are_noted_and_kept(
    tmp_path: Path, stamps: tuple[int, ...], words: str
) -> None:
    recording = read(tmp_path, mcap(states(*stamps)))
    assert recording.series["state"].stamp.tolist() == list(stamps)
    assert words in [str(note) for note in recording.damage]


def test_without_stamps_log_times_are_used_with_a_note(tmp_path: Path) -> None:
    recording = read(tmp_path, mcap(states(0, 0, 0)))
    assert recording.series["state"].stamp.tolist() == [START, START + 1, START + 2]
    assert "no message has a header.stamp" in str(recording.damage[0])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_non_finite_values_are_kept_and_noted(tmp_path: Path, value: float) -> None:
    messages = sines(4)
    messages[2].effort = (1.0, value)
    recording = read(tmp_path, mcap(messages))
    effort = recording.series["state"].effort
    assert effort is not None
    np.testing.assert_array_equal(effort[2], [1.0, value])
    assert [str(note) for note in recording.damage] == [
        "/joint_states: effort is not finite in 1 messages, first message 2, joint 'elbow'"
    ]


GOOD = cdr(sines(1)[0])
BROKEN = {
    "shorter than its encapsulation": b"\0\1",
    "empty message": b"",
    "encapsulation 0x0007 is not plain CDR": b"\0\7" + GOOD[2:],
    "ends inside header.frame_id": GOOD[:14],
    "header.frame_id is longer than the message": GOOD[:12] + b"\xff\xff\xff\xff" + GOOD[16:],
    "4294967295 joints, more than 1024": GOOD[:20] + b"\xff\xff\xff\xff" + GOOD[24:],
    "ends inside effort": GOOD[:-4],
    "bytes left over": GOOD + bytes(8),
    "a joint's name is not UTF-8": GOOD.replace(b"elbow", b"elb\xffw"),
    "a joint occurs twice": cdr(Message(START, ("a", "a"), (1.0, 2.0))),
    "no joint names": cdr(Message(START, (), ())),
    "a joint's name is empty or unprintable": cdr(Message(START, ("a", "\n"), (1.0, 2.0))),
    "3 values of position for 2 joints": cdr(Message(START, ("a", "b"), (1.0, 2.0, 3.0))),
}


@pytest.mark.parametrize("words", list(BROKEN))
def test_an_undecodable_message_is_lost_with_a_note(tmp_path: Path, words: str) -> None:
    messages = sines(5)
    messages[3].raw = BROKEN[words]
    recording = read(tmp_path, mcap(messages))
    assert len(positions(recording)) == 4
    note = str(recording.damage[0])
    assert (
        "/joint_states: 1 of 5 messages are lost, they cannot be decoded; first message 3" in note
    )
    assert words in note


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        (b"{", "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b"[]", "not a JSON object"),
        (b"{}", "name is not a list of text"),
        (b'{"name": ["a"], "position": [1, 2]}', "2 values of position for 1 joints"),
        (b'{"name": ["a"], "position": ["1"]}', "position contains a value that is not a number"),
        (b'{"name": ["a"], "position": [true]}', "position contains a value that is not a number"),
        (b'{"name": ["a"], "position": 3}', "position is not a list"),
        (b'{"name": ["a"], "position": [1' + b"0" * 400 + b"]}", "out of range"),
        (b'{"name": ["a"], "position": [1' + b"0" * 5000 + b"]}", "not JSON"),
        (b'{"name": ["a"], "header": {"stamp": 3}}', "header.stamp is not an object"),
        (b'{"name": ["a"], "header": {"stamp": {"sec": 1.5, "nanosec": 0}}}', "header.stamp.sec"),
        (b'{"name": ["a"], "header": {"stamp": {"sec": 1}}}', "header.stamp.nanosec"),
        (b"\xff", "not JSON"),
    ],
)
def test_an_invalid_json_message_is_lost_with_a_note(
    tmp_path: Path, raw: bytes, words: str
) -> None:
    messages = [*sines(2), Message(START + 10**9, raw=raw)]
    recording = read(tmp_path, mcap(messages, encoding="json"))
    assert len(positions(recording)) == 2
    assert words in str(recording.damage[0])


def test_a_topic_without_any_decodable_message_is_an_error(tmp_path: Path) -> None:
    messages = [Message(START + i, raw=b"\xff" * 40) for i in range(50)]
    with pytest.raises(RecordingError, match="no message can be decoded, first message 0"):
        read(tmp_path, mcap(messages))


def test_contradicting_trial_metadata_is_an_error(tmp_path: Path) -> None:
    def trial(role: str) -> bytes:
        pair = text("role") + text(role)
        return record(12, text("trial") + struct.pack("<I", len(pair)) + pair)

    same = HEADER + trial("fit") * 2 + DECLARED + ONE + END
    assert read(tmp_path, same).metadata == {"role": "fit"}
    with pytest.raises(RecordingError, match="metadata records 'trial' differ"):
        read(tmp_path, HEADER + trial("fit") + trial("held_out") + DECLARED + ONE + END)
