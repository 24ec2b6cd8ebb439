"""Stiffness and damping of position servos, from command, position and measured effort."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import si_unit
from pytest_twin.estimation.score import effective_samples
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.document import parameter_entry
from pytest_twin.identification.effort.delay import without_delay
from pytest_twin.identification.effort.drive_gains import as_torques
from pytest_twin.identification.effort.effort_scale import divide_by_scales
from pytest_twin.identification.effort.essential_parameters import SIGNIFICANT
from pytest_twin.identification.effort.filtering import Filter, differentiate, resample_uniformly
from pytest_twin.identification.effort.identify_effort import EffortResult
from pytest_twin.identification.effort.least_squares import LinearProblem, solve
from pytest_twin.identification.effort.recording_rows import inner_rows
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.realization import Realization
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.realization.inputs import LINEAR_GAINS, joint_inputs
from pytest_twin.signals import Signals

_OTHER_LAW = 0.3
"""Residual, relative to the effort's deviation, above which the effort does not follow the law."""
_WIDEST = 0.5
"""Relative half width of the stiffness above which the motion does not determine it."""
_FEWEST_ROWS = 50
_LEVELS = 10
"""Number of groups of rows by the effort of the law."""
_DELAY_ROUNDS = 4
"""Largest number of estimates of a delay, each linearized about the previous one."""
_LATEST = 0.3
"""Largest delay of a command, s, as in the catalogue."""
_WITHIN_SAMPLE = 0.5
"""Share of a sample by which the readings of effort and position may lie apart in time. It is
unknown, and shifts the damping by the stiffness times this time."""
_ESTIMATOR = "weighted least squares"


@dataclass(frozen=True, slots=True)
class ServoGains:
    """Gains of one joint's position servo: effort = stiffness (command - q) - damping v.

    Attributes:
        joint, actuator: names in the model.
        stiffness, damping: N*m/rad and N*m*s/rad, or N/m and N*s/m.
        half_widths: half widths of their 95 % intervals.
        delay: time, s, by which commands act late, and half width of its 95 % interval; of commands
            that move on between their stamps.
        sample: time between two states, s.
        nominal: the model's stiffness and damping.
        transmission: square of the actuator's gear in the model.
        is_slide: whether the joint is prismatic.
        misfit: systematic difference from this law, relative to the effort's deviation: the part of
            the residual that depends on the law's effort, on its rate and on the direction of
            motion, and the effect of a delay of more than a sample.
    """

    joint: str
    actuator: str
    stiffness: float
    damping: float
    half_widths: tuple[float, float]
    delay: tuple[float, float]
    sample: float
    nominal: tuple[float, float]
    transmission: float
    is_slide: bool
    misfit: float

    def parameters(self) -> dict[str, dict[str, Any]]:
        """Return ``JOINT.servo_stiffness`` and ``JOINT.servo_damping`` for a record."""
        rows = zip(
            ("servo_stiffness", "servo_damping"), (self.stiffness, self.damping),
            self.half_widths, self.nominal,
            (si_unit("stiffness", self.is_slide), si_unit("damping", self.is_slide)), strict=True,
        )  # fmt: skip
        return {
            f"{self.joint}.{name}": parameter_entry(
                value, half, of, prior=nominal, stage="closed_loop", used=True, estimator=_ESTIMATOR
            )
            for name, value, half, nominal, of in rows
        }

    @property
    def is_late(self) -> bool:
        """Whether the delay differs significantly from zero."""
        return self.delay[0] * Z95 >= SIGNIFICANT * self.delay[1]

    def command_delay(self, is_held: bool) -> float:
        """Return the delay, s. A held command is half a sample late on the average already."""
        return max(self.delay[0] - (0.5 * self.sample if is_held else 0.0), 0.0)

    def delay_parameter(self, is_held: bool) -> dict[str, dict[str, Any]]:
        """Return ``JOINT.command_delay`` for a record."""
        value, half = self.command_delay(is_held), self.delay[1]
        return {
            f"{self.joint}.command_delay": parameter_entry(
                value, half, "s", prior=0.0, stage="delay", used=True, estimator=_ESTIMATOR
            )
        }

    def patch(self) -> dict[str, float]:
        """Return ``kp`` and ``kv`` of the actuator, as ``fit:`` of a twin states them."""
        return {
            "kp": self.stiffness / self.transmission,
            "kv": max(self.damping, 0.0) / self.transmission,
        }

    @property
    def words(self) -> str:
        """Describe the gains and the model's."""
        unit = si_unit("stiffness", self.is_slide)
        return f"{self.joint} {self.stiffness:.4g} {unit} (model {self.nominal[0]:.4g})"


