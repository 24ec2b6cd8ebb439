"""The effects of each stage: candidates of the search, and its start from the equation error."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.equation_error import first_values
from pytest_twin.diagnosis.problem import CandidateMask, Problem
from pytest_twin.effects import Effect, Parameter, catalogue, in_order_of_fields
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.identification.stages import StageName

SIMULATED: tuple[StageName, ...] = ("delay", "encoder", "gravity", "inertia", "friction", "drive")
"""Stages that are fitted by simulation, in order."""
TOGETHER: StageName = "closed_loop"
"""Stage of all effects together, and of those that no other stage has."""
_GAIN, _VISCOUS, _DRY, _ARMATURE = range(4)
"""Columns of the first values: gain of the drive, viscous friction, dry friction and armature."""


def effects_of(stage: StageName) -> tuple[str, ...]:
    """Return the effects of a stage that recordings of motion show."""
    return tuple(
        effect.id
        for effect in catalogue().values()
        if effect.stage == stage and effect.candidate and effect.shows_in_motion_alone
    )


def basic_effects(stage: StageName) -> tuple[str, ...]:
    """Return the effects of a stage that every robot has, such as friction and servo gains."""
    basic = (e for e in catalogue().values() if e.stage == stage and e.basic_modes)
    return tuple(effect.id for effect in in_order_of_fields(basic))


def _directional_effects() -> tuple[str, ...]:
    """Return the friction that differs between the directions, as a constant effort of a drive."""
    return tuple(
        effect.id
        for effect in catalogue().values()
        if effect.family == "friction" and any(p.difference_of for p in effect.parameters)
    )


def _given(possible: Collection[str]) -> frozenset[str]:
    """Return the effects whose first values the equation error has: friction, gains, armature."""
    return frozenset(
        name
        for name in possible
        if (effect := catalogue()[name]).basic_modes
        and any(_first_column(effect, p) is not None for p in effect.parameters)
    )


def _stages_of_all_effects() -> dict[str, StageName]:
    return {effect: stage for stage in (*SIMULATED, TOGETHER) for effect in effects_of(stage)}


@dataclass(frozen=True, slots=True)
class StagePlan:
    """Stages that are fitted, and the effects among which the search chooses.

    Attributes:
        order: stages in order, without that of all effects together.
        stage_of: effect that may be found -> its stage.
        known_drives: joints that keep the model's drive and friction.
        tried_first: stages whose effects are candidates from the start; the others follow where a
            residual remains.
    """

    order: tuple[StageName, ...] = SIMULATED
    stage_of: Mapping[str, StageName] = field(default_factory=_stages_of_all_effects)
    known_drives: frozenset[str] = frozenset()
    tried_first: tuple[StageName, ...] = SIMULATED

    @classmethod
    def after_effort(cls, known_drives: frozenset[str]) -> StagePlan:
        """Return the plan where measured effort has determined inertia and friction.

        It lacks the effects that no stage has. The errors of the given inertia and friction leave a
        residual in the motion, which an effect that the robot does not have (a warm-up, an
        eccentric encoder) would take up, in held-out recordings too.
        """
        of_drive = *effects_of("drive"), *basic_effects("delay"), *_directional_effects()
        of_friction = set(effects_of("friction")) - set(basic_effects("friction"))
        return cls(
            ("drive",),
            {**dict.fromkeys(of_friction, TOGETHER), **dict.fromkeys(of_drive, "drive")},
            known_drives,
            ("drive", TOGETHER),
        )

    @property
    def mask(self) -> CandidateMask:
        """Candidates of the search."""
        last = frozenset(e for e, stage in self.stage_of.items() if stage not in self.tried_first)
        return CandidateMask(
            frozenset(self.stage_of) - last, _given(self.stage_of), last, self.known_drives
        )

    def terms_of(self, stage: StageName, modes: Sequence[str]) -> list[Term]:
        """Return the basic effects of a stage as terms: at each joint, or once for the robot.

        Args:
            modes: (joints,) command mode of each joint's drive; empty for a known drive.
        """
        terms = []
        for name in basic_effects(stage):
            if name not in self.stage_of:
                continue
            if catalogue()[name].scope == "robot":
                terms.append(Term(name, -1))
            else:
                of_drive = catalogue()[name].basic_modes
                terms += [Term(name, joint) for joint, mode in enumerate(modes) if mode in of_drive]
        return terms

    def modes_of(self, problem: Problem) -> list[str]:
        """Return the (joints,) command mode of each joint's drive; empty for a known drive."""
        return [
            "" if joint in self.known_drives else problem.simulator.segments[0].mode_of(j)
            for j, joint in enumerate(problem.joints)
        ]

    def start(self, problem: Problem) -> Hypothesis:
        """Return the basic effects with the values of the equation error, where it has some.

        The simulation error has many minima; these values are near the right one.
        """
        values, modes = first_values(problem), self.modes_of(problem)
        found = EMPTY
        for term in (term for stage in self.order for term in self.terms_of(stage, modes)):
            theta = np.array(
                list(map(partial(_first_value, problem, values, term), term.parameters))
            )
            if term.joint >= 0 and not np.isnan(theta).all():
                neutral = [p.absent_value for p in term.parameters]
                found = found.with_term(term, np.where(np.isnan(theta), neutral, theta))
        return found


def _first_value(problem: Problem, values: FloatArray, term: Term, parameter: Parameter) -> float:
    """Return the scaled first value of a parameter within its bounds; NaN without one."""
    column = _first_column(term.law, parameter)
    if column is None or term.joint < 0:
        return np.nan
    value = values[term.joint, column]
    scaled = value - 1.0 if column == _GAIN else value / problem.scales.value(parameter, term.joint)
    return float(np.clip(scaled, parameter.lower, parameter.upper))


def _first_column(effect: Effect, parameter: Parameter) -> int | None:
    """Return the column of the first values that has a parameter; None without one."""
    if parameter.relation == "relative":
        return _GAIN if effect.stage == "drive" else None
    if parameter.relation != "added":
        return None
    if parameter.name == effect.dry_friction_level:
        return _DRY
    return {"damping": _VISCOUS, "inertia": _ARMATURE}.get(parameter.quantity)
