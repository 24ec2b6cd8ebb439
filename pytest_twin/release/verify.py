"""Verify a release from its bytes and facts; this module reads neither files nor the clock."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import PurePosixPath
from typing import Any, Literal

from securesystemslib.signer import Key

from pytest_twin.errors import ReleaseError
from pytest_twin.formats.digest import LINE_ENDINGS_ADVICE
from pytest_twin.release import statement
from pytest_twin.release.envelope import open_envelope
from pytest_twin.release.limits import LIMITS
from pytest_twin.release.statement import FileEntry, Release

ENVELOPE = "release.dsse.json"
RESULTS = "results.json"
REPORT = "report.html"
FILES = "files"

Code = Literal[
    "envelope", "files", "folder", "twin", "order", "rollback", "expired", "future", "keys",
    "stamp", "records",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class FolderEntry:
    """An entry of a release's folder on the disk.

    Attributes:
        kind: ``file``, ``folder``, ``link``, or ``other`` (pipe, socket, device).
        sha256: digest of a file that was read, hex; else empty.
        size: size of a file, bytes.
        links: number of hard links of the file.
        sha256_with_lf: digest of a small file after conversion of CR LF to LF, hex; else empty.
    """

    kind: Literal["file", "folder", "link", "other"]
    sha256: str = ""
    size: int = 0
    links: int = 1
    sha256_with_lf: str = ""


@dataclass(frozen=True, slots=True)
class Circumstances:
    """Facts outside the release itself; None where they are unknown.

    Attributes:
        folder_number: number in the name of the folder.
        twin: name that the enclosing twin states.
        newer: an authentic release with a higher number in the same twin.
        before: the authentic release with the next lower number in the same twin.
        seen: highest number of this series that was accepted before on this machine.
    """

    folder_number: int | None = None
    twin: str | None = None
    newer: Release | None = None
    before: Release | None = None
    seen: int | None = None


@dataclass(frozen=True, slots=True)
class ReleaseProblem:
    """A reason why a release is not valid."""

    code: Code
    text: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of the verification of a release.

    Attributes:
        release: the release, None if it is not authentic.
        problems: reasons why it is not valid; empty for a valid one.
    """

    release: Release | None
    problems: tuple[ReleaseProblem, ...] = field(default=())

    @property
    def holds(self) -> bool:
        """Whether the release is valid."""
        return self.release is not None and not self.problems

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON-able values."""
        found: dict[str, Any] = {
            "schema": 1,
            "holds": self.holds,
            "problems": [{"code": p.code, "text": p.text} for p in self.problems],
            "release": None,
        }
        if self.release is not None:
            header = self.release.header
            found["release"] = {
                "twin": header.twin,
                "series": header.series,
                "number": header.number,
                "created": header.created,
                "expires": header.expires,
                "key": header.key_id,
                "sha256": self.release.sha256,
                "files": len(self.release.files),
                "goldens": len(self.release.goldens),
            }
        return found


NOTHING_SIGNED = Verdict(
    None,
    (ReleaseProblem("envelope", f"no {ENVELOPE}: its write was interrupted or it is no release"),),
)


def authenticate(data: bytes, keys: Sequence[Key]) -> Release:
    """Verify the signature of an envelope, and read its release.

    Raises:
        ReleaseError: it is not authentic, or not a release.
    """
    opened = open_envelope(data, keys)
    return statement.read(opened.payload, opened.key_ids[0], opened.sha256)


def verify(
    data: bytes | None,
    listing: Mapping[str, FolderEntry],
    keys: Sequence[Key],
    *,
    now: datetime,
    circumstances: Circumstances = Circumstances(),
) -> Verdict:
    """Verify a release.

    Args:
        data: content of the envelope, None if it does not exist.
        listing: all entries of the folder, relative POSIX path -> entry.
        now: present time, with time zone.
    """
    if data is None:
        return NOTHING_SIGNED
    try:
        release = authenticate(data, keys)
    except ReleaseError as error:
        return Verdict(None, (ReleaseProblem("envelope" if keys else "keys", str(error)),))
    return judge(release, listing, now=now, circumstances=circumstances)


def judge(
    release: Release,
    listing: Mapping[str, FolderEntry],
    *,
    now: datetime,
    circumstances: Circumstances = Circumstances(),
) -> Verdict:
    """Verify the files, the place and the age of an authentic release.

    The arguments are those of :func:`verify`.
    """
    problems = [
        *_files(release, listing),
        *_place(release, circumstances),
        *_time(release, now),
    ]
    if len(problems) > LIMITS.problems_count:
        left_out = len(problems) - LIMITS.problems_count
        problems = problems[: LIMITS.problems_count]
        problems.append(ReleaseProblem("files", f"and {left_out} more"))
    return Verdict(release, tuple(problems))


def _files(release: Release, listing: Mapping[str, FolderEntry]) -> Iterator[ReleaseProblem]:
    stated = {entry.name: entry for entry in release.files}
    yield from _misplaced_files(stated)
    yield from _unlisted_entries(stated, listing)
    steps = _steps_of_asset(release)
    for name, entry in stated.items():
        step = steps.get((entry.original or name).removeprefix(f"{FILES}/"))
        of = "" if step is None else f" ({step})"
        for problem in _changed_file(name, entry, listing.get(name)):
            yield ReleaseProblem(problem.code, f"{problem.text}{of}")


def _steps_of_asset(release: Release) -> dict[str, str]:
    """Path in the twin's folder -> step from the supplier's files to the model that it belongs to.

    The chain is that of the signed statement; of one with another layout no step is named.
    """
    steps: dict[str, str] = {}
    try:
        for manifest, content in release.ids.get("chain", {}).items():
            at = PurePosixPath(manifest).parent
            of_asset = f"of the asset {content['asset']!r}"
            steps[manifest] = f"manifest {of_asset}"
            for state, facts in content["states"].items():
                link = facts["made"].get("from", {"state": "source", "files": {}})
                steps |= {str(at / file): f"{link['state']} {of_asset}" for file in link["files"]}
                steps |= {str(at / file): f"{state} {of_asset}" for file in facts.get("files", ())}
    except (AttributeError, KeyError, TypeError):
        return {}
    return steps


def _misplaced_files(stated: Mapping[str, FileEntry]) -> Iterator[ReleaseProblem]:
    for name in (RESULTS, REPORT):
        if name not in stated:
            yield ReleaseProblem("files", f"{name}: a release without it")
    for name in stated:
        if name not in (RESULTS, REPORT) and not name.startswith(f"{FILES}/"):
            yield ReleaseProblem("files", f"{name}: not a place for a file of a release")


def _unlisted_entries(
    stated: Mapping[str, FileEntry], listing: Mapping[str, FolderEntry]
) -> Iterator[ReleaseProblem]:
    folders = set(_folders(stated))
    for name, found in sorted(listing.items()):
        if found.kind == "link":
            yield ReleaseProblem("files", f"{name}: a link instead of a file")
        elif found.kind == "other":
            yield ReleaseProblem("files", f"{name}: neither a file nor a folder")
        elif found.kind == "folder":
            if name not in folders:
                yield ReleaseProblem("files", f"{name}/: a folder that the statement does not list")
        elif name != ENVELOPE and name not in stated:
            yield ReleaseProblem("files", f"{name}: a file that the statement does not list")
        elif found.links > 1:
            yield ReleaseProblem("files", f"{name}: linked from {found.links} places")


def _changed_file(
    name: str, entry: FileEntry, here: FolderEntry | None
) -> Iterator[ReleaseProblem]:
    if here is None:
        yield ReleaseProblem("files", f"{name}: missing")
    elif here.kind == "file" and here.sha256_with_lf == entry.sha256:
        yield ReleaseProblem(
            "files",
            f"{name}: has CR LF line endings where LF was signed; nothing else differs: "
            f"{LINE_ENDINGS_ADVICE}",
        )
    elif here.kind == "file" and here.size != entry.size:
        yield ReleaseProblem(
            "files", f"{name}: changed, {here.size} bytes where {entry.size} were signed"
        )
    elif here.kind == "file" and here.sha256 != entry.sha256:
        yield ReleaseProblem(
            "files",
            f"{name}: changed, SHA-256 {here.sha256[:16]}... where "
            f"{entry.sha256[:16]}... was signed",
        )


def _folders(names: Iterable[str]) -> Iterator[str]:
    for name in names:
        parts = name.split("/")
        for end in range(1, len(parts)):
            yield "/".join(parts[:end])


def _place(release: Release, known: Circumstances) -> Iterator[ReleaseProblem]:
    header = release.header
    if known.folder_number is not None and known.folder_number != header.number:
        yield ReleaseProblem(
            "folder", f"release {header.number} is in the folder of release {known.folder_number}"
        )
    if known.twin is not None and known.twin != header.twin:
        yield ReleaseProblem(
            "twin", f"a release of the twin {header.twin!r}, not of {known.twin!r}"
        )
    if known.newer is not None and known.newer.number > header.number:
        yield ReleaseProblem("rollback", f"older than release {known.newer.number} beside it")
    elif known.seen is not None and known.seen > header.number:
        yield ReleaseProblem(
            "rollback", f"older than release {known.seen}, which was accepted here"
        )
    before = known.before
    if before is not None:
        stated = header.previous
        if stated is None or stated.number < before.number:
            yield ReleaseProblem("order", f"does not follow release {before.number} before it")
        elif stated.number == before.number and stated.sha256 != before.sha256:
            yield ReleaseProblem(
                "order", f"follows a release {before.number} other than the one before it"
            )


def _time(release: Release, now: datetime) -> Iterator[ReleaseProblem]:
    header = release.header
    if now >= statement.moment(header.expires):
        yield ReleaseProblem("expired", f"expired at {header.expires}")
    skew = timedelta(seconds=LIMITS.clock_skew_seconds)
    if statement.moment(header.created) > now + skew:
        yield ReleaseProblem("future", f"made at {header.created}, which is in the future")
