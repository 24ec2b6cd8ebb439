"""Whether a release holds. Bytes and facts in, a verdict out; no files, no clock of its own."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any, Literal

from securesystemslib.signer import Key

from pytest_twin.errors import ReleaseError
from pytest_twin.formats.digest import LINE_ENDINGS_ADVICE
from pytest_twin.release import statement
from pytest_twin.release.envelope import open_envelope
from pytest_twin.release.limits import LIMITS, ReleaseLimits
from pytest_twin.release.statement import FileEntry, Release

ENVELOPE = "release.dsse.json"
RESULTS = "results.json"
REPORT = "report.html"
FILES = "files"

Code = Literal[
    "envelope", "files", "folder", "twin", "order", "rollback", "expired", "future", "keys", "stamp"
]


@dataclass(frozen=True, slots=True)
class Found:
    """One entry of a release's folder as it lies there.

    Attributes:
        kind: ``file``, ``folder``, ``link``, or ``other`` (pipe, socket, device).
        sha256: hex, of a file that was read, else empty.
        size: bytes, of a file.
        links: number of names that the file has on the disk.
        sha256_with_lf: hex, of a small file with CR LF in it, as if each were LF; else empty.
    """

    kind: Literal["file", "folder", "link", "other"]
    sha256: str = ""
    size: int = 0
    links: int = 1
    sha256_with_lf: str = ""


@dataclass(frozen=True, slots=True)
class Circumstances:
    """What is known beside the release itself; None where nothing is.

    Attributes:
        folder_number: the number that the folder's name states.
        twin: the name that the twin around it states.
        newer: an authentic release with a higher number that lies beside.
        before: the authentic release with the highest lower number that lies beside.
        seen: the highest number of this series that was accepted here before.
    """

    folder_number: int | None = None
    twin: str | None = None
    newer: Release | None = None
    before: Release | None = None
    seen: int | None = None


@dataclass(frozen=True, slots=True)
class Problem:
    """One reason why a release does not hold."""

    code: Code
    text: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a release holds.

    Attributes:
        release: what it states, None where that is not authentic.
        problems: empty where it holds.
    """

    release: Release | None
    problems: tuple[Problem, ...] = field(default=())

    @property
    def holds(self) -> bool:
        """Whether nothing speaks against it."""
        return self.release is not None and not self.problems

    def to_json(self) -> dict[str, Any]:
        """JSON-able fields."""
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
    None, (Problem("envelope", f"no {ENVELOPE}: its write was interrupted or it is no release"),)
)


def authenticate(data: bytes, keys: Sequence[Key], limits: ReleaseLimits = LIMITS) -> Release:
    """The release that an envelope states, once a trusted key vouches for every byte of it.

    Raises:
        ReleaseError: it is not authentic, or no release.
    """
    opened = open_envelope(data, keys, limits)
    return statement.read(opened.payload, opened.key_ids[0], opened.sha256, limits)


def verify(
    data: bytes | None,
    listing: Mapping[str, Found],
    keys: Sequence[Key],
    *,
    now: datetime,
    circumstances: Circumstances = Circumstances(),
    limits: ReleaseLimits = LIMITS,
) -> Verdict:
    """Whether a release holds.

    Args:
        data: the envelope's bytes, None where there is none.
        listing: everything in the folder, relative POSIX path -> what lies there.
        keys: the trusted public keys.
        now: with time zone.
        circumstances: what is known beside the release.
        limits: bounds.
    """
    if data is None:
        return NOTHING_SIGNED
    try:
        release = authenticate(data, keys, limits)
    except ReleaseError as error:
        return Verdict(None, (Problem("envelope" if keys else "keys", str(error)),))
    return judge(release, listing, now=now, circumstances=circumstances, limits=limits)


def judge(
    release: Release,
    listing: Mapping[str, Found],
    *,
    now: datetime,
    circumstances: Circumstances = Circumstances(),
    limits: ReleaseLimits = LIMITS,
) -> Verdict:
    """Whether an authentic statement is true of what lies there, current, and in its place.

    Arguments as for :func:`verify`.
    """
    problems = [
        *_files(release, listing),
        *_place(release, circumstances),
        *_time(release, now, limits),
    ]
    if len(problems) > limits.problems_count:
        left_out = len(problems) - limits.problems_count
        problems = problems[: limits.problems_count]
        problems.append(Problem("files", f"and {left_out} more"))
    return Verdict(release, tuple(problems))


