"""Counts with a noun in singular or plural."""

from __future__ import annotations


def counted(count: int, noun: str) -> str:
    """Count with its noun, ``1 file`` or ``2 files``; for nouns with a plural in s."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
