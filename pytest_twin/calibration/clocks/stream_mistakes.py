"""Find input mistakes that would explain the errors of two streams: units, sizes, directions."""

from __future__ import annotations

from dataclasses import replace

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.changed_cell import changed_cell
from pytest_twin.calibration.clocks.offset import (
    MOST_OFFSET_SPREAD_S,
    ClockFit,
    smoothing,
    spread_rows,
)
from pytest_twin.calibration.clocks.streams import PoseStream
from pytest_twin.calibration.input_mistake import InputMistake
from pytest_twin.calibration.input_mistakes import find_mistakes, has_large_errors, lengths_in_mm
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.plan import Plan
from pytest_twin.calibration.pose_errors import with_pose_errors
from pytest_twin.calibration.problem import make_problem
from pytest_twin.calibration.records import estimate as estimated
from pytest_twin.calibration.residual_errors import errors_of
from pytest_twin.calibration.solve import robust_cost, solve
from pytest_twin.calibration.starts import starts
from pytest_twin.calibration.wrong_scale import wrong_scale
from pytest_twin.metrics.pose import inverse

_POSES = 60
"""Number of poses used. Neighbouring poses have the same errors, so more add nothing."""
_WORDS = {
    "flange.*": "the hand's stream",
    "camera_from_target": "the camera's stream",
    "declare camera": "give poses at stamps of one clock (observations:) and declare camera",
}
"""Terms for columns of a table of observations, and the terms for streams that replace them."""


def mistakes_of_streams(
    plan: Plan,
    hand: PoseStream,
    camera: PoseStream,
    seen: FloatArray,
    fit: ClockFit,
    middle: float,
) -> tuple[tuple[InputMistake, ...], list[str]]:
    """Return mistakes that explain the streams far better, with the checks for poses on one clock.

    The notes have a change of the cell that errors of the arm would explain too, and errors that
    repeat with the pose. Without an offset both are empty, because poses of different times cannot
    be compared.

    Args:
        plan: plan with the accepted errors.
        seen: (n, 4, 4) poses of the camera stream in ``hand @ hand_eye = robot_world @ seen``, m.
        fit: fit with the offset.
        middle: time of the camera's clock at which the offset holds, s.
    """
    if not fit.interval(0) < MOST_OFFSET_SPREAD_S:
        return (), []
    rows, time = spread_rows(hand, camera, fit, middle, _POSES)
    carried = hand.at(time)
    observations = Observations(
        ids=tuple(f"at {stamp:.2f} s" for stamp in camera.time[rows]),
        flange=inverse(carried) if hand.is_inverted else carried,
        camera_from_target=inverse(seen[rows]),
    )
    estimate = tuple(name for name in plan.estimate if name != "time_offset")
    problem = make_problem(replace(plan, estimate=estimate), observations, None)
    averaged = 0.0 if lengths_in_mm(problem) else smoothing(hand, camera, seen, fit, middle)
    if averaged:
        return (_smoothed(averaged),), []
    candidates = starts(problem)
    if not candidates:
        return (), []
    best = min(candidates.values(), key=lambda state: robust_cost(problem, state))
    found = solve(problem, best)
    change = changed_cell(problem, found)
    if change is not None and not change.may_be_arm:
        suspected: tuple[InputMistake, ...] = (change.mistake,)
    elif has_large_errors(errors_of(found.problem, found.state, found.kept).summary(), problem):
        suspected = find_mistakes(found)
    else:
        scale = wrong_scale(found)
        suspected = () if scale is None else (scale,)
    notes = [change.note] if change is not None and change.may_be_arm else []
    if not suspected:
        for error in with_pose_errors(estimated(found, ()))[1].errors:
            if error.kind == "depth":
                suspected = (InputMistake(error.cause, error.mend, float("nan"), float("nan")),)
            else:
                notes.append(_words_of_streams(error.found_words))
    in_words = tuple(
        replace(one, what=_words_of_streams(one.what), mend=_words_of_streams(one.mend))
        for one in suspected
    )
    return in_words, notes


def _smoothed(averaged: float) -> InputMistake:
    """Mistake of a stream that is an average over time, s, as ``smoothing`` returns it."""
    smooth, other = ("camera", "hand") if averaged > 0.0 else ("hand", "camera")
    return InputMistake(
        f"the {smooth}'s poses are smoother than the {other}'s, as averages over time with weights "
        f"of standard deviation {1e3 * abs(averaged):.0f} ms are: they were filtered, or sampled "
        "too rarely. The frames are off, and the offset contains the filter's delay",
        f"give the {smooth}'s poses as measured, without a filter",
        float("nan"),
        float("nan"),
    )


def _words_of_streams(words: str) -> str:
    for of_table, of_streams in _WORDS.items():
        words = words.replace(of_table, of_streams)
    return words
