"""Variables on which the missing force of one joint may depend, along the measured motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.sensitivities import Linearization
from pytest_twin.diagnosis.first_order.sensor_readings import ReadingChange
from pytest_twin.diagnosis.unnamed_law.settings import FREE_LAWS
from pytest_twin.effects.unnamed_law import (
    COLD_FRACTION,
    COMMAND,
    KNOTS,
    LOAD,
    POSITION,
    SINCE_REVERSAL,
    SPEED,
    TABLES,
    VELOCITY,
    UnnamedFriction,
    UnnamedLaw,
    UnnamedThermalFriction,
    Variable,
    update_reversal_time,
)


@dataclass(frozen=True, slots=True)
class Covariate:
    """One variable along the motion, and the knots of a table over it.

    Attributes:
        effect: id of the effect with the table.
        at: (segments, samples) values of the variable, in its unit.
        sign: (segments, samples) factor on the table: 1 for a force, minus the direction of motion
            for friction.
        inside: (segments, samples) whether the sample is in the recorded part of the segment.
        low, high: first and last knot.
        valid: range of the variable in the recordings, with the extrapolation at its ends.
    """

    effect: str
    variable: Variable
    at: FloatArray
    sign: FloatArray
    inside: NDArray[np.bool_]
    low: float
    high: float
    valid: tuple[float, float]

    @property
    def is_friction(self) -> bool:
        """Whether the table is a level of dry friction instead of a force."""
        return TABLES[self.effect].is_friction

    @property
    def knots(self) -> FloatArray:
        """(KNOTS,) values of the variable at the knots."""
        return np.linspace(self.low, self.high, KNOTS)

    @property
    def occupancy(self) -> FloatArray:
        """(KNOTS,) share of the recorded samples near each knot."""
        weights = self._hat_functions(self.at[self.inside])
        share: FloatArray = weights.sum(axis=0) / max(int(self.inside.sum()), 1)
        return share

    def columns(self, joint: int) -> list[ReadingChange]:
        """For each knot the force at ``joint`` if only this knot has the value 1, N*m or N."""
        hats = self._hat_functions(self.at) * self.sign[..., None]
        forces = np.ascontiguousarray(np.moveaxis(hats, -1, 0))
        return [ReadingChange(force=f, drive=np.zeros_like(f), joint=joint) for f in forces]

    def for_linearization(self, linear: Linearization, joint: int) -> Covariate:
        """The same table along the measured motion of another linearization."""
        for other in covariates(linear, joint):
            if (other.effect, other.variable) == (self.effect, self.variable):
                return replace(other, low=self.low, high=self.high, valid=self.valid)
        return self

    def _hat_functions(self, at: FloatArray) -> FloatArray:
        """(..., KNOTS) linear interpolation weights; zero from one interval outside the knots."""
        place = (at - self.low) / max(self.high - self.low, 1e-12) * (KNOTS - 1)
        weights: FloatArray = np.maximum(1.0 - np.abs(place[..., None] - np.arange(KNOTS)), 0.0)
        return weights


def covariates(linear: Linearization, joint: int) -> list[Covariate]:
    """All variables that vary in the recordings, over their whole ranges, the simplest first."""
    trajectory, simulator = linear.trajectory, linear.simulator
    segments = [simulator.segments[s] for s in trajectory.segments]
    inside = trajectory.time <= np.array([s.time[-1] for s in segments])[:, None]
    position, velocity = trajectory.position[..., joint], trajectory.velocity[..., joint]
    still = FREE_LAWS.still * float(linear.problem.scales.of["velocity"][joint])
    cold = np.array([s.cold_fraction for s in segments])
    against_motion = -np.tanh(velocity / trajectory.slip_velocity[joint])
    force, friction = np.ones_like(position), UnnamedFriction.id
    since = _time_since_reversal(velocity, still, trajectory.interval)
    found = [
        (UnnamedLaw.id, POSITION, position, force),
        (friction, POSITION, position, against_motion),
        (friction, SPEED, np.abs(velocity), against_motion),
        (UnnamedLaw.id, VELOCITY, velocity, force),
        (friction, LOAD, np.abs(linear.laws.load[..., joint]), against_motion),
        (friction, SINCE_REVERSAL, since, against_motion),
    ]
    if all(s.mode_of(joint) == "position" for s in segments):
        # A velocity or effort command mostly comes from an outer loop and contains its reaction to
        # the missing force. It would therefore explain any force.
        command = np.stack([
            s.setpoint.at(t)[:, joint] for s, t in zip(segments, trajectory.time, strict=True)
        ])  # fmt: skip
        found.append((UnnamedLaw.id, COMMAND, command, force))
    if len(set(cold)) >= FREE_LAWS.fewest_temperatures:
        of_samples = np.repeat(cold[:, None], position.shape[1], axis=1)
        found.append((UnnamedThermalFriction.id, COLD_FRACTION, of_samples, against_motion))
    out = []
    for effect, variable, at, sign in found:
        if not np.isfinite(at).all():
            continue
        low, high = float(at[inside].min()), float(at[inside].max())
        if variable is SINCE_REVERSAL:
            high = float(np.quantile(at[inside], 1.0 - FREE_LAWS.tail))
        if high - low > 1e-6 * max(abs(low), abs(high), 1e-6):
            more = FREE_LAWS.beyond * (high - low)
            low = low - more if variable in (POSITION, VELOCITY, COMMAND) else max(low - more, 0.0)
            high += more
            out.append(Covariate(effect, variable, at, sign, inside, low, high, (low, high)))
    return out


def _time_since_reversal(velocity: FloatArray, still: float, interval: float) -> FloatArray:
    """(segments, samples) time since the last reversal in s; since the start without one."""
    since, direction = np.zeros((2, len(velocity)))
    out = np.empty_like(velocity)
    for k, v in enumerate(velocity.T):
        since, direction = update_reversal_time(
            since, direction, v, np.full(len(v), still), interval
        )
        out[:, k] = since
    return out
