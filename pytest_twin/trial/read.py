"""Recordings as a user declared them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pytest_twin.formats.recording import Recording
from pytest_twin.formats.recordings import read_one, read_recordings
from pytest_twin.recording_options import NO_OPTIONS, RecordingOptions


def recordings_at(
    path: Path, topics: Mapping[str, str], options: RecordingOptions = NO_OPTIONS
) -> list[Recording]:
    """The recordings of a file or folder of any kind: one, or each episode of a data set.

    Args:
        path: the file or folder.
        topics: role -> topic.
        options: what is declared about it.

    Raises:
        TwinError: it cannot be read.
    """
    return read_recordings(path, topics, columns=options.columns, units=options.units)


def recording_at(
    path: Path, topics: Mapping[str, str], options: RecordingOptions = NO_OPTIONS
) -> Recording:
    """The only recording of a file or folder.

    Raises:
        FormatError: a data set of several episodes.
        TwinError: it cannot be read.
    """
    return read_one(path, topics, columns=options.columns, units=options.units)
