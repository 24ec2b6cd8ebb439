"""Compare a candidate with a release under the same commands, by criteria of the release.

Runs in the child process.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.adaptation.faults import inject
from pytest_twin.adaptation.guard import Guard
from pytest_twin.adaptation.guarded_simulation import Log, simulate
from pytest_twin.adaptation.laws import law_of
from pytest_twin.adaptation.update_trial import try_update
from pytest_twin.adaptation_spec import ShadowPolicy
from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.model import read_patched_model
from pytest_twin.diagnosis.patched.replay import replay_whole
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import Quantity, si_unit
from pytest_twin.errors import SpecError
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.open_loop import Replayed, replay, row_of
from pytest_twin.realization import Realization, load
from pytest_twin.time_limit import limited, skips
from pytest_twin.trial import Trial, make_trials
from pytest_twin.trial.read import recordings_at
from pytest_twin.trial.roles import refuse_final
from pytest_twin.twin import Twin, load_twin

_QUANTITY: Mapping[str, Quantity] = {
    "position": "position", "velocity": "velocity", "effort": "effort",
}  # fmt: skip
"""First word of a metric -> its quantity."""
ERRORS = ("position_rms", "velocity_rms", "position_max")
"""Metrics of predicted minus measured motion."""


@dataclass(frozen=True, slots=True)
class ComparedTwin:
    """The release or the candidate.

    Attributes:
        realization: its first realization.
    """

    twin: Twin
    realization: Realization

    @classmethod
    def of(cls, file: str) -> ComparedTwin:
        """Load a ``twin.yaml`` and its first realization.

        Raises:
            TwinError: the twin cannot be loaded.
        """
        twin = load_twin(Path(file))
        first = twin.first_realization
        return cls(twin, load(first.file, twin=twin, name=first.name))


def shadow(
    released: str, candidate: str, recordings: Sequence[str], seconds: float = 0.0
) -> dict[str, Any]:
    """Compare a candidate with a release over recordings, and inject faults into it.

    At the time limit and at a stop request of the parent, the comparison so far is the result, and
    the candidate is rejected.

    Args:
        released, candidate: ``twin.yaml`` of either.
        recordings: paths, in the order of time.
        seconds: limit of the processor time, s; 0 for none.

    Raises:
        TwinError: a twin does not load, a recording cannot be used, or a simulation diverges.
    """
    with limited(seconds) as limit:
        try:
            document = _compare(released, candidate, recordings)
        except OutOfTime:
            document = {
                "policy": {"metrics": {}, "safety": {}},
                "metrics": [], "faults": [], "acting": None, "notes": [],
            }  # fmt: skip
    document["not_tried"] = limit.not_tried
    if limit.not_tried:
        document["verdict"] = "rejected"
        document["notes"].insert(0, limit.note())
    return document


def _compare(released: str, candidate: str, recordings: Sequence[str]) -> dict[str, Any]:
    base, other = ComparedTwin.of(released), ComparedTwin.of(candidate)
    read = [
        recording
        for path in recordings
        for recording in recordings_at(Path(path), base.twin.topics, base.twin.recordings)
    ]
    for recording in read:
        refuse_final(recording.metadata, recording.path, "the choice of a candidate")
    trials = [
        trial
        for recording in read
        for trial in make_trials(recording, base.realization.structure, base.twin.recordings)
    ]
    policy = base.twin.shadow
    notes = []
    if other.twin.shadow != policy:
        notes.append("the candidate states other metrics under 'shadow:'; the release's count")
    if other.twin.update is not None:
        same = base.realization.parts == other.realization.parts
        try:
            document = try_update(
                other.twin.update, other.realization, trials, policy,
                None if same else base.realization, None if same else base.twin.update,
            )  # fmt: skip
        except SpecError as error:
            if error.path is not None or error.where is None:
                raise
            raise other.twin.error(
                error.where, error.problem, value=error.value, expected=error.expected
            ) from None
        document["update"]["units"] = [
            _unit_of_parameter(name, other.realization) for name in other.twin.update.parameters
        ]
    else:
        document = _compare_twins(base, other, trials, policy)
    for one in document["metrics"]:
        one["units"] = {
            joint: _unit_of_metric(one["metric"], joint, base.realization)
            for joint in one["joints"]
        }
    held = all(fault["holds"] for fault in document["faults"])
    met = all(one["met"] for one in document["metrics"])
    at_bounds = document.get("update", {}).get("at_bounds", [])
    return {
        "policy": {"metrics": dict(policy.metrics), "safety": dict(policy.safety)},
        **document,
        "verdict": "better" if met and held and not at_bounds else "rejected",
        "notes": [*notes, *document["notes"]],
    }


def _compare_twins(
    base: ComparedTwin, other: ComparedTwin, trials: Sequence[Trial], policy: ShadowPolicy
) -> dict[str, Any]:
    before = _replay_until_limit(base, trials)
    spec = other.twin.residual
    faults: list[dict[str, Any]] = []
    notes: list[str] = []
    acting = None
    if spec is None:
        after = _replay_until_limit(other, trials)
        notes.append("the candidate declares no residual and no update: no faults to inject")
    else:
        if read_patched_model(other.realization) is not None:
            raise SpecError(
                "a residual cannot be combined with effects outside the model's MJCF",
                path=other.realization.path,
                expected="a base model without an effects.json",
            )
        _require_joints(other, trials)
        law = law_of(spec)
        rows = [row_of(other.realization, trial) for trial in trials]
        logs: list[Log] = []
        after = []
        reasons: Counter[str] = Counter()
        passed = 0
        for row in rows[: len(before)]:
            if after and skips(f"recording {row.trial.name}"):
                continue
            guard = Guard(spec, law)
            result, log = simulate(row, guard)
            after.append(result)
            logs.append(log)
            passed += guard.passed
            reasons += guard.reasons
        total = max(passed + sum(reasons.values()), 1)
        acting = {
            "share": passed / total,
            "kept_out": {reason: count / total for reason, count in reasons.items()},
        }
        most = int(np.argmax([_active_samples(log) for log in logs]))
        faults = inject(spec, law, rows[most], logs[most])
    before = before[: len(after)]
    for result in (*before, *after):
        if result.error is not None:
            raise result.error
    return {
        "metrics": judge_metrics(measures(before), measures(after), policy),
        "faults": faults,
        "acting": acting,
        "notes": notes,
    }


def _replay_until_limit(side: ComparedTwin, trials: Sequence[Trial]) -> list[Replayed]:
    """Replay trials in order of time until the run must end.

    Raises:
        OutOfTime: before the first one.
    """
    replayed = []
    for trial in trials:
        if skips(f"recording {trial.name}"):
            break
        replayed.append(_replay(side, trial))
    if not replayed:
        raise OutOfTime
    return replayed


def _unit_of_metric(metric: str, joint: str, realization: Realization) -> str:
    """Unit of a metric of a joint; of ``all``, the unit of the joints if they have one."""
    quantity = _QUANTITY[metric.partition("_")[0]]
    kinds = realization.structure.joint_type
    own = [kinds[joint]] if joint in kinds else list(kinds.values())
    return " or ".join(dict.fromkeys(si_unit(quantity, kind == "slide") for kind in own))


def _unit_of_parameter(name: str, realization: Realization) -> str:
    joint, _, parameter = name.rpartition(".")
    law = catalogue()[parameter].parameters[0]
    return law.unit(realization.structure.joint_type[joint])


def _require_joints(side: ComparedTwin, trials: Sequence[Trial]) -> None:
    assert side.twin.residual is not None
    for trial in trials:
        for joint in side.twin.residual.joints:
            if joint not in trial.joints:
                raise SpecError(
                    "a joint of the residual is not in a recording",
                    path=trial.path,
                    where=f"residual.joints.{joint}",
                    expected=", ".join(trial.joints),
                )


def _replay(side: ComparedTwin, trial: Trial) -> Replayed:
    patched = read_patched_model(side.realization)
    if patched is not None:
        return replay_whole(side.realization, patched, trial)
    return replay(side.realization, [trial])[0]


def _active_samples(log: Log) -> float:
    _, force = log.table
    return float(np.count_nonzero(np.any(force != 0.0, axis=1)))


def measures(replayed: Sequence[Replayed]) -> dict[str, dict[str, float]]:
    """Return metric -> joint -> value over all trials; NaN if nothing was measured.

    ``position_rms``, ``position_max`` and ``velocity_rms`` are errors, predicted minus measured.
    ``velocity_peak`` and ``effort_peak`` are of the prediction. All are in SI units.
    """
    joints = sorted({joint for one in replayed for joint in one.trial.joints})
    found: dict[str, dict[str, float]] = {
        name: {} for name in (*ERRORS, "velocity_peak", "effort_peak")
    }
    for joint in joints:
        position, velocity, speed, effort = (np.zeros(0) for _ in range(4))
        for one in replayed:
            if joint not in one.trial.joints:
                continue
            at = one.trial.joints.index(joint)
            position = np.append(position, one.position[:, at] - one.trial.position[:, at])
            if one.trial.velocity is not None:
                left = one.velocity[:, at] - one.trial.velocity[:, at]
                velocity = np.append(velocity, left)
            speed = np.append(speed, np.abs(one.velocity[:, at]))
            effort = np.append(effort, np.abs(one.effort[:, at]))
        found["position_rms"][joint] = _rms(position)
        found["position_max"][joint] = _largest(position)
        found["velocity_rms"][joint] = _rms(velocity)
        found["velocity_peak"][joint] = _largest(speed)
        found["effort_peak"][joint] = _largest(effort)
    return found


def _rms(values: FloatArray) -> float:
    some = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(some)))) if len(some) else float("nan")


def _largest(values: FloatArray) -> float:
    some = values[np.isfinite(values)]
    return float(np.abs(some).max()) if len(some) else float("nan")


def judge_metrics(
    before: Mapping[str, Mapping[str, float]],
    after: Mapping[str, Mapping[str, float]],
    policy: ShadowPolicy,
) -> list[dict[str, Any]]:
    """Return each declared metric with both values and whether the candidate meets it.

    A metric must decrease by its declared fraction, on average over joints. A safety metric may
    increase by at most its declared fraction on each joint. A declared metric without measurements
    is not met.
    """
    listed = []
    for safety, table in ((False, policy.metrics), (True, policy.safety)):
        for name, share in table.items():
            both = {
                joint: (before[name][joint], after[name][joint])
                for joint in before[name]
                if np.isfinite([before[name][joint], after[name][joint]]).all()
            }
            rises = [_rise(*pair) for pair in both.values()]
            # A joint with zero error in both is unchanged.
            rise = (max(rises) if safety else float(np.mean(rises))) if rises else None
            met = rise is not None and (rise <= share if safety else rise <= -share)
            listed.append(
                {
                    "metric": name,
                    "safety": safety,
                    "declared": share,
                    "change": rise,
                    "met": bool(met),
                    "joints": {
                        joint: {"release": pair[0], "candidate": pair[1]}
                        for joint, pair in both.items()
                    },
                }
            )
    return listed


def _rise(before: float, after: float) -> float:
    """Relative increase (after - before) / before; zero if both are zero."""
    if before == after:
        return 0.0
    return (after - before) / before if before > 0.0 else 1e9
