"""The mark of long proofs over many seeds: a sample always runs, the whole proof nightly."""

from __future__ import annotations

from typing import Any

import pytest


def samples(count: int, *, always: tuple[int, ...]) -> list[Any]:
    """Values of one parameter: the seeds of a sample, and nightly all ``count`` of the proof."""
    return [
        pytest.param(always, id="sample"),
        pytest.param(tuple(range(count)), id="all seeds", marks=pytest.mark.nightly),
    ]
