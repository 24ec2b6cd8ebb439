"""Base class of checks. A new kind of golden is one class and one entry point."""

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
    """Reason why ``init`` proposes no golden of a kind, such as ``no joint takes a command``."""


@dataclass(frozen=True, slots=True)
class Observation:
    """Result of a stimulus on a realization.

    Attributes:
        values: results as JSON data (lists, not arrays), SI units.
        trace: time or frequency series, or None.
        reference: results of an independent computation (Pinocchio, coal) with keys of
            ``values``; empty without one.
        against: series to plot with ``trace`` if it is compared with a recording instead of a
            stored trace, else None.
        notes: what the result relies on and no tolerance bounds, one line each, for terminal,
            report and release.
    """

    values: Mapping[str, Any]
    trace: Trace | None = None
    reference: Mapping[str, Any] = field(default_factory=dict)
    against: Trace | None = None
    notes: tuple[str, ...] = ()


class Check(ABC):
    """One kind of golden.

    The modules of checks are imported while pytest collects: they import no simulator at the
    top, only where it is used.

    Class attributes:
        kind: name in the spec.
        version: increase it when a code change alters the numbers of an unchanged spec.
        libraries: distributions whose version affects the result.
        tolerances: name -> SI unit of the tolerance.
        required_tolerances: tolerances that a spec must state.
        schema: JSON Schema of ``target`` and ``stimulus``, as ``{"target": {}, "stimulus": {}}``.
        simulators: what can compute it; a realization on another is an error.
        needs_record: whether a golden compares with values that ``--twin-update`` wrote. A kind
            that compares with measured data alone runs, and is released, without them.
        recorded: whether goldens compare a realization with a recording, ``target.recording``.
            ``trial`` then reads it, and a failure can be diagnosed.
        dynamic: whether goldens compare motions or efforts over time, which need masses, friction
            and drives. A release without any says so.
    """

    kind: ClassVar[str]
    version: ClassVar[int] = 1
    libraries: ClassVar[tuple[str, ...]] = ("numpy",)
    tolerances: ClassVar[Mapping[str, str]]
    required_tolerances: ClassVar[frozenset[str]] = frozenset()
    schema: ClassVar[Mapping[str, Any]]
    simulators: ClassVar[tuple[Simulator, ...]] = ("mujoco",)
    needs_record: ClassVar[bool] = True
    recorded: ClassVar[bool] = False
    dynamic: ClassVar[bool] = False

    @abstractmethod
    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return ids of the realization's parts that can affect the result (see ``Structure``)."""

    @abstractmethod
    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Run the stimulus on a realization, deterministically.

        Raises:
            SpecError: the spec names an element that the realization lacks.
            SimulationError: the simulation diverged.
        """

    @abstractmethod
    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare an observation with the golden's values, trace and declarations; pure."""

    def trial(self, golden: Golden, realization: Realization) -> Trial:
        """Return the golden's recording as a trial; only for kinds that are ``recorded``.

        Raises:
            SpecError, RecordingError: the recording is missing or cannot be used.
        """
        raise NotImplementedError(self.kind)

    def expect(
        self, golden: Golden, observation: Observation
    ) -> tuple[Mapping[str, Any], Trace | None]:
        """Return what ``--twin-update`` writes: the spec's ``expected`` and its trace file."""
        return observation.values, observation.trace

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Return specs of this kind that ``pytest-twin init`` proposes for a robot.

        Each spec lacks ``schema`` and ``kind`` and has a ``name``: its subject, such as a joint,
        unique within the kind. Optional ``notes`` state what the spec omits and why; they become
        comments at the top of its file.

        Raises:
            NothingToProposeError: there is no such spec; the error has the reason.
        """
        return []
