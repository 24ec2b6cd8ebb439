"""Named parameters of an update: their values in a model, and predictions with other values.

A parameter is an attribute of a joint of the MJCF, the torque constant of a drive, or a parameter
of any other effect of the catalogue, which then acts beside the MJCF.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from pytest_twin.adaptation_spec import UpdateSpec
from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.model import AppliedEffect, PatchedModel, read_patched_model
from pytest_twin.diagnosis.patched.replay import patched_segment, predict_segments
from pytest_twin.effects import catalogue, mjcf_fields
from pytest_twin.effects.actuation import TorqueConstant
from pytest_twin.errors import SpecError
from pytest_twin.open_loop import Row, replay_rows
from pytest_twin.realization import Realization
from pytest_twin.realization.inputs import JOINT_TRANSMISSIONS
from pytest_twin.realization.patch import suggest

_DRIVE_FIELDS = ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange")
_LINEAR = (
    frozenset({int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)}),
    frozenset({int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)}),
)
"""Types of gain and bias whose effort is proportional to their parameters."""


@dataclass(frozen=True, slots=True)
class _Place:
    """Place of a parameter.

    Attributes:
        index: index of the joint in the model.
        effect: id of the effect that it belongs to.
        parameter: its name in the effect; empty where the model has it.
    """

    joint: str
    index: int
    effect: str
    parameter: str


def base_parameters(
    spec: UpdateSpec, model: mujoco.MjModel, patched: PatchedModel | None = None
) -> FloatArray:
    """(p,) parameters of a model, SI units at the joint.

    Args:
        patched: effects of the model beside its MJCF.

    Raises:
        SpecError: the model lacks a joint, no effect has such a parameter, or a value is outside
            its bounds.
    """
    values = []
    for name, (low, high) in spec.parameters.items():
        target = _place(name, model)
        value = _value(model, target, name, patched)
        least = -1.0 if target.effect == TorqueConstant.id else -np.inf
        if not least < low <= value <= high:
            raise SpecError(
                "the base model's value lies outside the bounds of the update",
                where=f"update.parameters.{name}",
                value=value,
                expected=f"bounds around it, not {low:g} to {high:g}"
                + (", and above -1" if low <= least else ""),
            )
        values.append(value)
    return np.array(values)


def predicted_positions(
    row: Row,
    names: Sequence[str],
    values: Sequence[FloatArray],
    base: Realization | None = None,
) -> list[FloatArray]:
    """Return (n, joints) positions that the encoders would read, for each vector of values.

    Args:
        row: trial with the base model.
        base: the base model with its effects; needed where effects beside the MJCF act.

    Raises:
        SimulationError: effects beside the MJCF make the simulation diverge.
    """
    places = [_place(name, row.model) for name in names]
    patched = None if base is None else read_patched_model(base)
    if base is None or (patched is None and not any(place.parameter for place in places)):
        rows = [replace(row, model=_with(row.model, names, value)) for value in values]
        return [one.position for one in replay_rows(rows, threads=1)]
    patched = replace(patched or PatchedModel(row.trial.joints), joints=row.trial.joints)
    segment = patched_segment(base, patched, row.trial)
    predicted = predict_segments(
        base, patched, row.trial,
        [replace(segment, model=_with(segment.model, names, value)) for value in values],
        variants=[_with_laws(patched, places, value) for value in values],
        threads=1,
    )  # fmt: skip
    return [one.position for one in predicted]


def _value(model: mujoco.MjModel, place: _Place, name: str, patched: PatchedModel | None) -> float:
    """Return a parameter of a model, SI units at the joint.

    Raises:
        SpecError: the joint's drive has no torque constant.
    """
    if place.parameter:
        return _of_law(place, patched or PatchedModel(()))[place.parameter]
    if place.effect == TorqueConstant.id:
        _drives(model, name, place)
        return 0.0
    field = f"dof_{mjcf_fields()[place.effect]}"
    return float(getattr(model, field)[model.jnt_dofadr[place.index]])


def _of_law(place: _Place, patched: PatchedModel) -> dict[str, float]:
    """Return the parameters of an effect beside the MJCF; absent where the model has none."""
    absent = {p.name: p.absent_value for p in catalogue()[place.effect].parameters}
    for one in patched.outside_mjcf:
        if (one.effect, one.joint) == (place.effect, place.joint):
            return {**absent, **one.values}
    return absent


def _with_laws(patched: PatchedModel, places: Sequence[_Place], values: FloatArray) -> PatchedModel:
    """Return the effects with the values of those parameters that belong to them."""
    effects = list(patched.effects)
    for place, value in zip(places, values.tolist(), strict=True):
        if not place.parameter:
            continue
        law_values = {
            **_of_law(place, replace(patched, effects=tuple(effects))),
            place.parameter: value,
        }
        effects = [
            effect for effect in effects
            if effect.is_in_mjcf or (effect.effect, effect.joint) != (place.effect, place.joint)
        ]  # fmt: skip
        effects.append(AppliedEffect(place.effect, place.joint, law_values, is_in_mjcf=False))
    return replace(patched, effects=tuple(effects))


def _place(name: str, model: mujoco.MjModel) -> _Place:
    """Return the place of ``JOINT.EFFECT`` or ``JOINT.EFFECT.PARAMETER``."""
    where = f"update.parameters.{name}"
    rest, _, last = name.rpartition(".")
    if last in (*mjcf_fields(), TorqueConstant.id):
        joint, effect, parameter = rest, last, ""
    else:
        joint, _, effect = rest.rpartition(".")
        parameter = last
        law = catalogue().get(effect)
        laws = [] if law is None or law.scope == "robot" else [
            p.name for p in law.parameters if not p.choice
        ]  # fmt: skip
        if parameter not in laws:
            raise SpecError(
                "no such parameter", where=where, value=name,
                expected=f"JOINT.EFFECT.PARAMETER of an effect of a joint, with one of "
                f"{', '.join(laws)}" if laws else
                f"JOINT.NAME with {', '.join((*mjcf_fields(), TorqueConstant.id))}, or "
                "JOINT.EFFECT.PARAMETER as pytest-twin effects lists them",
            )  # fmt: skip
    index = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint))
    if index < 0:
        raise SpecError(
            "no such joint", where=where, value=joint,
            expected=suggest(joint, [model.joint(k).name for k in range(model.njnt)]),
        )  # fmt: skip
    return _Place(joint, index, effect, parameter)


def _drives(model: mujoco.MjModel, name: str, place: _Place) -> list[int]:
    """Return the actuators of a joint; all efforts of each are proportional to its gains."""
    gains, biases = _LINEAR
    found = [
        actuator
        for actuator in range(model.nactuator)
        if int(model.actuator_trntype[actuator]) in JOINT_TRANSMISSIONS
        and int(model.actuator_trnid[actuator, 0]) == place.index
    ]
    linear = all(
        int(model.actuator_gaintype[one]) in gains and int(model.actuator_biastype[one]) in biases
        for one in found
    )
    if not found or not linear:
        raise SpecError(
            "no drive with a torque constant",
            where=f"update.parameters.{name}",
            value=place.joint,
            expected="a joint with a motor, a position servo or a velocity servo",
        )
    return found


def _with(model: mujoco.MjModel, names: Sequence[str], values: FloatArray) -> mujoco.MjModel:
    changed = copy.copy(model)
    for name, value in zip(names, values, strict=True):
        place = _place(name, model)
        if place.parameter:
            continue
        if place.effect == TorqueConstant.id:
            drives = _drives(model, name, place)
            for field_name in _DRIVE_FIELDS:
                getattr(changed, field_name)[drives] *= 1.0 + value
        else:
            field = f"dof_{mjcf_fields()[place.effect]}"
            getattr(changed, field)[model.jnt_dofadr[place.index]] = value
    return changed
