"""Budget of a diagnosis: time and number of simulations for all of its searches.

Work is counted in simulations of all data: the number of simulated steps, divided by the steps of
one simulation of all recordings. Unlike seconds, this number is the same on every machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from pytest_twin.diagnosis.problem import Problem
from pytest_twin.estimation.deadline import CHECK, OutOfTime, no_limit
from pytest_twin.interrupts import is_stop_requested
from pytest_twin.processor_time import processor_seconds

RESERVED_SHARE, FINAL_SHARE = 0.2, 0.1
"""Shares of the time limit: ``RESERVED_SHARE`` is kept for the steps after the search (final
parameters, intervals, test recordings, report), ``FINAL_SHARE`` for those after the final
parameters. With six joints on two cores, imports, reading and the report take 8 to 10 s."""
SEARCH_SHARE = 0.25
"""Share of the time limit that questions about the signals leave for the search."""
MAX_SIMULATIONS = 1200
"""Largest number of simulations of all data for all searches of a diagnosis: four times the limit
of one search. A case with one joint needs 60 to 270."""


class Budget:
    """Time and simulations of one diagnosis.

    Args:
        seconds: limit of the processor time of the whole diagnosis, s; 0 for no limit.
        simulations: limit of simulations of all data, for all searches together.
        clock: function that returns the processor time so far, s.
        begin: reading of the clock from which the limit counts; the present one by default.
    """

    def __init__(
        self,
        seconds: float = 0.0,
        simulations: float = MAX_SIMULATIONS,
        clock: Callable[[], float] = processor_seconds,
        begin: float | None = None,
    ) -> None:
        self.seconds = seconds
        self.simulations = simulations
        self._is_stopped = False
        self.problems: list[Problem] = []
        self._clock = clock
        self._start = clock() if begin is None else begin
        self._kept_share = 0.0
        self._limit = simulations

    def add(self, problem: Problem) -> None:
        """Count the work of one more problem."""
        if not any(problem.memory is p.memory for p in self.problems):
            self.problems.append(problem)

    def stop(self) -> None:
        """End the search at the next simulation, as if its time were over."""
        self._is_stopped = True

    @property
    def stopped(self) -> bool:
        """Whether the search was stopped here or by the parent process."""
        return self._is_stopped or is_stop_requested()

    @property
    def elapsed(self) -> float:
        """Processor time since the start, s."""
        return self._clock() - self._start

    @property
    def left(self) -> float:
        """Remaining time of the whole diagnosis, s; infinite without a limit."""
        return max(self.seconds - self.elapsed, 0.0) if self.seconds else float("inf")

    @property
    def is_out_of_time(self) -> bool:
        """Whether the search must end: its share of the time is over, or it was stopped."""
        over = (
            bool(self.seconds)
            and self.elapsed > (1.0 - RESERVED_SHARE - self._kept_share) * self.seconds
        )
        return self.stopped or over

    @property
    def was_short_of_time(self) -> bool:
        """Whether the time may have ended a search."""
        limit = (1.0 - RESERVED_SHARE - SEARCH_SHARE) * self.seconds
        return bool(self.seconds) and self.elapsed > limit

    @property
    def work(self) -> float:
        """Number of simulations of all data so far, those for free initial states included."""
        return sum(
            (p.simulated_steps + p.memory.steps_for_initial_states) / p.steps_per_simulation
            for p in self.problems
        )

    @property
    def is_spent(self) -> bool:
        """Whether the searches have used all simulations, or those of the present :meth:`part`."""
        return self._used_by_searches > self._limit

    @property
    def _used_by_searches(self) -> float:
        return self._simulations

    @property
    def _simulations(self) -> float:
        return sum(p.simulated_steps / p.steps_per_simulation for p in self.problems)

    @contextmanager
    def searching(self, kept_share: float = 0.0) -> Iterator[None]:
        """Context in which simulations raise :class:`OutOfTime` when the search must end.

        Args:
            kept_share: share of the time limit (0 to 1) that is kept for later searches.
        """
        token, before = CHECK.set(self._check), self._kept_share
        self._kept_share = kept_share
        try:
            yield
        finally:
            self._kept_share = before
            CHECK.reset(token)

    @contextmanager
    def fitting(self) -> Iterator[None]:
        """Context in which simulations raise :class:`OutOfTime` in the last ``FINAL_SHARE``."""
        token = CHECK.set(self._check_final)
        try:
            yield
        finally:
            CHECK.reset(token)

    @contextmanager
    def reserved(self) -> Iterator[None]:
        """Context in which simulations are not interrupted; they use the reserved time."""
        token = CHECK.set(no_limit)
        try:
            yield
        finally:
            CHECK.reset(token)

    def _check(self) -> None:
        if self.is_out_of_time:
            raise OutOfTime

    def _check_final(self) -> None:
        if self.seconds and self.elapsed > (1.0 - FINAL_SHARE) * self.seconds:
            raise OutOfTime
