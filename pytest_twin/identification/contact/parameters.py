"""Free contact parameters, their bounds, and their use in a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.contact import (
    ContactDamping,
    ContactFriction,
    ContactOffset,
    ContactStiffness,
)
from pytest_twin.realization import Realization
from pytest_twin.realization.free_body import FreeBody, copy_of_model

FRICTION, STIFFNESS, DAMPING, OFFSET = (
    ContactFriction.id, ContactStiffness.id, ContactDamping.id, ContactOffset.id,
)  # fmt: skip
TORSIONAL, ROLLING = "contact_torsional_friction", "contact_rolling_friction"
UNITS: Mapping[str, str] = {
    FRICTION: "1", STIFFNESS: "1/s^2", DAMPING: "1/s", OFFSET: "m", TORSIONAL: "m", ROLLING: "m",
}  # fmt: skip
_SIZES = {
    int(mujoco.mjtGeom.mjGEOM_BOX): 3,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): 3,
    int(mujoco.mjtGeom.mjGEOM_SPHERE): 1,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): 2,
}
"""Shape -> number of leading sizes to increase for an outward offset of the surface."""
_OFFSET_SHARE = 0.2
"""Range of the offset, as a fraction of the smallest half size."""


@dataclass(frozen=True)
class Parameter:
    """One free parameter, searched on a scale from 0 to 1.

    Attributes:
        name: a key of ``UNITS``.
        low, high: bounds in its unit.
        is_logarithmic: whether the scale is logarithmic.
    """

    name: str
    low: float
    high: float
    start: float
    is_logarithmic: bool = True

    def value(self, place: float) -> float:
        """Return the value at a position on the scale."""
        if self.is_logarithmic:
            return float(self.low * (self.high / self.low) ** place)
        return float(self.low + (self.high - self.low) * place)

    def place(self, value: float) -> float:
        """Return the position of a value on the scale, clipped to 0 to 1."""
        if self.is_logarithmic:
            share = np.log(max(value, 1e-300) / self.low) / np.log(self.high / self.low)
        else:
            share = (value - self.low) / (self.high - self.low)
        return float(np.clip(share, 0.0, 1.0))

    def slope(self, place: float) -> float:
        """Return the derivative of the value by the position on the scale."""
        if self.is_logarithmic:
            return float(self.value(place) * np.log(self.high / self.low))
        return float(self.high - self.low)


@dataclass(frozen=True)
class ContactModel:
    """A model whose free body has contact parameters of its own.

    All geoms of the body that can collide get the same friction, stiffness and damping. Their
    ``priority`` is higher than that of other geoms, so the contact pair uses their parameters. If
    the model declares contact pairs of the body, these pairs get the parameters instead, and all
    other contacts keep those of the model.

    Attributes:
        parameters: free parameters.
        fixed: fixed parameters -> value.
    """

    model: mujoco.MjModel
    body: FreeBody
    parameters: tuple[Parameter, ...]
    fixed: Mapping[str, float]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(one.name for one in self.parameters)

    @property
    def size(self) -> float:
        """Mean distance of the body's surface from its centre along its axes, m."""
        return float(np.mean([_half_size(self.model, geom) for geom in self.body.geoms]))

    def start(self) -> FloatArray:
        """Positions of the nominal values on the scales."""
        return np.array([one.place(one.start) for one in self.parameters])

    def values(self, places: FloatArray) -> dict[str, float]:
        """Return the free parameters at positions on their scales."""
        pairs = zip(self.parameters, places, strict=True)
        return {one.name: one.value(float(place)) for one, place in pairs}

    def without(self, names: Sequence[str], values: Mapping[str, float]) -> ContactModel:
        """Return the contact model with some parameters fixed."""
        kept = tuple(one for one in self.parameters if one.name not in names)
        given = {**self.fixed, **{name: values[name] for name in names}}
        return replace(self, parameters=kept, fixed=given)

    def at(self, values: Mapping[str, float]) -> mujoco.MjModel:
        """Return the model with contact parameters; missing ones are fixed or nominal values."""
        return with_contact_parameters(self.model, self.body, {**self.fixed, **values})

    def with_options(self, change: Mapping[str, Any]) -> ContactModel:
        """Return the contact model with other simulation options (``timestep``, ``cone``, ...)."""
        model = copy_of_model(self.model)
        for name, value in change.items():
            setattr(model.opt, name, value)
        return replace(self, model=model)


def contact_model(realization: Realization, body: FreeBody) -> ContactModel:
    """Return the contact model of a body, with nominal values from its model."""
    model = realization.model
    friction, stiffness, damping = _nominal(model, body)
    step = float(model.opt.timestep)
    parameters = [
        Parameter(FRICTION, 0.01, 3.0, friction),
        # The bounds exclude springs faster than the time step and springs slower than a bounce.
        Parameter(STIFFNESS, 100.0, 1.0 / step**2, stiffness),
        Parameter(DAMPING, 0.5, 2.0 / step, damping),
    ]
    if all(int(model.geom_type[g]) in _SIZES for g in body.geoms):
        most = _OFFSET_SHARE * min(_half_size(model, g) for g in body.geoms)
        parameters.append(Parameter(OFFSET, -most, most, 0.0, is_logarithmic=False))
    return ContactModel(model, body, tuple(parameters), {})


