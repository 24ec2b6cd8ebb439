"""Write and read the statement of a release: an in-toto statement with our own predicate."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pytest_twin.dependency import Part, canonical
from pytest_twin.errors import ReleaseError
from pytest_twin.outcome import Outcome
from pytest_twin.release import canonical_json, file_names
from pytest_twin.release.limits import LIMITS, ReleaseLimits

STATEMENT_TYPE = "https://in-toto.io/Statement/v1"
PREDICATE_TYPE = "urn:pytest-twin:release:1"

_SHA256 = re.compile(r"[0-9a-f]{64}")
_SERIES = re.compile(r"[0-9a-f]{32}")
_TIME = "%Y-%m-%dT%H:%M:%SZ"
_PREDICATE_FIELDS = {
    "twin",
    "series",
    "number",
    "previous",
    "created",
    "expires",
    "ids",
    "parts",
    "goldens",
    "environment",
    "external",
}


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


def read(payload: bytes, key_id: str, sha256: str, limits: ReleaseLimits = LIMITS) -> Release:
    """Read the release in a signed payload.

    Args:
        payload: bytes of the statement, with a verified signature.
        key_id: id of the signing key.
        sha256: digest of the envelope, hex.
        limits: limits of sizes and counts.

    Raises:
        ReleaseError: not canonical JSON, not a statement of this type, or an inconsistent one.
    """
    statement = canonical_json.load(payload, "the statement", limits)
    try:
        return _read(statement, key_id, sha256, limits)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ReleaseError(f"the statement is not a release: {error!r}") from None


def _read(statement: Any, key_id: str, sha256: str, limits: ReleaseLimits) -> Release:
    _require_fields(statement, {"_type", "subject", "predicateType", "predicate"}, "statement")
    _require_equal(statement["_type"], STATEMENT_TYPE, "_type")
    _require_equal(statement["predicateType"], PREDICATE_TYPE, "predicateType")
    predicate = statement["predicate"]
    _require_fields(predicate, _PREDICATE_FIELDS, "predicate")
    header = _read_header(predicate, key_id)
    files = tuple(_read_descriptor(entry) for entry in statement["subject"])
    _check_files(files, limits)
    parts = {}
    for ident, fields in predicate["parts"].items():
        _require_fields(fields, {"digest", "content"}, f"parts.{ident}")
        parts[ident] = Part(ident, fields["content"])
        _require_equal(fields["digest"], parts[ident].digest, f"parts.{ident}.digest")
    goldens = {}
    for fields in predicate["goldens"]:
        proof = _read_proof(fields)
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
    if not isinstance(predicate["ids"], dict):
        raise TypeError("ids is not a table")
    return Release(
        header=header,
        ids=predicate["ids"],
        parts=parts,
        goldens=goldens,
        environment={str(k): str(v) for k, v in predicate["environment"].items()},
        files=files,
        external=tuple(_read_descriptor(entry) for entry in predicate["external"]),
        sha256=sha256,
    )


def _read_header(predicate: Mapping[str, Any], key_id: str) -> Header:
    number, previous = predicate["number"], predicate["previous"]
    if type(number) is not int or number < 1:
        raise ReleaseError("not a release number", value=number, expected="1 or more")
    if not isinstance(predicate["twin"], str) or not _SERIES.fullmatch(predicate["series"]):
        raise ReleaseError(
            "the statement names no twin or no series of releases",
            where="predicate",
            expected="twin, a text, and series, 32 hex digits",
        )
    if previous is not None:
        _require_fields(previous, {"number", "sha256"}, "previous")
        if type(previous["number"]) is not int or not 1 <= previous["number"] < number:
            raise ReleaseError(
                "not a release before this one",
                where="previous.number",
                value=previous["number"],
                expected=f"1 to {number - 1}",
            )
        previous = Previous(previous["number"], _require_sha256(previous["sha256"]))
    if moment(predicate["expires"]) <= moment(predicate["created"]):
        raise ReleaseError(
            "expires before its creation",
            where="expires",
            value=predicate["expires"],
            expected=f"later than {predicate['created']}",
        )
    return Header(
        twin=predicate["twin"],
        series=predicate["series"],
        number=number,
        previous=previous,
        created=predicate["created"],
        expires=predicate["expires"],
        key_id=key_id,
    )


def _read_proof(fields: Mapping[str, Any]) -> Proof:
    _require_fields(fields, {"outcome", "title", "parts", "release", "at"}, "goldens")
    outcome = dict(fields["outcome"]) | {"plot": None}
    measures = [dict(measure) for measure in outcome["measures"]]
    for measure in measures:
        del measure["margin"]
    moment(fields["at"])
    return Proof(
        outcome=Outcome.from_json(outcome | {"measures": measures}),
        title=str(fields["title"]),
        parts=tuple(str(ident) for ident in fields["parts"]),
        release=int(fields["release"]),
        at=fields["at"],
    )


def _check_files(files: Sequence[FileEntry], limits: ReleaseLimits) -> None:
    if len(files) > limits.files_count:
        raise ReleaseError(
            "too many files", value=len(files), expected=f"at most {limits.files_count}"
        )
    for entry in files:
        problem = file_names.problem_with(entry.name, limits)
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
    """The in-toto ResourceDescriptor of a file."""
    annotations: dict[str, Any] = {"size": entry.size}
    if entry.original is not None:
        annotations["original"] = entry.original
    return {
        "name": entry.name,
        "digest": {"sha256": entry.sha256},
        "annotations": annotations,
    }


def _read_descriptor(fields: Any) -> FileEntry:
    _require_fields(fields, {"name", "digest", "annotations"}, "file")
    _require_fields(fields["digest"], {"sha256"}, "file.digest")
    annotations = dict(fields["annotations"])
    original = annotations.pop("original", None)
    _require_fields(annotations, {"size"}, "file.annotations")
    size = annotations["size"]
    if not isinstance(fields["name"], str) or type(size) is not int or size < 0:
        raise TypeError("a file without name or size")
    if original is not None and not isinstance(original, str):
        raise TypeError("an original path that is no text")
    return FileEntry(fields["name"], _require_sha256(fields["digest"]["sha256"]), size, original)


def _require_fields(table: Any, expected: set[str], where: str) -> None:
    if not isinstance(table, dict) or set(table) != expected:
        found = sorted(table) if isinstance(table, dict) else type(table).__name__
        raise ReleaseError(
            "not the fields of a release",
            where=where,
            value=found,
            expected=", ".join(sorted(expected)),
        )


def _require_equal(value: object, expected: str, where: str) -> None:
    if value != expected:
        raise ReleaseError("not what a release states", where=where, value=value, expected=expected)


def _require_sha256(value: object) -> str:
    if not isinstance(value, str) or not _SHA256.fullmatch(value):
        raise ReleaseError("not a SHA-256", value=value, expected="64 hex digits")
    return value
