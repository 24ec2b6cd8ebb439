"""Where independent work runs: in forks of this process, or on the workers of a Dask scheduler.

The batches of a search and the robots of a fleet are run by the same call.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeVar

from pytest_twin.errors import SimulationError, TwinError
from pytest_twin.realization.forks import in_forks

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_RETRIES = 2
_CONNECT_SECONDS = 30.0


class Executor(Protocol):
    """Runs a function on items that are independent of one another."""

    def map(self, function: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
        """Results in the order of the items.

        An item whose worker dies is done again by another; what was finished stands.

        Raises:
            Exception: what the function raises.
            SimulationError: every worker that had an item died.
        """
        ...


@dataclass(frozen=True, slots=True)
class Forks:
    """Forks of this process, which have all that it has in memory.

    Attributes:
        processes: at most, this one among them.
    """

    processes: int

    def map(self, function: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
        """As :meth:`Executor.map`; whoever is done takes the next item, the longest should be
        first.
        """
        return in_forks([partial(function, item) for item in items], self.processes)


@dataclass(frozen=True, slots=True)
class Dask:
    """Workers of a Dask scheduler (extra ``dask``), each with pytest-twin of this version.

    Attributes:
        address: of the scheduler, ``tcp://host:8786``.
    """

    address: str

    def map(self, function: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
        """As :meth:`Executor.map`; function, items and results travel by pickle.

        Raises:
            TwinError: Dask is not installed, or nothing answers at the address.
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
            try:
                return list(client.gather(futures))
            except dask.KilledWorker as error:
                raise SimulationError(
                    "every Dask worker that had this item died",
                    where="--scheduler",
                    value=str(error),
                    expected="workers with enough memory; see their logs",
                ) from None
