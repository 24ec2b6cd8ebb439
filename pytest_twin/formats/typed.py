"""Build typed values from parsed JSON or YAML, and the reverse, by msgspec."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

Value = TypeVar("Value")


def build(data: object, kind: type[Value]) -> Value:
    """Return ``data`` as a ``kind``: a dataclass, or a mapping or tuple of typed values.

    Fields of a dataclass that ``data`` lacks have their defaults; others are ignored.

    Raises:
        ValueError: a value is missing or of another type; its text says where, such as
            ``$.joints[...].offset``.
    """
    import msgspec

    return msgspec.convert(data, kind, dec_hook=_of_text)


def plain(value: object) -> Any:
    """Return a typed value as dicts, lists, text and numbers."""
    import msgspec

    return msgspec.to_builtins(value, enc_hook=str)


def _of_text(kind: type, value: Any) -> Any:
    if kind is not Path or not isinstance(value, str | Path):
        raise ValueError(f"Expected `{kind.__name__}`, got {value!r}")
    return Path(value)
