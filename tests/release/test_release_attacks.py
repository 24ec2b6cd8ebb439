"""Attacks on signed releases, one per test; each is refused with its reason."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import random
import shutil
import socket
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from hypothesis import given, settings
from hypothesis import strategies as st
from release_twins import NOW, MakeRelease, html, make_draft, make_twin
from securesystemslib.dsse import Envelope
from securesystemslib.signer import CryptoSigner, Key

from pytest_twin import release
from pytest_twin.errors import PathError, ReleaseError
from pytest_twin.release import canonical_json, file_names, folder, keys, statement
from pytest_twin.release.envelope import PAYLOAD_TYPE, open_envelope, seal
from pytest_twin.release.limits import ReleaseLimits
from pytest_twin.release.verify import FolderEntry, verify


def problems(path: Path, now: datetime = NOW, **options: Any) -> list[tuple[str, str]]:
    verdict = release.check(path, now=now, **options)
    assert verdict.holds == (not verdict.problems)
    return [(problem.code, problem.text) for problem in verdict.problems]


@pytest.fixture
def first(root: Path, make: MakeRelease) -> Path:
    make()
    return root / "releases" / "0001"


def resign(path: Path, root: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change a statement and sign it again with the trusted key."""
    value = json.loads((path / "release.dsse.json").read_bytes())
    payload = json.loads(base64.standard_b64decode(value["payload"]))
    change(payload)
    signer, _ = release.signer(root)
    (path / "release.dsse.json").write_bytes(seal(canonical_json.dump(payload), signer))


# one flipped byte


def test_a_changed_byte_in_the_envelope_is_detected(root: Path, first: Path) -> None:
    """Each byte, including white space and base64 padding; verification without disk access."""
    data = (first / "release.dsse.json").read_bytes()
    listing = folder.listing(first)
    trusted = keys.load_trusted(root / "keys")
    assert verify(data, listing, trusted, now=NOW).holds
    assert len(data) > 3000
    rng = random.Random(7)
    for index in range(len(data)):
        changed = bytearray(data)
        # Bit 5 changes the case of a letter, as in hexadecimal digits and escapes.
        changed[index] ^= rng.choice((0x01, 0x20, 0x80, rng.randrange(1, 256)))
        verdict = verify(bytes(changed), listing, trusted, now=NOW)
        assert not verdict.holds, f"changed byte {index} of the envelope is not detected"
        assert verdict.release is None


def test_a_changed_byte_in_any_file_is_detected(root: Path, first: Path) -> None:
    for path in [path for path in first.rglob("*") if path.is_file()]:
        data = path.read_bytes()
        is_envelope = path.name == "release.dsse.json"
        indices = random.Random(3).sample(range(len(data)), 60) if is_envelope else range(len(data))
        step = 1 if len(data) < 200 else 7
        for index in list(indices)[::step]:
            changed = bytearray(data)
            changed[index] ^= 1 << (index % 8)
            path.write_bytes(bytes(changed))
            found = problems(first)
            assert found, f"changed byte {index} of {path.name} is not detected"
            if not is_envelope:
                name = path.relative_to(first).as_posix()
                assert found[0][1].startswith(f"{name}: changed, SHA-256")
        path.write_bytes(data)
    assert problems(first) == []


def test_an_added_or_removed_byte_is_detected(root: Path, first: Path) -> None:
    for path in [path for path in first.rglob("*") if path.is_file()]:
        data = path.read_bytes()
        for changed in (data + b"\n", data[:-1], b"", b" " + data):
            path.write_bytes(changed)
            assert problems(first), (
                f"{path.name}: {len(changed)} instead of {len(data)} bytes are not detected"
            )
        path.write_bytes(data)
    assert problems(first) == []


# files that are not part of the release


def test_an_unlisted_file_is_refused(first: Path) -> None:
    (first / "files" / "meshes" / "more.stl").write_bytes(b"")
    assert problems(first) == [
        ("files", "files/meshes/more.stl: a file that the statement does not list")
    ]


def test_an_unlisted_folder_is_refused(first: Path) -> None:
    (first / "files" / "plugins").mkdir()
    assert problems(first) == [
        ("files", "files/plugins/: a folder that the statement does not list")
    ]


