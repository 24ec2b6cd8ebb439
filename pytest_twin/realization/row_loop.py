"""Step rows of simulations one after another, where MuJoCo has no ``mujoco.batch`` (before 3.17).

The rows of :class:`RowLoop` move as those of ``mujoco.batch.Batch``, bit for bit, and stop where
they stop. It has the part of its interface that this package uses.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray

_CTRL = int(mujoco.mjtState.mjSTATE_CTRL)
_STATE = frozenset(
    {
        *("time", "qpos", "qvel", "act", "qacc_warmstart", "ctrl", "qfrc_applied", "xfrc_applied"),
        *("eq_active", "mocap_pos", "mocap_quat", "userdata", "plugin_state", "history"),
    }
)
"""Fields that a row starts from; all others are results."""


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
        self._bound: dict[str, NDArray[Any]] = {}
        self._fields: dict[str, NDArray[Any]] = {}
        self._scratch: mujoco.MjData | None = None
        self._errors = [""] * nsim
        self.warning = np.zeros((nsim, len(self._data[0].warning.number), 2), dtype=np.int32)

    def set_models(self, models: Sequence[mujoco.MjModel]) -> None:
        """Give each row a model of the same layout."""
        self._models = list(models)
        self._data = [mujoco.MjData(model) for model in models]

    def expand(self, name: str) -> NDArray[Any]:
        """(rows, ...) values of a model field, to be written; ``opt.NAME`` is a field of options.

        The rows keep sharing one copy of the model, into which the values of a row are written
        before it is stepped: a copy for each row would repeat its meshes.
        """
        if not self._fields:
            self._models = [copy.copy(self._models[0])] * len(self._data)
        if name not in self._fields:
            values = np.array(_field(self._models[0], name))
            self._fields[name] = np.array([values] * len(self._data))
        return self._fields[name]

    def set_const(self) -> None:
        """Derive the constants of each row's model from its fields, now and before each call."""
        self._scratch = mujoco.MjData(self._models[0])

    def bind(self, name: str) -> NDArray[Any]:
        """(rows, ...) values of a field of the data, which follow each call.

        Those of a state field may be written; rows start from them.
        """
        if name not in self._bound:
            self._bound[name] = np.array([getattr(data, name) for data in self._data])
        return self._bound[name]

    def error(self, row: int) -> str:
        """Message of the error that a row raised in its last call, or ''."""
        return self._errors[row]

    def forward(self, ids: Iterable[int] | None = None, stage: int = 0) -> None:
        """Compute the results of the state of rows, whichever ``stage`` would suffice.

        Raises:
            RowError: MuJoCo raised in some rows.
        """
        self._each(ids, lambda at, row: mujoco.mj_forward(self._models[row], self._data[row]))

    def step(self, ids: Iterable[int] | None = None) -> None:
        """Step rows once.

        Raises:
            RowError: MuJoCo raised in some rows.
        """
        self._each(ids, lambda at, row: mujoco.mj_step(self._models[row], self._data[row]))

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
        rows = len(self._data) if ids is None else len(ids)
        if out is None:
            out = {item: self._empty(item, rows, nstep) for item in record}

        def roll(at: int, row: int) -> None:
            records = {item: out[item][at] for item in record}
            self._roll(row, control[at], control_spec, records)

        self._each(ids, roll)
        return out

    def _each(self, ids: Iterable[int] | None, act: Callable[[int, int], None]) -> None:
        """Call ``act`` with the position and number of each row, between its fields and results."""
        failed = []
        for at, row in enumerate(range(len(self._data)) if ids is None else ids):
            model, data = self._models[row], self._data[row]
            for name, values in self._fields.items():
                _write(model, name, values[row])
            try:
                if self._scratch is not None:
                    mujoco.mj_setConst(model, self._scratch)
                for name, values in self._bound.items():
                    if name in _STATE:
                        _write(data, name, values[row])
                act(at, row)
                self._errors[row] = ""
            except mujoco.FatalError as error:
                self._errors[row] = str(error)
                failed.append(row)
            for name, values in self._bound.items():
                values[row] = getattr(data, name)
            self.warning[row, :, 0] = data.warning.lastinfo
            self.warning[row, :, 1] = data.warning.number
        if failed:
            raise RowError(failed, self._errors[failed[0]])

    def _empty(self, item: str | int, rows: int, steps: int) -> FloatArray:
        if isinstance(item, str):
            return np.empty((rows, steps, *np.shape(getattr(self._data[0], item))))
        return np.empty((rows, steps, mujoco.mj_stateSize(self._models[0], int(item))))

    def _roll(
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


def _field(model: mujoco.MjModel, name: str) -> Any:
    return getattr(model.opt, name[4:]) if name.startswith("opt.") else getattr(model, name)


def _write(owner: mujoco.MjModel | mujoco.MjData, name: str, value: Any) -> None:
    if name.startswith("opt."):
        owner, name = owner.opt, name[4:]
    if np.ndim(value):
        getattr(owner, name)[:] = value
    else:
        setattr(owner, name, value)
