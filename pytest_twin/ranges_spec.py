"""Section ``ranges:`` of ``twin.yaml``: recordings that check the ranges, and tolerances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pytest_twin.formats.identification_record import IdentificationRecord
from pytest_twin.formats.result_record import ResultRecord
from pytest_twin.record_spec import Unaffected, unaffected_of

SHARE, DRAWS = 0.95, 256
"""Defaults of ``share`` and ``draws``. With 256 simulated robots the ends of a 95 % interval have
an error of about a tenth of its width."""


@dataclass(frozen=True, slots=True)
class TrialGroup:
    """Identification from recordings that were made under one condition.

    Attributes:
        conditions: name, such as ``temperature`` (deg C) or ``load`` (kg) -> value.
        unaffected: changed inputs that do not touch the record.
    """

    record: IdentificationRecord
    conditions: Mapping[str, float]
    unaffected: tuple[Unaffected, ...] = ()


@dataclass(frozen=True, slots=True)
class Tolerance:
    """Manufacturing tolerance: variation between robots, which one robot's recordings cannot show.

    Attributes:
        parameter: its name, such as ``elbow.armature`` or ``BODY.mass``.
        half_width: half the width of a uniform distribution, in the parameter's unit, or as a
            fraction of its value where ``relative``.
        is_relative: whether ``half_width`` is a fraction of the value.
    """

    parameter: str
    half_width: float
    is_relative: bool


@dataclass(frozen=True, slots=True)
class RangesSpec:
    """Sources of randomization ranges, and the recordings that check them.

    Attributes:
        share: fraction of the samples of final recordings that should lie in the envelope.
        draws: number of simulated robots.
        final: recordings that only check the ranges.
        held_out: recordings that were not fitted; they may widen the ranges.
        trials: identifications of the same robot under different conditions.
        record: ranges in use, a ``ranges.json``; None without.
        unaffected: changed inputs that do not touch these ranges.
    """

    share: float = SHARE
    draws: int = DRAWS
    final: tuple[Path, ...] = ()
    held_out: tuple[Path, ...] = ()
    trials: tuple[TrialGroup, ...] = ()
    tolerances: tuple[Tolerance, ...] = ()
    record: ResultRecord | None = None
    unaffected: tuple[Unaffected, ...] = ()

    @classmethod
    def from_json(
        cls,
        data: Mapping[str, Any],
        final: tuple[Path, ...],
        held_out: tuple[Path, ...],
        trials: tuple[TrialGroup, ...],
        record: ResultRecord | None = None,
    ) -> RangesSpec:
        """Build the spec from the validated table of ``twin.yaml``, files and records."""
        return cls(
            share=float(data.get("share", SHARE)),
            draws=int(data.get("draws", DRAWS)),
            final=final,
            held_out=held_out,
            trials=trials,
            record=record,
            unaffected=unaffected_of(data),
            tolerances=tuple(
                Tolerance(
                    str(one["parameter"]),
                    float(one["relative"] if "relative" in one else one["absolute"]),
                    "relative" in one,
                )
                for one in data.get("tolerance", ())
            ),
        )
