"""Write a release: into a temporary folder, which is checked and renamed to its final name."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path, PurePosixPath

from securesystemslib.signer import CryptoSigner

from pytest_twin.errors import ReleaseError, cannot_write
from pytest_twin.formats import atomic
from pytest_twin.formats.digest import bytes_sha256
from pytest_twin.formats.file_names import portable_paths
from pytest_twin.formats.paths import open_regular
from pytest_twin.formats.temporary import temporary_folder
from pytest_twin.release import accepted_releases, statement
from pytest_twin.release import folder as folders
from pytest_twin.release import keys as trusted_keys
from pytest_twin.release.check import baseline
from pytest_twin.release.envelope import seal
from pytest_twin.release.statement import Draft, FileEntry, Header, Previous, Release
from pytest_twin.release.verify import ENVELOPE, FILES, REPORT, RESULTS, judge

_BLOCK_BYTES = 2**20
"""Number of bytes that are copied at once."""


def write(
    root: Path,
    draft: Draft,
    signer: CryptoSigner,
    report: Callable[[Header], str],
    *,
    now: datetime | None = None,
) -> tuple[Release, tuple[str, ...]]:
    """Sign ``draft``, and write it as the next release of the twin.

    Either the whole release is written, or nothing.

    Args:
        root: the twin's folder.
        signer: signing key, from :func:`pytest_twin.release.signer`.
        report: returns the HTML report for the header of the release.
        now: time of the signature; the present time if None.

    Returns:
        The release, and notes for the terminal.

    Raises:
        ReleaseError: a critical golden did not pass; a file changed since the run started; the key
            is not trusted; another process wrote a release at the same time.
        PathError: a file cannot be written, or a link is in its place.
    """
    root = Path(os.path.realpath(root))
    releases = root / folders.RELEASES
    _require_passed(draft)
    first = _require_trust(root, releases, signer)
    header = _header(root, releases, draft, signer, now or datetime.now(UTC))
    try:
        releases.mkdir(exist_ok=True)
        with temporary_folder(releases) as staging:
            release = _write_staged(staging, root, draft, header, signer, report)
            _check_staged(staging, release, header)
            notes = [trusted_keys.trust_first(root, signer)] if first else []
            # The temporary folder can only be read by its owner.
            staging.chmod(0o755)
            if not atomic.create_directory(staging, releases / f"{header.number:04d}"):
                raise _concurrent_release(header.number, releases)
    except OSError as error:
        raise cannot_write(error, releases) from None
    note = accepted_releases.remember(header.series, header.number)
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
    """Check that the twin trusts the signer; whether it is the first signer of the twin."""
    trusted = trusted_keys.load_trusted(root / trusted_keys.FOLDER)
    if trusted:
        trusted_keys.require_trusted(signer, trusted, root)
        return False
    if folders.numbered_releases(releases):
        raise ReleaseError(
            "there are releases but no trusted keys",
            path=root / trusted_keys.FOLDER,
            expected="the *.pub files that were there when they were signed",
        )
    return True


def _concurrent_release(number: int, releases: Path) -> ReleaseError:
    return ReleaseError(
        f"release {number} was written by another process meanwhile",
        path=releases,
        expected="one writer at a time; run pytest --twin-release again",
    )


def _header(
    root: Path, releases: Path, draft: Draft, signer: CryptoSigner, now: datetime
) -> Header:
    there = folders.numbered_releases(releases)
    before = baseline(root, now=now).known
    numbers = [number for number, _ in there]
    if before is None:
        series = secrets.token_hex(16)
    else:
        series = before.header.series
        numbers.append(accepted_releases.highest(series) or 0)
    # If another process finished a release in between, this one would state the wrong predecessor.
    since = folders.numbered_releases(releases)
    if since != there:
        raise _concurrent_release(since[0][0] if since else there[0][0], releases)
    return Header(
        twin=draft.twin,
        series=series,
        number=max(numbers, default=0) + 1,
        previous=Previous(before.number, before.sha256) if before else None,
        created=statement.timestamp(now),
        expires=statement.timestamp(now + timedelta(days=draft.valid_days)),
        key_id=signer.public_key.keyid,
    )


def _write_staged(
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
    """Path as text for JSON; bytes that are not valid text are escaped."""
    return name.encode("utf-8", "backslashreplace").decode()


def _digest_into(path: Path, copy: Path | None) -> tuple[str, int]:
    """Copy a file and compute SHA-256 (hex) and size (bytes) of the copied bytes in one pass."""
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
    """Verify the written release before it gets its final name."""
    verdict = judge(release, folders.listing(staging), now=statement.moment(header.created))
    if not verdict.holds:
        raise ReleaseError(
            "the written release does not verify: " + verdict.problems[0].text,
            path=staging,
            expected="files that no other process changes; run pytest --twin-release again",
        )