def servo_gains(
    realization: Realization,
    recordings: Sequence[MeasuredRecording],
    found: EffortResult,
    signals: Signals,
) -> list[ServoGains]:
    """Fit the gains of the model's position servos to effort and tracking error.

    Joints are left out whose effort does not follow the law: another controller, a feedforward, or
    an integral term. Recordings of controllers that the twin declares have their gains there.

    Args:
        found: identification, whose delay, gains and scales of efforts are removed.
        signals: meaning of the recorded signals.
    """
    declared = {} if realization.twin is None else realization.twin.controllers
    recordings = [one for one in recordings if one.metadata.get("controller") not in declared]
    used = {joint: s for joint, s in found.scales.items() if s.is_significant}
    right = divide_by_scales(as_torques(recordings, found.gains), used)
    if found.delay is not None:
        right = without_delay(right, found.delay.value, found.delay.name)
    right = tuple(one for one in right if one.command is not None)
    gains = []
    for k, joint in enumerate(right[0].joints if right else ()):
        servo = _servo(realization, joint)
        shared = signals.of(joint).shared is not None
        if servo is None or shared or any(one.unscaled[k] for one in right):
            continue
        fit = _fit_gains(realization, right, k, found.filter)
        if fit is not None:
            model = realization.model
            gear = float(model.actuator_gear[model.actuator_outadr[servo], 0])
            bias = -(gear**2) * model.actuator_biasprm[servo]
            gains.append(
                ServoGains(
                    joint, model.actuator(servo).name, *fit.gains, fit.half_widths,
                    fit.delay, fit.sample,
                    (float(bias[1]), float(bias[2])), gear**2,
                    realization.structure.joint_type[joint] == "slide", fit.misfit,
                )
            )  # fmt: skip
    return gains


def _servo(realization: Realization, joint: str) -> int | None:
    """Return the only position servo with linear gains and a name that drives a joint."""
    model = realization.model
    servos = [
        one.actuator
        for one in joint_inputs(model, joint)
        if one.mode == "position"
        and int(model.actuator_gaintype[one.actuator]) in LINEAR_GAINS
        and int(model.actuator_dyntype[one.actuator]) == int(mujoco.mjtDyn.mjDYN_NONE)
        and model.actuator(one.actuator).name
    ]
    return servos[0] if len(servos) == 1 else None


@dataclass(frozen=True, slots=True)
class _Fit:
    """Fit of one servo, as in :class:`ServoGains`."""

    gains: tuple[float, float]
    half_widths: tuple[float, float]
    delay: tuple[float, float]
    sample: float
    misfit: float


def _fit_gains(
    realization: Realization, recordings: Sequence[MeasuredRecording], k: int, chosen: Filter
) -> _Fit | None:
    """Return the gains of one joint; None if its effort does not follow the law of a servo.

    The rate of the command has its own column, which takes up a delay of the command. The command
    is shifted by this delay, and the fit repeated.
    """
    period = max(1.0 / one.rate for one in recordings)
    delay = 0.0
    for _ in range(_DELAY_ROUNDS):
        rows = _servo_rows(realization, recordings, k, chosen, delay)
        if rows is None:
            return None
        problem, solution = rows, solve(rows)
        stiffness, damping, lateness = (float(value) for value in solution.values[:3])
        spread = float(problem.effort[problem.known].std())
        half = solution.half_width
        if solution.noise[0] > _OTHER_LAW * spread or half[0] > _WIDEST * stiffness:
            return None
        # The command c(t - d) is c(t) - d dc/dt to first order.
        shift = float(np.clip(delay - lateness / stiffness, 0.0, _LATEST)) - delay
        if abs(shift) <= half[2] / stiffness:
            break
        delay += shift
    law = problem.matrix[:, 0] @ solution.values
    within_sample = _WITHIN_SAMPLE * period
    rate = float(problem.matrix[problem.known[:, 0], 0, 2].std())
    # A logged effort may belong to the command before or after its stamp. What looks like a longer
    # delay may be a lag.
    longest = max(abs(lateness), delay * stiffness) - float(half[2])
    late = max(longest - period * stiffness, 0.0) * rate
    misfit = float(np.hypot(_systematic_deviation(problem, law), late)) / spread
    return _Fit(
        (stiffness, damping),
        (float(half[0]), float(np.hypot(half[1], within_sample * stiffness))),
        (delay, float(np.hypot(half[2] / stiffness, within_sample))),
        period,
        misfit,
    )


