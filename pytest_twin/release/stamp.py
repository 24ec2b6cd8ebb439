"""Stamp of a data set or policy: the release of the twin that it was made with.

A stamp contains the IDs with digests, and the signed envelope of the release. The signature of the
release therefore covers the IDs. It cannot cover the digest of the data, which detects mistakes but
not a change by someone who can write the data. This module reads no files.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, TypeGuard

from securesystemslib.signer import Key

from pytest_twin.errors import ReleaseError
from pytest_twin.release import canonical_json
from pytest_twin.release.statement import Release, moment, timestamp
from pytest_twin.release.verify import authenticate

SCHEMA = 1
"""Version of the stamp's layout."""
VARIANTS = ("controller", "payload")
"""Members of the twin of which data use one, if any."""
PARTS = ("asset", "calibration", "fit", "controller", "validation")
"""Members of the twin in a stamp, each with ``id`` and ``digest``."""
_TUPLE = ("twin", "series", "release", *PARTS, "payload", "declared")
_FIELDS = {"schema", *_TUPLE, "data", "stamped", "envelope"}
NO_MAPPING: Mapping[str, str] = {}
"""For data with the joint names of the release."""


@dataclass(frozen=True, slots=True)
class Stamp:
    """Content of a stamp.

    Attributes:
        ids: ``twin``, ``series``, ``release`` (its number), all of :data:`PARTS`, ``payload`` and
            ``declared`` (such as firmware).
        data: SHA-256 of the content at the time of the stamp, hex.
        stamped: time of the stamp, RFC 3339, UTC.
        envelope: signed envelope of the release.
        joints: mapping from joint names of the data to the release's, in the form of ``joints:`` in
            ``twin.yaml``; None if the data are stated to name no joints.
    """

    ids: Mapping[str, Any]
    data: str
    stamped: str
    envelope: bytes
    joints: Mapping[str, str] | None = field(default_factory=lambda: NO_MAPPING)

    @property
    def name(self) -> str:
        """Number and twin of the release as text: ``release 7 of 'arm'``."""
        return f"release {self.ids['release']} of {self.ids['twin']!r}"

    def to_text(self) -> str:
        """Text of the stamp as written into a file, ASCII."""
        fields = {
            "schema": SCHEMA,
            **self.ids,
            "data": {"sha256": self.data},
            "stamped": self.stamped,
            "envelope": json.loads(self.envelope),
            **({} if self.joints == {} else {"joints": self.joints}),
        }
        return json.dumps(fields, indent=1) + "\n"


def make(
    release: Release,
    envelope: bytes,
    data: str,
    now: datetime,
    variants: Mapping[str, str | None] | None = None,
    joints: Mapping[str, str] | None = NO_MAPPING,
) -> Stamp:
    """Create the stamp of a release for data with the SHA-256 ``data``.

    Args:
        data: SHA-256 of the content, hex.
        variants: ``payload`` and ``controller`` of the data; left out if they are not known.
        joints: as in :class:`Stamp`.

    Raises:
        ReleaseError: the release states no digests, or lacks the payload or controller.
    """
    ids = stated_ids(release)
    for part, name in (variants or {}).items():
        known = variants_of(release, part)
        if name is not None and name not in known:
            raise ReleaseError(
                f"release {release.number} has no {part} of this name",
                where=part,
                value=name,
                expected=f"one of {', '.join(known)}"
                if known
                else f"a release whose twin.yaml declares it under {part}s:",
            )
        ids[part] = {**ids[part], "id": name}
    return Stamp(ids, data, timestamp(now), envelope, joints)


def variants_of(release: Release, part: str) -> list[str]:
    """Names of the payloads or controllers that a release declares."""
    declared = release.ids.get(f"{part}s")
    return sorted(map(str, declared)) if isinstance(declared, list) else []


