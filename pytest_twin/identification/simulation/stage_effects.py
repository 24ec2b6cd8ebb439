"""The effects that each stage fits, and nuisance effects that are free in the same fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.estimation.hypothesis import Hypothesis, Scales, Term
from pytest_twin.identification.stages import StageName

SIMULATED: Mapping[StageName, tuple[str, ...]] = {
    "delay": ("command_delay",),
    "encoder": ("encoder_bias",),
    "gravity": ("payload",),
    "inertia": ("armature",),
    "friction": ("viscous_friction", "coulomb_friction"),
    "drive": ("controller_gain",),
}
"""Stage -> effects that it fits, at every joint or once for the robot."""
FURTHER: Mapping[StageName, tuple[str, ...]] = {
    "friction": ("stribeck_friction", "load_dependent_friction", "motor_load_friction"),
    "drive": (
        "dead_zone", "torque_rolloff", "torque_speed_limit", "torque_saturation",
        "watchdog_timeout", "actuator_lag",
    ),
}  # fmt: skip
"""Stage -> effects that it adds if they reduce the held-out error."""
AFTER_EFFORT: Mapping[StageName, tuple[str, ...]] = {
    "drive": (*FURTHER["drive"], "asymmetric_friction", "command_delay"),
    "closed_loop": FURTHER["friction"],
}
"""The same as ``FURTHER`` where measured effort has determined inertia and friction. The constant
effort of a drive acts like friction that differs between the directions."""


@dataclass(frozen=True, slots=True)
class StagePlan:
    """Stages that are fitted, and the effects that they may add.

    Attributes:
        order: stages in order.
        further: stage -> effects that it adds if they reduce the held-out error.
        known_drives: joints that keep the model's drive.
    """

    order: tuple[StageName, ...] = tuple(SIMULATED)
    further: Mapping[StageName, tuple[str, ...]] = field(default_factory=lambda: FURTHER)
    known_drives: frozenset[str] = frozenset()


ALL_STAGES = StagePlan()
_OF_EFFORT_DRIVES = {"controller_gain": "torque_constant"}
"""Effect -> effect that replaces it for effort drives, which have no gains."""
_NUISANCE = ("viscous_friction", "coulomb_friction", "controller_gain", "armature")
"""Nuisance effects, which often compensate for others. They are free while another stage is
fitted, and their values are discarded."""

_GAIN, _VISCOUS, _DRY, _ARMATURE = range(4)
"""Columns of the first values: gain of the drive, viscous friction, dry friction and armature."""
_FIRST: Mapping[tuple[str, str], int] = {
    ("controller_gain", "stiffness_error"): _GAIN,
    ("controller_gain", "damping_error"): _GAIN,
    ("torque_constant", "relative_error"): _GAIN,
    ("viscous_friction", "coefficient"): _VISCOUS,
    ("coulomb_friction", "coulomb"): _DRY,
    ("stribeck_friction", "coulomb"): _DRY,
    ("armature", "inertia"): _ARMATURE,
}
"""Effect and parameter -> column of the first values."""

EXCLUDES: Mapping[StageName, str] = {
    "delay": "damping, dry friction, gains and armature were free while the delay was fitted",
    "encoder": "gains and dry friction were free: both leave an offset at rest, too",
    "gravity": "gains and friction were free: a soft drive sags as under a weight",
    "inertia": "gains and damping were free: they move the resonance, too",
    "friction": "gains and armature were free",
    "drive": "the results of earlier stages are fixed; nothing else is free",
    "closed_loop": "all accepted parameters together",
}


def terms_of(stage: StageName, modes: Sequence[str]) -> list[Term]:
    """Return the terms that a stage fits.

    Args:
        modes: (joints,) command mode of each joint's drive.
    """
    return terms_at(SIMULATED[stage], modes)


def nuisance_of(stage: StageName, frozen: Sequence[Term], modes: Sequence[str]) -> list[Term]:
    """Return nuisance terms of a stage: neither frozen nor another form of its own terms."""
    if stage == "drive":
        return []
    own = set(SIMULATED[stage]) | {term.effect for term in frozen}
    dry = {"coulomb_friction", "stribeck_friction"}
    names = [n for n in _NUISANCE if n not in own and not (n in dry and own & dry)]
    return terms_at(names, modes)


def terms_at(names: Sequence[str], modes: Sequence[str]) -> list[Term]:
    """Return effects as terms: at each joint whose drive can have them, or once for the robot."""
    found = []
    for name in names:
        if catalogue()[name].scope == "robot":
            found.append(Term(name, -1))
            continue
        for joint, mode in enumerate(modes):
            own = _OF_EFFORT_DRIVES.get(name, name) if mode == "effort" else name
            if own in catalogue() and mode in catalogue()[own].modes:
                found.append(Term(own, joint))
    return found


def starts_of(effect: str) -> list[tuple[float, ...]]:
    """Return starting values of an effect's parameters, in multiples of their scales.

    Each form of an effect has all starting values: a fit does not change a choice.
    """
    parameters = catalogue()[effect].parameters
    count = max(len(p.starts) for p in parameters if not p.choice)
    forms = product(*(p.starts if p.choice else (None,) for p in parameters))
    return [
        tuple(
            p.starts[min(k, len(p.starts) - 1)] if chosen is None else chosen
            for p, chosen in zip(parameters, form, strict=True)
        )
        for form in forms
        for k in range(count)
    ]


def start(terms: Sequence[Term], scales: Scales, first: FloatArray) -> Hypothesis:
    """Return the start of a fit: the first values from the equation error.

    Args:
        first: (joints, 5) values of :func:`~.equation_error.first_values`. Parameters without a
            first value start at the model's own value.
    """
    theta: list[float] = []
    for term in terms:
        own = first[term.joint] if term.joint >= 0 else np.full(first.shape[1], np.nan)
        for p in term.parameters:
            value = _FIRST.get((term.effect, p.name))
            known = np.nan if value is None else own[value]
            if np.isfinite(known):
                known = known - 1.0 if value == _GAIN else known / scales.value(p, term.joint)
                theta.append(float(np.clip(known, p.lower, p.upper)))
            elif p.neutral is None:
                theta.append(p.starts[0] if p.choice else p.starts[len(p.starts) // 2])
            else:
                theta.append(p.neutral)
    return Hypothesis(tuple(terms), np.array(theta))
