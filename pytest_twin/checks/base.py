"""What a kind of golden is made of. A new kind is one class and one entry point."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from pytest_twin.arrays import FloatArray
from pytest_twin.dependency import Structure
from pytest_twin.errors import SpecError
from pytest_twin.golden import Golden
from pytest_twin.outcome import Measure
from pytest_twin.trace import Trace
from pytest_twin.twin import Simulator

if TYPE_CHECKING:
    from pytest_twin.realization import Realization
    from pytest_twin.trial import Trial

__all__ = [
    "Check",
    "FloatArray",
    "Measure",
    "NothingToProposeError",
    "Observation",
    "Progress",
    "Trace",
]

Progress = Callable[[float], None]
"""Called with the fraction done, 0 to 1, by checks that take long."""


class NothingToProposeError(SpecError):
    """Why ``init`` proposes no golden of a kind for a robot: ``no joint takes a command``."""


@dataclass(frozen=True, slots=True)
class Observation:
    """What a stimulus brought out of a realization.

    Attributes:
        values: JSON-able results; lists, not arrays; SI units.
        trace: series, where the kind has them.
        reference: results of the independent computation (Pinocchio, coal), same keys as
            ``values``, where the kind has one.
        against: series that ``trace`` is compared with where that is no stored trace, such as a
            recording; for the plot.
    """

    values: Mapping[str, Any]
    trace: Trace | None = None
    reference: Mapping[str, Any] = field(default_factory=dict)
    against: Trace | None = None


class Check(ABC):
    """One kind of golden.

    The modules of checks are imported while pytest collects: they import no simulator at the
    top, only where it is used.

    Class attributes:
        kind: the name in the spec.
        version: raised when the same spec would give other numbers.
        libraries: distributions whose version the result depends on.
        tolerances: name -> the SI unit of the tolerance.
        required_tolerances: those that a spec must state.
        schema: JSON Schema of ``target`` and ``stimulus``, as ``{"target": {}, "stimulus": {}}``.
        simulators: what can compute it; a realization on another is an error.
        recorded: whether goldens hold a realization against a recording, ``target.recording``:
            ``trial`` then reads it, and a failure can be diagnosed.
    """

    kind: ClassVar[str]
    version: ClassVar[int] = 1
    libraries: ClassVar[tuple[str, ...]] = ("numpy",)
    tolerances: ClassVar[Mapping[str, str]]
    required_tolerances: ClassVar[frozenset[str]] = frozenset()
    schema: ClassVar[Mapping[str, Any]]
    simulators: ClassVar[tuple[Simulator, ...]] = ("mujoco",)
    recorded: ClassVar[bool] = False

    @abstractmethod
    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Ids of the realization's parts that can move the result (``Structure`` has helpers)."""

    @abstractmethod
    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Run the stimulus on a realization. Deterministic.

        Raises:
            SpecError: the spec names something that the realization lacks.
            SimulationError: the simulation diverged.
        """

    @abstractmethod
    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Hold an observation against the golden's values, trace and declarations. Pure."""

    def trial(self, golden: Golden, realization: Realization) -> Trial:
        """The recording of a golden, made usable; of kinds that are ``recorded``.

        Raises:
            SpecError, RecordingError: no such recording, or one that cannot be used.
        """
        raise NotImplementedError(self.kind)

    def expect(
        self, golden: Golden, observation: Observation
    ) -> tuple[Mapping[str, Any], Trace | None]:
        """What ``--twin-update`` writes as ``expected`` and as the trace beside the spec."""
        return observation.values, observation.trace

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """First specs of this kind that a robot can have, for ``pytest-twin init``.

        Each is a spec without ``schema`` and ``kind`` and with ``name``: what it is about, such as
        a joint; unique within the kind, any text. ``notes``, where there are some, say what was
        left out of the spec and why; they become comments at the top of its file. Empty where
        there is nothing to propose.

        Raises:
            NothingToProposeError: why there is nothing.
        """
        return []
