"""Parameters of effects of a fitted model: their values and the values that a robot can have."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.diagnosis.patched.model import AppliedEffect, PatchedModel
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import Parameter
from pytest_twin.realization import Realization

_TOTALS: Mapping[str, str] = {
    "damping": "dof_damping", "inertia": "dof_armature", "effort": "dof_frictionloss",
}  # fmt: skip
"""Quantity of an addition -> field of the model's degree of freedom that it is added to."""


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect in the twin's realization.

    Attributes:
        effect, joint: id and joint; joint None for an effect of the whole robot.
        value: its value in the realization, SI units.
        lower, upper: smallest and largest value that a robot can have; of an error relative to the
            model's value, smallest and largest ratio to it.
        is_in_mjcf: whether the MJCF contains it.
    """

    effect: str
    joint: str | None
    law: Parameter
    value: float
    lower: float
    upper: float
    is_in_mjcf: bool

    def possible(self, value: float) -> float:
        """Return the nearest value that a robot can have."""
        ratio = 1.0 if self.law.relation == "relative" else 0.0
        return float(np.clip(ratio + value, self.lower, self.upper)) - ratio


def effect_parameter(
    name: str, realization: Realization, patched: PatchedModel | None
) -> EffectParameter | None:
    """Return the parameter that a record names, or None if the realization does not have it.

    Args:
        name: ``JOINT.EFFECT`` or ``JOINT.EFFECT.PARAMETER``; JOINT is ``robot`` for the whole one.
        realization: the twin's first realization.
    """
    place, _, rest = name.partition(".")
    effect, _, parameter = rest.partition(".")
    joint = None if place == "robot" else place
    if effect not in catalogue() or patched is None:
        return None
    # If a fit changes only one parameter of an effect, the record does not name it.
    law = next(
        (
            p
            for p in catalogue()[effect].parameters
            if p.name == parameter or not (parameter or p.choice)
        ),
        None,
    )
    own = [one for one in patched.effects if (one.effect, one.joint) == (effect, joint)]
    holder = next((one for one in own if law is not None and law.name in one.values), None)
    if law is None or holder is None:
        return None
    value = holder.values[law.name]
    is_in_mjcf = any(one.is_in_mjcf for one in own)
    total = _total(law, joint, value, realization, is_in_mjcf)
    return EffectParameter(effect, joint, law, value, *bounds(law, value, total), holder.is_in_mjcf)


def with_values(patched: PatchedModel, values: Mapping[EffectParameter, float]) -> PatchedModel:
    """Return the effects with other values of parameters that the MJCF does not contain.

    Args:
        values: parameter -> value, SI units; it is limited to what a robot can have.
    """

    def changed(one: AppliedEffect) -> AppliedEffect:
        own = {
            parameter.law.name: parameter.possible(value)
            for parameter, value in values.items()
            if (parameter.effect, parameter.joint) == (one.effect, one.joint)
        }
        return one if one.is_in_mjcf else replace(one, values={**one.values, **own})

    return replace(patched, effects=tuple(changed(one) for one in patched.effects))


def bounds(law: Parameter, stated: float, total: float | None) -> tuple[float, float]:
    """Return the smallest and the largest value of a parameter that a robot can have.

    A passive joint generates no energy: damping, dry friction, armature and spring of the model and
    the addition to it are together at least zero. Where a law states its bounds in SI units, as for
    friction per unit of effort, they hold for every robot. Other bounds depend on a recording; of
    these only zero counts.

    Args:
        stated: value in the twin's realization, SI units.
        total: sum of the model's value and this addition, SI units; None if it is no addition to a
            value of the joint.
    """
    if law.relation == "relative":
        return 0.0, np.inf
    if total is not None:
        return min(stated - total, stated), np.inf
    if law.reference == "one" and not law.relation:
        return min(law.lower, stated), max(law.upper, stated)
    added = law.relation == "added" or law.quantity in ("mass", "inertia", "damping")
    positive = law.lower >= 0.0 or (added and stated >= 0.0)
    return (0.0 if positive else -np.inf), np.inf


def _total(
    law: Parameter, joint: str | None, stated: float, realization: Realization, is_in_mjcf: bool
) -> float | None:
    """Return the sum of the model's value and an addition to it; None if it is no addition."""
    if law.relation != "added" or joint is None:
        return None
    model = realization.model
    if law.quantity == "stiffness":
        own = float(model.jnt_stiffness[model.joint(joint).id])
    elif law.quantity in _TOTALS:
        dof = realization.joint_dof_index(joint)
        own = float(getattr(model, _TOTALS[law.quantity])[dof])
    else:
        return None
    return own if is_in_mjcf else own + stated
