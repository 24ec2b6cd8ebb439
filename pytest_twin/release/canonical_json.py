"""Canonical JSON: each value has exactly one byte string, so that a signature covers all bytes."""

from __future__ import annotations

import json
from typing import Any, NoReturn

from pytest_twin.errors import ReleaseError
from pytest_twin.formats.digest import LINE_ENDINGS_ADVICE
from pytest_twin.release.limits import LIMITS


def dump(value: object) -> bytes:
    """Write a value as canonical JSON: sorted keys, no spaces, ASCII, shortest decimal floats.

    Raises:
        ReleaseError: a number that is not finite, or a value that JSON cannot express.
    """
    try:
        text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (ValueError, TypeError) as error:
        raise ReleaseError(f"cannot be written as JSON: {error}") from error
    return text.encode("ascii")


def load(data: bytes, what: str) -> Any:
    """Parse canonical JSON; the bytes must equal those that :func:`dump` writes for the value.

    Args:
        data: the bytes.
        what: name of the data, for error messages.

    Raises:
        ReleaseError: too large, nested too deeply, not JSON, a repeated key, a number that is not
            finite, or JSON that is not canonical.
    """
    if len(data) > LIMITS.envelope_bytes:
        raise ReleaseError(
            f"{what} is too large",
            value=len(data),
            unit="bytes",
            expected=f"at most {LIMITS.envelope_bytes} bytes",
        )
    try:
        value = json.loads(
            data.decode("ascii"), object_pairs_hook=_unique, parse_constant=_refuse_constant
        )
    except RecursionError:
        raise _too_deep(what) from None
    except ValueError as error:
        raise ReleaseError(f"{what} is not JSON: {error}") from None
    _check_depth(value, what)
    if dump(value) != data:
        if dump(value) == data.rstrip(b"\r\n"):
            raise ReleaseError(
                f"{what} has line endings that were not signed; git converts them under "
                "core.autocrlf, and some editors add one",
                expected=LINE_ENDINGS_ADVICE,
            )
        raise ReleaseError(
            f"{what} is not canonical",
            expected="JSON with sorted keys, no spaces and shortest numbers, as it was signed",
        )
    return value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"key {key[:80]!r} occurs twice")
        found[key] = value
    return found


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a finite number")


def _check_depth(value: object, what: str) -> None:
    level: list[object] = [value]
    for _ in range(LIMITS.depth_levels):
        following: list[object] = []
        for item in level:
            if isinstance(item, dict):
                following.extend(item.values())
            elif isinstance(item, list):
                following.extend(item)
        if not following:
            return
        level = following
    raise _too_deep(what)


def _too_deep(what: str) -> ReleaseError:
    return ReleaseError(
        f"{what} is nested too deeply", expected=f"at most {LIMITS.depth_levels} levels"
    )