def test_a_symbolic_link_instead_of_a_file_is_refused(root: Path, first: Path) -> None:
    """A link to the same bytes is refused too: its target may change later."""
    mesh = first / "files" / "meshes" / "link.stl"
    mesh.unlink()
    mesh.symlink_to(root / "meshes" / "link.stl")
    assert problems(first) == [("files", "files/meshes/link.stl: a link instead of a file")]


def test_a_symbolic_link_instead_of_a_folder_is_refused(root: Path, first: Path) -> None:
    shutil.rmtree(first / "files" / "meshes")
    (first / "files" / "meshes").symlink_to(root / "meshes")
    found = problems(first)
    assert ("files", "files/meshes: a link instead of a file") in found


def test_a_hard_linked_file_is_refused(root: Path, first: Path) -> None:
    os.link(first / "files" / "arm.xml", root / "elsewhere.xml")
    assert problems(first) == [("files", "files/arm.xml: linked from 2 places")]


def test_a_symbolic_link_instead_of_the_envelope_is_refused(root: Path, first: Path) -> None:
    envelope = first / "release.dsse.json"
    envelope.rename(root / "moved.json")
    envelope.symlink_to(root / "moved.json")
    assert "is a symbolic link" in problems(first)[0][1]


def test_a_symbolic_link_instead_of_the_release_folder_is_refused(
    root: Path, first: Path, tmp_path: Path
) -> None:
    first.rename(tmp_path / "moved")
    first.symlink_to(tmp_path / "moved")
    assert problems(first) == [("files", "0001: a link, not the release itself")]


def test_pipes_and_sockets_are_refused_without_blocking(first: Path) -> None:
    os.mkfifo(first / "files" / "pipe")
    (first / "files" / "arm.xml").unlink()
    os.mkfifo(first / "files" / "arm.xml")
    with socket.socket(socket.AF_UNIX) as listener:
        here = Path.cwd()
        os.chdir(first)
        try:
            listener.bind("socket")
        finally:
            os.chdir(here)
        assert problems(first) == [
            ("files", "files/arm.xml: neither a file nor a folder"),
            ("files", "files/pipe: neither a file nor a folder"),
            ("files", "socket: neither a file nor a folder"),
        ]


def test_a_folder_instead_of_a_file_is_refused(first: Path) -> None:
    (first / "files" / "arm.xml").unlink()
    (first / "files" / "arm.xml").mkdir()
    assert problems(first) == [
        ("files", "files/arm.xml/: a folder that the statement does not list")
    ]


def test_a_missing_file_is_refused(first: Path) -> None:
    """An interrupted copy may lack any one file."""
    for path in [path for path in first.rglob("*") if path.is_file()]:
        data = path.read_bytes()
        path.unlink()
        (code, text), *_ = problems(first)
        name = path.relative_to(first).as_posix()
        if name == "release.dsse.json":
            assert (code, text) == (
                "envelope",
                "no release.dsse.json: its write was interrupted or it is no release",
            )
        else:
            assert (code, text) == ("files", f"{name}: missing")
        path.write_bytes(data)


def test_files_mixed_from_two_releases_are_refused(root: Path, make: MakeRelease) -> None:
    make()
    (root / "arm.xml").write_text("<mujoco><worldbody><body/></worldbody></mujoco>\n")
    make(NOW + timedelta(hours=1))
    one, two = root / "releases" / "0001", root / "releases" / "0002"
    for name in ("files/arm.xml", "report.html", "results.json"):
        data = (two / name).read_bytes()
        shutil.copyfile(one / name, two / name)
        found = problems(two, NOW + timedelta(hours=1))
        assert [code for code, _ in found] == ["files"]
        assert found[0][1].startswith(f"{name}: changed")
        (two / name).write_bytes(data)
    assert problems(two, NOW + timedelta(hours=1)) == []


# order of releases


def test_an_older_release_beside_a_newer_one_is_refused(root: Path, make: MakeRelease) -> None:
    make()
    make()
    assert problems(root / "releases" / "0001") == [("rollback", "older than release 2 beside it")]


