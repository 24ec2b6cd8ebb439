"""Read rosbag2 folders: ``metadata.yaml`` and the files of one recording."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

from pytest_twin.errors import FormatError, PathError, require_at_most
from pytest_twin.formats import limits, yaml
from pytest_twin.formats.mcap import gather_mcap
from pytest_twin.formats.message_collector import MessageCollector
from pytest_twin.formats.paths import Roots
from pytest_twin.formats.recording import Recording
from pytest_twin.formats.recordings import mcap, sqlite
from pytest_twin.formats.recordings.base import ReadingOptions
from pytest_twin.formats.sqlite_bag import gather_sqlite

METADATA = "metadata.yaml"
# Pattern of rosbag2's file names: the number of the file in its bag.
_PART = re.compile(r"(?P<bag>.*)_\d+\.(mcap|db3)(\.zstd?)?", re.IGNORECASE)
_INFORMATION = "rosbag2_bagfile_information"


class Rosbag2Folder:
    """Reads folders written by ``ros2 bag record``, MCAP or SQLite, compressed or not.

    A recorder that was killed leaves no ``metadata.yaml``. The files are then read in the order
    of their numbers.
    """

    kind: ClassVar[str] = "rosbag2 folder"

    def reads(self, path: Path) -> bool:
        """Whether ``path`` is a folder with ``metadata.yaml`` or with files of a bag."""
        return path.is_dir() and ((path / METADATA).is_file() or bool(_bag_files(path)))

    def read(self, path: Path, options: ReadingOptions) -> Sequence[Recording]:
        """Read all files of the folder as one recording."""
        collector = MessageCollector(path, options.topics)
        self.gather(path, collector)
        return [collector.recording()]

    def gather(self, path: Path, collector: MessageCollector) -> None:
        """Pass all messages of the folder's files to ``collector``."""
        if (path / METADATA).is_file():
            information = _information(path / METADATA)
            files = _listed_files(path, information)
            collector.metadata.update(_custom_data(information))
        else:
            information = {}
            files = _bag_files(path)
            _refuse_several(path, files)
            collector.notes.add(
                METADATA, "missing: the recorder was killed; the folder's files are read by name"
            )
        require_at_most(len(files), limits.MCAP.channels_count, "too many files", path=path)
        for file in files:
            if file.name.lower().endswith(sqlite.SUFFIXES):
                gather_sqlite(file, collector)
            else:
                gather_mcap(file, collector)
        _compare(path / METADATA, information, collector)


def _information(path: Path) -> Mapping[str, Any]:
    data = yaml.load(path).data
    found = data.get(_INFORMATION) if isinstance(data, dict) else None
    if not isinstance(found, dict):
        raise FormatError("not the metadata of a bag", path=path, expected=f"{_INFORMATION}:")
    return found


def _listed_files(folder: Path, information: Mapping[str, Any]) -> list[Path]:
    names = information.get("relative_file_paths")
    metadata = folder / METADATA
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        raise FormatError(
            "names no files", path=metadata, where="relative_file_paths", expected="a list of names"
        )
    roots = Roots(folder)
    files = []
    for name in names:
        where = f"{_INFORMATION}.relative_file_paths"
        # Old recorders prefix the file with the folder's name.
        bare = PurePosixPath(name).name
        if name == f"{PurePosixPath(name).parent.name}/{bare}" and not (folder / name).exists():
            name = bare
        files.append(roots.resolve(name, at=metadata, where=where))
    if len(set(files)) != len(files):
        raise FormatError(
            "names a file twice",
            path=metadata,
            where="relative_file_paths",
            value=", ".join(names),
            expected="each file once",
        )
    return files


def _bag_files(folder: Path) -> list[Path]:
    suffixes = (*mcap.SUFFIXES, *sqlite.SUFFIXES)
    try:
        found = [p for p in folder.iterdir() if p.name.lower().endswith(suffixes)]
    except OSError as error:
        raise PathError(f"cannot be read: {error.strerror}", path=folder) from None
    return sorted((p for p in found if p.is_file()), key=_by_number)


def _refuse_several(folder: Path, files: Sequence[Path]) -> None:
    """Refuse a folder of several independent recordings."""
    parts = [_PART.fullmatch(file.name) for file in files]
    if len(files) > 1 and (not all(parts) or len({p and p["bag"] for p in parts}) > 1):
        raise FormatError(
            f"holds files of several recordings and no {METADATA}",
            path=folder,
            value=", ".join(file.name for file in files[:4]) + (", ..." if len(files) > 4 else ""),
            expected="one recording, or the folder of one bag",
        )


def _by_number(path: Path) -> tuple[list[tuple[int, int | str]]]:
    parts = re.split(r"(\d+)", path.name)
    return ([(0, int(p)) if p.isdigit() and len(p) < 20 else (1, p) for p in parts],)


def _custom_data(information: Mapping[str, Any]) -> dict[str, str]:
    """Return the trial's metadata, recorded by ``ros2 bag record --custom-data payload=kg05``."""
    found = information.get("custom_data")
    if not isinstance(found, dict):
        return {}
    return {str(key): str(value) for key, value in found.items()}


def _compare(file: Path, information: Mapping[str, Any], collector: MessageCollector) -> None:
    """Note topics whose number of messages differs from the number in ``metadata.yaml``.

    Raises:
        FormatError: a topic has no name, or its count is no whole number.
    """
    counts = information.get("topics_with_message_count", [])
    where = f"{_INFORMATION}.topics_with_message_count"
    if not isinstance(counts, list):
        raise FormatError(
            "not a list of topics", path=file, where=where, value=str(counts)[:80],
            expected="topic_metadata and message_count for each topic",
        )  # fmt: skip
    wanted = {reader.topic for reader in collector.readers.values()}
    for at, entry in enumerate(counts):
        topic = entry.get("topic_metadata") if isinstance(entry, dict) else None
        name = topic.get("name") if isinstance(topic, dict) else None
        stated = entry.get("message_count") if isinstance(entry, dict) else None
        for key, value, kind in (
            ("topic_metadata.name", name, str),
            ("message_count", stated, int),
        ):
            if type(value) is not kind:
                raise FormatError(
                    "not the metadata of a topic", path=file, where=f"{where}[{at}].{key}",
                    value=str(value)[:80],
                    expected="the topic's name" if kind is str else "a whole number",
                )  # fmt: skip
        if name not in wanted:
            continue
        known = collector.topics.get(name)
        read = 0 if known is None else known.messages
        if stated != read:
            collector.notes.add(name, f"{read} of {stated} messages that {METADATA} counts")
