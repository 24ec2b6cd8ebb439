"""What of a contact is free, within which bounds, and how a model takes it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.realization import Realization
from pytest_twin.realization.free_body import FreeBody, varied

FRICTION, STIFFNESS, DAMPING, OFFSET = (
    "contact_friction", "contact_stiffness", "contact_damping", "contact_offset",
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
"""Shapes whose surface is moved outwards by adding to so many sizes."""
_OFFSET_SHARE = 0.2
"""Range of the offset, in shares of the smallest half size."""


@dataclass(frozen=True)
class Parameter:
    """One free parameter, searched on a scale from 0 to 1.

    Attributes:
        name: as ``UNITS`` has it.
        low, high: bounds in its unit.
        start: the model's value.
        is_logarithmic: whether the scale is.
    """

    name: str
    low: float
    high: float
    start: float
    is_logarithmic: bool = True

    def value(self, place: float) -> float:
        """The value at a place on the scale."""
        if self.is_logarithmic:
            return float(self.low * (self.high / self.low) ** place)
        return float(self.low + (self.high - self.low) * place)

    def place(self, value: float) -> float:
        """The place of a value on the scale, within it."""
        if self.is_logarithmic:
            share = np.log(max(value, 1e-300) / self.low) / np.log(self.high / self.low)
        else:
            share = (value - self.low) / (self.high - self.low)
        return float(np.clip(share, 0.0, 1.0))

    def slope(self, place: float) -> float:
        """Change of the value by a unit of the scale."""
        if self.is_logarithmic:
            return float(self.value(place) * np.log(self.high / self.low))
        return float(self.high - self.low)


@dataclass(frozen=True)
class ContactModel:
    """A model whose free body has contact parameters of its own.

    All geoms of the body that can collide get the same friction, stiffness and damping, and go
    before what they touch (``priority``), so that the pair has them whatever the surroundings say.

    Attributes:
        model: nominal.
        body: what was tossed.
        parameters: what is free.
        fixed: parameters that are given and not free.
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
        """Places of the model's own values."""
        return np.array([one.place(one.start) for one in self.parameters])

    def values(self, places: FloatArray) -> dict[str, float]:
        """Free parameters at places on their scales."""
        pairs = zip(self.parameters, places, strict=True)
        return {one.name: one.value(float(place)) for one, place in pairs}

    def without(self, names: Sequence[str], values: Mapping[str, float]) -> ContactModel:
        """With some parameters fixed at values."""
        kept = tuple(one for one in self.parameters if one.name not in names)
        given = {**self.fixed, **{name: values[name] for name in names}}
        return replace(self, parameters=kept, fixed=given)

    def at(self, values: Mapping[str, float]) -> mujoco.MjModel:
        """The model with contact parameters; those left out are the fixed or nominal ones."""
        return written(self.model, self.body, {**self.fixed, **values})

    def with_options(self, change: Mapping[str, Any]) -> ContactModel:
        """The same under other options of the simulation (``timestep``, ``cone``, ...)."""
        model = varied(self.model)
        for name, value in change.items():
            setattr(model.opt, name, value)
        return replace(self, model=model)


def contact_model(realization: Realization, body: FreeBody) -> ContactModel:
    """The free contact parameters of a body, from the nominal values of its model."""
    model = realization.model
    geom = body.geoms[0]
    mine = int(max(model.geom_priority[g] for g in body.geoms))
    theirs = max(body.others, key=lambda g: int(model.geom_priority[g]))
    friction = float(model.geom_friction[geom, 0])
    if mine == int(model.geom_priority[theirs]):
        friction = max(friction, float(model.geom_friction[theirs, 0]))
    stiffness, damping = direct(model, geom)
    step = float(model.opt.timestep)
    parameters = [
        Parameter(FRICTION, 0.01, 3.0, friction),
        # A spring that is faster than the step, or slower than a bounce, is no contact.
        Parameter(STIFFNESS, 100.0, 1.0 / step**2, stiffness),
        Parameter(DAMPING, 0.5, 2.0 / step, damping),
    ]
    if all(int(model.geom_type[g]) in _SIZES for g in body.geoms):
        most = _OFFSET_SHARE * min(_half_size(model, g) for g in body.geoms)
        parameters.append(Parameter(OFFSET, -most, most, 0.0, is_logarithmic=False))
    return ContactModel(model, body, tuple(parameters), {})


def direct(model: mujoco.MjModel, geom: int) -> tuple[float, float]:
    """Stiffness (1/s^2) and damping (1/s) of a geom's ``solref``, in MuJoCo's direct form.

    ``k = 1 / (dmax timeconst dampratio)^2``, ``b = 2 / (dmax timeconst)`` (MuJoCo's documentation,
    Solver parameters); the time constant is at least two steps, as the engine has it.
    """
    first, second = (float(v) for v in model.geom_solref[geom])
    most = float(model.geom_solimp[geom, 1])
    if first <= 0.0:
        return -first / most**2, -second / most
    first = max(first, 2.0 * float(model.opt.timestep))
    return 1.0 / (most * first * second) ** 2, 2.0 / (most * first)


def written(model: mujoco.MjModel, body: FreeBody, values: Mapping[str, float]) -> mujoco.MjModel:
    """A copy of a model with contact parameters of its free body."""
    found = varied(model)
    first = 1 + max((int(model.geom_priority[g]) for g in body.others), default=0)
    for geom in body.geoms:
        patch = geom_patch(model, geom, values)
        found.geom_priority[geom] = first
        if "condim" in patch:
            found.geom_condim[geom] = int(patch["condim"])
        found.geom_friction[geom] = patch["friction"]
        found.geom_solref[geom] = patch["solref"]
        if "size" in patch:
            found.geom_size[geom] = patch["size"]
            half = _box(model, geom, np.array(patch["size"]))
            found.geom_aabb[geom, 3:] = half
            found.geom_rbound[geom] = float(np.linalg.norm(half))
    return found


def geom_patch(model: mujoco.MjModel, geom: int, values: Mapping[str, float]) -> dict[str, Any]:
    """Attributes of a geom under contact parameters, as ``fit:`` of a twin takes them."""
    friction = np.array(model.geom_friction[geom], dtype=float)
    friction[0] = values.get(FRICTION, friction[0])
    friction[1] = values.get(TORSIONAL, friction[1])
    friction[2] = values.get(ROLLING, friction[2])
    stiffness, damping = direct(model, geom)
    most = float(model.geom_solimp[geom, 1])
    # The engine divides by dmax^2 and dmax.
    solref = [
        -values.get(STIFFNESS, stiffness) * most**2, -values.get(DAMPING, damping) * most,
    ]  # fmt: skip
    patch: dict[str, Any] = {"friction": friction.tolist(), "solref": solref}
    if ROLLING in values:
        patch["condim"] = 6
    elif TORSIONAL in values:
        patch["condim"] = 4
    if OFFSET in values:
        size = np.array(model.geom_size[geom], dtype=float)
        size[: _SIZES[int(model.geom_type[geom])]] += values[OFFSET]
        patch["size"] = size.tolist()
    return patch


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
