"""What came of one golden: numbers against tolerances, and why it ran. No simulator, no files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

Status = Literal["passed", "failed", "error"]


@dataclass(frozen=True, slots=True)
class Measure:
    """One number compared with its tolerance.

    Attributes:
        name: what was measured, a key of the golden's ``tolerance``.
        subject: the joint, frame, pair or sample that it belongs to.
        measured, golden: values in ``unit``; ``golden`` is the stored or reference value.
        error: what the tolerance bounds, in ``unit``, not negative; NaN never passes.
        tolerance: bound on ``error``, in ``unit``.
        unit: SI unit.
        against: ``golden``, ``pinocchio``, ``coal``, ``declared`` or ``recording``.
        time: when the worst sample was, in s, or None; of a mean (``..._rms``) the sample that
            adds most to it.
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

    @property
    def passed(self) -> bool:
        """Whether the error is finite and within the tolerance."""
        return bool(self.error <= self.tolerance) and math.isfinite(self.error)

    @property
    def when(self) -> str:
        """``at 1.5 s``; of a mean ``(largest at 1.5 s)``; empty without a time."""
        if self.time is None:
            return ""
        at = f"at {self.time:.4g} s"
        return f"(largest {at})" if self.name.endswith("_rms") else at

    @property
    def margin(self) -> float:
        """Tolerance minus error, in ``unit``; negative is a failure."""
        return self.tolerance - self.error

    def to_json(self) -> dict[str, Any]:
        """JSON-able fields; numbers that are not finite as ``"nan"``, ``"inf"``, ``"-inf"``."""
        return {key: _number_to_json(value) for key, value in asdict(self).items()}

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> Measure:
        """The inverse of ``to_json``.

        Raises:
            TypeError, KeyError, ValueError: fields missing, unknown or of another type.
        """
        time = fields["time"]
        return cls(
            name=str(fields["name"]),
            subject=str(fields["subject"]),
            measured=float(fields["measured"]),
            golden=float(fields["golden"]),
            error=float(fields["error"]),
            tolerance=float(fields["tolerance"]),
            unit=str(fields["unit"]),
            against=str(fields["against"]),
            time=None if time is None else float(time),
        )


@dataclass(frozen=True, slots=True)
class Reason:
    """Why a golden is stale: a part that changed, the field in it, its value then and now.

    'no release yet' and 'dependency set changed' use ``part`` and ``field`` alone.
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
    """One golden on one realization.

    Attributes:
        golden: id of the golden, ``golden/fk/home``.
        kind: the check that ran it.
        realization: its name in ``twin.yaml``.
        criticality: ``critical`` blocks a release, ``advisory`` is reported.
        status: ``passed``, ``failed`` (a tolerance was left), ``error`` (no comparison came about).
        measures: every number that was compared with a tolerance.
        error: one line, what went wrong, for ``error``.
        reasons: why it was stale.
        plot: path of the plot, relative to the twin's root, or None.
        diagnosis: one line, what a failure against a recording looks like, or None.
        seconds: wall time that it took.
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
    seconds: float = 0.0

    @property
    def key(self) -> str:
        """``golden@realization``: what a run, a report and a release know it by."""
        return f"{self.golden}@{self.realization}"

    @property
    def worst(self) -> Measure | None:
        """The measure that used most of its tolerance, None without measures."""
        return max(self.measures, key=use_of_tolerance, default=None)

    def to_json(self) -> dict[str, Any]:
        """JSON-able fields."""
        fields = {name: getattr(self, name) for name in self.__slots__}
        return fields | {
            "measures": [measure.to_json() for measure in self.measures],
            "reasons": [asdict(reason) for reason in self.reasons],
        }

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> Outcome:
        """The inverse of ``to_json``.

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
            }
        )


def use_of_tolerance(measure: Measure) -> float:
    """Error over tolerance, 1 at the limit; infinite where no number or nothing is allowed."""
    if not math.isfinite(measure.error):
        return math.inf
    if measure.tolerance > 0:
        return measure.error / measure.tolerance
    return 0.0 if measure.error <= measure.tolerance else math.inf


def _number_to_json(value: object) -> object:
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
