"""Propagate the uncertainty of identified parameters to a simulated motion.

A change of inverse-dynamics parameters is equivalent to a force: a robot whose parameters differ by
``d`` from the model moves like the model with the added force ``-Y d``, where ``Y`` is the
regressor along the motion. To first order the force is computed along the nominal motion, with one
replay for each parameter. Random draws change damping, dry friction and armature in the simulator,
and add the force of the other parameters. Delays, encoder zeros, gears and gains shift the joint
positions (:mod:`pytest_twin.budget.shifts`). Parameters of effects beside the MJCF are changed in
the effects themselves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.budget.categories import category_of_parameter
from pytest_twin.budget.changed_replays import Change, ChangedReplays
from pytest_twin.budget.effect_parameters import EffectParameter
from pytest_twin.budget.identification import IdentifiedParameters
from pytest_twin.budget.propagate import (
    Spread,
    angles,
    first_order,
    normal_draws,
    root_of,
    spread_of,
)
from pytest_twin.budget.task import Task
from pytest_twin.calibration.chain import ChainParameters, forward
from pytest_twin.calibration.transform_derivatives import TransformWithJacobian
from pytest_twin.effects import mjcf_fields
from pytest_twin.open_loop import Replayed
from pytest_twin.realization import Realization
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.trial import Trial

DRAWS = 64
"""Number of draws, a power of two; each needs a replay. With Sobol points an RMS is then accurate
to 3 %."""
_STEP = 0.1
"""Step of a finite difference, in standard deviations. It is small against the curvature of dry
friction."""


@dataclass(frozen=True)
class SimulatedDisplacement:
    """Effect of parameters on a motion.

    Attributes:
        frame: displacement of the frame, to first order.
        drawn: displacement of the frame, by random draws.
        joints: joint -> RMS displacement of its position, rad or m.
        alone: category -> displacement by its parameters only, to first order.
    """

    frame: Spread
    drawn: Spread
    joints: dict[str, float]
    alone: dict[str, Spread]


def simulate_displacement(
    found: IdentifiedParameters, task: Task, realization: Realization
) -> SimulatedDisplacement:
    """Return the displacement of joints and frame along the task's motion.

    Raises:
        SimulationError: a replay diverged.
    """
    assert task.trial is not None
    return _Motion(found, task, realization, task.trial).moved()


class _Motion:
    """Nominal motion of a trial, and its change with the parameters."""

    def __init__(
        self, found: IdentifiedParameters, task: Task, realization: Realization, trial: Trial
    ) -> None:
        self.found, self.task, self.realization = found, task, realization
        self.joints = trial.joints
        self.replays = ChangedReplays(realization, trial)
        self.nominal = self.replays.nominal
        encoders = Encoders.of(calibration_of(realization), self.joints)
        self.position = encoders.model_position(self.nominal.position)
        self.velocity = encoders.model_velocity(self.nominal.velocity)
        self.slope = encoders.slope
        self.effort = self._effort()
        self.forces = len(found.columns)
        self.replayed = [
            *range(self.forces),
            *range(self.forces + len(found.shifts), len(found.names)),
        ]

    def moved(self) -> SimulatedDisplacement:
        path = self.found.entry.record.path
        root = root_of(self.found.covariance, path)
        responses = self._responses()
        slopes = responses @ root
        rms = np.sqrt(np.sum(slopes**2, axis=2).mean(axis=0))
        moving = self._frame(self.nominal.position)
        chain = self._on_chain()
        on_chain = (self.slope[:, None] * responses)[:, chain]
        categories = np.array([category_of_parameter(name) for name in self.found.names])
        alone = {}
        for category in dict.fromkeys(categories.tolist()):
            own = np.flatnonzero(categories == category)
            part = root_of(self.found.covariance[np.ix_(own, own)], path)
            alone[category] = first_order(moving, on_chain[:, :, own] @ part)
        draws = normal_draws(root, DRAWS)
        shift, turn = np.zeros((2, len(self.nominal.time)))
        for position in self._drawn(draws):
            at = self._frame(position)
            shift += np.sum((at.position - moving.position) ** 2, axis=1)
            turn += angles(at.rotation, moving.rotation) ** 2
        drawn = spread_of(shift / len(draws), turn / len(draws))
        joints = dict(zip(self.joints, rms.tolist(), strict=True))
        return SimulatedDisplacement(first_order(moving, on_chain @ root), drawn, joints, alone)

    def _effort(self) -> FloatArray:
        """(n, j, p) derivative of the joints' effort along the nominal motion."""
        own = self.found.regressor.joints
        n = len(self.nominal.time)
        values = np.zeros((3, n, len(own)))
        # Two states may have one stamp.
        time, first, own_time = np.unique(self.nominal.time, return_index=True, return_inverse=True)
        acceleration = np.gradient(self.velocity[first], time, axis=0)[own_time]
        for at, joint in enumerate(own):
            if joint in self.joints:
                k = self.joints.index(joint)
                for row, series in enumerate((self.position, self.velocity, acceleration)):
                    values[row, :, at] = series[:, k]
        matrix = self.found.regressor.matrix(*values)[:, :, list(self.found.columns)]
        effort = np.zeros((n, len(self.joints), len(self.found.columns)))
        for at, joint in enumerate(own):
            if joint in self.joints:
                effort[:, self.joints.index(joint)] = matrix[:, at]
        return effort

    def _force(self, change: FloatArray) -> FloatArray:
        """(n, j) force that is equivalent to a change of the parameters that act as forces."""
        return np.asarray(-(self.effort @ change))

    def _responses(self) -> FloatArray:
        """(n, j, p) derivative of the positions by each parameter."""
        count = len(self.found.names)
        found = np.zeros((*self.nominal.position.shape, count))
        steps = _STEP * np.sqrt(np.diag(self.found.covariance).clip(0.0))
        for at, one in enumerate(self.found.effects, count - len(self.found.effects)):
            ways = (one.possible(one.value + way * steps[at]) - one.value for way in (1.0, -1.0))
            steps[at] = max(ways, key=abs)
        varied = [at for at in self.replayed if steps[at]]
        changes = [self._linear_change(np.eye(count)[at] * steps[at]) for at in varied]
        for at, done in zip(varied, self.replays.changed(changes), strict=True):
            found[:, :, at] = (done.position - self.nominal.position) / steps[at]
        for shifting in range(self.forces, self.forces + len(self.found.shifts)):
            found[:, :, shifting] = self._shifted(self.nominal, np.eye(count)[shifting])
        return found

    def _linear_change(self, change: FloatArray) -> Change:
        """Return a small change of the parameters; those of the inverse dynamics act as forces."""
        return Change(self._force(change[: self.forces]), effects=self._effects(change))

    def _effects(self, change: FloatArray) -> dict[EffectParameter, float]:
        """Return parameters of effects -> their changed values."""
        own = self.found.effects
        return {
            one: one.value + float(step)
            for one, step in zip(own, change[len(change) - len(own) :], strict=True)
        }

    def _shifted(self, motion: Replayed, change: FloatArray) -> FloatArray:
        """(n, j) shift of the joint positions by parameters that are not forces."""
        found = np.zeros_like(motion.position)
        own = change[self.forces : self.forces + len(self.found.shifts)]
        for shift, size in zip(self.found.shifts, own, strict=True):
            if shift.joint in self.joints:
                at = self.joints.index(shift.joint)
                found[:, at] += size * shift.rate(motion.velocity[:, at], motion.effort[:, at])
        return found

    def _drawn(self, draws: FloatArray) -> Iterator[FloatArray]:
        """(n, j) positions for each draw; simulator parameters are changed in the simulator."""
        replayed = self.replays.changed([self._change(draw) for draw in draws])
        for draw, done in zip(draws, replayed, strict=True):
            yield np.asarray(done.position + self._shifted(done, draw))

    def _change(self, draw: FloatArray) -> Change:
        rest = draw[: self.forces].copy()
        fields: dict[str, FloatArray] = {}
        for at, column in enumerate(self.found.columns):
            own = self.found.regressor.columns[column]
            if own.kind not in mjcf_fields() or own.joint not in self.realization.joints:
                continue
            field = f"dof_{mjcf_fields()[own.kind]}"
            dof = self.realization.joint_dof_index(own.joint)
            values = fields.setdefault(field, getattr(self.replays.model, field).copy())
            # The simulator accepts no negative friction; such a change is applied as a force.
            changed = values[dof] + draw[at]
            if changed >= 0.0:
                values[dof], rest[at] = changed, 0.0
        return Change(self._force(rest), fields, self._effects(draw))

    def _on_chain(self) -> list[int]:
        return [self.joints.index(j) for j in self.task.chain.joints if j in self.joints]

    def _frame(self, position: FloatArray) -> TransformWithJacobian:
        """Return the frame at positions (n, j) of the trial's joints, with derivatives."""
        chain = self.task.chain
        readings = np.zeros((len(position), len(chain.joints)))
        columns: list[int] = []
        for at, joint in enumerate(chain.joints):
            here = joint in self.joints
            columns.append(sum(c >= 0 for c in columns) if here else -1)
            if here:
                readings[:, at] = position[:, self.joints.index(joint)]
        width = sum(c >= 0 for c in columns)
        none = ChainParameters(width, np.zeros(len(chain.joints)), tuple(columns))
        return forward(chain, readings, none)
