"""Write and read the statement of a release: an in-toto statement with our own predicate."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct

from pytest_twin.dependency import Part, canonical
from pytest_twin.errors import ReleaseError
from pytest_twin.formats import typed
from pytest_twin.outcome import Outcome
from pytest_twin.release import canonical_json, file_names
from pytest_twin.release.limits import LIMITS

STATEMENT_TYPE = "https://in-toto.io/Statement/v1"
PREDICATE_TYPE = "urn:pytest-twin:release:1"

_TIME = "%Y-%m-%dT%H:%M:%SZ"
_Sha256 = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]


@dataclass(frozen=True, slots=True)
class FileEntry:
    """A file that a release depends on.

    Attributes:
        name: POSIX path relative to the release's folder, or, for an external file, relative to
            the twin's folder.
        sha256: digest, hex.
        size: bytes.
        original: path in the twin's folder if it is not a portable file name; None if it equals
            ``name``.
    """

    name: str
    sha256: str
    size: int
    original: str | None = None


@dataclass(frozen=True, slots=True)
class Proof:
    """Result of one golden on one realization in a release.

    Attributes:
        outcome: the result, with all measures and margins.
        parts: ids of the parts that the result depends on.
        release: number of the release for which it ran; 0 in a draft.
        at: creation time of that release, RFC 3339, UTC; empty in a draft.
    """

    outcome: Outcome
    title: str
    parts: tuple[str, ...]
    release: int = 0
    at: str = ""


@dataclass(frozen=True, slots=True)
class Previous:
    """Number of the previous release, and SHA-256 of its envelope, hex."""

    number: int
    sha256: str


@dataclass(frozen=True, slots=True)
class Header:
    """Fields of a release that are known before its files.

    Attributes:
        series: 128 random bits, hex, which all releases of a twin share.
        number: counted from 1.
        previous: the previous release, None for the first.
        created, expires: RFC 3339, UTC.
        key_id: id of the signing key.
    """

    twin: str
    series: str
    number: int
    previous: Previous | None
    created: str
    expires: str
    key_id: str


@dataclass(frozen=True, slots=True)
class Draft:
    """Content of a release that is to be written.

    Attributes:
        valid_days: validity of the release, days.
        ids: IDs of asset, realizations, calibration, fit, controllers, payloads, firmware and
            other declared parts.
        parts: part id -> part, also of those that no golden depends on.
        proofs: results of all goldens on all realizations.
        environment: software environment of the run.
        files: file -> SHA-256 before the run. Files in the twin's folder are copied, others are
            listed.
    """

    twin: str
    valid_days: float
    ids: Mapping[str, Any]
    parts: Mapping[str, Part]
    proofs: tuple[Proof, ...]
    environment: Mapping[str, str]
    files: Mapping[Path, str]


@dataclass(frozen=True, slots=True)
class Release:
    """A signed release.

    Attributes:
        header: twin, series, number, previous release, creation, expiry and key.
        ids, environment: as in :class:`Draft`.
        parts: part id -> part with its content.
        goldens: ``golden@realization`` -> result.
        files: files in the release's folder, without the envelope.
        external: files outside the twin's folder.
        sha256: digest of the envelope, hex.
    """

    header: Header
    ids: Mapping[str, Any]
    parts: Mapping[str, Part] = field(repr=False)
    goldens: Mapping[str, Proof] = field(repr=False)
    environment: Mapping[str, str] = field(repr=False)
    files: tuple[FileEntry, ...] = field(repr=False)
    external: tuple[FileEntry, ...] = field(repr=False)
    sha256: str

    @property
    def twin(self) -> str:
        """Name of the twin."""
        return self.header.twin

    @property
    def number(self) -> int:
        """Number of the release, counted from 1."""
        return self.header.number


def timestamp(moment: datetime) -> str:
    """Time as RFC 3339 text in UTC, whole seconds."""
    return moment.astimezone(UTC).strftime(_TIME)


def moment(text: str) -> datetime:
    """Parse a time as :func:`timestamp` writes it.

    Raises:
        ReleaseError: another form.
    """
    try:
        parsed = datetime.strptime(text, _TIME).replace(tzinfo=UTC)
    except (ValueError, TypeError):
        parsed = None
    if parsed is None or timestamp(parsed) != text:
        raise ReleaseError("not a time", value=text, expected="RFC 3339 in UTC, whole seconds")
    return parsed


def proof_to_json(proof: Proof) -> dict[str, Any]:
    """JSON-able fields of a result, with the margins of all measures."""
    outcome = replace(proof.outcome, plot=None).to_json()
    for fields, measure in zip(outcome["measures"], proof.outcome.measures, strict=True):
        margin = measure.margin
        fields["margin"] = margin if abs(margin) < float("inf") else str(margin)
    del outcome["plot"]
    return {
        "outcome": outcome,
        "title": proof.title,
        "parts": sorted(proof.parts),
        "release": proof.release,
        "at": proof.at,
    }


def write(
    header: Header, draft: Draft, files: Sequence[FileEntry], external: Sequence[FileEntry]
) -> bytes:
    """Write the statement as canonical JSON.

    Raises:
        ReleaseError: two results of one golden, or a result that depends on a missing part.
    """
    goldens: dict[str, dict[str, Any]] = {}
    for proof in draft.proofs:
        key = proof.outcome.key
        if key in goldens:
            raise ReleaseError("the release states this golden twice", where=key, expected="once")
        missing = sorted(set(proof.parts) - set(draft.parts))
        if missing:
            raise ReleaseError(
                "depends on a part that the release does not contain",
                where=key,
                value=missing[0],
                expected="one of its parts",
            )
        goldens[key] = proof_to_json(
            proof if proof.release else replace(proof, release=header.number, at=header.created)
        )
    previous = header.previous
    return canonical_json.dump(
        {
            "_type": STATEMENT_TYPE,
            "subject": [_descriptor(entry) for entry in sorted(files, key=_name)],
            "predicateType": PREDICATE_TYPE,
            "predicate": {
                "twin": header.twin,
                "series": header.series,
                "number": header.number,
                "previous": previous and {"number": previous.number, "sha256": previous.sha256},
                "created": header.created,
                "expires": header.expires,
                "ids": draft.ids,
                "parts": {
                    ident: {"digest": part.digest, "content": json.loads(canonical(part.content))}
                    for ident, part in draft.parts.items()
                },
                "goldens": [goldens[key] for key in sorted(goldens)],
                "environment": dict(draft.environment),
                "external": [_descriptor(entry) for entry in sorted(external, key=_name)],
            },
        }
    )


def read(payload: bytes, key_id: str, sha256: str) -> Release:
    """Read the release in a signed payload.

    Args:
        payload: bytes of the statement, with a verified signature.
        key_id: id of the signing key.
        sha256: digest of the envelope, hex.

    Raises:
        ReleaseError: not canonical JSON, not a statement of this type, or an inconsistent one.
    """
    statement = canonical_json.load(payload, "the statement")
    try:
        return _release(typed.build(statement, _Statement), key_id, sha256)
    except typed.FieldError as error:
        raise ReleaseError(
            "not what a release states",
            where=error.where or "statement",
            value=error.value,
            expected=error.expected,
        ) from None


class _Table(Struct, forbid_unknown_fields=True):
    """A table of the statement, with no other fields than those below."""


class _Digest(_Table):
    sha256: _Sha256


class _Annotations(_Table):
    size: Annotated[int, Meta(ge=0)]
    original: str | None = None


class _Descriptor(_Table):
    """The in-toto ResourceDescriptor of a file."""

    name: str
    digest: _Digest
    annotations: _Annotations

    def entry(self) -> FileEntry:
        annotations = self.annotations
        return FileEntry(self.name, self.digest.sha256, annotations.size, annotations.original)


class _Part(_Table):
    digest: str
    content: dict[str, Any]


class _Proof(_Table):
    outcome: dict[str, Any]
    title: str
    parts: tuple[str, ...]
    release: int
    at: str

    def proof(self) -> Proof:
        moment(self.at)
        outcome = Outcome.from_json({**self.outcome, "plot": None})
        return Proof(outcome, self.title, self.parts, self.release, self.at)


class _Previous(_Table):
    number: Annotated[int, Meta(ge=1)]
    sha256: _Sha256


class _Predicate(_Table):
    twin: str
    series: Annotated[str, Meta(pattern=r"^[0-9a-f]{32}\Z")]
    number: Annotated[int, Meta(ge=1)]
    previous: _Previous | None
    created: str
    expires: str
    ids: dict[str, Any]
    parts: dict[str, _Part]
    goldens: list[_Proof]
    environment: dict[str, str]
    external: list[_Descriptor]


class _Statement(_Table, rename={"kind": "_type", "predicate_type": "predicateType"}):
    kind: str
    subject: list[_Descriptor]
    predicate_type: str
    predicate: _Predicate


def _release(stated: _Statement, key_id: str, sha256: str) -> Release:
    _require_equal(stated.kind, STATEMENT_TYPE, "_type")
    _require_equal(stated.predicate_type, PREDICATE_TYPE, "predicateType")
    predicate = stated.predicate
    header = _header(predicate, key_id)
    files = tuple(entry.entry() for entry in stated.subject)
    _check_files(files)
    parts = {ident: Part(ident, part.content) for ident, part in predicate.parts.items()}
    for ident, part in predicate.parts.items():
        _require_equal(part.digest, parts[ident].digest, f"parts.{ident}.digest")
    goldens: dict[str, Proof] = {}
    for at, golden in enumerate(predicate.goldens):
        try:
            proof = golden.proof()
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ReleaseError(
                f"the statement is not a release: {error!r}", where=f"predicate.goldens.{at}"
            ) from None
        if proof.outcome.key in goldens:
            raise ReleaseError(
                "the release states this golden twice", where=proof.outcome.key, expected="once"
            )
        if not set(proof.parts) <= set(parts) or not 1 <= proof.release <= header.number:
            raise ReleaseError(
                "depends on a part that the release does not contain",
                where=proof.outcome.key,
                expected="its own parts, and a release up to this one",
            )
        goldens[proof.outcome.key] = proof
    return Release(
        header=header,
        ids=predicate.ids,
        parts=parts,
        goldens=goldens,
        environment=predicate.environment,
        files=files,
        external=tuple(entry.entry() for entry in predicate.external),
        sha256=sha256,
    )


def _header(predicate: _Predicate, key_id: str) -> Header:
    number, previous = predicate.number, predicate.previous
    if previous is not None and previous.number >= number:
        raise ReleaseError(
            "not a release before this one",
            where="previous.number",
            value=previous.number,
            expected=f"1 to {number - 1}",
        )
    if moment(predicate.expires) <= moment(predicate.created):
        raise ReleaseError(
            "expires before its creation",
            where="expires",
            value=predicate.expires,
            expected=f"later than {predicate.created}",
        )
    return Header(
        twin=predicate.twin,
        series=predicate.series,
        number=number,
        previous=None if previous is None else Previous(previous.number, previous.sha256),
        created=predicate.created,
        expires=predicate.expires,
        key_id=key_id,
    )


def _check_files(files: Sequence[FileEntry]) -> None:
    if len(files) > LIMITS.files_count:
        raise ReleaseError(
            "too many files", value=len(files), expected=f"at most {LIMITS.files_count}"
        )
    for entry in files:
        problem = file_names.problem_with(entry.name)
        if problem:
            raise ReleaseError(
                f"the name of a file {problem}",
                where="subject",
                value=entry.name,
                expected="a relative path with names that every system can hold",
            )
    for one, other in file_names.colliding_names(entry.name for entry in files):
        raise ReleaseError(
            f"two files have the same name on other systems: {one!r} and {other!r}",
            where="subject",
            expected="names that differ in more than upper and lower case",
        )


def _name(entry: FileEntry) -> str:
    return entry.name


def _descriptor(entry: FileEntry) -> dict[str, Any]:
    original = {} if entry.original is None else {"original": entry.original}
    return {
        "name": entry.name,
        "digest": {"sha256": entry.sha256},
        "annotations": {"size": entry.size, **original},
    }


def _require_equal(value: object, expected: str, where: str) -> None:
    if value != expected:
        raise ReleaseError("not what a release states", where=where, value=value, expected=expected)
