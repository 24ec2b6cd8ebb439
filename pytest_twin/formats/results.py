"""Write the result of a command, several files in a folder, which may contain files of others.

The files appear together: while an old file is there, no new one is, and the main file is the last.
:data:`MANIFEST` lists the files that pytest-twin wrote, with digests. Only these are ever replaced
or removed, and only unchanged. What users add or edit stays.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from pytest_twin.errors import FormatError, PathError, cannot_write
from pytest_twin.formats import atomic, file_set, temporary
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.file_set import ChangeSet, FileChange
from pytest_twin.formats.paths import decode_text, read_bytes

MANIFEST = ".pytest-twin.json"
"""File that lists the files written by pytest-twin in its folder."""
_PENDING = ".pytest-twin.new"
"""Folder with a result that is complete, and not yet moved to its place."""
_MAX_BYTES = 64 * 2**20
"""Largest size of a manifest."""


@dataclass(frozen=True, slots=True)
class _Written:
    """One written file: its SHA-256, and the main file of the result that it belongs to."""

    sha256: str
    result: str


@contextlib.contextmanager
def result_folder(
    folder: Path,
    main: str,
    *,
    replaceable: Collection[str] = (),
    stays: str | None = None,
    alone: bool = False,
) -> Iterator[Path]:
    """Context with an empty folder; what it contains at the end becomes the result in ``folder``.

    An exception in the block leaves ``folder`` as it was.

    Args:
        folder: folder of the result, which is created if it is missing.
        main: name of the main file, which identifies the result in its folder.
        replaceable: files that the user named on the command line. They are replaced, also if
            somebody else wrote them.
        stays: folder in it whose files of earlier results are not removed.
        alone: whether a folder with files of others and without an earlier result is refused.

    Raises:
        PathError: a file of somebody else is in the way, a folder is a link, or the disk cannot be
            written.
    """
    folder = folder.absolute()
    with atomic.folder_in_use(folder):
        with temporary.exclusive(folder):
            finish(folder)
            written = _read(folder)
            _old_files(folder, written, main, stays)
            if alone and not any(w.result == main for w in written.values()):
                _check_empty(folder)
            if main not in written and main not in replaceable and (folder / main).exists():
                raise file_set.edited(folder / main)
        with temporary.temporary_folder(folder) as staging:
            new = staging / file_set.NEW
            new.mkdir()
            yield new
            with temporary.exclusive(folder):
                finish(folder)
                _put_in_place(folder, staging, main, replaceable, stays)


def finish(folder: Path) -> None:
    """Complete a result whose process was killed while it moved the files, if there is one.

    Raises:
        PathError: as :func:`result_folder`.
    """
    pending = folder / _PENDING
    if pending.is_dir() and not pending.is_symlink():
        file_set.apply(folder, pending)
        file_set.discard(pending)


def as_placed(text: str, staging: Path) -> str:
    """Text with the paths that files of the folder from :func:`result_folder` will have."""
    return text.replace(f"{staging.parent.name}/{staging.name}/", "")


def withdraw(folder: Path, main: str) -> None:
    """Remove an earlier result before the files that it describes are replaced.

    Raises:
        PathError: one of its files was edited, or the disk cannot be written.
    """
    if not folder.is_dir():
        return
    with temporary.exclusive(folder):
        finish(folder)
        old = _old_files(folder, _read(folder), main)
        try:
            for name in old:
                (folder / name).unlink()
        except OSError as error:
            raise cannot_write(error, folder) from None


def check_unchanged(folder: Path, main: str) -> None:
    """Check that the files of a result are as pytest-twin wrote them.

    Args:
        folder: folder of the result; one without a manifest is not checked.
        main: name of its main file.

    Raises:
        PathError: one of its files was edited.
    """
    finish(folder)
    for name, known in _read(folder).items():
        if known.result == main and file_set.digest_of(folder / name) != known.sha256:
            raise PathError(
                "changed since pytest-twin wrote it",
                path=folder / name,
                expected=f"the file as it was, or the command that wrote {main} again",
            )


def _put_in_place(
    folder: Path, staging: Path, main: str, replaceable: Collection[str], stays: str | None
) -> None:
    written = _read(folder)
    new = staging / file_set.NEW
    after = {
        path.relative_to(new).as_posix(): file_sha256(path)
        for path in sorted(new.rglob("*"))
        if path.is_file()
    }
    before = _old_files(folder, written, main, stays)
    for name, sha256 in after.items():
        file_set.check_folders(folder, name)
        digest = file_set.digest_of(folder / name)
        if digest is None:
            continue
        if name not in replaceable and digest != sha256:
            known = written.get(name)
            if known is None or known.sha256 != digest:
                raise file_set.edited(folder / name)
        before[name] = digest
    now_written = {
        **{name: w for name, w in written.items() if name not in before},
        **{name: _Written(sha256, main) for name, sha256 in after.items()},
    }
    text = _text({n: w for n, w in now_written.items() if n in after or (folder / n).exists()})
    atomic.write_text(new / MANIFEST, text)
    before_manifest = file_set.digest_of(folder / MANIFEST)
    if before_manifest is not None:
        before[MANIFEST] = before_manifest
    after[MANIFEST] = file_sha256(new / MANIFEST)
    changes = tuple(
        FileChange(name, before.get(name), after.get(name)) for name in sorted({**before, **after})
    )
    file_set.begin(staging, folder / _PENDING, ChangeSet(changes, main, withdraw=True, facts={}))
    finish(folder)


def _old_files(
    folder: Path, written: Mapping[str, _Written], main: str, stays: str | None = None
) -> dict[str, str]:
    """Files of an earlier result that are still there, other than those in ``stays`` -> SHA-256.

    Raises:
        PathError: one was edited.
    """
    old = {}
    for name, known in written.items():
        if known.result != main or (stays is not None and name.startswith(f"{stays}/")):
            continue
        file_set.check_folders(folder, name)
        digest = file_set.digest_of(folder / name)
        if digest is None:
            continue
        if digest != known.sha256:
            raise file_set.edited(folder / name)
        old[name] = digest
    return old


def _check_empty(folder: Path) -> None:
    for path in folder.iterdir():
        if path.name != MANIFEST and not path.name.startswith(temporary.PREFIX):
            raise PathError(
                f"a folder with other files, such as {path.name}, is not replaced",
                path=folder,
                expected="a new folder for --out, or that of an earlier result of this command",
            )


def _read(folder: Path) -> dict[str, _Written]:
    path = folder / MANIFEST
    if not path.is_symlink() and not path.exists():
        return {}
    try:
        files = json.loads(decode_text(read_bytes(path, _MAX_BYTES), path))["files"]
        written = {name: _Written(item["sha256"], item["result"]) for name, item in files.items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        written = None
    if written is None or not all(map(file_set.is_plain, written)):
        raise FormatError(
            "not a list of written files",
            path=path,
            expected="the file as pytest-twin wrote it, or none: then no file is replaced",
        )
    return written


def _text(written: Mapping[str, _Written]) -> str:
    files = {name: {"sha256": w.sha256, "result": w.result} for name, w in sorted(written.items())}
    return json.dumps({"schema": 1, "files": files}, indent=1) + "\n"