def _files(release: Release, listing: Mapping[str, Found]) -> Iterator[Problem]:
    stated = {entry.name: entry for entry in release.files}
    yield from _misplaced(stated)
    yield from _not_listed(stated, listing)
    for name, entry in stated.items():
        yield from _changed(name, entry, listing.get(name))


def _misplaced(stated: Mapping[str, FileEntry]) -> Iterator[Problem]:
    for name in (RESULTS, REPORT):
        if name not in stated:
            yield Problem("files", f"{name}: a release without it")
    for name in stated:
        if name not in (RESULTS, REPORT) and not name.startswith(f"{FILES}/"):
            yield Problem("files", f"{name}: not a place for a file of a release")


def _not_listed(stated: Mapping[str, FileEntry], listing: Mapping[str, Found]) -> Iterator[Problem]:
    folders = set(_folders(stated))
    for name, found in sorted(listing.items()):
        if found.kind == "link":
            yield Problem("files", f"{name}: a link instead of a file")
        elif found.kind == "other":
            yield Problem("files", f"{name}: neither a file nor a folder")
        elif found.kind == "folder":
            if name not in folders:
                yield Problem("files", f"{name}/: a folder that the statement does not list")
        elif name != ENVELOPE and name not in stated:
            yield Problem("files", f"{name}: a file that the statement does not list")
        elif found.links > 1:
            yield Problem("files", f"{name}: linked from {found.links} places")


def _changed(name: str, entry: FileEntry, here: Found | None) -> Iterator[Problem]:
    if here is None:
        yield Problem("files", f"{name}: missing")
    elif here.kind == "file" and here.sha256_with_lf == entry.sha256:
        yield Problem(
            "files",
            f"{name}: has CR LF line endings where LF was signed; nothing else differs: "
            f"{LINE_ENDINGS_ADVICE}",
        )
    elif here.kind == "file" and here.size != entry.size:
        yield Problem("files", f"{name}: changed, {here.size} bytes where {entry.size} were signed")
    elif here.kind == "file" and here.sha256 != entry.sha256:
        yield Problem(
            "files",
            f"{name}: changed, SHA-256 {here.sha256[:16]}... where "
            f"{entry.sha256[:16]}... was signed",
        )


def _folders(names: Iterable[str]) -> Iterator[str]:
    for name in names:
        parts = name.split("/")
        for end in range(1, len(parts)):
            yield "/".join(parts[:end])


def _place(release: Release, known: Circumstances) -> Iterator[Problem]:
    header = release.header
    if known.folder_number is not None and known.folder_number != header.number:
        yield Problem(
            "folder", f"release {header.number} is in the folder of release {known.folder_number}"
        )
    if known.twin is not None and known.twin != header.twin:
        yield Problem("twin", f"a release of the twin {header.twin!r}, not of {known.twin!r}")
    if known.newer is not None and known.newer.number > header.number:
        yield Problem("rollback", f"older than release {known.newer.number} beside it")
    elif known.seen is not None and known.seen > header.number:
        yield Problem("rollback", f"older than release {known.seen}, which was accepted here")
    before = known.before
    if before is not None:
        stated = header.previous
        if stated is None or stated.number < before.number:
            yield Problem("order", f"does not follow release {before.number} before it")
        elif stated.number == before.number and stated.sha256 != before.sha256:
            yield Problem(
                "order", f"follows a release {before.number} other than the one before it"
            )


def _time(release: Release, now: datetime, limits: ReleaseLimits) -> Iterator[Problem]:
    header = release.header
    if now >= statement.moment(header.expires):
        yield Problem("expired", f"expired at {header.expires}")
    skew = timedelta(seconds=limits.clock_skew_seconds)
    if statement.moment(header.created) > now + skew:
        yield Problem("future", f"made at {header.created}, which is in the future")
