"""What a twin knows of its servos before any recording: Gaussian priors of their parameters."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from pytest_twin.formats.record_fields import Z95
from pytest_twin.servos.library import PARAMETERS, Servo


@dataclass(frozen=True, slots=True)
class PriorParameter:
    """A parameter of a drive at its output shaft.

    Attributes:
        value: in ``unit``.
        unit: SI unit.
        ci95: 95 % interval around it.
    """

    value: float
    unit: str
    ci95: tuple[float, float]

    def expected_of(self, name: str) -> str:
        """What a parameter of this name must be; empty if it is."""
        unit = PARAMETERS[name][0]
        low, high = self.ci95
        if self.unit == unit and low <= self.value <= high and low < high:
            return ""
        return f"a value in {unit} inside its interval, which is wider than 0"


@dataclass(frozen=True, slots=True)
class TwinServo:
    """One entry of ``servos:`` in ``twin.yaml``.

    Attributes:
        id: name in the library.
        joints: hinges that such servos drive.
        parameters: one of ``PARAMETERS`` -> value with interval.
        law: law of the drive.
        conditions: supply, firmware gains, load and temperature under which the values hold.
        evidence: digest of the recordings from which they were identified.
    """

    id: str
    joints: tuple[str, ...]
    parameters: dict[str, PriorParameter]
    law: str = ""
    conditions: dict[str, str] = field(default_factory=dict)
    evidence: str = ""

    @classmethod
    def of(cls, servo: Servo, joints: Iterable[str]) -> TwinServo:
        """A servo of the library at some joints, with the parameters whose interval is known."""
        known: dict[str, PriorParameter] = {}
        for name, estimate in servo.drive.items():
            if len(estimate.ci95) == 2:
                low, high = estimate.ci95
                parameter = PriorParameter(estimate.value, estimate.unit, (max(low, 0.0), high))
                if not parameter.expected_of(name):
                    known[name] = parameter
        return cls(
            servo.id, tuple(joints), known, servo.law, servo.conditions,
            servo.evidence.get("digest", ""),
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class ParameterPrior:
    """A normal distribution of one parameter of one drive.

    Attributes:
        servo: id of the servo.
        joint: its joint.
        parameter: one of ``PARAMETERS``.
        value: mean, in ``unit``.
        ci95: interval that the servo states. The distribution is as wide as its longer side, since
            an interval that was found for several servos need not be symmetric.
    """

    servo: str
    joint: str
    parameter: str
    value: float
    unit: str
    ci95: tuple[float, float]

    @property
    def deviation(self) -> float:
        """Standard deviation, in ``unit``."""
        return max(self.ci95[1] - self.value, self.value - self.ci95[0]) / Z95


def priors_of(servos: Iterable[TwinServo]) -> Iterator[ParameterPrior]:
    """The priors of all joints with a servo."""
    for servo in servos:
        for joint in servo.joints:
            for name, known in servo.parameters.items():
                yield ParameterPrior(servo.id, joint, name, known.value, known.unit, known.ci95)


def contents_of(servos: Iterable[TwinServo]) -> Mapping[str, dict[str, list[float]]]:
    """Joint -> parameter -> value and ends of its interval."""
    found: dict[str, dict[str, list[float]]] = {}
    for prior in priors_of(servos):
        known = found.setdefault(prior.joint, {})
        known[f"{prior.parameter} [{prior.unit}]"] = [prior.value, *prior.ci95]
    return found


__all__ = ["ParameterPrior", "PriorParameter", "TwinServo", "contents_of", "priors_of"]
