"""An answer about a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class Fact:
    """One answer about one recording, or about one joint of it.

    Attributes:
        value: the answer; None if the data do not determine it.
        confidence: probability that it is right, 0 to 1; 0 for None.
        source: ``data``, or where it is declared: ``option``, ``metadata``, ``twin.yaml``.
        evidence: reason in words, with numbers and units.
        numbers: name -> (value, unit) of further results.
    """

    value: str | None
    confidence: float
    source: str
    evidence: str
    numbers: Mapping[str, tuple[float, str]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """An entry of ``recordings`` in ``diagnosis.json``."""
        said: dict[str, Any] = {
            "value": self.value,
            "confidence": round(self.confidence, 4),
            "source": self.source,
            "evidence": self.evidence,
        }
        for name, (value, unit) in self.numbers.items():
            said[name] = {"value": value, "unit": unit}
        return said


def unknown(evidence: str) -> Fact:
    """The answer if the data do not determine it."""
    return Fact(None, 0.0, "data", evidence)
