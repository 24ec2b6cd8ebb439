"""All answers about the signals of the recordings, and the recordings as they are then used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.signal_meaning.command_interpolation import CommandInterpolation
from pytest_twin.diagnosis.signal_meaning.fact import Fact, unknown
from pytest_twin.diagnosis.signal_meaning.interpolation_fit import (
    InterpolationFit,
    fit_interpolation,
)
from pytest_twin.diagnosis.signal_meaning.logged_efforts import logged_efforts
from pytest_twin.diagnosis.signal_meaning.settings import INTERPOLATION
from pytest_twin.diagnosis.signal_meaning.step_times import StepTimes, step_intervals, with_steps_at
from pytest_twin.diagnosis.signal_meaning.velocity import velocity_fact
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.errors import TwinError
from pytest_twin.recording_options import COMMAND_BETWEEN, CommandBetween
from pytest_twin.trial import Trial

_NO_STATE = ("differenced", "filtered", "late")


@dataclass(frozen=True, slots=True)
class RecordedSignals:
    """Meaning of the recorded signals.

    Attributes:
        between: interpolation of the commands where it is not declared, for each command period.
        velocity: joint -> origin of its logged velocity.
        effort: joint -> origin of its logged effort.
        problems: problems that were simulated to determine it.
        steps: times of command steps between two stamps, for each command period.
    """

    between: tuple[CommandInterpolation, ...] = ()
    velocity: Mapping[str, Fact] = field(default_factory=dict)
    effort: Mapping[str, Fact] = field(default_factory=dict)
    problems: tuple[Problem, ...] = ()
    steps: tuple[StepTimes, ...] = ()

    def apply(self, trials: TrialSet) -> TrialSet:
        """The recordings as they are used from here on, with notes for the reader.

        They have the interpolation that was found, and their steps where the motion shows them.
        Velocities that are differenced, filtered or late are left out, and so are efforts that
        were not measured at the time of their stamps.
        """
        each = [tuple(map(self._apply_to_trial, role)) for role in (trials.fit, trials.held_out)]
        kept = [n for n in trials.notes if not (self.between and "assumed: neither" in n)]
        notes = dict.fromkeys([*kept, *self.notes([*trials.fit, *trials.held_out])])
        return replace(trials, fit=each[0], held_out=each[1], notes=tuple(notes))

    def notes(self, trials: Sequence[Trial]) -> list[str]:
        """A line for each answer that changes how recordings are used."""
        lines = []
        for answer in self.between:
            said = answer.fact
            names = ", ".join(dict.fromkeys(
                t.path.name for t in trials
                if t.between_source == "assumed" and self._answer(t) is answer
            ))  # fmt: skip
            if said.value is None:
                lines.append(
                    f"{names}: the interpolation of commands between stamps cannot be determined; "
                    f"they are taken as {answer.assumed}, and delays have an interval that allows "
                    "for it (metadata or twin.yaml: command_between)"
                )
            else:
                lines.append(
                    f"{names}: commands are {said.value} between their stamps, by the recordings "
                    f"themselves (confidence {100 * said.confidence:.3g} %)"
                )
        timed = [(t, shares) for t in trials if (shares := self._shares(t)) is not None]
        if timed:
            names = ", ".join(dict.fromkeys(t.path.name for t, _ in timed))
            lines.append(
                f"{names}: {sum(len(s) for _, s in timed)} commands step between two stamps; the "
                "times of the steps are fitted to the motion"
            )
        for what, facts, use in (
            ("velocity", self.velocity, "it is not used as initial velocity"),
            ("effort", self.effort, "it is not used as a sensor's reading"),
        ):
            lines += [
                f"joint {joint!r}: {fact.evidence}; {use}"
                for joint, fact in facts.items()
                if (_has_no_state(fact) if what == "velocity" else _has_no_sensor(fact))
            ]
        return lines

    def to_json(self, trials: Sequence[Trial]) -> dict[str, Any]:
        """``recordings`` of ``diagnosis.json``: file -> answers, and joint -> answers."""
        out: dict[str, Any] = {}
        for trial in trials:
            fact = self._between_fact(trial).to_json()
            joints: dict[str, Any] = {}
            for joint in trial.joints:
                mine: dict[str, Any] = {}
                if joint in trial.command_joints:
                    mine["command_between"] = fact
                for name, facts in (("velocity", self.velocity), ("effort", self.effort)):
                    if joint in facts:
                        mine[name] = facts[joint].to_json()
                joints[joint] = mine
            out.setdefault(trial.path.name, {"command_between": fact, "joints": joints})
        return out

    @property
    def found_between(self) -> CommandBetween | None:
        """The interpolation that was found; None if it is undetermined or differs."""
        values = {b.fact.value for b in self.between}
        return next((b for b in COMMAND_BETWEEN if values == {b}), None)

    def _answer(self, trial: Trial) -> CommandInterpolation | None:
        """The answer for the command period of a trial; None without one."""
        period = _period(trial)
        near = [b for b in self.between if _are_alike(b.period, period)]
        return near[0] if near else None

    def _shares(self, trial: Trial) -> FloatArray | None:
        """Times of the steps of a trial whose setpoint moves on; None without one."""
        between = trial.command_between
        if trial.between_source == "assumed":
            answer = self._answer(trial)
            between = "held" if answer is None else answer.assumed
        if between != "interpolated":
            return None
        near = [s for s in self.steps if _are_alike(s.period, _period(trial))]
        return near[0].shares(trial) if near else None

    def undetermined(self, trials: Sequence[Trial]) -> CommandInterpolation | None:
        """The undetermined answer with the longest command period; None without one."""
        asked = (self._answer(t) for t in trials if t.between_source == "assumed")
        undetermined = [b for b in asked if b is not None and len(b.possible) > 1]
        return max(undetermined, key=lambda b: b.period, default=None)

    def with_decision(
        self, undetermined: CommandInterpolation, between: CommandBetween
    ) -> RecordedSignals:
        """The same with an undetermined answer decided by the number of effects."""
        words = (
            f"{undetermined.fact.evidence}; fewer effects explain them if commands are {between}"
        )
        fact = Fact(between, INTERPOLATION.most_by_model, "data", words)
        known = CommandInterpolation(fact, (between,), undetermined.period)
        return replace(self, between=tuple(known if b is undetermined else b for b in self.between))

    def _between_fact(self, trial: Trial) -> Fact:
        if trial.between_source not in ("assumed", "data"):
            return Fact(trial.command_between, 1.0, trial.between_source, "declared")
        answer = self._answer(trial)
        return unknown("not asked") if answer is None else answer.fact

    def _apply_to_trial(self, trial: Trial) -> Trial:
        shares = self._shares(trial)
        if shares is not None:
            trial = with_steps_at(trial, shares)
        answer = self._answer(trial) if trial.between_source == "assumed" else None
        if answer is not None:
            source = "assumed" if answer.fact.value is None else "data"
            trial = replace(trial, command_between=answer.assumed, between_source=source)
        if any(_has_no_state(f) for f in self.velocity.values()):
            trial = replace(trial, velocity=None)
        if any(_has_no_sensor(f) for f in self.effort.values()):
            trial = replace(trial, effort=None)
        return trial


def determine_signals(setup: ModelSetup, trials: TrialSet) -> RecordedSignals:
    """Determine the meaning of the recorded signals.

    Args:
        setup: the model with its simulation settings.
    """
    everything = [*trials.fit, *trials.held_out]
    velocity = _velocities(everything)
    trials = RecordedSignals(velocity=velocity).apply(trials)
    everything = [*trials.fit, *trials.held_out]
    fits = []
    for group in _alike_recordings(everything):
        declared = group[0].between_source != "assumed"
        moves_on = declared and group[0].command_between == "interpolated"
        may_step = moves_on and any(len(step_intervals(t.command)) for t in group)
        if declared and not may_step and all(t.effort is None for t in group):
            continue
        interpolations = (group[0].command_between,) if declared else COMMAND_BETWEEN
        try:
            # Simulations with extreme parameters may overflow; they are never the best.
            with np.errstate(over="ignore", invalid="ignore"):
                fits.append((group, fit_interpolation(setup, group, interpolations)))
        except TwinError:
            # The diagnosis itself reports the error of these recordings.
            continue
    between = tuple(f.answer for group, f in fits if group[0].between_source == "assumed")
    problems = tuple(f.space.problem for _, f in fits)
    steps = tuple(
        StepTimes(setup, f.space, f.fit, f.joints, f.answer.period)
        for _, f in fits
        if f.answer.assumed == "interpolated"
    )
    return RecordedSignals(between, velocity, _efforts(everything, fits), problems, steps)


def _efforts(
    trials: Sequence[Trial], fits: Sequence[tuple[Sequence[Trial], InterpolationFit]]
) -> dict[str, Fact]:
    """Joint -> origin of its logged effort, by the fit of the most recordings."""
    if not fits or not any(t.effort is not None for t in trials):
        return {}
    return logged_efforts(*max(fits, key=lambda each: len(each[0])))


def _velocities(trials: Sequence[Trial]) -> dict[str, Fact]:
    """Joint -> origin of its velocity, by the recording in which the joint moves most."""
    found: dict[str, Fact] = {}
    for joint in dict.fromkeys(j for t in trials for j in t.joints):
        most: tuple[float, Trial] | None = None
        for t in trials:
            if joint in t.joints and t.velocity is not None:
                travel = float(np.nanstd(t.position[:, t.joints.index(joint)]))
                if most is None or travel > most[0]:
                    most = travel, t
        if most is None:
            continue
        trial, column = most[1], most[1].joints.index(joint)
        assert trial.velocity is not None
        seen = np.isfinite(trial.position[:, column]) & np.isfinite(trial.velocity[:, column])
        seen &= np.concatenate([[True], np.diff(trial.time) > 0.0])
        found[joint] = velocity_fact(
            trial.time[seen], trial.position[seen, column], trial.velocity[seen, column]
        )
    return found


def _alike_recordings(trials: Sequence[Trial]) -> list[list[Trial]]:
    """Groups of recordings with the same command period and the same declared interpolation."""
    groups: list[list[Trial]] = []
    for trial in sorted(trials, key=_period):
        for group in groups:
            if _are_alike(_period(group[0]), _period(trial)) and _declared_interpolation(
                group[0]
            ) == _declared_interpolation(trial):
                group.append(trial)
                break
        else:
            groups.append([trial])
    return groups


def _declared_interpolation(trial: Trial) -> CommandBetween | None:
    return None if trial.between_source == "assumed" else trial.command_between


def _period(trial: Trial) -> float:
    times = trial.command_times
    return float(np.median(np.diff(times))) if len(times) > 1 else 0.0


def _are_alike(one: float, other: float) -> bool:
    return max(one, other) <= INTERPOLATION.same_period * min(one, other)


def _has_no_state(fact: Fact) -> bool:
    return fact.value in _NO_STATE


def _has_no_sensor(fact: Fact) -> bool:
    return fact.value == "demanded" or bool(fact.numbers.get("lag", (0.0, "s"))[0])
