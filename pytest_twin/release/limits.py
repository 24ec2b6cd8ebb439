"""Limits of the verification of releases, well above the size of real ones."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ReleaseLimits:
    """Limits of a release and of the trusted keys; the unit is in the name of each field."""

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
