"""Read and create keys: trusted public keys in the twin, the private key outside it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path

import platformdirs
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    PublicFormat,
    load_pem_private_key,
    load_pem_public_key,
)
from securesystemslib.signer import CryptoSigner, Key, SSlibKey

from pytest_twin.errors import PathError, ReleaseError
from pytest_twin.formats import atomic
from pytest_twin.formats.paths import read_bytes
from pytest_twin.formats.temporary import temporary_file, temporary_folder
from pytest_twin.release.envelope import short_key_id
from pytest_twin.release.folder import refuse_link
from pytest_twin.release.limits import LIMITS

FOLDER = "keys"
VARIABLE = "TWIN_SIGNING_KEY"
_FIELD = 2**255 - 19
"""Order of the field of Curve25519 and Edwards25519."""


def load_trusted(folder: Path) -> list[Key]:
    """Read the Ed25519 public keys ``*.pub`` (PEM) of a folder; empty if it does not exist.

    Raises:
        ReleaseError: a file that is not such a key, or too many files.
        PathError: the folder or a file is a link or cannot be read.
    """
    refuse_link(folder)
    try:
        paths = sorted(path for path in folder.iterdir() if path.suffix == ".pub")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise PathError(f"cannot be read: {error.strerror}", path=folder) from None
    if len(paths) > LIMITS.keys_count:
        raise ReleaseError(
            "too many keys",
            path=folder,
            value=len(paths),
            expected=f"at most {LIMITS.keys_count}",
        )
    found: dict[str, Key] = {}
    for path in paths:
        try:
            public = load_pem_public_key(read_bytes(path, LIMITS.key_bytes, links=False))
        except (ValueError, UnsupportedAlgorithm):
            public = None
        if not isinstance(public, Ed25519PublicKey):
            raise ReleaseError(
                "not a public key that releases are signed with",
                path=path,
                expected="an Ed25519 public key in PEM",
            )
        if _has_low_order(public):
            raise ReleaseError(
                "a public key of low order, with which anybody can sign",
                path=path,
                expected="the public key of a key that was drawn at random; delete this file",
            )
        key = SSlibKey.from_crypto(public)
        found[key.keyid] = key
    return list(found.values())


def _has_low_order(key: Ed25519PublicKey) -> bool:
    """Whether eight times the key's point is zero, so that a signature verifies any statement.

    The point's image on Curve25519 is u = (1 + y) / (1 - y) (RFC 7748, section 4.1). There the
    library refuses points of low order, because scalars are multiples of eight.
    """
    y = int.from_bytes(key.public_bytes_raw(), "little") % 2**255 % _FIELD
    u = (1 + y) * pow(1 - y, -1, _FIELD) % _FIELD if y != 1 else 0
    try:
        X25519PrivateKey.generate().exchange(
            X25519PublicKey.from_public_bytes(u.to_bytes(32, "little"))
        )
    except ValueError:
        return True
    return False


def signer(
    root: Path, option: str | None = None, ini: str | None = None
) -> tuple[CryptoSigner, tuple[str, ...]]:
    """Find the signing key; the key, and notes for the terminal.

    The order is ``option`` (``--twin-key``), the environment variable ``TWIN_SIGNING_KEY``, ``ini``
    (``twin_key``), and the user's configuration folder, in which a key is created at first use.

    Args:
        root: the twin's folder.
        option, ini: paths as given; relative to the working directory.

    Raises:
        ReleaseError: the file does not exist, is not an Ed25519 key, is inside the twin's folder,
            or its key is not trusted by the twin.
    """
    notes: list[str] = []
    stated = option or os.environ.get(VARIABLE) or ini
    if stated:
        path = Path(stated).expanduser().absolute()
    else:
        path = platformdirs.user_config_path("pytest-twin") / "signing_key.pem"
        if not path.exists():
            _create(path)
            notes.append(f"created a signing key: {path} (keep it private, and keep a copy)")
    if path.resolve().is_relative_to(root.resolve()):
        raise ReleaseError(
            "the signing key is inside the twin, where it would be published",
            path=path,
            expected="a path outside " + str(root),
        )
    found = _load_private(path)
    if path.stat().st_mode & 0o077:
        notes.append(f"other users can read the signing key: run chmod 600 {path}")
    trusted = load_trusted(root / FOLDER)
    if trusted:
        require_trusted(found, trusted, root)
    return found, tuple(notes)


def require_trusted(signer: CryptoSigner, trusted: Sequence[Key], root: Path) -> None:
    """Check that a signing key is trusted.

    Raises:
        ReleaseError: the key is not among the trusted keys.
    """
    key_id = signer.public_key.keyid
    if key_id not in {key.keyid for key in trusted}:
        raise ReleaseError(
            f"the signing key {short_key_id(key_id)} is not a key that this twin trusts",
            path=root / FOLDER,
            expected=", ".join(sorted(short_key_id(key.keyid) for key in trusted))
            + f", or its public key added to {FOLDER}/ by an owner of the twin",
        )


def trust_first(root: Path, signer: CryptoSigner) -> str:
    """Write the signer's public key into a twin without keys, and return a note.

    Raises:
        ReleaseError: another process wrote another key at the same time.
        PathError: it cannot be written.
    """
    folder = root / FOLDER
    name = f"{short_key_id(signer.public_key.keyid)}.pub"
    try:
        with contextlib.suppress(OSError):
            folder.rmdir()
        with temporary_folder(root) as staging:
            staging.chmod(0o755)
            (staging / name).write_bytes(public_pem(signer))
            if not atomic.create_directory(staging, folder):
                if trusted := load_trusted(folder):
                    require_trusted(signer, trusted, root)
                else:
                    atomic.write_bytes(folder / name, public_pem(signer))
    except OSError as error:
        raise PathError(f"cannot be written: {error.strerror}", path=folder) from None
    return f"first release: this twin now trusts {folder / name}; commit this file"


def public_pem(signer: CryptoSigner) -> bytes:
    """Public key of a signer, PEM."""
    private = load_pem_private_key(signer.private_bytes, None)
    return private.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)


def _load_private(path: Path) -> CryptoSigner:
    try:
        private = load_pem_private_key(read_bytes(path.resolve(), LIMITS.key_bytes), None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        private = None
    if not isinstance(private, Ed25519PrivateKey):
        raise ReleaseError(
            "not a key to sign with",
            path=path,
            expected="an Ed25519 private key in PEM (PKCS #8) without a passphrase",
        )
    return CryptoSigner(private)


def _create(path: Path) -> None:
    """Create a key that only its owner can read; if two processes create one, the first is kept."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with contextlib.suppress(FileExistsError), temporary_file(path.parent) as (new, descriptor):
            new.chmod(0o600)
            with os.fdopen(os.dup(descriptor), "wb") as stream:
                stream.write(CryptoSigner.generate_ed25519().private_bytes)
                stream.flush()
                os.fsync(stream.fileno())
            # A hard link fails if the name exists; a rename would overwrite the file.
            path.hardlink_to(new)
    except OSError as error:
        raise PathError(f"no signing key can be created: {error.strerror}", path=path) from None
