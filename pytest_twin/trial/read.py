"""Read recordings with the options that a user declared."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pytest_twin.errors import FormatError
from pytest_twin.formats.recording import Recording
from pytest_twin.formats.recordings import read_one, read_recordings
from pytest_twin.recording_options import NO_OPTIONS, RecordingOptions


def recordings_at(
    path: Path, topics: Mapping[str, str], options: RecordingOptions = NO_OPTIONS
) -> list[Recording]:
    """Read the recordings of a file or folder: one, or all episodes of a data set.

    Args:
        path: file or folder.
        topics: role -> topic.

    Raises:
        TwinError: it cannot be read.
    """
    return read_recordings(path, topics, **options.reading)


def recording_at(
    path: Path,
    topics: Mapping[str, str],
    options: RecordingOptions = NO_OPTIONS,
    episode: int | None = None,
) -> Recording:
    """Read the only recording of a file or folder, or one episode of a data set.

    Args:
        path: file or folder.
        topics: role -> topic.
        episode: number of the episode, from 0.

    Raises:
        FormatError: the data set has several episodes and none is chosen, or it has no such one.
        TwinError: it cannot be read.
    """
    if episode is None:
        return read_one(path, topics, **options.reading)
    found = recordings_at(path, topics, options)
    if not 0 <= episode < len(found):
        last = len(found) - 1
        raise FormatError("no such episode", path=path, value=episode, expected=f"0 to {last}")
    return found[episode]
