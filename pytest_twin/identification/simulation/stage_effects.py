"""The effects that each stage fits, and nuisance effects that are free in the same fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import Effect, Parameter, catalogue, in_order_of_fields
from pytest_twin.estimation.hypothesis import Hypothesis, Scales, Term
from pytest_twin.identification.stages import StageName

SIMULATED: tuple[StageName, ...] = ("delay", "encoder", "gravity", "inertia", "friction", "drive")
"""Stages that are fitted by simulation, in order."""


def further_effects(stage: StageName) -> tuple[str, ...]:
    """Return the effects that a stage adds if they reduce the held-out error."""
    return tuple(
        effect.id
        for effect in catalogue().values()
        if effect.stage == stage
        and not effect.basic_modes
        and effect.candidate
        and effect.shows_in_motion_alone
    )


def basic_effects(stage: StageName) -> tuple[str, ...]:
    """Return the effects that a stage fits from the start, at every joint or for the robot."""
    basic = (e for e in catalogue().values() if e.stage == stage and e.basic_modes)
    return tuple(effect.id for effect in in_order_of_fields(basic))


def _directional_effects() -> tuple[str, ...]:
    """Return the friction that differs between the directions, as a constant effort of a drive."""
    return tuple(
        effect.id
        for effect in catalogue().values()
        if effect.family == "friction" and any(p.difference_of for p in effect.parameters)
    )


@dataclass(frozen=True, slots=True)
class StagePlan:
    """Stages that are fitted, and the effects that they may add.

    Attributes:
        order: stages in order.
        further: stage -> effects that it adds if they reduce the held-out error.
        last: effects that are tried after all others, while a residual remains.
        known_drives: joints that keep the model's drive.
    """

    order: tuple[StageName, ...] = SIMULATED
    further: Mapping[StageName, tuple[str, ...]] = field(
        default_factory=lambda: {stage: further_effects(stage) for stage in SIMULATED}
    )
    last: tuple[str, ...] = field(default_factory=lambda: further_effects(_TOGETHER))
    known_drives: frozenset[str] = frozenset()

    @classmethod
    def after_effort(cls, known_drives: frozenset[str]) -> StagePlan:
        """Return the plan where measured effort has determined inertia and friction.

        It has no last effects. The errors of the given inertia and friction leave a residual in the
        motion, which an effect that the robot does not have (a warm-up, an eccentric encoder) would
        take up, in held-out recordings too.
        """
        return cls(
            ("drive",),
            {
                "drive": (
                    *further_effects("drive"),
                    *basic_effects("delay"),
                    *_directional_effects(),
                ),
                _TOGETHER: further_effects("friction"),
            },
            last=(),
            known_drives=known_drives,
        )

    def stage_that_adds(self, effect: str) -> StageName | None:
        """Return the stage that adds a further effect; None for a basic one."""
        for stage, effects in self.further.items():
            if effect in effects:
                return stage
        return _TOGETHER if effect in self.last else None


_TOGETHER: StageName = "closed_loop"
_NUISANCE: tuple[StageName, ...] = ("friction", "drive", "inertia")
"""Stages whose basic effects often compensate for others. They are free while another stage is
fitted, and their values are discarded."""
_GAIN, _VISCOUS, _DRY, _ARMATURE = range(4)
"""Columns of the first values: gain of the drive, viscous friction, dry friction and armature."""

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
    """Return the terms that a stage fits from the start.

    Args:
        modes: (joints,) command mode of each joint's drive.
    """
    return _terms_at({name: catalogue()[name].basic_modes for name in basic_effects(stage)}, modes)


def nuisance_of(stage: StageName, frozen: Sequence[Term], modes: Sequence[str]) -> list[Term]:
    """Return nuisance terms of a stage: neither frozen nor another form of its own terms."""
    if stage == "drive":
        return []
    present = set(basic_effects(stage)) | {term.effect for term in frozen}
    has_dry_friction = any(catalogue()[name].dry_friction_level for name in present)
    return [
        term
        for other in _NUISANCE
        for term in terms_of(other, modes)
        if term.effect not in present and not (term.law.dry_friction_level and has_dry_friction)
    ]


def terms_at(
    names: Sequence[str], modes: Sequence[str], slides: Sequence[bool] | None = None
) -> list[Term]:
    """Return effects as terms: at each joint whose drive can have them, or once for the robot.

    Args:
        slides: (joints,) whether each joint is prismatic; periodic effects are at hinges.
    """
    terms = _terms_at({name: catalogue()[name].modes for name in names}, modes)
    return [t for t in terms if not (t.law.periodic and slides is not None and slides[t.joint])]


def _terms_at(modes_of: Mapping[str, tuple[str, ...]], modes: Sequence[str]) -> list[Term]:
    terms = []
    for name, possible in modes_of.items():
        if catalogue()[name].scope == "robot":
            terms.append(Term(name, -1))
        else:
            terms += [Term(name, joint) for joint, mode in enumerate(modes) if mode in possible]
    return terms


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
            column = _first_column(term.law, p)
            known = np.nan if column is None else own[column]
            if np.isfinite(known):
                known = known - 1.0 if column == _GAIN else known / scales.value(p, term.joint)
                theta.append(float(np.clip(known, p.lower, p.upper)))
            elif p.neutral is None:
                theta.append(p.starts[0] if p.choice else p.starts[len(p.starts) // 2])
            else:
                theta.append(p.neutral)
    return Hypothesis(tuple(terms), np.array(theta))


def _first_column(effect: Effect, parameter: Parameter) -> int | None:
    """Return the column of the first values that has a parameter; None without one."""
    if parameter.relation == "relative":
        return _GAIN if effect.stage == "drive" else None
    if parameter.relation != "added":
        return None
    if parameter.name == effect.dry_friction_level:
        return _DRY
    return {"damping": _VISCOUS, "inertia": _ARMATURE}.get(parameter.quantity)