def test_an_older_release_is_refused_after_a_newer_one_was_accepted(
    root: Path, make: MakeRelease, tmp_path: Path
) -> None:
    make()
    shutil.copytree(root / "releases" / "0001", tmp_path / "offered")
    make()
    trusted = root / "keys"
    assert problems(root / "releases" / "0002", remember=True) == []
    shutil.rmtree(root / "releases" / "0002")
    expected = [("rollback", "older than release 2, which was accepted here")]
    assert problems(root / "releases" / "0001", remember=True) == expected
    assert problems(tmp_path / "offered", keys=trusted, remember=True) == expected


def test_a_machine_that_only_verifies_remembers_the_newest_release(
    root: Path, make: MakeRelease, user: Path
) -> None:
    """The machine received the releases and wrote none."""
    make()
    make()
    shutil.rmtree(user / "state")
    assert problems(root / "releases" / "0002", remember=True) == []
    shutil.rmtree(root / "releases" / "0002")
    assert problems(root / "releases" / "0001", remember=True) == [
        ("rollback", "older than release 2, which was accepted here")
    ]


def test_accepted_releases_of_one_twin_do_not_affect_another_twin_of_the_same_name(
    root: Path, make: MakeRelease, tmp_path: Path
) -> None:
    make()
    make()
    assert problems(root / "releases" / "0002", remember=True) == []
    other = make_twin(tmp_path / "again" / "arm")
    signer, _ = release.signer(other)
    release.write(other, make_draft(other), signer, html, now=NOW)
    assert problems(other / "releases" / "0001", remember=True) == []


def test_an_unreadable_record_of_accepted_releases_is_an_error(
    root: Path, first: Path, user: Path
) -> None:
    problems(first, remember=True)
    (memory,) = (user / "state").rglob("*.json")
    memory.write_text("{")
    with pytest.raises(ReleaseError, match="the record of accepted releases cannot be read"):
        problems(first, remember=True)


def test_a_release_in_the_folder_of_another_number_is_refused(root: Path, first: Path) -> None:
    first.rename(root / "releases" / "0007")
    assert problems(root / "releases" / "0007") == [
        ("folder", "release 1 is in the folder of release 7")
    ]


def test_a_copy_of_an_older_release_as_the_newest_is_refused(root: Path, make: MakeRelease) -> None:
    make()
    make()
    shutil.copytree(root / "releases" / "0001", root / "releases" / "0003")
    codes = [code for code, _ in problems(root / "releases" / "0003")]
    assert "folder" in codes


def test_a_release_of_another_twin_by_the_same_signer_is_refused(
    root: Path, first: Path, tmp_path: Path
) -> None:
    other = make_twin(tmp_path / "other", name="leg")
    signer, _ = release.signer(other)
    for _ in range(2):
        release.write(other, make_draft(other, name="leg"), signer, html, now=NOW)
    shutil.copytree(other / "releases" / "0002", root / "releases" / "0002")
    assert problems(root / "releases" / "0002") == [
        ("twin", "a release of the twin 'leg', not of 'arm'"),
        ("order", "follows a release 1 other than the one before it"),
    ]


def test_a_release_of_another_twin_with_the_same_name_and_signer_is_refused(
    root: Path, first: Path, tmp_path: Path
) -> None:
    other = make_twin(tmp_path / "other")
    signer, _ = release.signer(other)
    for _ in range(2):
        release.write(other, make_draft(other), signer, html, now=NOW)
    shutil.copytree(other / "releases" / "0002", root / "releases" / "0002")
    assert problems(root / "releases" / "0002") == [
        ("order", "follows a release 1 other than the one before it")
    ]


def test_a_release_without_predecessor_after_another_release_is_refused(
    root: Path, first: Path, tmp_path: Path
) -> None:
    resign(first, root, lambda payload: payload["predicate"].update(number=2))
    first.rename(root / "releases" / "0002")
    (root / "releases" / "0001").mkdir()
    assert problems(root / "releases" / "0002") == []
    (root / "releases" / "0001").rmdir()
    other = make_twin(tmp_path / "other")
    signer, _ = release.signer(other)
    release.write(other, make_draft(other), signer, html, now=NOW)
    shutil.copytree(other / "releases" / "0001", root / "releases" / "0001")
    assert problems(root / "releases" / "0002") == [
        ("order", "does not follow release 1 before it")
    ]


# time


def test_an_expired_release_is_refused(first: Path) -> None:
    expires = NOW + timedelta(days=90)
    assert problems(first, expires - timedelta(seconds=1)) == []
    assert problems(first, expires) == [("expired", "expired at 2026-08-02T12:00:00Z")]


