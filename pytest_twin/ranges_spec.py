"""What ``twin.yaml`` says of randomization ranges: recordings that check them, and tolerances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pytest_twin.formats.identification_record import IdentificationRecord

SHARE, DRAWS = 0.95, 256
"""What counts where nobody says it: 256 robots know the ends of a 95 % interval to a tenth of its
width."""


@dataclass(frozen=True, slots=True)
class TrialGroup:
    """An identification of recordings that were made under one condition.

    Attributes:
        record: what it found.
        conditions: such as ``temperature`` (deg C) or ``load`` (kg) -> number.
    """

    record: IdentificationRecord
    conditions: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Tolerance:
    """A manufacturing tolerance that no measurement of one robot shows.

    Attributes:
        parameter: such as ``elbow.armature``, or ``BODY.mass``.
        half_width: of a uniform distribution, in the parameter's unit; of its value where
            ``relative``.
        relative: whether it is a share of the value.
    """

    parameter: str
    half_width: float
    relative: bool


@dataclass(frozen=True, slots=True)
class RangesSpec:
    """What randomization ranges are made from and checked with.

    Attributes:
        share: of the samples of final recordings that should lie in the envelope.
        draws: robots that are simulated.
        final: recordings that nothing was made from; they check the ranges.
        held_out: recordings that nothing was fitted on; they may widen the ranges.
        trials: records of the same robot under different conditions.
        tolerances: declared manufacturing tolerances.
    """

    share: float = SHARE
    draws: int = DRAWS
    final: tuple[Path, ...] = ()
    held_out: tuple[Path, ...] = ()
    trials: tuple[TrialGroup, ...] = ()
    tolerances: tuple[Tolerance, ...] = ()

    @classmethod
    def from_json(
        cls,
        data: Mapping[str, Any],
        final: tuple[Path, ...],
        held_out: tuple[Path, ...],
        trials: tuple[TrialGroup, ...],
    ) -> RangesSpec:
        """From the validated table of ``twin.yaml``, its files resolved and its records read."""
        return cls(
            share=float(data.get("share", SHARE)),
            draws=int(data.get("draws", DRAWS)),
            final=final,
            held_out=held_out,
            trials=trials,
            tolerances=tuple(
                Tolerance(
                    str(one["parameter"]),
                    float(one["relative"] if "relative" in one else one["absolute"]),
                    "relative" in one,
                )
                for one in data.get("tolerance", ())
            ),
        )
