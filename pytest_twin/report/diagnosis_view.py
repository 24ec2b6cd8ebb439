"""Collect the data for the report of a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from pytest_twin.arrays import FloatArray

if TYPE_CHECKING:
    from pytest_twin.diagnosis.diagnose import Diagnosis
    from pytest_twin.diagnosis.patched.model import AppliedEffect, Patched


@dataclass(frozen=True, slots=True)
class Regime:
    """RMS errors in one regime of the motion.

    Attributes:
        name: description with units.
        before, after: RMS error of the model and of the patched model, rad or m.
        share: share of the time.
    """

    name: str
    before: float
    after: float
    share: float


@dataclass(frozen=True, slots=True)
class JointView:
    """Data of one joint's figure.

    Attributes:
        joint: name of the joint.
        unit: ``rad`` or ``m``.
        recording: recording that is drawn over time.
        time, measured, before, after: (n,) time [s], measured position, and predictions of model
            and patched model in this recording.
        command_time, command: (m,) time and position commands, or None.
        floor: noise floor.
        left_before, left_after: (s,) residuals, measured minus predicted, in the test recordings.
        velocity, position, load: (s,) motion at these samples; rad/s or m/s, and N*m or N.
        stretches: number of samples of each test recording; they add up to s.
        interval: median sampling interval, s.
        regimes: RMS errors by regime.
        windows: (effect, start, end) of the findings in the drawn recording, s.
    """

    joint: str
    unit: str
    recording: str
    time: FloatArray
    measured: FloatArray
    before: FloatArray
    after: FloatArray
    command_time: FloatArray | None
    command: FloatArray | None
    floor: float
    left_before: FloatArray
    left_after: FloatArray
    velocity: FloatArray
    position: FloatArray
    load: FloatArray
    stretches: tuple[int, ...]
    interval: float
    regimes: tuple[Regime, ...]
    windows: tuple[tuple[str, float, float], ...]


@dataclass(frozen=True, slots=True)
class DiagnosisView:
    """Content of one report.

    Attributes:
        model: name of the diagnosed model.
        created: RFC 3339.
        document: content of ``diagnosis.json``.
        joints: figures, the largest error in noise floors first.
        floor_parts: source -> joint -> RMS in the joint's unit.
        is_simulated: whether predictions contain the integration error of the time step.
        step_left: share of that error that is in the floor.
        native: changes in the patched MJCF, one line each.
        outside_mjcf: effects that MJCF cannot express, applied by ``pytest-twin replay``.
        tried: number of candidate effects.
        laws: effect -> (equation, source).
        at_floor, share_left, left_floors: limits of an explained joint, see
            :mod:`pytest_twin.diagnosis.verdict`.
    """

    model: str
    created: str
    document: Mapping[str, Any]
    joints: tuple[JointView, ...]
    floor_parts: Mapping[str, Mapping[str, float]]
    is_simulated: bool
    step_left: float
    native: tuple[str, ...]
    outside_mjcf: tuple[str, ...]
    tried: int
    laws: Mapping[str, tuple[str, str]]
    at_floor: float
    share_left: float
    left_floors: float


def view_of(
    found: Diagnosis, document: Mapping[str, Any], patched: Patched, model: str
) -> DiagnosisView:
    """Return the content of the report.

    Args:
        found: the diagnosis.
        document: its ``diagnosis.json``.
        patched: the patched model that was written.
        model: name of the diagnosed model.
    """
    from pytest_twin.diagnosis.verdict_settings import VERDICT
    from pytest_twin.effects import catalogue

    tested = found.tested.prepared
    joints = tested.problem.joints
    return DiagnosisView(
        model=model,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        document=document,
        joints=joint_views(found),
        floor_parts={
            source: dict(zip(joints, map(float, values), strict=True))
            for source, values in tested.floor_parts.items()
        },
        is_simulated=patched.substeps > 0,
        step_left=tested.problem.step_left,
        native=tuple(f"{_at(e)}: {e.written}" for e in patched.effects if e.written),
        outside_mjcf=tuple(_at(e) for e in patched.outside_mjcf),
        tried=found.selected.tried,
        laws={id: (law.law, law.source) for id, law in catalogue().items()},
        at_floor=VERDICT.at_floor,
        share_left=VERDICT.left,
        left_floors=VERDICT.left_floors,
    )


def _at(effect: AppliedEffect) -> str:
    name = effect.effect.replace("_", " ")
    return name if effect.joint is None else f"{name} at joint {effect.joint}"


def joint_views(found: Diagnosis) -> tuple[JointView, ...]:
    """Return figure data of all joints, the largest error in noise floors first."""
    from pytest_twin.diagnosis.locate import motions, regimes

    tested = found.tested
    problem, prepared = tested.prepared.problem, tested.prepared
    everything = (*tested.trials.fit, *tested.trials.held_out)
    every, shown = problem.everywhere, problem.tested
    lengths = problem.lengths(every)
    starts = np.concatenate([[0], np.cumsum(lengths)])
    inside = problem.in_test
    paths = [
        m for m, t in zip(motions(prepared, everything), np.isin(every, shown), strict=True) if t
    ]
    owners = sorted({prepared.segment_trial[s] for s in shown})
    views = []
    for j, joint in enumerate(problem.joints):
        error = found.errors.get(joint)
        if error is None:
            continue
        left = [r[inside, j] for r in (tested.before, tested.after)]
        worst = max(
            owners,
            key=lambda o: _rms(
                np.concatenate(
                    [
                        tested.before[starts[s] : starts[s + 1], j]
                        for s in shown
                        if prepared.segment_trial[s] == o
                    ]
                )
            ),
        )
        parts = [s for s in shown if prepared.segment_trial[s] == worst]
        segments = [problem.simulator.segments[s] for s in parts]
        rows = np.concatenate([np.arange(starts[s], starts[s + 1]) for s in parts])
        measured = np.concatenate([s.position[:, j] for s in segments])
        name = everything[worst].path.name
        commanded = (
            segments[0].mode_of(j) == "position" and np.isfinite(segments[0].command[:, j]).all()
        )
        views.append(
            JointView(
                joint=joint,
                unit=error.unit,
                recording=name,
                time=everything[worst].offset + np.concatenate([s.time for s in segments]),
                measured=measured,
                before=measured - tested.before[rows, j],
                after=measured - tested.after[rows, j],
                command_time=everything[worst].offset + segments[0].command_time
                if commanded
                else None,
                command=segments[0].command[:, j] if commanded else None,
                floor=error.floor,
                left_before=left[0],
                left_after=left[1],
                velocity=np.concatenate([m.velocity[:, j] for m in paths]),
                position=np.concatenate([m.position[:, j] for m in paths]),
                load=np.concatenate([m.load[:, j] for m in paths]),
                stretches=tuple(lengths[s] for s in shown),
                interval=float(np.median(np.diff(segments[0].time))),
                regimes=tuple(
                    Regime(text, _rms(left[0][mask]), _rms(left[1][mask]), float(mask.mean()))
                    for text, mask in regimes(paths, j, error.unit)
                    if 0.02 < mask.mean() < 0.9
                ),
                windows=tuple(
                    (f.effect, float(a), float(b))
                    for f in found.explained.findings
                    if f.joint in (None, joint)
                    for a, b in f.where.windows.get(name, ())
                ),
            )
        )
    views.sort(key=lambda v: -(_rms(v.left_before) / max(v.floor, 1e-300)))
    return tuple(views)


def _rms(values: FloatArray) -> float:
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0
