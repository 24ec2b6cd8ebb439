"""Write contact effects into a spec: positions, ``solref`` and friction of geoms and pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import ModelFields
from pytest_twin.effects.contact_geoms import ContactGeoms, least_time_constant
from pytest_twin.realization.mjcf import compile_spec

_MAX_NAMED = 4
"""Largest number of names in a note."""


def write_contact(
    spec: mujoco.MjSpec,
    contact: ContactGeoms,
    effect: str,
    values: Mapping[str, float],
) -> str | None:
    """Write one contact effect.

    Args:
        spec: spec that is changed in place.
        contact: geoms that the effect acts on.
        values: parameters of the effect, SI units.

    Returns:
        Description of the changed elements, or None if the spec cannot express the effect.
    """
    model = compile_spec(spec)[0]
    fields = ModelFields.neutral(np.zeros((1, 3)), 1)
    catalogue()[effect].fields(fields, {k: np.full((1, 1), v) for k, v in values.items()})
    wanted: dict[str, FloatArray] = {}

    def expand(name: str) -> FloatArray:
        wanted[name] = np.array(getattr(model, name), dtype=float)[None]
        return wanted[name]

    contact.write(expand, fields, least_time_constant(model, float(model.opt.timestep)))
    said = []
    for name, rows in wanted.items():
        kind, attribute = name.split("_")
        elements = {int(e.id): e for e in (spec.geoms if kind == "geom" else spec.pairs)}
        target, now = rows[0], getattr(model, name)
        changed = [int(i) for i in np.flatnonzero((target != now).any(axis=1))]
        for i in changed:
            if attribute == "pos":
                _move_geom(spec, elements[i], target[i] - now[i])
            else:
                _set(elements[i], attribute, target[i])
        if changed:
            said.append(f"{_names(kind, [elements[i] for i in changed])} {attribute}")
    written = compile_spec(spec)[0]
    if not all(np.allclose(getattr(written, n), rows[0], atol=1e-9) for n, rows in wanted.items()):
        return None
    return " and ".join(said)


def _set(element: Any, attribute: str, value: FloatArray) -> None:
    array = np.array(getattr(element, attribute), dtype=float)
    array[: len(value)] = value
    setattr(element, attribute, array)


def _move_geom(spec: mujoco.MjSpec, geom: Any, shift: FloatArray) -> None:
    """Move a geom by ``shift``, (3,) m in its body's frame."""
    if geom.frame is not None:
        # MJCF frames have many forms of rotation, so the compiler applies the shift.
        start = compile_spec(spec)[0].geom_pos[geom.id]
        place = np.array(geom.pos, dtype=float), np.array(geom.fromto, dtype=float)
        columns = []
        for axis in np.eye(3):
            _shift_geom(geom, axis)
            columns.append(compile_spec(spec)[0].geom_pos[geom.id] - start)
            geom.pos, geom.fromto = place
        shift = np.linalg.solve(np.stack(columns, axis=1), shift)
    _shift_geom(geom, shift)


def _shift_geom(geom: Any, shift: FloatArray) -> None:
    ends = np.array(geom.fromto, dtype=float)
    if np.isfinite(ends).all():
        geom.fromto = ends + np.tile(shift, 2)
    else:
        geom.pos = np.array(geom.pos, dtype=float) + shift


def _names(kind: str, elements: Sequence[Any]) -> str:
    names = [f"'{e.name}'" if e.name else f"number {e.id}" for e in elements]
    more = len(names) - _MAX_NAMED
    shown = ", ".join(names[:_MAX_NAMED]) + (f" and {more} more" if more > 0 else "")
    return f"{kind if len(names) == 1 else kind + 's'} {shown}"
