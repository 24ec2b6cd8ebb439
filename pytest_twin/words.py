"""Counts, lists and first words of sentences."""

from __future__ import annotations

from collections.abc import Sequence


def counted(count: int, noun: str) -> str:
    """Count with its noun, ``1 file`` or ``2 files``; for nouns with a plural in s."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def join_words(words: Sequence[str], conjunction: str = "and") -> str:
    """Join words for a sentence: ``a``, ``a and b``, ``a, b and c``; empty without words."""
    *first, last = words or ("",)
    return f"{', '.join(first)} {conjunction} {last}" if first else last


def list_names(names: Sequence[str], most: int = 8, separator: str = ", ") -> str:
    """List names; of more than ``most`` the first, and the number of the others."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return separator.join(names[:most]) + more


def capitalize_first(text: str) -> str:
    """Begin a sentence with a text, whose other capitals stay."""
    return text[:1].upper() + text[1:]