def test_a_release_from_the_future_is_refused(first: Path) -> None:
    assert problems(first, NOW - timedelta(minutes=9)) == []
    assert problems(first, NOW - timedelta(minutes=11)) == [
        ("future", "made at 2026-05-04T12:00:00Z, which is in the future")
    ]


# keys and signatures


def test_verification_without_trusted_keys_is_refused(
    root: Path, first: Path, tmp_path: Path
) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    assert problems(first, keys=empty)[0] == (
        "keys",
        "no trusted keys (expected at least one public key)",
    )
    shutil.rmtree(root / "keys")
    assert problems(first)[0][0] == "keys"


def test_a_release_signed_by_an_untrusted_key_is_refused(first: Path, tmp_path: Path) -> None:
    foreign = CryptoSigner.generate_ed25519()
    folder_of_keys = tmp_path / "foreign"
    folder_of_keys.mkdir()
    (folder_of_keys / "a.pub").write_bytes(keys.public_pem(foreign))
    ((code, text),) = problems(first, keys=folder_of_keys)
    assert code == "envelope"
    assert "signed by a key that is not trusted" in text
    assert foreign.public_key.keyid[:16] in text


@pytest.mark.parametrize("content", [b"", b"x", b"-----BEGIN PUBLIC KEY-----\n-----END"])
def test_an_invalid_public_key_file_is_an_error(root: Path, first: Path, content: bytes) -> None:
    (root / "keys" / "broken.pub").write_bytes(content)
    with pytest.raises(ReleaseError, match=r"broken\.pub: not a public key"):
        problems(first)


def envelope(payload: bytes = b"{}", kind: str = PAYLOAD_TYPE, *signers: CryptoSigner) -> Envelope:
    made = Envelope(payload, kind, {})
    for signer in signers:
        made.sign(signer)
    return made


def assert_envelope_refused(data: bytes, trusted: list[Key], words: str) -> None:
    with pytest.raises(ReleaseError, match=words):
        open_envelope(data, trusted)


A, B = CryptoSigner.generate_ed25519(), CryptoSigner.generate_ed25519()


# Encodings of the points whose order divides eight, RFC 8032; anybody can sign for them.
LOW_ORDER = [
    bytes(32),
    b"\x01" + bytes(31),
    b"\xec" + b"\xff" * 30 + b"\x7f",
    b"\xed" + b"\xff" * 30 + b"\x7f",
    b"\xee" + b"\xff" * 30 + b"\x7f",
    bytes.fromhex("26e8958fc2b227b045c3f489f2ef98f0d5dfac05d3c63339b13802886d53fc05"),
    bytes.fromhex("c7176a703d4dd84fba3c0b760d10670f2a2053fa2c39ccc64ec7fd7792ac037a"),
]


@pytest.mark.parametrize("sign", [0, 0x80], ids=["", "negative"])
@pytest.mark.parametrize("raw", LOW_ORDER, ids=[raw[:4].hex() for raw in LOW_ORDER])
def test_a_public_key_of_low_order_is_an_error(
    root: Path, first: Path, raw: bytes, sign: int
) -> None:
    raw = raw[:31] + bytes([raw[31] | sign])
    pem = Ed25519PublicKey.from_public_bytes(raw).public_bytes(
        Encoding.PEM, PublicFormat.SubjectPublicKeyInfo
    )
    (root / "keys" / "weak.pub").write_bytes(pem)
    with pytest.raises(ReleaseError, match="public key of low order, with which anybody can sign"):
        problems(first)


@pytest.mark.parametrize("name", ["keys", "releases"])
def test_a_symbolic_link_instead_of_a_folder_of_the_twin_is_refused(
    root: Path, first: Path, tmp_path: Path, name: str
) -> None:
    (root / name).rename(tmp_path / "moved")
    (root / name).symlink_to(tmp_path / "moved")
    try:
        ((_, words),) = problems(first)
    except PathError as error:
        words = str(error)
    assert f"{root / name}: a link (expected the folder itself, inside the twin)" in words


def test_a_link_to_keys_on_the_command_line_is_followed(
    root: Path, first: Path, tmp_path: Path
) -> None:
    (tmp_path / "link").symlink_to(root / "keys")
    assert problems(first, keys=tmp_path / "link") == []


