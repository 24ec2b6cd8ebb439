"""Writing a release: staged beside its place, synced, checked, and renamed into it."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path, PurePosixPath

from securesystemslib.signer import CryptoSigner

from pytest_twin.errors import PathError, ReleaseError
from pytest_twin.formats import atomic
from pytest_twin.formats.digest import bytes_sha256
from pytest_twin.formats.file_names import portable_paths
from pytest_twin.formats.paths import open_regular
from pytest_twin.release import folder as folders
from pytest_twin.release import keys as trusted_keys
from pytest_twin.release import seen, statement
from pytest_twin.release.check import baseline
from pytest_twin.release.envelope import seal
from pytest_twin.release.statement import Draft, FileEntry, Header, Previous, Release
from pytest_twin.release.verify import ENVELOPE, FILES, REPORT, RESULTS, judge

_STAGING = ".staging-"
_STALE_SECONDS = 3600.0
_BLOCK_BYTES = 2**20


def write(
    root: Path,
    draft: Draft,
    signer: CryptoSigner,
    report: Callable[[Header], str],
    *,
    now: datetime | None = None,
) -> tuple[Release, tuple[str, ...]]:
    """Sign ``draft`` and write it as the twin's next release.

    Either the whole release is there afterwards, or none of it.

    Args:
        root: the twin's folder.
        draft: what is released.
        signer: with what, from :func:`pytest_twin.release.signer`.
        report: makes the HTML report once the number is known.
        now: the time to sign at; the clock's if None.

    Returns:
        The release, and what to say in the terminal.

    Raises:
        ReleaseError: a critical golden did not pass; a file is not what it was before the run;
            the key is not trusted; another release was written meanwhile.
        PathError: the disk refuses, or a link lies in the way.
    """
    root = Path(os.path.realpath(root))
    releases = root / folders.RELEASES
    _require_passed(draft)
    first = _require_trust(root, releases, signer)
    header = _header(root, releases, draft, signer, now or datetime.now(UTC))
    try:
        releases.mkdir(exist_ok=True)
        _clean(releases)
        staging = Path(tempfile.mkdtemp(prefix=_STAGING, dir=releases))
    except OSError as error:
        raise PathError(f"cannot be written: {error.strerror}", path=releases) from None
    try:
        release = _stage(staging, root, draft, header, signer, report)
        _check_staged(staging, release, header)
        notes = [trusted_keys.trust_first(root, signer)] if first else []
        # mkdtemp makes folders that only their owner can read.
        staging.chmod(0o755)
        if not atomic.create_directory(staging, releases / f"{header.number:04d}"):
            raise _meanwhile(header.number, releases)
    except OSError as error:
        raise PathError(f"cannot be written: {error.strerror or error}", path=releases) from None
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    note = seen.remember(header.series, header.number)
    return release, (*notes, *([note] if note else []))


def _require_passed(draft: Draft) -> None:
    for proof in draft.proofs:
        outcome = proof.outcome
        if outcome.criticality == "critical" and outcome.status != "passed":
            raise ReleaseError(
                "a critical golden did not pass, so nothing is released",
                where=outcome.key,
                value=outcome.status,
                expected="passed",
            )


def _require_trust(root: Path, releases: Path, signer: CryptoSigner) -> bool:
    """Refuse a signer that the twin does not trust; whether it is the twin's first."""
    trusted = trusted_keys.load_trusted(root / trusted_keys.FOLDER)
    if trusted:
        trusted_keys.require_trusted(signer, trusted, root)
        return False
    if folders.numbered(releases):
        raise ReleaseError(
            "there are releases but no trusted keys",
            path=root / trusted_keys.FOLDER,
            expected="the *.pub files that were there when they were signed",
        )
    return True


def _meanwhile(number: int, releases: Path) -> ReleaseError:
    return ReleaseError(
        f"release {number} was written by another process meanwhile",
        path=releases,
        expected="one writer at a time; run pytest --twin-release again",
    )


