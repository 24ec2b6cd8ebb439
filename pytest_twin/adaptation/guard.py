"""Guard between a residual and the robot: bounds, valid region, monitors and fallback.

If any condition is not met, the force is zero for the whole robot and only the base model remains.
The fallback is not applied joint by joint, because the joints are coupled.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pytest_twin.adaptation_spec import ResidualSpec
from pytest_twin.arrays import FloatArray

Law = Callable[[FloatArray, FloatArray, FloatArray], "tuple[FloatArray, FloatArray | None]"]
"""Function from (position, velocity, command), each (j,), to force (j,) and its standard deviation
(or None)."""


@dataclass(frozen=True, slots=True)
class Sample:
    """Measured states and commands of the joints that a residual acts on.

    Attributes:
        time: time of the measurement, s.
        position, velocity, command: (j,) rad and rad/s or m and m/s.
    """

    time: float
    position: FloatArray
    velocity: FloatArray
    command: FloatArray


class Guard:
    """A residual that is applied only while all of its conditions are met.

    Args:
        spec: declaration with bounds and conditions.
        law: function that computes the residual.
    """

    def __init__(self, spec: ResidualSpec, law: Law) -> None:
        regions = list(spec.joints.values())
        self.spec, self.law = spec, law
        self.bound = np.array([region.bound for region in regions])
        self.low = np.array([[r.position[0], r.velocity[0]] for r in regions]).T
        self.high = np.array([[r.position[1], r.velocity[1]] for r in regions]).T
        self.jump = np.array([region.jump for region in regions])
        self.reasons: Counter[str] = Counter()
        """Condition -> number of samples at which it blocked the residual."""
        self.passed = 0
        """Number of samples at which the residual was applied."""
        self.restart()

    def restart(self) -> None:
        """Reset the state, as after a restart of the process."""
        self._blocked_until: float | None = None
        self._velocity: FloatArray | None = None
        self._saturated_since: float | None = None

    def force(self, now: float, sample: Sample | None) -> FloatArray:
        """Return the (j,) force to add to the base model, N*m or N; zero during a fallback.

        Args:
            now: current time, s.
            sample: newest sample, or None.
        """
        if self._blocked_until is None:
            self._blocked_until = now + self.spec.hold_off
        reason, force = self._judged(now, sample)
        if reason is not None:
            self.reasons[reason] += 1
            self._blocked_until = now + self.spec.hold_off
        elif now < self._blocked_until:
            self.reasons["waiting"] += 1
        else:
            self.passed += 1
            return force
        return np.zeros_like(self.bound)

    def _judged(self, now: float, sample: Sample | None) -> tuple[str | None, FloatArray]:
        none = np.zeros_like(self.bound)
        if sample is None:
            return "no sample", none
        state = np.stack([sample.position, sample.velocity])
        if not (np.isfinite(state).all() and np.isfinite(sample.command).all()):
            return "no sample", none
        if not -1e-9 <= now - sample.time <= self.spec.max_age:
            return "stale sample", none
        before, self._velocity = self._velocity, sample.velocity
        # A saturated sensor reads exactly the end of the region.
        if ((state <= self.low) | (state >= self.high)).any():
            return "outside the valid region", none
        if before is not None and (np.abs(sample.velocity - before) > self.jump).any():
            return "velocity jump", none
        raw, deviation = self.law(sample.position, sample.velocity, sample.command)
        if not np.isfinite(raw).all():
            return "not finite", none
        if self.spec.uncertainty is not None and (
            # A residual without standard deviation does not pass the monitor of uncertainty.
            deviation is None or not (deviation <= self.spec.uncertainty).all()
        ):
            return "uncertain", none
        if (np.abs(raw) > self.bound).any():
            since = now if self._saturated_since is None else self._saturated_since
            self._saturated_since = since
            if now - since > self.spec.hold_off:
                return "at its bound for too long", none
        else:
            self._saturated_since = None
        return None, np.clip(raw, -self.bound, self.bound)
