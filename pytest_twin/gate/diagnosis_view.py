"""Collect the data for the report of a diagnosis.

This module runs in the child process.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.diagnose import Diagnosis
from pytest_twin.diagnosis.locate import list_regimes, smooth_motions
from pytest_twin.diagnosis.patched.model import AppliedEffect, PatchedModel
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.effects import catalogue
from pytest_twin.report.diagnosis_view import DiagnosisView, JointView, Regime


def view_of(
    found: Diagnosis, document: Mapping[str, Any], patched: PatchedModel, model: str
) -> DiagnosisView:
    """Return the content of the report.

    Args:
        document: its ``diagnosis.json``.
        patched: the patched model that was written.
        model: name of the diagnosed model.
    """
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
        tried=found.candidate_count,
        laws={id: (law.law, law.source) for id, law in catalogue().items()},
        at_floor=VERDICT.at_floor,
    )


def _at(effect: AppliedEffect) -> str:
    name = effect.effect.replace("_", " ")
    return name if effect.joint is None else f"{name} at joint {effect.joint}"


def joint_views(found: Diagnosis) -> tuple[JointView, ...]:
    """Return figure data of all joints, the largest error in noise floors first."""
    tested = found.tested
    problem, prepared = tested.prepared.problem, tested.prepared
    everything = (*tested.trials.fit, *tested.trials.held_out)
    every, shown = problem.all_segments, problem.tested_segments
    lengths = problem.lengths(every)
    starts = np.concatenate([[0], np.cumsum(lengths)])
    inside = problem.is_in_test
    paths = [
        m
        for m, t in zip(smooth_motions(prepared, everything), np.isin(every, shown), strict=True)
        if t
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
                    for text, mask in list_regimes(paths, j, error.unit)
                    if 0.02 < mask.mean() < 0.9
                ),
                windows=tuple(
                    (f.effect, float(a), float(b))
                    for f in found.explanation.findings
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