def test_a_twin_that_cannot_be_read_does_not_skip_the_check_of_its_name(
    root: Path, first: Path
) -> None:
    (root / "twin.yaml").write_text("name: [")
    ((code, text),) = problems(first)
    assert code == "twin"
    assert "so that the twin's name is not checked" in text


def test_an_envelope_without_signature_is_refused() -> None:
    data = canonical_json.dump(envelope().to_dict())
    assert_envelope_refused(data, [A.public_key], "no signature or too many")


def test_two_signatures_of_one_key_are_refused() -> None:
    value = envelope(b"{}", PAYLOAD_TYPE, A).to_dict()
    value["signatures"] *= 2
    assert_envelope_refused(canonical_json.dump(value), [A.public_key], "one key signed twice")


def test_an_untrusted_signature_beside_a_trusted_one_is_refused() -> None:
    """Every signature in an envelope is checked, also those that are not needed."""
    data = canonical_json.dump(envelope(b"{}", PAYLOAD_TYPE, A, B).to_dict())
    assert_envelope_refused(data, [A.public_key], "signed by a key that is not trusted")
    assert open_envelope(data, [A.public_key, B.public_key]).payload == b"{}"


def test_an_untrusted_signature_with_the_key_id_of_a_trusted_key_is_refused() -> None:
    value = envelope(b"{}", PAYLOAD_TYPE, B).to_dict()
    value["signatures"][0]["keyid"] = A.public_key.keyid
    assert_envelope_refused(
        canonical_json.dump(value), [A.public_key], "the signature is not valid"
    )


def test_a_signature_of_another_payload_is_refused() -> None:
    value = envelope(b"{}", PAYLOAD_TYPE, A).to_dict()
    value["payload"] = base64.standard_b64encode(b"[]").decode()
    assert_envelope_refused(
        canonical_json.dump(value), [A.public_key], "the signature is not valid"
    )


def test_a_trusted_signature_of_another_payload_type_is_refused() -> None:
    data = canonical_json.dump(envelope(b"{}", "application/vnd.cyclonedx+json", A).to_dict())
    assert_envelope_refused(
        data, [A.public_key], "payloadType: the envelope contains another type of payload"
    )


def test_non_canonical_base64_is_refused() -> None:
    value = envelope(b"{}?", PAYLOAD_TYPE, A).to_dict()
    value["payload"] = value["payload"].replace("/", "_")
    assert_envelope_refused(canonical_json.dump(value), [A.public_key], "not canonical")
    # Decoding ignores some bits of the last digit before the padding.
    value = envelope(b"{}", PAYLOAD_TYPE, A).to_dict()
    digits = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
    last = value["payload"][2]
    value["payload"] = value["payload"][:2] + digits[digits.index(last) + 1] + "="
    assert base64.standard_b64decode(value["payload"]) == b"{}"
    assert_envelope_refused(canonical_json.dump(value), [A.public_key], "not canonical")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data + b" ", "not canonical"),
        (lambda data: b"\n" + data, "not canonical"),
        (lambda data: data.replace(b":", b": ", 1), "not canonical"),
        (lambda data: data.replace(b'{"payload"', b'{"payload":"","payload"'), "occurs twice"),
        (lambda data: b'{"extra":1,' + data[1:], "not a DSSE envelope"),
        (lambda data: data.replace(b'{"keyid"', b'{"a":1,"keyid"'), "not a DSSE envelope"),
        (lambda data: b"\xef\xbb\xbf" + data, "not JSON"),
        (lambda data: data.decode().encode("utf-16"), "not JSON"),
        (lambda data: data[: len(data) // 2], "not JSON"),
        (lambda data: b"", "not JSON"),
        (lambda data: b"null", "not a DSSE envelope"),
        (lambda data: b"[" * 100_000, "nested too deeply"),
        (lambda data: b"[" * 70 + b"]" * 70, "nested too deeply"),
        (lambda data: b"NaN", "not a finite number"),
        (lambda data: b"1" * 5000, "not JSON"),
        (lambda data: b"1e999", "cannot be written as JSON|not canonical|not JSON"),
    ],
)
def test_a_non_canonical_or_malformed_envelope_is_refused(
    change: Callable[[bytes], bytes], words: str
) -> None:
    data = seal(b"{}", A)
    assert open_envelope(data, [A.public_key]).payload == b"{}"
    assert_envelope_refused(change(data), [A.public_key], words)