def _servo_rows(
    realization: Realization,
    recordings: Sequence[MeasuredRecording],
    k: int,
    chosen: Filter,
    delay: float,
) -> LinearProblem | None:
    """Return the rows of one servo with its command shifted by a delay, s; None for too few."""
    encoders = Encoders.of(calibration_of(realization), recordings[0].joints)
    columns, efforts, known = [], [], []
    for one in recordings:
        even = resample_uniformly(one)
        assert even.command is not None
        command = encoders.model_position(even.command)
        if not np.isfinite(command[:, k]).all() or not np.isfinite(even.effort[:, k]).all():
            continue
        command[:, k] = np.interp(even.time - delay, even.time, command[:, k])
        motion = differentiate(even, chosen)
        asked = differentiate(replace(even, position=command), chosen)
        rows = np.stack(
            [
                asked.position[:, k] - motion.position[:, k],
                -motion.velocity[:, k],
                asked.velocity[:, k],
                np.ones(len(motion.time)),
            ],
            axis=1,
        )
        columns.append(inner_rows(rows, motion, chosen))
        efforts.append(inner_rows(motion.effort[:, k : k + 1], motion, chosen))
        known.append(np.abs(efforts[-1]) < 0.98 * one.limit[k])
    if sum(map(len, columns)) < _FEWEST_ROWS:
        return None
    matrix, effort = np.concatenate(columns)[:, None], np.concatenate(efforts)
    seen = np.concatenate(known)
    return LinearProblem(
        matrix, np.where(seen, effort, 0.0), seen, np.zeros_like(seen),
        np.zeros((1, matrix.shape[2]), dtype=bool), tuple(len(one) for one in columns),
    )  # fmt: skip


def _systematic_deviation(problem: LinearProblem, law: FloatArray) -> float:
    """Return the deviation of the residual's part that another law would explain, without noise.

    It is the variance between groups of rows with a similar effort of the law and the same
    direction of motion, minus what noise causes in so many groups (analysis of variance).

    Args:
        problem: rows of one joint; the second column is minus its velocity.
        law: (n,) effort of the fitted law.
    """
    seen = problem.known[:, 0]
    residual = np.where(seen, problem.effort[:, 0] - law, 0.0)
    ends = np.cumsum(problem.lengths)
    slope = np.concatenate([
        np.gradient(law[end - n : end]) for end, n in zip(ends, problem.lengths, strict=True)
    ])  # fmt: skip
    level = np.searchsorted(np.quantile(law[seen], np.linspace(0.0, 1.0, _LEVELS + 1)[1:-1]), law)
    group = 2 * level + (problem.matrix[:, 0, 1] > 0.0)
    columns = np.column_stack([np.equal.outer(group, np.arange(2 * _LEVELS)), slope])[seen]
    columns = columns[:, np.abs(columns).sum(axis=0) > 0.0]
    left = residual[seen]
    explained = columns @ np.linalg.lstsq(columns, left, rcond=None)[0]
    rest = left - explained
    count = float(effective_samples(np.where(seen, residual, 0.0)[:, None], problem.lengths)[0])
    noise = columns.shape[1] * float(np.mean(rest**2)) / max(count - columns.shape[1], 1.0)
    return float(np.sqrt(max(float(np.mean(explained**2)) - noise, 0.0)))
