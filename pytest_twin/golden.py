"""A golden spec: stimulus, expected values, tolerances, and who recorded them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pytest_twin.units import Quantity

Criticality = Literal["critical", "advisory"]


@dataclass(frozen=True, slots=True)
class Provenance:
    """Who recorded the expected values, when, and with which model and simulator.

    Attributes:
        recorded_by: a person or a service.
        recorded_at: RFC 3339, UTC.
        realization: the realization that was recorded.
        simulator: name and version, ``mujoco 4.0.0``.
        parts: part id -> digest, of all parts that the recorded values depended on.
    """

    recorded_by: str
    recorded_at: str
    realization: str
    simulator: str
    parts: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class TraceRef:
    """The trace file beside the spec, and its SHA-256."""

    file: str
    sha256: str


@dataclass(frozen=True, slots=True)
class Golden:
    """One validated golden spec.

    Attributes:
        id: path relative to the twin's root without suffix, ``golden/fk/home``.
        kind: name of the check that runs it.
        title: one line for people.
        realizations: names from ``twin.yaml`` that it runs on, the authoritative one first.
        criticality: ``critical`` blocks a release, ``advisory`` is reported.
        target, stimulus: as the kind's schema declares them.
        tolerance: name -> quantity in SI units.
        expected: recorded values, None until ``--twin-update``.
        trace: recorded series, None where the kind has none or before ``--twin-update``.
        provenance: None until ``--twin-update``.
        unwritten: one line that names the tolerance that the user still has to write, and its
            place; None where all are written. Such a golden is neither run nor recorded.
        lines: dotted field -> 1-based line in ``path``.
    """

    id: str
    path: Path
    kind: str
    title: str
    realizations: tuple[str, ...]
    criticality: Criticality
    target: Mapping[str, Any]
    stimulus: Mapping[str, Any]
    tolerance: Mapping[str, Quantity]
    expected: Mapping[str, Any] | None = None
    trace: TraceRef | None = None
    provenance: Provenance | None = None
    unwritten: str | None = None
    lines: Mapping[str, int] = field(default_factory=dict)