def test_a_too_large_envelope_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(canonical_json, "LIMITS", ReleaseLimits(envelope_bytes=100))
    with pytest.raises(ReleaseError, match=r"the envelope is too large .*at most 100 bytes"):
        open_envelope(seal(b"{}", A), [A.public_key])


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_refused_with_a_release_error(data: bytes) -> None:
    with pytest.raises(ReleaseError):
        open_envelope(data, [A.public_key])


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=12,
)


@settings(max_examples=200, deadline=None)
@given(_JSON)
def test_arbitrary_signed_json_is_refused_with_a_release_error(value: Any) -> None:
    with pytest.raises(ReleaseError):
        statement.read(_dump_or_skip(value), "key", "0" * 64)


def _dump_or_skip(value: Any) -> bytes:
    try:
        return canonical_json.dump(value)
    except ReleaseError:  # an infinite number
        return b"Infinity"


# invalid statements signed by a trusted key


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("_type", "https://in-toto.io/Statement/v0.1", "_type: not what a release states"),
        ("predicateType", "https://slsa.dev/provenance/v1", "predicateType: not what"),
        ("extra", 1, "extra: not what a release states (expected no field of this name)"),
        ("predicate", {}, "predicate.twin: not what a release states (expected this field)"),
        ("predicate.number", 0, "(got 0; expected a whole number >= 1)"),
        ("predicate.number", True, "(got True; expected a whole number)"),
        ("predicate.number", "1", "(got '1'; expected a whole number)"),
        ("predicate.series", "../../etc/passwd", "predicate.series: not what a release states"),
        ("predicate.twin", None, "predicate.twin: not what a release states (expected text)"),
        ("predicate.created", "yesterday", "not a time"),
        ("predicate.expires", "2026-05-04T12:00:00+00:00", "not a time"),
        ("predicate.expires", "2020-01-01T00:00:00Z", "expires before its creation"),
        ("predicate.previous", {"number": 1, "sha256": "0" * 64}, "not a release before"),
        ("predicate.previous", {"number": 0}, "predicate.previous.number: not what"),
        ("predicate.parts", [], "predicate.parts: not what a release states"),
        ("predicate.parts.library:pin.digest", "0" * 64, "digest: not what a release states"),
        ("predicate.parts.library:pin.content", {"version": "4.2"}, "digest: not what"),
        (
            "predicate.goldens.0.parts",
            ["elsewhere"],
            "depends on a part that the release does not contain",
        ),
        ("predicate.goldens.0.release", 2, "depends on a part that the release does not contain"),
        ("predicate.goldens.0.outcome.status", "perfect", "unknown status"),
        ("predicate.goldens.0.outcome.measures.0.error", [], "is not a release"),
        ("subject.0.digest", {"md5": "0"}, "subject.0.digest.md5: not what a release states"),
        ("subject.0.digest.sha256", "0" * 63, "subject.0.digest.sha256: not what"),
        ("subject.0.annotations.size", -1, "(got -1; expected a whole number >= 0)"),
        ("subject.0.name", "../../../etc/passwd", "the name of a file leaves its folder"),
        ("subject.0.name", "/etc/passwd", "the name of a file leaves its folder"),
        ("subject.0.name", "files/a\\b", "the name of a file contains a character"),
        ("subject.0.name", "files/REPORT", None),
    ],
)
def test_an_invalid_or_contradictory_statement_is_refused(
    root: Path, first: Path, field: str, value: Any, words: str | None
) -> None:
    def change(payload: dict[str, Any]) -> None:
        *path, last = field.split(".")
        here: Any = payload
        for step in path:
            here = here[int(step)] if isinstance(here, list) else here[step]
        here[last] = value

    resign(first, root, change)
    found = problems(first)
    if words is None:
        assert [code for code, _ in found] == ["files", "files"]
    else:
        ((code, text),) = found
        assert code == "envelope"
        assert words in text


def test_a_statement_with_a_repeated_golden_is_refused(root: Path, first: Path) -> None:
    resign(first, root, lambda p: p["predicate"]["goldens"].append(p["predicate"]["goldens"][0]))
    assert "the release states this golden twice" in problems(first)[0][1]


