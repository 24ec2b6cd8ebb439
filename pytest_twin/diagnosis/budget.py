"""What a diagnosis may spend: one budget of time and of simulations for all of its searches.

Work is counted in simulations of all data: the steps that were asked for, divided by the steps of
one simulation of all recordings. Unlike seconds, it is the same on every machine.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from pytest_twin.diagnosis.deadline import CHECK, OutOfTime, no_bound
from pytest_twin.diagnosis.problem import Problem

RESERVED, LAST = 0.2, 0.1
"""Shares of the time: kept for what follows the search (final parameters, intervals, test
recordings, the report), and of that for what follows the final parameters. Of six joints on two
cores, imports, reading and the report take 8 to 10 s."""
STRETCH = 5.0
"""Times its own time that a diagnosis may take where other programs hold the processors."""
MOST_SIMULATIONS = 1200
"""Simulations of all data that all searches of a diagnosis may take together: four times what one
search may take. A case with one joint takes 170 to 830."""


def computing_seconds() -> float:
    """s of all processors that this process and its ended children have used."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


class Budget:
    """Time and simulations of one diagnosis.

    Args:
        seconds: wall-clock time from now on for the whole diagnosis; 0 for as long as it takes.
        simulations: of all data, for all searches.
        clock: seconds, monotonic.
        own_time: whether time in which other programs hold the processors is not counted, up to
            ``STRETCH`` times ``seconds``.
    """

    def __init__(
        self,
        seconds: float = 0.0,
        simulations: float = MOST_SIMULATIONS,
        clock: Callable[[], float] = time.monotonic,
        own_time: bool = False,
    ) -> None:
        self.seconds = seconds
        self.own_time = own_time
        self.simulations = simulations
        self.stopped = False
        self.problems: list[Problem] = []
        self._clock = clock
        self._start, self._start_computing = clock(), computing_seconds()
        self._apart = 0.0
        self._most = simulations

    def add(self, problem: Problem) -> None:
        """Count the work of one more problem."""
        if not any(problem is p for p in self.problems):
            self.problems.append(problem)

    def stop(self) -> None:
        """Let the search end at the next simulation, as if its time were over."""
        self.stopped = True

    @property
    def elapsed(self) -> float:
        """s since the start."""
        wall = self._clock() - self._start
        if not self.own_time:
            return wall
        # A search is computing all the time: what is missing went to other programs.
        computing = computing_seconds() - self._start_computing
        return max(min(wall, computing), wall / STRETCH)

    @property
    def left(self) -> float:
        """s that are left of the whole diagnosis; infinite without a bound."""
        return max(self.seconds - self.elapsed, 0.0) if self.seconds else float("inf")

    @property
    def out_of_time(self) -> bool:
        """Whether the search has to end: its share of the time is over, or it was stopped."""
        over = bool(self.seconds) and self.elapsed > (1.0 - RESERVED) * self.seconds
        return self.stopped or over

    @property
    def work(self) -> float:
        """Simulations of all data so far, with those that find where segments start."""
        return sum((p.stepped + p.in_starts) / p.once for p in self.problems)

    @property
    def spent(self) -> bool:
        """Whether all searches together have used their simulations, or those of :meth:`part`."""
        return self._searched > self._most

    @contextmanager
    def part(self, share: float) -> Iterator[None]:
        """Searches inside may take a share of the simulations that are left."""
        most = self._most
        self._most = self._searched + share * max(most - self._searched, 0.0)
        try:
            yield
        finally:
            self._most = most

    @property
    def _searched(self) -> float:
        return self._stepped - self._apart

    @property
    def _stepped(self) -> float:
        return sum(p.stepped / p.once for p in self.problems)

    @contextmanager
    def searching(self) -> Iterator[None]:
        """Simulations inside raise :class:`OutOfTime` once the search has to end."""
        token = CHECK.set(self._check)
        try:
            yield
        finally:
            CHECK.reset(token)

    @contextmanager
    def fitting(self) -> Iterator[None]:
        """Simulations inside raise :class:`OutOfTime` where only the last share of time is left."""
        token = CHECK.set(self._check_last)
        try:
            yield
        finally:
            CHECK.reset(token)

    @contextmanager
    def reserved(self) -> Iterator[None]:
        """Simulations inside run to their end: they use the reserved time."""
        token = CHECK.set(no_bound)
        try:
            yield
        finally:
            CHECK.reset(token)

    @contextmanager
    def apart(self) -> Iterator[None]:
        """Simulations inside are no search over effects: they have bounds of their own."""
        before = self._stepped
        try:
            yield
        finally:
            self._apart += self._stepped - before

    def _check(self) -> None:
        if self.out_of_time:
            raise OutOfTime

    def _check_last(self) -> None:
        if self.seconds and self.elapsed > (1.0 - LAST) * self.seconds:
            raise OutOfTime
