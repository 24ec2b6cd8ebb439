"""Step rows of simulations one after another, where MuJoCo has no ``mujoco.batch`` (before 3.17).

The rows of :class:`RowLoop` move as those of ``mujoco.batch.Batch``, bit for bit, and stop where
they stop. It has the part of its interface that needs no parameters of the model for each row.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray

_CTRL = int(mujoco.mjtState.mjSTATE_CTRL)


class RowError(RuntimeError):
    """MuJoCo raised in rows ``ids`` of a call; the other rows were stepped."""

    def __init__(self, ids: Sequence[int], message: str) -> None:
        self.ids = list(ids)
        super().__init__(message)


class RowLoop:
    """Simulations that are stepped one after another.

    Args:
        model: the model of all rows.
        nsim: number of rows.

    Attributes:
        warning: (rows, kinds, 2) last index and number of each warning.
    """

    def __init__(self, model: mujoco.MjModel, nsim: int, _nthread: int = 0) -> None:
        self._models = [model] * nsim
        self._data = [mujoco.MjData(model) for _ in range(nsim)]
        self._initial: dict[str, NDArray[Any]] = {}
        self._errors = [""] * nsim
        self.warning = np.zeros((nsim, len(self._data[0].warning.number), 2), dtype=np.int32)

    def set_models(self, models: Sequence[mujoco.MjModel]) -> None:
        """Give each row a model of the same layout."""
        self._models = list(models)
        self._data = [mujoco.MjData(model) for model in models]

    def bind(self, name: str) -> NDArray[Any]:
        """(rows, ...) values of a field at the start of the first rollout, to be written."""
        if name not in self._initial:
            values = [getattr(data, name) for data in self._data]
            self._initial[name] = np.array(values)
        return self._initial[name]

    def error(self, row: int) -> str:
        """Message of the error that a row raised in its last call, or ''."""
        return self._errors[row]

    def rollout(
        self,
        nstep: int,
        control: FloatArray,
        control_spec: int = _CTRL,
        record: Sequence[str | int] = ("qpos",),
        ids: Sequence[int] | None = None,
        out: dict[Any, FloatArray] | None = None,
    ) -> dict[Any, FloatArray]:
        """Step rows ``nstep`` times with (rows, nstep, n) controls, and record after each step.

        A row with a new warning is not stepped further: its records repeat the last ones.

        Raises:
            RowError: MuJoCo raised in some rows.
        """
        for name, values in self._initial.items():
            for data, value in zip(self._data, values, strict=True):
                if np.ndim(value):
                    getattr(data, name)[:] = value
                else:
                    setattr(data, name, value)
        self._initial = {}
        rows = range(len(self._data)) if ids is None else ids
        if out is None:
            out = {item: self._empty(item, len(rows), nstep) for item in record}
        failed = []
        for at, row in enumerate(rows):
            records = {item: out[item][at] for item in record}
            try:
                self._step(row, control[at], control_spec, records)
                self._errors[row] = ""
            except mujoco.FatalError as error:
                self._errors[row] = str(error)
                failed.append(row)
        if failed:
            raise RowError(failed, self._errors[failed[0]])
        return out

    def _empty(self, item: str | int, rows: int, steps: int) -> FloatArray:
        if isinstance(item, str):
            return np.empty((rows, steps, *np.shape(getattr(self._data[0], item))))
        return np.empty((rows, steps, mujoco.mj_stateSize(self._models[0], int(item))))

    def _step(
        self, row: int, control: FloatArray, spec: int, records: dict[str | int, FloatArray]
    ) -> None:
        model, data = self._models[row], self._data[row]
        warnings = data.warning.number.copy()
        for k, inputs in enumerate(control):
            mujoco.mj_setState(model, data, inputs, spec)
            mujoco.mj_step(model, data)
            for item, array in records.items():
                if isinstance(item, str):
                    array[k] = getattr(data, item)
                else:
                    mujoco.mj_getState(model, data, array[k], int(item))
            if (data.warning.number > warnings).any():
                for array in records.values():
                    array[k + 1 :] = array[k]
                break
        self.warning[row, :, 0] = data.warning.lastinfo
        self.warning[row, :, 1] = data.warning.number
