"""Bounds of the verification: what a release may be, with room to spare."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ReleaseLimits:
    """Bounds on a release and on the keys that it is compared with."""

    envelope_bytes: int = 256 * 2**20
    depth_levels: int = 64
    signatures_count: int = 8
    files_count: int = 100_000
    file_bytes: int = 8 * 2**30
    name_bytes: int = 1024
    keys_count: int = 64
    key_bytes: int = 16 * 2**10
    clock_skew_seconds: float = 600.0
    problems_count: int = 20


LIMITS = ReleaseLimits()
