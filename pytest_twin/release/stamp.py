"""The stamp of a data set or policy: which release of which twin it was made with. No files.

A stamp holds the tuple of IDs with digests, and the release's signed envelope as it is. A trusted
key therefore vouches for the tuple; the digest of the data, which no release can know, guards
against mistakes and not against whoever may write the data.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from securesystemslib.signer import Key

from pytest_twin.errors import ReleaseError
from pytest_twin.release import canonical_json
from pytest_twin.release.statement import Release, moment, timestamp
from pytest_twin.release.verify import authenticate

SCHEMA = 1
PARTS = ("asset", "calibration", "fit", "controller", "validation")
"""Members of the tuple, each with ``id`` and ``digest``."""
_TUPLE = ("twin", "series", "release", *PARTS, "payload", "declared")
_FIELDS = {"schema", *_TUPLE, "data", "stamped", "envelope"}


@dataclass(frozen=True, slots=True)
class Stamp:
    """What a data set or policy says of itself.

    Attributes:
        ids: the tuple: ``twin``, ``series``, ``release`` (its number), each of :data:`PARTS`,
            ``payload`` and ``declared`` (firmware and the like).
        data: SHA-256 of the content when it was stamped, hex.
        stamped: RFC 3339, UTC.
        envelope: the release's signed envelope.
    """

    ids: Mapping[str, Any]
    data: str
    stamped: str
    envelope: bytes

    @property
    def name(self) -> str:
        """``release 7 of 'arm'``."""
        return f"release {self.ids['release']} of {self.ids['twin']!r}"

    def to_text(self) -> str:
        """As it is written; ASCII."""
        fields = {
            "schema": SCHEMA,
            **self.ids,
            "data": {"sha256": self.data},
            "stamped": self.stamped,
            "envelope": json.loads(self.envelope),
        }
        return json.dumps(fields, indent=1) + "\n"


def make(release: Release, envelope: bytes, data: str, now: datetime) -> Stamp:
    """The stamp of a release on data of a digest.

    Raises:
        ReleaseError: the release states no digests.
    """
    return Stamp(tuple_of(release), data, timestamp(now), envelope)


def tuple_of(release: Release) -> dict[str, Any]:
    """The tuple of IDs with digests that a signed release states.

    Raises:
        ReleaseError: a release of an earlier version, which states none.
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
        "asset": _listed(ids.get("asset") or ids.get("realizations")),
        "calibration": ids.get("calibration"),
        "fit": ids.get("fit"),
        "controller": _listed(ids.get("controllers")),
        "payload": _listed(ids.get("payloads")),
        "validation": f"release {header.number}",
    }
    return {
        "twin": header.twin,
        "series": header.series,
        "release": header.number,
        **{part: {"id": named[part], "digest": digests[part]} for part in named},
        "declared": ids.get("parts") or {},
    }


def _listed(names: Any) -> str | None:
    return ", ".join(sorted(map(str, names))) or None if names else None


def parse(text: str) -> Stamp:
    """The stamp that a data set's text is.

    Raises:
        ReleaseError: no stamp; the message says what is wrong with it.
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
    if not isinstance(fields, dict) or set(fields) != _FIELDS or fields["schema"] != SCHEMA:
        raise wrong
    data = fields["data"]
    known = (
        isinstance(data, dict)
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
    )


@dataclass(frozen=True, slots=True)
class StampVerdict:
    """Whether a stamp holds.

    Attributes:
        release: what the envelope states, None where it is not authentic.
        problems: empty where it holds.
    """

    release: Release | None
    problems: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether nothing speaks against it."""
        return self.release is not None and not self.problems


def judge(stamp: Stamp, keys: Sequence[Key], data: str, now: datetime) -> StampVerdict:
    """Whether a trusted key vouches for a stamp's tuple, and the data are those it was put on.

    A release that has expired since, or that newer ones follow, still is what the data were made
    with.

    Args:
        stamp: as read.
        keys: the trusted public keys.
        data: SHA-256 of the content today, hex.
        now: with time zone.
    """
    try:
        release = authenticate(stamp.envelope, keys)
        expected = tuple_of(release)
        stamped = moment(stamp.stamped)
    except ReleaseError as error:
        return StampVerdict(None, (str(error),))
    problems = [
        f"{name}: the stamp says {_shown(stamp.ids[name])}, release {release.number} says "
        f"{_shown(value)}"
        for name, value in expected.items()
        if stamp.ids[name] != value
    ]
    if stamp.data != data:
        problems.append(
            f"the data have changed since they were stamped: SHA-256 {data[:16]}... where "
            f"{stamp.data[:16]}... was stamped"
        )
    if stamped < moment(release.header.created) or stamped > now:
        problems.append(f"stamped at {stamp.stamped}, which is before the release or in the future")
    return StampVerdict(release, tuple(problems))


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 120 else text[:117] + "..."
