"""Read and write the stamp of a LeRobot data set: ``meta/twin.json``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pytest_twin.errors import FormatError
from pytest_twin.formats import atomic, limits
from pytest_twin.formats.digest import bytes_sha256, file_sha256
from pytest_twin.formats.paths import decode_text, read_bytes

_FILE, _INFO = "meta/twin.json", "meta/info.json"


@dataclass(frozen=True, slots=True)
class LeRobotStamp:
    """A LeRobot data set, versions 2.0 to 3.0.

    The digest covers ``meta/info.json`` and the Parquet files under ``data/``: joint positions,
    actions, units, episodes. It does not cover videos and statistics.
    """

    path: Path

    @staticmethod
    def is_dataset(folder: Path) -> bool:
        """Whether a folder is a LeRobot data set."""
        return (folder / _INFO).is_file()

    def read(self) -> str | None:
        """Return the text of ``meta/twin.json``, or None."""
        file = self.path / _FILE
        if not file.is_symlink() and not file.exists():
            return None
        return decode_text(read_bytes(file, limits.STAMPS.stamp_bytes), file)

    def write(self, text: str) -> None:
        """Write ``meta/twin.json`` atomically."""
        atomic.write_text(self.path / _FILE, text)

    def digest(self) -> str:
        """Return the SHA-256 over names and digests of the files, hex."""
        files = sorted((self.path / "data").rglob("*.parquet"))
        if not files:
            raise FormatError(
                "a LeRobot data set without data",
                path=self.path / "data",
                expected="Parquet files with the frames",
            )
        listed = "".join(
            f"{file_sha256(file)} {file.relative_to(self.path).as_posix()}\n"
            for file in (self.path / _INFO, *files)
        )
        return bytes_sha256(listed.encode())