def _header(
    root: Path, releases: Path, draft: Draft, signer: CryptoSigner, now: datetime
) -> Header:
    there = folders.numbered(releases)
    before = baseline(root, now=now).known
    numbers = [number for number, _ in there]
    if before is None:
        series = secrets.token_hex(16)
    else:
        series = before.header.series
        numbers.append(seen.highest(series) or 0)
    # A number beyond a release that was not looked at would follow the one before that.
    since = folders.numbered(releases)
    if since != there:
        raise _meanwhile(since[0][0] if since else there[0][0], releases)
    return Header(
        twin=draft.twin,
        series=series,
        number=max(numbers, default=0) + 1,
        previous=Previous(before.number, before.sha256) if before else None,
        created=statement.timestamp(now),
        expires=statement.timestamp(now + timedelta(days=draft.valid_days)),
        key_id=signer.public_key.keyid,
    )


def _stage(
    staging: Path,
    root: Path,
    draft: Draft,
    header: Header,
    signer: CryptoSigner,
    report: Callable[[Header], str],
) -> Release:
    files, external = _copy(staging, root, draft)
    for name, text in ((RESULTS, _results(header, draft)), (REPORT, report(header))):
        data = text.encode("utf-8")
        (staging / name).write_bytes(data)
        files.append(FileEntry(name, bytes_sha256(data), len(data)))
    payload = statement.write(header, draft, files, external)
    envelope = seal(payload, signer)
    (staging / ENVELOPE).write_bytes(envelope)
    return statement.read(payload, header.key_id, bytes_sha256(envelope))


def _copy(staging: Path, root: Path, draft: Draft) -> tuple[list[FileEntry], list[FileEntry]]:
    files, external = [], []
    names = {path: _relative_name(path, root) for path in draft.files}
    copies = portable_paths(names[path] for path in draft.files if _is_inside(path, root))
    for path, expected in draft.files.items():
        real, name = Path(os.path.realpath(path)), names[path]
        inside = _is_inside(path, root)
        copy = staging / FILES / copies[name] if inside else None
        sha256, size = _digest_into(real, copy)
        if sha256 != expected:
            raise ReleaseError(
                "changed during the run, so nothing was released",
                path=path,
                expected="files that stay as they are; run pytest --twin-release again",
            )
        if inside:
            original = None if copies[name] == name else _as_text(name)
            files.append(FileEntry(f"{FILES}/{copies[name]}", sha256, size, original))
        else:
            external.append(FileEntry(name, sha256, size))
    return files, external


def _is_inside(path: Path, root: Path) -> bool:
    return Path(os.path.realpath(path)).is_relative_to(root)


def _relative_name(path: Path, root: Path) -> str:
    return PurePosixPath(os.path.relpath(os.path.realpath(path), root)).as_posix()


def _as_text(name: str) -> str:
    """A path as JSON can hold it; bytes that are no text are written as escapes."""
    return name.encode("utf-8", "backslashreplace").decode()


def _digest_into(path: Path, copy: Path | None) -> tuple[str, int]:
    """Read a file once; the digest is of the very bytes that are copied."""
    hashed, size = hashlib.sha256(), 0
    if copy is not None:
        copy.parent.mkdir(parents=True, exist_ok=True)
    with open_regular(path) as source, (copy or Path(os.devnull)).open("wb") as sink:
        while block := source.read(_BLOCK_BYTES):
            hashed.update(block)
            size += len(block)
            sink.write(block)
    return hashed.hexdigest(), size


def _results(header: Header, draft: Draft) -> str:
    proofs = [statement.proof_to_json(proof) for proof in draft.proofs]
    for proof in proofs:
        if not proof["release"]:
            proof["release"], proof["at"] = header.number, header.created
    results = {
        "schema": 1,
        "twin": header.twin,
        "release": header.number,
        "created": header.created,
        "expires": header.expires,
        "goldens": proofs,
    }
    return json.dumps(results, indent=1, allow_nan=False) + "\n"


def _check_staged(staging: Path, release: Release, header: Header) -> None:
    """What was staged must hold before anybody sees it."""
    verdict = judge(release, folders.listing(staging), now=statement.moment(header.created))
    if not verdict.holds:
        raise ReleaseError(
            "the written release does not verify: " + verdict.problems[0].text,
            path=staging,
            expected="files that no other process changes; run pytest --twin-release again",
        )


def _clean(releases: Path) -> None:
    """Remove what interrupted writes left; not what another process may be writing now."""
    for path in releases.glob(f"{_STAGING}*"):
        # Another process may have finished its release since the folder was listed.
        with suppress(FileNotFoundError):
            if not path.is_symlink() and time.time() - path.stat().st_mtime > _STALE_SECONDS:
                shutil.rmtree(path, ignore_errors=True)
