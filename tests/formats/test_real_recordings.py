"""Recordings of real robots keep their numbers when written in other formats."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from bag_files import FILE, MCAP, MESSAGE, SQLITE, write_bag
from mcap_files import Message
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from pytest_twin.formats.recording import Recording
from pytest_twin.formats.recordings import read_one
from pytest_twin.formats.ros_serialization import QUANTITIES

RECORDINGS = Path(
    os.environ.get("TWIN_RECORDINGS", Path(__file__).parents[3] / "shared" / "recordings")
)


@pytest.fixture(params=["xl330", "emps"])
def real_recording(request: pytest.FixtureRequest) -> Recording:
    folder = RECORDINGS / request.param / "recordings"
    if not folder.is_dir():
        pytest.skip(f"no recordings at {RECORDINGS}; the variable TWIN_RECORDINGS names the place")
    return read_one(min(folder.glob("*.mcap"), key=lambda path: path.stat().st_size))


def messages(recording: Recording) -> list[Message]:
    found = []
    for series in recording.series.values():
        for row, (stamp, log_time) in enumerate(
            zip(series.stamp.tolist(), series.log_time.tolist(), strict=True)
        ):
            values = {
                name: tuple(table[row])
                for name in QUANTITIES
                if (table := getattr(series, name)) is not None
            }
            found.append(
                Message(stamp, series.names, topic=series.topic, log_time=log_time, **values)
            )
    return sorted(found, key=lambda message: message.log_time or 0)


@pytest.mark.parametrize(
    ("storage", "compression"), [(SQLITE, None), (SQLITE, MESSAGE), (MCAP, FILE)]
)
def test_a_real_recording_written_as_bag_has_the_same_numbers(
    real_recording: Recording,
    tmp_path: Path,
    storage: StoragePlugin,
    compression: CompressionMode | None,
) -> None:
    found = read_one(write_bag(tmp_path / "bag", messages(real_recording), storage, compression))
    for role, series in real_recording.series.items():
        for name in ("stamp", "log_time", *QUANTITIES):
            np.testing.assert_array_equal(getattr(found.series[role], name), getattr(series, name))


def test_a_real_recording_written_as_csv_has_the_same_numbers(
    real_recording: Recording, tmp_path: Path
) -> None:
    state, command = real_recording.series["state"], real_recording.series["command"]
    sent = next(t for name in QUANTITIES if (t := getattr(command, name)) is not None)
    assert state.position is not None
    lines = [
        "time,"
        + ",".join([f"{n}.position" for n in state.names] + [f"{n}.command" for n in command.names])
    ]
    rows: dict[int, list[str]] = {}
    width = len(state.names)
    for row, stamp in enumerate(state.stamp.tolist()):
        cells = [repr(float(value)) for value in state.position[row]]
        rows[stamp] = cells + [""] * len(command.names)
    for row, stamp in enumerate(command.stamp.tolist()):
        before = rows.get(stamp, [""] * width)[:width]
        rows[stamp] = before + [repr(float(value)) for value in sent[row]]
    lines += [",".join([str(stamp), *rows[stamp]]) for stamp in sorted(rows)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    found = read_one(path)
    np.testing.assert_array_equal(found.series["state"].stamp, state.stamp)
    np.testing.assert_array_equal(found.series["state"].position, state.position)
    np.testing.assert_array_equal(found.series["command"].stamp, command.stamp)
    np.testing.assert_array_equal(found.series["command"].position, sent)
