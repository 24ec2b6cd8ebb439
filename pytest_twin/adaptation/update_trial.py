"""Test an online update on recordings in order of time, and under sensor faults."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pytest_twin.adaptation.recursive import Disturb, Recursion, Window, track
from pytest_twin.adaptation.updated_parameters import base_parameters, predicted_positions
from pytest_twin.adaptation_spec import ShadowPolicy, UpdateSpec
from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.model import read_patched_model
from pytest_twin.errors import RecordingError
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.open_loop import Row, replay_rows, row_of
from pytest_twin.realization import Realization
from pytest_twin.time_limit import is_over, skips
from pytest_twin.trial import Trial

_FIRST_FAULT, _FAULT_WINDOWS = 4, 3
"""Number of windows before a fault, and of consecutive windows with it."""
_TRIED_WINDOWS = 12
"""Number of windows of motion for testing a fault: before, during and after it."""
_WORSE = 1.05
"""Largest ratio of the update's error to the base's error, over all windows including the fault."""
_RESTING_WINDOWS = 3
"""Number of last updates at a bound after which an estimate rests there: one may touch it by
chance."""
_SEED = 57


def try_update(
    spec: UpdateSpec,
    realization: Realization,
    trials: Sequence[Trial],
    policy: ShadowPolicy,
    released: Realization | None = None,
    released_update: UpdateSpec | None = None,
) -> dict[str, Any]:
    """Run an update and compare it with the base; each window is predicted before it is used.

    Args:
        trials: trials in order of time.
        released: realization of the release, if its model is different. The candidate must then
            improve on its prediction, so that an update cannot hide a worse model.
        released_update: update of the release, if its model is different and it has one.

    Raises:
        SpecError: the model lacks parameters.
        RecordingError: no recording is long enough for a window.
        OutOfTime: the run must end before the first window.
    """
    rows = [row_of(realization, trial) for trial in trials]
    recursion = Recursion(
        spec, base_parameters(spec, rows[0].model, read_patched_model(realization))
    )
    windows = track(recursion, rows, base=realization)
    if not windows and is_over():
        raise OutOfTime
    if not windows:
        raise RecordingError(
            "no window of motion to update from",
            path=trials[0].path,
            expected=f"recordings of more than {spec.window:g} s with dense positions",
        )
    before = [w.base_rms for w in windows]
    notes = ["metrics are over windows, each predicted before it was learned from"]
    if released is not None:
        others = [row_of(released, trial) for trial in trials]
        release_spec = released_update or spec
        of_release = base_parameters(release_spec, others[0].model, read_patched_model(released))
        release_windows = track(Recursion(release_spec, of_release), others, base=released)
        before = [w.base_rms if released_update is None else w.updated_rms for w in release_windows]
        if not before:
            raise OutOfTime
        notes.append("the candidate's model is another one: it is compared with the release's")
    share = policy.metrics.get("position_rms", 0.0)
    # A run that ends early may have fewer windows of the release.
    after = [w.updated_rms for w in windows[: len(before)]]
    before = before[: len(after)]
    allowed = policy.safety.get("position_max", 0.0)
    resting = _at_bounds(spec, windows)
    notes += [
        f"{one['parameter']} stays at its bound of {one['bound']:g} "
        f"({100 * one['share']:.0f} % of the updates): the recordings ask for a value beyond it, "
        "or for an effect that the update lacks"
        for one in resting
    ]
    return {
        "metrics": [
            _metric("position_rms", False, share, _rms(before), _rms(after)),
            _metric("position_max", True, allowed, max(before), max(after)),
        ],
        "faults": _faults(spec, recursion, rows, realization),
        "acting": {
            "share": sum(w.state == "updated" for w in windows) / len(windows),
            "kept_out": {
                state: count / len(windows)
                for state, count in Counter(w.state for w in windows).items()
                if state != "updated"
            },
        },
        "update": {
            "parameters": list(spec.parameters),
            "base": recursion.base.tolist(),
            "value": recursion.value.tolist(),
            "deviation": np.sqrt(np.diag(recursion.covariance)).tolist(),
            "at_bounds": resting,
            "windows": [
                {
                    "base_rms": w.base_rms,
                    "updated_rms": w.updated_rms,
                    "parameters": w.parameters.tolist(),
                    "state": w.state,
                }
                for w in windows
            ],
        },
        "notes": notes,
    }


def _at_bounds(spec: UpdateSpec, windows: Sequence[Window]) -> list[dict[str, Any]]:
    """Parameters whose estimate is at a bound after the last updates, or after most of them."""
    sides = np.array([w.side for w in windows if w.state in ("updated", "base")])
    found = []
    for column, (name, bounds) in enumerate(spec.parameters.items()):
        for side, bound in zip((-1.0, 1.0), bounds, strict=True):
            at = sides[:, column] == side if len(sides) else np.zeros(0, dtype=bool)
            if len(at) and (at[-_RESTING_WINDOWS:].all() or at.mean() > 0.5):
                found.append({"parameter": name, "bound": bound, "share": float(at.mean())})
    return found


def _metric(name: str, safety: bool, share: float, before: float, after: float) -> dict[str, Any]:
    change = (after - before) / before if before > 0.0 else 0.0
    return {
        "metric": name,
        "safety": safety,
        "declared": share,
        "change": change,
        "met": bool(change <= share if safety else change <= -share),
        "joints": {"all": {"release": before, "candidate": after}},
    }


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _faults(
    spec: UpdateSpec, learned: Recursion, rows: Sequence[Row], base: Realization
) -> list[dict[str, Any]]:
    """Test each fault on the first windows of motion, from the learned state.

    The test passes if the parameters stay within their bounds and the update's error over all these
    windows, against the undisturbed measurement, exceeds that of the base by at most 5 %. If the
    base predicts poorly, this error hides what a fault does to the update. Therefore the same
    faults are injected into recordings of a robot that is exactly the base model. After the fault,
    the estimate may add no more error there than the noise of the sensor. A restart gives no wrong
    measurement to the update, so it has no such test.
    """
    some: list[Row] = []
    seconds = 0.0
    for row in rows:
        if seconds < _TRIED_WINDOWS * spec.window:
            some.append(row)
            seconds += row.trial.duration
    simulated = _base_model_rows(some, spec.noise, base)
    found = []
    for name, change in _CHANGES.items():
        if skips(f"fault {name}"):
            continue
        windows = track(
            _recursion_from(learned, learned.value),
            some,
            disturb=_WindowsWithFault(change),
            base=base,
        )
        of_base: list[Window] = []
        if name != "restart":
            begun = _recursion_from(learned, learned.base)
            of_base = track(begun, simulated, disturb=_WindowsWithFault(change), base=base)
        found.append(_verdict(name, spec, windows, of_base))
    return found


def _recursion_from(learned: Recursion, value: FloatArray) -> Recursion:
    """Return a recursion with the learned covariance that starts at a value."""
    found = Recursion(learned.spec, learned.base)
    found.value, found.covariance = value.copy(), learned.covariance.copy()
    return found


def _base_model_rows(rows: Sequence[Row], noise: float, base: Realization) -> list[Row]:
    """Return trials whose positions are those of the base model, with sensor noise in rad or m."""
    random = np.random.default_rng(_SEED)
    found = []
    for row, one in zip(rows, replay_rows(rows, threads=1), strict=True):
        position, velocity = one.position, one.velocity if row.trial.velocity is not None else None
        if read_patched_model(base) is not None:
            # Without effects the velocity is another one; it follows from the positions.
            (position,), velocity = predicted_positions(row, [], [np.zeros(0)], base), None
        elif one.error is not None:
            raise one.error
        read = position + noise * random.standard_normal(position.shape)
        found.append(replace(row, trial=replace(row.trial, position=read, velocity=velocity)))
    return found


class _WindowsWithFault:
    """Function that adds a fault to some consecutive windows of a run."""

    def __init__(self, change: Disturb) -> None:
        self.change, self.count = change, 0

    def __call__(self, time: FloatArray, position: FloatArray) -> FloatArray | None:
        self.count += 1
        inside = _FIRST_FAULT < self.count <= _FIRST_FAULT + _FAULT_WINDOWS
        return self.change(time, position) if inside else position


def _verdict(
    name: str, spec: UpdateSpec, windows: Sequence[Window], of_base: Sequence[Window]
) -> dict[str, Any]:
    low, high = np.array(list(spec.parameters.values())).T
    values = np.array([w.parameters for w in (*windows, *of_base)])
    bounded = bool(((values >= low - 1e-12) & (values <= high + 1e-12)).all())
    problems = [] if bounded else ["a parameter leaves its bounds"]
    before, after = _rms([w.base_rms for w in windows]), _rms([w.updated_rms for w in windows])
    if not after <= _WORSE * before:
        problems.append(f"it predicts {after / before - 1:.0%} worse than the base")
    exact = wrong = None
    rest = of_base[_FIRST_FAULT + _FAULT_WINDOWS :]
    if rest:
        exact, wrong = _rms([w.base_rms for w in rest]), _rms([w.updated_rms for w in rest])
        if not wrong**2 <= exact**2 + spec.noise**2:
            problems.append(
                f"its error for a robot that is exactly the base model is {wrong:.3g} after the "
                f"fault, that of the base {exact:.3g}"
            )
    return {
        "fault": name,
        "holds": not problems,
        "why": "; ".join(problems) or "bounded, and no worse than the base",
        "base_rms": before,
        "updated_rms": after,
        "exact_base_rms": exact,
        "exact_updated_rms": wrong,
    }


def _stale(time: FloatArray, position: FloatArray) -> FloatArray:
    return np.repeat(position[:1], len(position), axis=0)


def _dropout(time: FloatArray, position: FloatArray) -> FloatArray:
    gone = position.copy()
    gone[len(gone) // 3 :] = np.nan
    return gone


def _clip_at_median(time: FloatArray, position: FloatArray) -> FloatArray:
    middle = np.median(position, axis=0)
    return np.minimum(position, middle)


def _contact(time: FloatArray, position: FloatArray) -> FloatArray:
    """Stop the joints in the middle of the window, as in a collision with a wall."""
    stopped = position.copy()
    stopped[len(stopped) // 2 :] = position[len(position) // 2]
    return stopped


_CHANGES: dict[str, Disturb] = {
    "distribution_shift": lambda time, position: position + 0.5 * (time - time[0])[:, None],
    "sensor_dropout": _dropout,
    "stale_time": _stale,
    "saturation": _clip_at_median,
    "contact_transition": _contact,
    "restart": lambda time, position: None,
}
