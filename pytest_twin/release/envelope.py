"""Sign payloads and verify signatures in DSSE envelopes; this module reads no files.

The format is the Dead Simple Signing Envelope, https://github.com/secure-systems-lab/dsse, with
Ed25519 through securesystemslib. The rules are stricter than the specification: the bytes of the
envelope must be canonical, and each signature must be by a trusted key.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

from securesystemslib.dsse import Envelope
from securesystemslib.exceptions import UnverifiedSignatureError
from securesystemslib.signer import Key, Signer

from pytest_twin.errors import ReleaseError
from pytest_twin.release import canonical_json
from pytest_twin.release.limits import LIMITS

PAYLOAD_TYPE = "application/vnd.in-toto+json"


@dataclass(frozen=True, slots=True)
class AuthenticPayload:
    """An authentic payload.

    Attributes:
        payload: the signed bytes.
        key_ids: ids of the trusted keys that signed them.
        sha256: digest of the envelope, hex.
    """

    payload: bytes
    key_ids: tuple[str, ...]
    sha256: str


def seal(payload: bytes, signer: Signer) -> bytes:
    """Sign ``payload``, and return the envelope."""
    envelope = Envelope(payload, PAYLOAD_TYPE, {})
    envelope.sign(signer)
    return canonical_json.dump(envelope.to_dict())


def open_envelope(data: bytes, keys: Sequence[Key]) -> AuthenticPayload:
    """Verify an envelope, and return its payload.

    Args:
        data: bytes of the envelope.

    Raises:
        ReleaseError: no keys; an envelope that is not canonical or has another type; no signature,
            too many, two by one key, one by an untrusted key, or an invalid one.
    """
    if not keys:
        raise ReleaseError("no trusted keys", expected="at least one public key")
    value = canonical_json.load(data, "the envelope")
    envelope = _parse(value)
    if canonical_json.dump(envelope.to_dict()) != data:
        raise ReleaseError("the envelope is not canonical", expected="the bytes that were signed")
    if envelope.payload_type != PAYLOAD_TYPE:
        raise ReleaseError(
            "the envelope contains another type of payload",
            where="payloadType",
            value=envelope.payload_type,
            expected=PAYLOAD_TYPE,
        )
    trusted = {key.keyid: key for key in keys}
    for key_id, signature in envelope.signatures.items():
        key = trusted.get(key_id)
        if key is None:
            raise ReleaseError(
                "signed by a key that is not trusted",
                value=key_id,
                expected="one of " + ", ".join(sorted(short_key_id(known) for known in trusted)),
            )
        try:
            key.verify_signature(signature, envelope.pae())
        except UnverifiedSignatureError:
            raise ReleaseError(
                "the signature is not valid: the statement was changed or another key signed it",
                where="signatures",
                value=key_id,
                expected="the release as it was signed; fetch it again from where it was written",
            ) from None
    return AuthenticPayload(
        envelope.payload, tuple(sorted(envelope.signatures)), hashlib.sha256(data).hexdigest()
    )


def short_key_id(key_id: str) -> str:
    """First 16 digits of a key id, for messages."""
    return key_id[:16]


def _parse(value: object) -> Envelope:
    wrong = ReleaseError(
        "not a DSSE envelope", expected="payload, payloadType and signatures of keyid and sig"
    )
    if not isinstance(value, dict) or set(value) != {"payload", "payloadType", "signatures"}:
        raise wrong
    signatures = value["signatures"]
    if not isinstance(signatures, list) or not all(
        isinstance(entry, dict)
        and set(entry) == {"keyid", "sig"}
        and all(isinstance(text, str) for text in entry.values())
        for entry in signatures
    ):
        raise wrong
    if not 1 <= len(signatures) <= LIMITS.signatures_count:
        raise ReleaseError(
            "the envelope has no signature or too many",
            value=len(signatures),
            expected=f"1 to {LIMITS.signatures_count}",
        )
    if len({entry["keyid"] for entry in signatures}) != len(signatures):
        raise ReleaseError("one key signed twice", expected="one signature for each key")
    try:
        return Envelope.from_dict(value)
    except Exception as error:
        # The library raises various exceptions of its decoders.
        raise ReleaseError(f"not a DSSE envelope: {error}") from None