def _nominal(model: mujoco.MjModel, body: FreeBody) -> tuple[float, float, float]:
    """Return friction, stiffness and damping of the model's contact."""
    if body.pairs:
        pair = body.pairs[0]
        return float(model.pair_friction[pair, 0]), *direct_solref_of_pair(model, pair)
    geom = body.geoms[0]
    mine = int(max(model.geom_priority[g] for g in body.geoms))
    theirs = max(body.others, key=lambda g: int(model.geom_priority[g]))
    friction = float(model.geom_friction[geom, 0])
    if mine == int(model.geom_priority[theirs]):
        friction = max(friction, float(model.geom_friction[theirs, 0]))
    return friction, *direct_solref(model, geom)


def direct_solref(model: mujoco.MjModel, geom: int) -> tuple[float, float]:
    """Stiffness (1/s^2) and damping (1/s) of a geom's ``solref``, in MuJoCo's direct form.

    ``k = 1 / (dmax timeconst dampratio)^2``, ``b = 2 / (dmax timeconst)`` (MuJoCo's documentation,
    Solver parameters). The engine limits the time constant to at least two steps.
    """
    return _direct(model, model.geom_solref[geom], float(model.geom_solimp[geom, 1]))


def direct_solref_of_pair(model: mujoco.MjModel, pair: int) -> tuple[float, float]:
    """Stiffness (1/s^2) and damping (1/s) of a declared pair, as :func:`direct_solref`."""
    return _direct(model, model.pair_solref[pair], float(model.pair_solimp[pair, 1]))


def _direct(model: mujoco.MjModel, solref: FloatArray, most: float) -> tuple[float, float]:
    first, second = (float(v) for v in solref)
    if first <= 0.0:
        return -first / most**2, -second / most
    first = max(first, 2.0 * float(model.opt.timestep))
    return 1.0 / (most * first * second) ** 2, 2.0 / (most * first)


def with_contact_parameters(
    model: mujoco.MjModel, body: FreeBody, values: Mapping[str, float]
) -> mujoco.MjModel:
    """Return a copy of a model with contact parameters on its free body or its declared pairs."""
    found = copy_of_model(model)
    for geom in body.geoms:
        patch = geom_patch(model, body, geom, values)
        for name, value in patch.items():
            getattr(found, f"geom_{name}")[geom] = value
        if "size" in patch:
            half = _box(model, geom, np.array(patch["size"]))
            found.geom_aabb[geom, 3:] = half
            found.geom_rbound[geom] = float(np.linalg.norm(half))
    for pair in body.pairs:
        for name, value in pair_patch(model, pair, values).items():
            getattr(found, f"pair_{_PAIR_FIELDS.get(name, name)}")[pair] = value
    return found


_PAIR_FIELDS = {"condim": "dim"}
"""Attribute of a pair in MJCF -> its field in a compiled model, where the names differ."""


def geom_patch(
    model: mujoco.MjModel, body: FreeBody, geom: int, values: Mapping[str, float]
) -> dict[str, Any]:
    """Return the attributes of a geom for contact parameters, in the form of ``fit:`` of a twin.

    If the model declares contact pairs, only the offset of the surface belongs to the geom.
    """
    patch: dict[str, Any] = {}
    if not body.pairs:
        friction = np.array(model.geom_friction[geom], dtype=float)
        friction[0] = values.get(FRICTION, friction[0])
        friction[1] = values.get(TORSIONAL, friction[1])
        friction[2] = values.get(ROLLING, friction[2])
        most = float(model.geom_solimp[geom, 1])
        solref = _solref(direct_solref(model, geom), most, values)
        priority = 1 + max((int(model.geom_priority[g]) for g in body.others), default=0)
        patch = {"friction": friction.tolist(), "solref": solref, "priority": priority}
        patch |= _condim(values)
    if OFFSET in values:
        size = np.array(model.geom_size[geom], dtype=float)
        size[: _SIZES[int(model.geom_type[geom])]] += values[OFFSET]
        patch["size"] = size.tolist()
    return patch


def pair_patch(model: mujoco.MjModel, pair: int, values: Mapping[str, float]) -> dict[str, Any]:
    """Return the attributes of a declared pair for contact parameters, as :func:`geom_patch`."""
    friction = np.array(model.pair_friction[pair], dtype=float)
    friction[:2] = values.get(FRICTION, friction[0])
    friction[2] = values.get(TORSIONAL, friction[2])
    friction[3:] = values.get(ROLLING, friction[3])
    most = float(model.pair_solimp[pair, 1])
    solref = _solref(direct_solref_of_pair(model, pair), most, values)
    return {"friction": friction.tolist(), "solref": solref, **_condim(values)}


def _solref(nominal: tuple[float, float], most: float, values: Mapping[str, float]) -> list[float]:
    """Return the direct form of ``solref``; the engine divides by dmax^2 and dmax."""
    stiffness, damping = nominal
    return [-values.get(STIFFNESS, stiffness) * most**2, -values.get(DAMPING, damping) * most]


def _condim(values: Mapping[str, float]) -> dict[str, int]:
    """Return the dimension of the contact that the given friction coefficients need."""
    if ROLLING in values:
        return {"condim": 6}
    return {"condim": 4} if TORSIONAL in values else {}


def _half_size(model: mujoco.MjModel, geom: int) -> float:
    return float(np.mean(model.geom_aabb[geom, 3:]))


def _box(model: mujoco.MjModel, geom: int, size: FloatArray) -> FloatArray:
    """Half sizes of the box around a geom, m."""
    kind = int(model.geom_type[geom])
    if kind == int(mujoco.mjtGeom.mjGEOM_SPHERE):
        return np.full(3, size[0])
    if kind == int(mujoco.mjtGeom.mjGEOM_CYLINDER):
        return np.array([size[0], size[0], size[1]])
    return size
