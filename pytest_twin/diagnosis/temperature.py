"""Normalized temperature of trials, for friction that depends on temperature."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Protocol

from pytest_twin.errors import RecordingError
from pytest_twin.trial import Trial

TEMPERATURE_KEY = "temperature"
_NUMBER = re.compile(r"\s*([-+]?\d+(?:\.\d+)?)\s*(?:°|deg)?\s*([CK]?)\s*")

ColdFractions = Mapping[str, float]
"""Temperature in the metadata -> cold fraction: 1 for the coldest, 0 for the warmest trial."""


class WithMetadata(Protocol):
    """A trial, or another part of a recording with the recording's metadata."""

    @property
    def path(self) -> Path:
        """The recording."""

    @property
    def metadata(self) -> Mapping[str, str]:
        """Metadata of the recording."""


def cold_fractions_of(trials: Iterable[Trial]) -> ColdFractions:
    """Temperature in the metadata of trials -> cold fraction; empty if they cannot be ordered.

    Numbers (``20``, ``20 C``, ``293.15 K``, all in one unit) are ordered. Of two names, such as
    ``cold`` and ``warm``, the first in the alphabet counts as the colder one; the other order only
    changes the sign of the effect. More than two names have no order.
    """
    recorded = [t.metadata.get(TEMPERATURE_KEY) for t in trials]
    names = sorted({g for g in recorded if g is not None})
    if None in recorded or len(names) < 2:
        return {}
    numbers = parse_temperatures(names)
    if numbers is None:
        return {names[0]: 1.0, names[1]: 0.0} if len(names) == 2 else {}
    coldest, warmest = min(numbers.values()), max(numbers.values())
    if coldest == warmest:
        return {}
    return {name: (warmest - t) / (warmest - coldest) for name, t in numbers.items()}


def cold_fraction_of_trial(known: ColdFractions, trial: WithMetadata) -> float:
    """Cold fraction of one trial; 1 if no temperatures are known.

    Raises:
        RecordingError: temperatures are known, but this trial has none that can be compared.
    """
    if not known:
        return 1.0
    name = trial.metadata.get(TEMPERATURE_KEY)
    if name is not None and name in known:
        return known[name]
    numbers = None if name is None else parse_temperatures([*known, name])
    if name is None or numbers is None:
        raise RecordingError(
            "the model's friction depends on temperature, and this recording has no usable one",
            path=trial.path,
            value=name,
            expected=f"metadata {TEMPERATURE_KEY!r} in the record 'trial', like {', '.join(known)}",
        )
    warmest, coldest = (pick(known, key=lambda n: known[n]) for pick in (min, max))
    share = (numbers[name] - numbers[warmest]) / (numbers[coldest] - numbers[warmest])
    return max(known[warmest] + share * (known[coldest] - known[warmest]), 0.0)


def parse_temperatures(names: Iterable[str]) -> dict[str, float] | None:
    """Temperatures in the metadata -> numbers; None if one is no number or units differ."""
    found, units = {}, set()
    for name in names:
        read = _NUMBER.fullmatch(name)
        if read is None:
            return None
        found[name] = float(read[1])
        units.add(read[2])
    return found if len(units) == 1 else None
