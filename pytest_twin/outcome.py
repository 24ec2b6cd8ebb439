"""Result of one golden: measured errors with tolerances, and why it ran.

This module uses no simulator and reads no files.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from pytest_twin.formats import typed
from pytest_twin.units import Quantity

Status = Literal["passed", "failed", "error"]
_NUMBERS = ("measured", "golden", "error", "tolerance", "time")


@dataclass(frozen=True, slots=True)
class Measure:
    """One number compared with its tolerance.

    Attributes:
        name: measured quantity, a key of the golden's ``tolerance``.
        subject: joint, frame, pair or sample.
        measured, golden: measured and expected value, in ``unit``.
        error: deviation that the tolerance bounds, in ``unit``, not negative; NaN never passes.
        tolerance: largest allowed ``error``, in ``unit``.
        unit: SI unit.
        against: source of the expected value: ``golden``, ``pinocchio``, ``coal``, ``declared``,
            ``recording`` or ``audit``; for ``audit`` the subject is a whole sentence.
        time: time of the largest error, s, or None; for a mean (``..._rms``) the time of the
            sample that contributes most to it.
    """

    name: str
    subject: str
    measured: float
    golden: float
    error: float
    tolerance: float
    unit: str
    against: str = "golden"
    time: float | None = None

    @classmethod
    def of_error(
        cls,
        name: str,
        subject: str,
        error: float,
        bound: Quantity,
        against: str = "golden",
        time: float | None = None,
    ) -> Measure:
        """Build the measure of an error, which would be zero if all were as expected."""
        return cls(name, subject, error, 0.0, error, bound.value, bound.unit, against, time)

    @classmethod
    def of_difference(
        cls,
        name: str,
        subject: str,
        values: tuple[float, float],
        bound: Quantity,
        against: str = "golden",
    ) -> Measure:
        """Build the measure of two values, measured and expected, by their difference."""
        measured, expected = values
        error = abs(measured - expected)
        return cls(name, subject, measured, expected, error, bound.value, bound.unit, against)

    @property
    def passed(self) -> bool:
        """Whether the error is finite and within the tolerance."""
        return bool(self.error <= self.tolerance) and math.isfinite(self.error)

    @property
    def when(self) -> str:
        """Time of the largest error as text: ``at 1.5 s``; ``(largest at 1.5 s)`` for a mean."""
        if self.time is None:
            return ""
        at = f"at {self.time:.4g} s"
        return f"(largest {at})" if self.name.endswith("_rms") else at

    @property
    def margin(self) -> float:
        """Tolerance minus error, in ``unit``; negative where the golden fails."""
        return self.tolerance - self.error

    def to_json(self) -> dict[str, Any]:
        """Return JSON-able fields; not finite numbers become ``"nan"``, ``"inf"`` or ``"-inf"``."""
        return {key: _number_to_json(value) for key, value in asdict(self).items()}

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> Measure:
        """Build a measure from what :meth:`to_json` returned.

        Raises:
            TypeError, KeyError, ValueError: fields missing, unknown or of another type.
        """
        numbers = {name: float(fields[name]) for name in _NUMBERS if fields[name] is not None}
        return typed.build({**fields, **numbers}, cls)


@dataclass(frozen=True, slots=True)
class Reason:
    """Why a golden is stale: the changed part, its field, the old and the new value.

    Reasons without a value ('no release yet', 'dependency set changed') leave ``old`` and ``new``
    empty.
    """

    part: str
    field: str = ""
    old: str = ""
    new: str = ""

    def __str__(self) -> str:
        head = f"{self.part}: {self.field}" if self.field else self.part
        return f"{head} {self.old} -> {self.new}" if self.old or self.new else head


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one golden on one realization.

    Attributes:
        golden: id of the golden, ``golden/fk/home``.
        kind: name of the check that ran it.
        realization: its name in ``twin.yaml``.
        criticality: ``critical`` blocks a release, ``advisory`` is reported.
        status: ``passed``, ``failed`` (an error exceeds its tolerance), ``error`` (the check did
            not finish).
        measures: all values that were compared with a tolerance.
        error: one line that says why the status is ``error``.
        reasons: why the golden was stale.
        plot: path of the plot, relative to the twin's root, or None.
        diagnosis: one line that names the probable cause of a failure against a recording, or
            None.
        notes: what the result relies on and no tolerance bounds, one line each.
        seconds: wall time of the check, s.
    """

    golden: str
    kind: str
    realization: str
    criticality: str
    status: Status
    measures: tuple[Measure, ...] = ()
    error: str | None = None
    reasons: tuple[Reason, ...] = ()
    plot: str | None = None
    diagnosis: str | None = None
    notes: tuple[str, ...] = ()
    seconds: float = 0.0

    @property
    def key(self) -> str:
        """``golden@realization``: the key in a run, a report and a release."""
        return f"{self.golden}@{self.realization}"

    @property
    def worst(self) -> Measure | None:
        """The measure with the largest ratio of error to tolerance; None without measures."""
        return max(self.measures, key=tolerance_ratio, default=None)

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON-able values."""
        fields = {name: getattr(self, name) for name in self.__slots__}
        return fields | {
            "measures": [measure.to_json() for measure in self.measures],
            "reasons": [asdict(reason) for reason in self.reasons],
            "notes": list(self.notes),
        }

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> Outcome:
        """Build an outcome from what :meth:`to_json` returned.

        Raises:
            TypeError, KeyError, ValueError: fields missing, unknown or of another type.
        """
        if fields["status"] not in ("passed", "failed", "error"):
            raise ValueError(f"unknown status {fields['status']!r}")
        return cls(
            **dict(fields)
            | {
                "measures": tuple(Measure.from_json(measure) for measure in fields["measures"]),
                "reasons": tuple(Reason(**reason) for reason in fields["reasons"]),
                # Older releases have no notes.
                "notes": tuple(str(note) for note in fields.get("notes", ())),
            }
        )


def tolerance_ratio(measure: Measure) -> float:
    """Ratio of error to tolerance; infinite for an error that is not finite or exceeds zero."""
    if not math.isfinite(measure.error):
        return math.inf
    if measure.tolerance > 0:
        return measure.error / measure.tolerance
    return 0.0 if measure.error <= measure.tolerance else math.inf


def _number_to_json(value: object) -> object:
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
