"""Temperatures of trials: how far each is from the warmest, for what grows stiff in the cold."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

from pytest_twin.errors import RecordingError
from pytest_twin.trial import Trial

KEY = "temperature"
_NUMBER = re.compile(r"\s*([-+]?\d+(?:\.\d+)?)\s*(?:°|deg)?\s*([CK]?)\s*")

Coldness = Mapping[str, float]
"""Temperature as trials name it -> 1 in the coldest, 0 in the warmest, even in between."""


def coldness_of(trials: Iterable[Trial]) -> Coldness:
    """How cold trials were, by their metadata; empty where it tells nothing.

    Numbers (``20``, ``20 C``, ``293.15 K``, all of one unit) are ordered. Two names are told apart,
    ``cold`` and ``warm``, the first of the alphabet being the colder: a law that has it the other
    way round has the other sign. More names have no order.
    """
    given = [t.metadata.get(KEY) for t in trials]
    names = sorted({g for g in given if g is not None})
    if None in given or len(names) < 2:
        return {}
    numbers = degrees(names)
    if numbers is None:
        return {names[0]: 1.0, names[1]: 0.0} if len(names) == 2 else {}
    coldest, warmest = min(numbers.values()), max(numbers.values())
    if coldest == warmest:
        return {}
    return {name: (warmest - t) / (warmest - coldest) for name, t in numbers.items()}


def coldness_in(known: Coldness, trial: Trial) -> float:
    """Of one trial; 1 where nothing is known of any.

    Raises:
        RecordingError: others have a temperature, this one has none or one of no order.
    """
    if not known:
        return 1.0
    name = trial.metadata.get(KEY)
    if name is not None and name in known:
        return known[name]
    numbers = None if name is None else degrees([*known, name])
    if name is None or numbers is None:
        raise RecordingError(
            "the model's friction depends on temperature, and this recording has no usable one",
            path=trial.path,
            value=name,
            expected=f"metadata {KEY!r} in the record 'trial', like {', '.join(known)}",
        )
    warmest, coldest = (pick(known, key=lambda n: known[n]) for pick in (min, max))
    share = (numbers[name] - numbers[warmest]) / (numbers[coldest] - numbers[warmest])
    return max(known[warmest] + share * (known[coldest] - known[warmest]), 0.0)


def degrees(names: Iterable[str]) -> dict[str, float] | None:
    """Temperatures as trials name them -> numbers of one unit; None where some is none of it."""
    found, units = {}, set()
    for name in names:
        read = _NUMBER.fullmatch(name)
        if read is None:
            return None
        found[name] = float(read[1])
        units.add(read[2])
    return found if len(units) == 1 else None
