"""Find the video of each episode of a LeRobot data set, and decode some of its images with PyAV.

Version 2 writes a file for each episode, version 3 several episodes to a file, with their times in
``meta/episodes``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.errors import FormatError
from pytest_twin.formats.paths import Roots
from pytest_twin.formats.recordings.parquet import data_files, read_columns
from pytest_twin.formats.ros_serialization import Floats

_EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_CHUNK = 1000
"""Default number of episodes in a folder."""
_INSIDE = 0.05
"""Fraction of an episode at its ends from which no image is taken."""


@dataclass(frozen=True, slots=True)
class EpisodeVideo:
    """Images of one camera in one episode.

    Attributes:
        begin, end: s, in the file.
    """

    episode: int
    file: Path
    begin: float
    end: float


def cameras(info: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """Return the names of features that are videos, and of those that are single images."""
    features = info["features"]
    kinds = {name: f.get("dtype") for name, f in features.items() if isinstance(f, dict)}
    videos = [name for name, kind in kinds.items() if kind == "video"]
    return videos, [name for name, kind in kinds.items() if kind == "image"]


def episode_videos(
    folder: Path, info: Mapping[str, Any], camera: str, durations: Mapping[int, float]
) -> list[EpisodeVideo]:
    """Return the video of each episode.

    Args:
        folder: folder of the data set; files outside it are refused.
        durations: number of an episode -> its duration, s.

    Raises:
        TwinError: the paths are not stated, or leave the folder.
    """
    template = info.get("video_path")
    where = folder / "meta" / "info.json"
    if not isinstance(template, str):
        raise FormatError(
            "states no path of the videos", path=where, where="video_path",
            expected="such as videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        )  # fmt: skip
    roots = Roots(folder)
    rows = _rows(folder, camera, durations, info, at=where)
    found = []
    for episode, fields, begin, end in rows:
        try:
            name = template.format(video_key=camera, **fields)
        except (KeyError, IndexError, ValueError, AttributeError):
            raise FormatError(
                "not a path of videos", path=where, where="video_path", value=template[:120],
                expected="the fields of LeRobot, such as {video_key} and {file_index:03d}",
            ) from None  # fmt: skip
        file = roots.resolve(name, at=folder / "videos", where="video_path")
        found.append(EpisodeVideo(episode, file, begin, end))
    return found


def _rows(
    folder: Path, camera: str, durations: Mapping[int, float], info: Mapping[str, Any], *, at: Path
) -> list[tuple[int, dict[str, int], float, float]]:
    """Episode, fields of its path, begin and end (s)."""
    if str(info.get("codebase_version")).startswith("v2"):
        size = info.get("chunks_size")
        chunk = size if type(size) is int and size > 0 else _CHUNK
        return [
            (n, {"episode_index": n, "episode_chunk": n // chunk}, 0.0, seconds)
            for n, seconds in durations.items()
        ]
    prefix = f"videos/{camera}/"
    names = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
    table = read_columns(
        data_files(folder, _EPISODES, at),
        {"episode_index": 0, **{prefix + name: 0 for name in names}},
    )
    columns = [table["episode_index"], *(table[prefix + name] for name in names)]
    return [
        (int(n), {"chunk_index": int(chunk), "file_index": int(file)}, float(begin), float(end))
        for n, chunk, file, begin, end in zip(*columns, strict=True)
        if int(n) in durations
    ]


def grey_frames(video: EpisodeVideo, count: int, width: int) -> Floats:
    """Decode images evenly over an episode.

    Args:
        count: number of images.
        width: width to which they are reduced, px.

    Returns:
        (count, height, width) grey levels, 0 to 255.

    Raises:
        FormatError: PyAV is missing, or the file cannot be decoded.
    """
    try:
        import av
    except ImportError:
        raise FormatError(
            "videos are decoded by PyAV, which is not installed",
            path=video.file,
            expected="pip install 'pytest-twin[video]'",
        ) from None
    margin = _INSIDE * (video.end - video.begin)
    times: Sequence[float] = np.linspace(
        video.begin + margin, video.end - margin, count
    ).tolist()  # fmt: skip
    images = []
    try:
        with av.open(str(video.file)) as container:
            stream = container.streams.video[0]
            for time in times:
                images.append(_image_at(container, stream, time, width))
    except (OSError, ValueError, IndexError, av.FFmpegError) as error:
        raise FormatError(
            f"cannot be decoded: {' '.join(str(error).split())[:120]}", path=video.file,
            expected="a video that FFmpeg reads",
        ) from None  # fmt: skip
    return np.stack(images)


def _image_at(container: Any, stream: Any, time: float, width: int) -> Floats:
    """First image at or after a time, s; the last one if there is none."""
    container.seek(int(time / stream.time_base), stream=stream)
    frame = None
    for frame in container.decode(stream):
        if frame.time is None or frame.time >= time:
            break
    if frame is None:
        raise ValueError(f"no image at {time:.3f} s")
    height = max(1, round(frame.height * width / frame.width))
    grey: Floats = frame.reformat(width, height, "gray").to_ndarray().astype(np.float64)
    return grey