def test_file_names_that_differ_only_by_case_are_refused(root: Path, first: Path) -> None:
    def change(payload: dict[str, Any]) -> None:
        again = json.loads(json.dumps(payload["subject"][0]))
        again["name"] = again["name"].upper()
        payload["subject"].append(again)

    resign(first, root, change)
    assert "two files have the same name on other systems" in problems(first)[0][1]


def test_a_statement_that_lists_a_file_twice_is_refused(root: Path, first: Path) -> None:
    resign(first, root, lambda p: p["subject"].append(p["subject"][0]))
    assert "two files have the same name on other systems" in problems(first)[0][1]


@pytest.mark.parametrize("name", ["report.html", "results.json"])
def test_a_statement_without_report_or_results_is_refused(
    root: Path, first: Path, name: str
) -> None:
    (first / name).unlink()

    def change(payload: dict[str, Any]) -> None:
        payload["subject"] = [entry for entry in payload["subject"] if entry["name"] != name]

    resign(first, root, change)
    assert problems(first) == [("files", f"{name}: a release without it")]


def test_a_listed_file_outside_the_files_folder_is_refused(root: Path, first: Path) -> None:
    data = b"#!/bin/sh\n"
    (first / "run.sh").write_bytes(data)
    entry = {
        "name": "run.sh",
        "digest": {"sha256": hashlib.sha256(data).hexdigest()},
        "annotations": {"size": len(data)},
    }
    resign(first, root, lambda p: p["subject"].append(entry))
    assert problems(first) == [("files", "run.sh: not a place for a file of a release")]


def test_at_most_20_problems_are_listed_with_a_count_of_the_others(root: Path, first: Path) -> None:
    for index in range(500):
        (first / f"{index}.txt").touch()
    found = problems(first)
    assert len(found) == 21
    assert found[-1] == ("files", "and 480 more")


# file names


@pytest.mark.parametrize(
    "name",
    [
        "",
        "/a",
        "a//b",
        "a/",
        "./a",
        "a/../b",
        "..",
        "a\\b",
        "c:/a",
        "a\0b",
        "a\nb",
        "a\x1b[31mb",
        "a\u202eb",
        "e\u0301",
        "a.",
        "a ",
        "aux",
        "COM1.txt",
        "x/nul.stl",
        "\ud800",
        "a" * 2000,
        "what?",
    ],
)
def test_file_names_that_are_not_portable_are_refused(name: str) -> None:
    assert file_names.problem_with(name) is not None


@pytest.mark.parametrize("name", ["a", "a/b.stl", "Arm 2 (left).xml", ".hidden", "größe.yaml"])
def test_portable_file_names_are_accepted(name: str) -> None:
    assert file_names.problem_with(name) is None


@pytest.mark.parametrize(
    "pair",
    [("a", "A"), ("a/b", "A/c"), ("straße", "STRASSE"), ("a", "a/b"), ("a", "A/b"), ("x", "x")],
)
def test_file_names_that_collide_on_other_systems_are_found(pair: tuple[str, str]) -> None:
    assert file_names.colliding_names(pair)
    assert file_names.colliding_names(reversed(pair))


def test_distinct_file_names_do_not_collide() -> None:
    assert file_names.colliding_names(["a/b", "a/c", "b/a", "ab"]) == []


# verification without disk access


def test_verification_works_on_file_facts_without_disk_access(root: Path, first: Path) -> None:
    data = (first / "release.dsse.json").read_bytes()
    trusted = keys.load_trusted(root / "keys")
    read = release.check(first, now=NOW).release
    assert read is not None
    facts = {entry.name: FolderEntry("file", entry.sha256, entry.size) for entry in read.files}
    for name in ("files", "files/meshes", "files/golden", "files/golden/fk"):
        facts[name] = FolderEntry("folder")
    assert verify(data, facts, trusted, now=NOW).holds
    mesh = facts["files/meshes/link.stl"]
    for wrong in (
        replace(mesh, sha256="0" * 64),
        replace(mesh, size=1),
        replace(mesh, kind="link"),
        replace(mesh, links=2),
        replace(mesh, kind="other"),
    ):
        assert not verify(data, facts | {"files/meshes/link.stl": wrong}, trusted, now=NOW).holds
