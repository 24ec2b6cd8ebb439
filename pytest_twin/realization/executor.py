"""Run independent tasks in forked processes, or on the workers of a Dask scheduler.

A search runs its batches, and a fleet its robots, with the same call.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeVar

from pytest_twin.errors import SimulationError, TwinError
from pytest_twin.interrupts import StopRequest
from pytest_twin.realization.forks import in_forks

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_RETRIES = 2
"""Number of times that Dask repeats a failed task."""
_LOOK_SECONDS = 0.5
"""Time between two looks at a stop request."""
_CONNECT_SECONDS = 30.0
"""Time limit of the connection to the scheduler."""


class Executor(Protocol):
    """Runs a function on independent items."""

    def map(self, function: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
        """Run ``function`` on each item; the results are in the order of the items.

        An item whose worker dies is run again on another worker; finished results are kept.

        Raises:
            Exception: an exception of the function.
            SimulationError: each worker that ran an item died.
        """
        ...


@dataclass(frozen=True, slots=True)
class Forks:
    """Runs items in forks of this process, which share its memory.

    Attributes:
        processes: largest number of processes, including this one.
    """

    processes: int

    def map(self, function: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
        """As :meth:`Executor.map`; each process that becomes free takes the next item.

        The run is shortest when the longest items come first.
        """
        return in_forks([partial(function, item) for item in items], self.processes)


@dataclass(frozen=True, slots=True)
class Dask:
    """Runs items on the workers of a Dask scheduler (extra ``dask``).

    The workers need the same version of pytest-twin.

    Attributes:
        address: address of the scheduler, ``tcp://host:8786``.
        stop: request after which items that are not done run in this process.
    """

    address: str
    stop: StopRequest | None = None

    def map(self, function: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
        """As :meth:`Executor.map`; function, items and results are sent with pickle.

        Raises:
            TwinError: Dask is not installed, or no scheduler answers at the address.
        """
        try:
            dask: Any = importlib.import_module("distributed")
        except ImportError:
            raise TwinError(
                "Dask is not installed",
                where="--scheduler",
                value=self.address,
                expected="pip install 'pytest-twin[dask]'",
            ) from None
        try:
            client = dask.Client(self.address, timeout=_CONNECT_SECONDS)
        except (OSError, ValueError) as error:
            raise TwinError(
                f"no Dask scheduler answers: {error}",
                where="--scheduler",
                value=self.address,
                expected="the address that `dask scheduler` prints, tcp://host:8786",
            ) from None
        with client:
            futures = client.map(function, items, pure=False, retries=_RETRIES)
            while self.stop is None or not self.stop.is_sent:
                with contextlib.suppress(TimeoutError):
                    dask.wait(futures, timeout=_LOOK_SECONDS)
                    break
            done = [future.done() for future in futures]
            client.cancel([f for f, is_done in zip(futures, done, strict=True) if not is_done])
            try:
                return [
                    future.result() if is_done else function(item)
                    for future, is_done, item in zip(futures, done, items, strict=True)
                ]
            except dask.KilledWorker as error:
                raise SimulationError(
                    "every Dask worker that ran this task ended",
                    where="--scheduler",
                    value=str(error),
                    expected="workers with enough memory; see their logs",
                ) from None