def stated_ids(release: Release) -> dict[str, Any]:
    """IDs with digests that a signed release states.

    The payload and the controller of the data are not among them: the release declares several.

    Raises:
        ReleaseError: a release of an earlier version, which states no digests.
    """
    ids, header = release.ids, release.header
    digests = ids.get("digests")
    if not isinstance(digests, dict) or not {*PARTS, "payload"} <= digests.keys():
        raise ReleaseError(
            f"release {header.number} states no digests of its parts",
            where="ids.digests",
            expected="a release of this version: run pytest --twin-release --twin-all",
        )
    named = {
        "asset": _join_names(ids.get("asset") or ids.get("realizations")),
        "calibration": ids.get("calibration"),
        "fit": ids.get("fit"),
        "controller": None,
        "payload": None,
        "validation": f"release {header.number}",
    }
    return {
        "twin": header.twin,
        "series": header.series,
        "release": header.number,
        **{part: {"id": named[part], "digest": digests[part]} for part in named},
        "declared": ids.get("parts") or {},
    }


def _join_names(names: Any) -> str | None:
    return ", ".join(sorted(map(str, names))) or None if names else None


def parse(text: str) -> Stamp:
    """Parse the text of a stamp.

    Raises:
        ReleaseError: not a stamp.
    """
    wrong = ReleaseError(
        "not a stamp of pytest-twin",
        where="stamp",
        expected="the text that pytest-twin stamp wrote",
    )
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError):
        raise wrong from None
    if not isinstance(fields, dict) or fields.keys() - {"joints"} != _FIELDS:
        raise wrong
    data = fields["data"]
    joints = fields.get("joints", NO_MAPPING)
    known = (
        fields["schema"] == SCHEMA
        and (joints is None or is_mapping(joints))
        and isinstance(data, dict)
        and isinstance(data.get("sha256"), str)
        and isinstance(fields["stamped"], str)
        and isinstance(fields["envelope"], dict)
    )
    if not known:
        raise wrong
    return Stamp(
        {name: fields[name] for name in _TUPLE},
        data["sha256"],
        fields["stamped"],
        canonical_json.dump(fields["envelope"]),
        joints,
    )


def is_mapping(given: object) -> TypeGuard[dict[str, str]]:
    """Whether a value maps text to text."""
    return isinstance(given, dict) and all(isinstance(text, str) for text in given.values())


@dataclass(frozen=True, slots=True)
class StampVerdict:
    """Result of the verification of a stamp.

    Attributes:
        release: release in the envelope, None if it is not authentic.
        problems: reasons why the stamp is not valid; empty for a valid one.
        note: what a valid stamp does not cover, in words.
    """

    release: Release | None
    problems: tuple[str, ...] = ()
    note: str = ""

    @property
    def holds(self) -> bool:
        """Whether the stamp is valid."""
        return self.release is not None and not self.problems


def judge(stamp: Stamp, keys: Sequence[Key], data: str, now: datetime) -> StampVerdict:
    """Verify the signature and the IDs of a stamp, and that the data have not changed.

    A stamp stays valid when its release has expired or has a successor, because the data were made
    with that release.

    Args:
        data: SHA-256 of the present content, hex.
        now: present time, with time zone.
    """
    try:
        release = authenticate(stamp.envelope, keys)
        expected = stated_ids(release)
        stamped = moment(stamp.stamped)
    except ReleaseError as error:
        return StampVerdict(None, (str(error),))
    problems = [
        f"{name}: the stamp says {_format(stamp.ids[name])}, release {release.number} says "
        f"{_format(value)}"
        for name, value in expected.items()
        if stamp.ids[name] != value and not _is_variant(stamp.ids[name], value, name, release)
    ]
    if stamp.data != data:
        problems.append(
            f"the data have changed since they were stamped: SHA-256 {data[:16]}... where "
            f"{stamp.data[:16]}... was stamped"
        )
    if stamped < moment(release.header.created) or stamped > now:
        problems.append(f"stamped at {stamp.stamped}, which is before the release or in the future")
    return StampVerdict(release, tuple(problems))


def _is_variant(stated: Any, expected: Any, part: str, release: Release) -> bool:
    """Whether a stamp names one of the payloads or controllers that the release declares."""
    return (
        part in VARIANTS
        and isinstance(stated, dict)
        and stated.keys() == expected.keys()
        and stated["digest"] == expected["digest"]
        and stated["id"] in variants_of(release, part)
    )


def _format(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 120 else text[:117] + "..."
