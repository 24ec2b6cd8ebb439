"""Functions that compute a residual: tables of a diagnosis, an ONNX model, or a user's function."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from pytest_twin.adaptation.guard import Law
from pytest_twin.adaptation_spec import RESIDUALS, ResidualSpec
from pytest_twin.arrays import FloatArray
from pytest_twin.effects.unnamed_law import KNOTS, TABLES, UnnamedLaw
from pytest_twin.errors import SpecError
from pytest_twin.formats.paths import read_bytes
from pytest_twin.installed import entry_points_by_name, load_plugin, package_of, single_entry_point

_TABLES_BYTES = 1 << 20
"""Largest size of a file of tables; 1 MiB is far above that of any diagnosis."""
_ONNX_BYTES = 256 * 2**20
"""Largest size of an ONNX model."""


def law_of(spec: ResidualSpec) -> Law:
    """Return the function that computes a residual.

    Raises:
        SpecError: the file or entry point contains no such function.
        PathError, LimitError: the file cannot be read.
    """
    makers: Mapping[str, Callable[[ResidualSpec], Law]] = {
        "unnamed_laws": _tables,
        "onnx": _onnx,
        "function": _function,
    }
    return makers[spec.kind](spec)


def _tables(spec: ResidualSpec) -> Law:
    """Return forces from tables of a diagnosis over position, velocity or command."""
    assert spec.file is not None
    try:
        listed = json.loads(read_bytes(spec.file, _TABLES_BYTES))["effects"]
        found = [(one["joint"], one["table"]) for one in listed if one["effect"] == UnnamedLaw.id]
        tables = {joint: TABLES[UnnamedLaw.id].read_table(table) for joint, table in found}
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise SpecError(
            f"no tables of a diagnosis: {error}", path=spec.file, expected="its effects.json"
        ) from None
    missing = [joint for joint in spec.joints if joint not in tables]
    if missing:
        raise SpecError(
            "no unnamed law at a joint of the residual",
            path=spec.file,
            value=missing[0],
            expected=", ".join(map(str, tables)) or "a diagnosis with an unnamed_law",
        )
    each = [_table(tables[joint]) for joint in spec.joints]

    def law(
        position: FloatArray, velocity: FloatArray, command: FloatArray
    ) -> tuple[FloatArray, FloatArray | None]:
        inputs = (position, velocity, command)
        forces = [at(float(inputs[which][i])) for i, (which, at) in enumerate(each)]
        return np.array(forces), None

    return law


def _table(values: Mapping[str, float]) -> tuple[int, Callable[[float], float]]:
    """Return the input of a table and its function: piecewise linear, zero one interval outside."""
    knots = np.linspace(values["low"], values["high"], KNOTS)
    step = knots[1] - knots[0]
    knots = np.concatenate([[knots[0] - step], knots, [knots[-1] + step]])
    table = np.pad([values[f"value_{k:02d}"] for k in range(KNOTS)], 1)
    return int(values["variable"]), lambda at: float(np.interp(at, knots, table))


def _onnx(spec: ResidualSpec) -> Law:
    """Return the function of an ONNX model.

    The input is (1, 3 j) float32: positions, velocities and commands. The outputs are (1, j)
    forces and, optionally, (1, j) standard deviations.
    """
    assert spec.file is not None
    try:
        import onnxruntime
    except ImportError:
        raise SpecError(
            "ONNX residuals are run by onnxruntime, which is not installed",
            path=spec.file,
            expected="pip install 'pytest-twin[onnx]'",
        ) from None
    data = read_bytes(spec.file, _ONNX_BYTES)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        (given,) = session.get_inputs()
    except Exception as error:
        # The library raises its own error types for damaged files.
        words = " ".join(str(error).split())[:120]
        raise SpecError(
            f"not a residual: {words}", path=spec.file, expected="an ONNX model with one input"
        ) from None
    name, count = given.name, len(spec.joints)

    def law(
        position: FloatArray, velocity: FloatArray, command: FloatArray
    ) -> tuple[FloatArray, FloatArray | None]:
        inputs = np.concatenate([position, velocity, command]).astype(np.float32)[None]
        outputs: list[Any] = session.run(None, {name: inputs})
        each = [np.asarray(one, dtype=np.float64).ravel() for one in outputs[:2]]
        if any(len(one) != count for one in each):
            raise SpecError(
                "a residual with another number of outputs",
                path=spec.file,
                value=[len(one) for one in each],
                expected=f"{count}, one for each joint",
            )
        return each[0], each[1] if len(each) > 1 else None

    try:
        law(*np.zeros((3, count)))
    except SpecError:
        raise
    except Exception as error:
        words = " ".join(str(error).split())[:120]
        raise SpecError(
            f"the residual does not run: {words}",
            path=spec.file,
            expected=f"an input of shape (1, {3 * count}), float32",
        ) from None
    return law


def _function(spec: ResidualSpec) -> Law:
    """Return an instance of the entry point's class, which is called like :data:`Law`."""
    points = entry_points_by_name(RESIDUALS).get(spec.function or "", ())
    if not points:
        raise SpecError(
            f"no installed package provides the residual {spec.function!r}",
            where="residual.function",
            expected=f"the name of an entry point of the group {RESIDUALS}",
        )
    point = single_entry_point(points, "residual")
    function: Any = load_plugin(point, "residual")
    count = len(spec.joints)

    def law(
        position: FloatArray, velocity: FloatArray, command: FloatArray
    ) -> tuple[FloatArray, FloatArray | None]:
        try:
            force, deviation = function(position, velocity, command)
            each = [np.asarray(force, dtype=np.float64)]
            if deviation is not None:
                each.append(np.asarray(deviation, dtype=np.float64))
        except Exception as error:
            # The code of another package may raise anything.
            words = f"{type(error).__name__}: {error}"[:120]
            raise SpecError(
                f"the residual of {package_of(point)} does not run: {words}",
                where="residual.function",
                value=spec.function,
                expected="a force and its standard deviation, or None for the second",
            ) from error
        if any(one.shape != (count,) for one in each):
            raise SpecError(
                f"the residual of {package_of(point)} has another number of outputs",
                where="residual.function",
                value=[list(one.shape) for one in each],
                expected=f"{count}, one for each joint",
            )
        return each[0], each[1] if len(each) > 1 else None

    law(*np.zeros((3, count)))
    return law
