"""Replay of a patched realization: its MJCF and the effects that MJCF cannot express."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.delays import effects_outside_mjcf, without_delays
from pytest_twin.diagnosis.patched.model import AppliedEffect, PatchedModel
from pytest_twin.diagnosis.patched.ranges import describe_range_exits
from pytest_twin.diagnosis.problem import REFINE, add_step_error, step_error
from pytest_twin.diagnosis.temperature import cold_fraction_of_trial
from pytest_twin.diagnosis.windows import segments_of
from pytest_twin.effects import catalogue
from pytest_twin.effects.active_effects import EffectValues
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Predicted, Segment
from pytest_twin.errors import RecordingError, SimulationError
from pytest_twin.open_loop import Replayed, replay
from pytest_twin.realization import Realization
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.trial import Trial

Progress = Callable[[float], None]


def fixed_values(
    effects: Sequence[AppliedEffect], joints: Sequence[str], rows: int
) -> EffectValues:
    """Parameters of effects as (rows, joints) arrays; neutral where an effect is absent.

    Parameters with a neutral value add up over several entries of one effect at one joint; relative
    errors multiply. Entries of other joints are ignored.
    """
    out: dict[str, dict[str, FloatArray]] = {}
    for e in effects:
        if e.joint not in (None, *joints):
            continue
        law = catalogue()[e.effect]
        if e.effect not in out:
            out[e.effect] = {
                p.name: np.full((rows, len(joints)), p.absent_value) for p in law.parameters
            }
        column: slice | int = slice(None) if e.joint is None else list(joints).index(e.joint)
        for p in law.parameters:
            value = e.values.get(p.name)
            if value is None:
                continue
            array = out[e.effect][p.name]
            present = array[:, column]
            array[:, column] = value if p.neutral is None else p.combined(present, value)
    return out


def replay_patched(
    realization: Realization, patched: PatchedModel, trials: Sequence[Trial], *, threads: int = 0
) -> list[Predicted]:
    """Open-loop predictions of sensor readings of whole trials, at their stamps.

    Args:
        realization: loaded from the patched folder.
        trials: trials, of which only commands and initial states are used.

    Returns:
        One prediction per trial: columns are ``patched.joints``, rows the trial's states.

    Raises:
        RecordingError: a recording lacks a joint that the effects act on, or a temperature that
            they depend on.
        SimulationError: a simulation diverged.
    """
    without_delay_lines = without_delays(realization)
    out = []
    for trial in trials:
        segment = patched_segment(without_delay_lines, patched, trial)
        (predicted,) = predict_segments(realization, patched, trial, [segment], threads=threads)
        out.append(predicted)
    return out


def patched_segment(realization: Realization, patched: PatchedModel, trial: Trial) -> Segment:
    """The whole trial as a segment to simulate with the effects of a patched realization.

    Args:
        realization, patched: as for :func:`replay_patched`.
        trial: the trial, of which only commands and initial state are used.

    Raises:
        RecordingError: as for :func:`replay_patched`.
    """
    missing = [j for j in patched.joints if j not in trial.joints]
    if missing:
        raise RecordingError(
            "a joint of the diagnosed model is not in the recording",
            path=trial.path,
            value=", ".join(missing),
            expected=", ".join(patched.joints),
        )
    return whole_segment(
        without_delays(realization),
        trial,
        patched.joints,
        cold_fraction_of_trial(patched.cold_fractions, trial),
        has_friction_creep=patched.has_friction_creep,
    )


def predict_segments(
    realization: Realization,
    patched: PatchedModel,
    trial: Trial,
    segments: Sequence[Segment],
    *,
    variants: Sequence[PatchedModel] = (),
    threads: int = 0,
) -> list[Predicted]:
    """Predicted sensor readings of a trial for variants of its segment, at its stamps.

    Args:
        realization, patched: as for :func:`replay_patched`.
        segments: variants of :func:`patched_segment`: with another model or with added forces.
        variants: the effects of each segment, with other values; by default those of ``patched``.
        threads: number of threads, 0 for all cores.

    Raises:
        SimulationError: a simulation diverged.
    """
    out = []
    for segment, predicted in zip(
        segments,
        _predict(realization, variants or [patched] * len(segments), segments, threads),
        strict=True,
    ):
        if not np.isfinite(predicted.position).all():
            raise SimulationError(
                "the simulation diverged",
                path=trial.path,
                expected="finite joint positions; check the unit of the commands, or diagnose "
                "again with this recording among those that are fitted",
            )
        out.append(_as_measured(predicted, segment, trial, realization, patched.joints))
    return out


def replay_whole(
    realization: Realization,
    patched: PatchedModel,
    trial: Trial,
    *,
    progress: Progress | None = None,
) -> Replayed:
    """The replay of one trial with all effects, in the form of a plain replay.

    Joints without effects, and the rest of the configuration, are those of the MJCF alone.

    Raises:
        RecordingError, SimulationError: as :func:`replay_patched`.
    """
    plain = replay(realization, [trial], progress=progress)[0]
    predicted = replay_patched(realization, patched, [trial])[0]
    columns = [trial.joints.index(joint) for joint in patched.joints]
    encoders = Encoders.of(calibration_of(realization), patched.joints)
    configuration = [realization.joint_qpos_index(joint) for joint in patched.joints]
    return replace(
        plain,
        position=with_columns(plain.position, columns, predicted.position),
        velocity=with_columns(plain.velocity, columns, predicted.velocity),
        effort=with_columns(plain.effort, columns, predicted.effort),
        qpos=with_columns(plain.qpos, configuration, encoders.model_position(predicted.position)),
        error=None,
        notes=(
            *plain.notes,
            *describe_effects_outside_mjcf(patched),
            *describe_range_exits(realization, patched, trial.time, predicted),
        ),
    )


def with_columns(table: FloatArray, columns: Sequence[int], values: FloatArray) -> FloatArray:
    """Return a copy of the table with other values in these columns."""
    changed = table.copy()
    changed[:, columns] = values
    return changed


def describe_effects_outside_mjcf(patched: PatchedModel) -> tuple[str, ...]:
    """Return a line that names the effects that MJCF cannot express; empty without any."""
    named = (e.effect + ("" if e.joint is None else f" of {e.joint}") for e in patched.outside_mjcf)
    text = ", ".join(named)
    return (f"effects applied in addition to the MJCF: {text}",) if text else ()


def _predict(
    realization: Realization,
    variants: Sequence[PatchedModel],
    segments: Sequence[Segment],
    threads: int,
) -> list[Predicted]:
    """Return the prediction of each segment as in the diagnosis.

    The integration error of the model's step is removed, unless the recordings come from a
    simulation with this error.
    """
    count, patched = len(segments), variants[0]
    each = [fixed_values(effects_outside_mjcf(realization, one), one.joints, 1) for one in variants]
    values = {
        effect: {name: np.concatenate([one[effect][name] for one in each]) for name in own}
        for effect, own in each[0].items()
    }

    def simulate(refine: int) -> list[Predicted]:
        simulator = BatchSimulator(segments, patched.joints, threads=threads, refine=refine)
        return simulator.simulate(np.arange(count), values)

    if patched.substeps:
        return simulate(patched.substeps)
    return [
        add_step_error(coarse, step_error(coarse, fine))
        if np.isfinite(fine.position).all()
        else coarse
        for coarse, fine in zip(simulate(1), simulate(REFINE), strict=True)
    ]


def _as_measured(
    predicted: Predicted,
    segment: Segment,
    trial: Trial,
    realization: Realization,
    joints: Sequence[str],
) -> Predicted:
    """The prediction at every state of the trial, in the units and signs of its encoders."""
    encoders = Encoders.of(calibration_of(realization), joints)
    at = np.clip(np.searchsorted(segment.time, trial.time), 0, len(segment.time) - 1)
    return Predicted(
        encoders.read_position(predicted.position[at]),
        encoders.read_velocity(predicted.velocity[at]),
        encoders.signed(predicted.effort[at]),
    )


def whole_segment(
    realization: Realization,
    trial: Trial,
    joints: Sequence[str],
    cold_fraction: float,
    *,
    has_friction_creep: bool = False,
) -> Segment:
    """One segment from the first state of a trial to its last."""
    parts = segments_of(
        realization,
        trial,
        0,
        joints,
        cold_fraction=cold_fraction,
        has_friction_creep=has_friction_creep,
    )
    if len(parts) == 1:
        return parts[0]
    kept = [np.concatenate([[True], np.diff(p.time) > 0]) for p in parts]
    for before, here, keep in zip(parts[:-1], parts[1:], kept[1:], strict=True):
        keep &= here.time > before.time[-1]

    def joined(name: str) -> Any:
        values = [getattr(p, name) for p in parts]
        if any(v is None for v in values):
            return None
        return np.concatenate([v[k] for v, k in zip(values, kept, strict=True)])

    return replace(parts[0], **{n: joined(n) for n in ("time", "position", "velocity", "effort")})
