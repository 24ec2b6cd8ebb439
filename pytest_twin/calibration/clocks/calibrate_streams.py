"""Calibrate the time offset and hand-eye transform of two pose streams on two clocks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.clocks.clock_step import clock_step
from pytest_twin.calibration.clocks.correlation import (
    LEAST_CORRELATION,
    MOST_RIVAL,
    SpeedCorrelation,
    correlate_speeds,
)
from pytest_twin.calibration.clocks.figures import angular_speeds, scene_of_streams
from pytest_twin.calibration.clocks.offset import (
    MOST_OFFSET_SPREAD_S,
    SCALE,
    ClockFit,
    errors_at,
    fit_clocks,
    hand_times,
)
from pytest_twin.calibration.clocks.residuals import residuals_of
from pytest_twin.calibration.clocks.stream_mistakes import mistakes_of_streams
from pytest_twin.calibration.clocks.streams import PoseStream, read_stream
from pytest_twin.calibration.conditions import HAND_POSES, ONE_DELAY, add_conditions
from pytest_twin.calibration.document import new_document
from pytest_twin.calibration.parameters import POSE_LABELS
from pytest_twin.calibration.plan import Plan
from pytest_twin.calibration.problem import INVERTED_RECORDS, describe_pose, records_of
from pytest_twin.calibration.records import (
    TARGET_SCALE,
    about_child,
    estimate_entry,
    inverse_with_covariance,
    pose_entry,
    scale_record,
    size_note,
)
from pytest_twin.calibration.residual_errors import acceptance_failures, regions_of
from pytest_twin.calibration.residual_patterns import pattern_of
from pytest_twin.calibration.solvers.algebraic import HandEye, solve_all
from pytest_twin.metrics.pose import inverse

MOST_POSITION_SPREAD_M = 0.05
"""Standard deviation of a transform's position above which it is not determined."""

SURE_DRIFT = 1.5
"""Smallest drift that is accepted as real, in half widths of its 95 % interval. One data set in a
thousand without a drift exceeds it."""

_STRETCHES = 12
"""Number of consecutive parts of the streams, from which the held-out ones are drawn."""
_MOST_POSES = 100
"""Largest number of poses for which errors are listed."""


@dataclass(frozen=True)
class Start:
    """Initial values of the least squares.

    Attributes:
        solver: name of the best algebraic solver.
        solved: result of each solver.
        is_inverted: whether the poses of the camera's stream are inverted.
    """

    solver: str
    solved: Mapping[str, HandEye]
    is_inverted: bool


def calibrate_streams(plan: Plan) -> dict[str, Any]:
    """Return the content of ``calibration.json``: clock offset and hand-eye, with held-out errors.

    Raises:
        TwinError: a stream that cannot be used.
    """
    hand, camera = streams_of(plan)
    document = new_document(plan)
    found = correlate_speeds(hand, camera)
    problem = _unclear(found)
    middle = float(camera.time.mean())
    parts = stretches(camera, plan)
    if not problem:
        try:
            _solve(document, plan, hand, camera, found, middle, parts)
        except np.linalg.LinAlgError:
            problem = "the time offset: the motion does not determine it together with hand-eye"
    if problem:
        document["unobservable"] = [problem]
    if document["unobservable"]:
        document["records"] = {}
        # A mistake in a stream makes directions seem undetermined; recording another motion would
        # not help.
        if not document["suspected"]:
            document["reasons"] = [*document["unobservable"], *document["reasons"]]
            document["verdict"] = "degenerate"
    return document


def streams_of(plan: Plan) -> tuple[PoseStream, PoseStream]:
    """The hand's and the camera's stream of a plan.

    Raises:
        TwinError: a stream that cannot be used.
    """
    hand, camera = (read_stream(plan.streams[name]) for name in ("hand", "camera"))
    # For a fixed camera, the poses of the flange are inverted: seen from the flange, the base
    # carries the camera. The errors are then those of the target's position, which is measured, and
    # not those of the camera's position, to which errors of angles add.
    return replace(hand, is_inverted=plan.mount == "world"), camera


def _unclear(found: SpeedCorrelation) -> str:
    """Reason why the angular speeds do not determine an offset; empty if they do."""
    if found.correlation < 0.0:
        return (
            "the time offset: at no offset do both streams turn; turn the hand about several axes "
            "while both are recorded"
        )
    if found.correlation < LEAST_CORRELATION:
        return (
            f"the time offset: the angular speeds of both streams have a correlation of "
            f"{found.correlation:.2f} at most (at least {LEAST_CORRELATION} is needed); turn the "
            "hand about several axes, faster and without a rhythm"
        )
    if found.rival > MOST_RIVAL:
        return (
            "the time offset: the motion repeats itself, and another offset has "
            f"{100 * found.rival:.0f} % of the best one's correlation; move without a rhythm"
        )
    return ""


def stretches(camera: PoseStream, plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Rows to fit and to hold out, by whole time segments, since neighbours share their errors."""
    blocks = np.array_split(np.arange(len(camera.time)), _STRETCHES)
    number = min(round(plan.hold_out.fraction * _STRETCHES), _STRETCHES - 2)
    drawn = np.random.default_rng(plan.hold_out.seed).permutation(_STRETCHES)[:number]
    held = np.sort(np.concatenate([np.zeros(0, dtype=int), *(blocks[i] for i in drawn)]))
    return np.setdiff1d(np.arange(len(camera.time)), held), held


def _solve(
    document: dict[str, Any],
    plan: Plan,
    hand: PoseStream,
    camera: PoseStream,
    found: SpeedCorrelation,
    middle: float,
    parts: tuple[np.ndarray, np.ndarray],
) -> None:
    fitted, held_out = parts
    start = _start(hand, camera.rows(fitted), found.offset)
    seen = seen_in(camera, inverted=start.is_inverted)
    mine, theirs = camera.rows(fitted), camera.rows(held_out)
    at = ClockFit.without_spread(found.offset, start.solved[start.solver])
    tolerance = plan.target_tolerance
    fit, drifting = (
        fit_clocks(
            hand, mine, seen[fitted], at, middle, with_drift=with_drift, size_tolerance=tolerance
        )
        for with_drift in (False, True)
    )
    if start.is_inverted:
        document["notes"].append(
            "the camera's stream was inverted: it holds poses of the camera in the target's "
            "frame, the hand's stream those of the base in the hand's frame, or the camera is "
            f"mounted otherwise than camera: {{mount: {plan.mount}}} says; the streams do not "
            "determine which"
        )
    step = clock_step(hand, camera, seen, fit, middle)
    drift = _drift(drifting, fit, camera)
    sure = bool(abs(drifting.drift) > SURE_DRIFT * drifting.interval(1))
    drift["used"] = drift["value"] is not None and sure
    if drift["used"]:
        fit = drifting
        document["notes"].append(
            f"the clocks drift apart by {1e6 * drifting.drift:.0f} us each second; the offset is "
            "that in the middle of the camera's stream"
        )
    if drift["value"] is None:
        document["notes"].append(drift["why"])
    if note := size_note(plan):
        document["notes"].append(note)
    document["unobservable"] = _undetermined_quantities(plan, fit)
    document["records"] = _records(plan, fit, drift, found)
    add_conditions(document, [HAND_POSES, ONE_DELAY])
    document["covariance"] = _joint_covariance(plan, fit)
    document["fitted"] = _summary(fit.translation, fit.rotation)
    if len(held_out):
        errors = errors_at(hand, theirs, seen[held_out], fit, middle)
        document["held_out"] = _summary(*errors)
        document["held_out"]["regions"] = _regions(hand, theirs, fit, middle, errors)
        for name, one in start.solved.items():
            if not one.failed:
                alone = replace(fit, offset=found.offset, drift=0.0, solved=one, scale=1.0)
                of_solver = _summary(*errors_at(hand, theirs, seen[held_out], alone, middle))
                kept = ("translation_rms", "rotation_rms")
                document["solvers"][name] = {k: of_solver[k] for k in kept if k in of_solver}
        document["solvers"]["least_squares"] = {
            key: document["held_out"][key] for key in ("translation_rms", "rotation_rms")
        }
    document["held_out"]["pattern"] = pattern_of(residuals_of(hand, camera, seen, fit, middle))
    document["scene"] = scene_of_streams(plan, hand, camera, seen, fit, middle, held_out)
    document["angular_speeds"] = angular_speeds(hand, camera, fit, middle, found.correlation)
    suspected, notes = mistakes_of_streams(plan, hand, camera, seen, fit, middle)
    document["notes"] += notes
    document["suspected"] = [one.to_json() for one in suspected]
    document["reasons"] = [
        *(f"{one.what}; {one.mend}" for one in suspected),
        *([step] if step and not suspected else []),
        *acceptance_failures(document["held_out"], asdict(plan.accept)),
    ]
    document["verdict"] = "rejected" if document["reasons"] else "accepted"


def _start(hand: PoseStream, camera: PoseStream, offset: float) -> Start:
    """Return the best algebraic solution, of the camera's poses and of their inverses."""
    time = camera.time + offset
    inside = np.flatnonzero((time > hand.time[0]) & (time < hand.time[-1]))
    if len(inside) < 20:
        raise np.linalg.LinAlgError("the streams do not overlap")
    chosen = inside[np.linspace(0, len(inside) - 1, min(_MOST_POSES, len(inside))).astype(int)]
    flange = hand.at(time[chosen])
    best, least = Start("", {}, False), np.inf
    for inverted in (False, True):
        seen = seen_in(camera.rows(chosen), inverted=inverted)
        solved = solve_all(flange, inverse(seen), "hand")
        for name, one in solved.items():
            if one.failed:
                continue
            # Distances of the target's poses are in the camera's units in both directions.
            poses = flange @ one.hand_eye @ inverse(seen)
            error = float(
                np.median(np.linalg.norm(poses[:, :3, 3] - one.robot_world[:3, 3], axis=1))
            )
            if error < least:
                best, least = Start(name, solved, inverted), error
    if not best.solver:
        raise np.linalg.LinAlgError("no solver found a transform")
    return best


def seen_in(camera: PoseStream, *, inverted: bool) -> FloatArray:
    """(n, 4, 4) ``seen`` with ``hand @ hand_eye = robot_world @ seen``."""
    return camera.poses if inverted else inverse(camera.poses)


def _adjacent_poses(plan: Plan, fit: ClockFit) -> dict[str, tuple[slice, FloatArray]]:
    """Slice in the covariance and (4, 4) pose of what the flange carries, and of the world.

    The fit of a fixed camera uses the inverted flange poses.
    """
    eye, world = (slice(2, 8), fit.solved.hand_eye), (slice(8, 14), fit.solved.robot_world)
    mounted, standing = (eye, world) if plan.mount == "hand" else (world, eye)
    return {"mounted": mounted, "world": standing}


def _undetermined_quantities(plan: Plan, fit: ClockFit) -> list[str]:
    found = []
    if not fit.interval(0) < MOST_OFFSET_SPREAD_S:
        found.append(
            f"the time offset: its 95 % interval is {1e3 * fit.interval(0):.0f} ms to either side; "
            "move the hand faster"
        )
    for role, (place, _) in _adjacent_poses(plan, fit).items():
        values, axes = np.linalg.eigh(fit.covariance[place, place][:3, :3])
        if not np.sqrt(max(values[-1], 0.0)) < MOST_POSITION_SPREAD_M:
            axis = ", ".join(f"{v:.2f}" for v in axes[:, -1])
            found.append(
                f"the position of {describe_pose(f'camera.{role}', plan.mount)} along ({axis}): "
                "turn the hand about a second axis"
            )
    return found


def _drift(drifting: ClockFit, fit: ClockFit, camera: PoseStream) -> dict[str, Any]:
    """Return the drift with its interval, or the reason why the motion does not determine it.

    The effect of a drift is the change of the offset from one end of the stream to the other. If
    the interval of this change is wider than both the camera's sampling period and the interval of
    the offset, a drift within the interval cannot be distinguished from no drift, nor from one that
    shifts samples against each other. A drift that is larger than its interval is reported.
    """
    span = float(camera.time[-1] - camera.time[0])
    period = float(np.median(np.diff(camera.time)))
    width = drifting.interval(1)
    change, useful = 2.0 * width * span, max(period, 2.0 * fit.interval(0))
    # The comparison also rejects NaN, which a singular fit gives.
    if not (change <= useful or abs(drifting.drift) > SURE_DRIFT * width):
        return {
            "value": None,
            "unit": "s/s",
            "ci95": None,
            "why": "the motion does not show a drift of the clocks, and none is used: the 95 % "
            f"interval of what the offset changes by over {span:.0f} s is {1e3 * change:.1f} ms "
            f"wide. The sampling period is {1e3 * period:.1f} ms, the interval of the offset "
            f"itself {2e3 * fit.interval(0):.1f} ms wide. Record for longer, with fast motion at "
            "both ends",
        }
    return {
        "value": drifting.drift,
        "unit": "s/s",
        "ci95": [drifting.drift - width, drifting.drift + width],
    }


def _records(
    plan: Plan, fit: ClockFit, drift: dict[str, Any], found: SpeedCorrelation
) -> dict[str, Any]:
    std = float(np.sqrt(fit.covariance[0, 0]))
    records: dict[str, Any] = {
        "time_offset": {
            **estimate_entry(fit.offset, "s", std, float(fit.quantile[0])),
            "correlation": found.correlation,
            "from_correlation_alone": found.offset,
            "meaning": "time of the hand's clock = stamp of the camera's clock + value",
            "drift": drift,
        }
    }
    flange = plan.flange or "hand"
    carried, standing = ("camera", "target") if plan.mount == "hand" else ("target", "camera")
    frames = {"mounted": (flange, carried), "world": ("base", standing)}
    for role, (place, pose) in _adjacent_poses(plan, fit).items():
        names = [n for n in records_of(role, "camera", plan.mount) if n in plan.estimate]
        for name in names or [frames[role][1]]:
            records[name] = _pose(name, fit, place, pose, frames[role], asked=bool(names))
    if plan.target_tolerance > 0.0:
        std = float(np.sqrt(fit.covariance[SCALE, SCALE]))
        records[TARGET_SCALE] = scale_record(
            fit.scale, std, float(fit.quantile[SCALE]), plan.target_tolerance
        )
    return records


def _joint_covariance(plan: Plan, fit: ClockFit) -> dict[str, Any]:
    """Joint covariance of the offset and both poses, with rotations about the child's axes."""
    around = _adjacent_poses(plan, fit)
    of_poses = [at for place, _ in around.values() for at in range(place.start, place.stop)]
    of_records = [0, *of_poses, *([SCALE] if plan.target_tolerance > 0.0 else [])]
    turn = np.eye(len(of_records))
    turn[1:7, 1:7], turn[7:13, 7:13] = (about_child(pose) for _, pose in around.values())
    names = [f"pose:camera.{role}.{label}" for role in around for label in POSE_LABELS]
    names += ["scale.camera"] * (len(of_records) - 13)
    matrix = turn @ fit.covariance[np.ix_(of_records, of_records)] @ turn.T
    return {"of": ["time_offset", *names], "matrix": matrix.tolist()}


def _pose(
    name: str,
    fit: ClockFit,
    place: slice,
    pose: FloatArray,
    frames: tuple[str, str],
    *,
    asked: bool,
) -> dict[str, Any]:
    parent, child = frames
    turn = about_child(pose)
    covariance = turn @ fit.covariance[place, place] @ turn.T
    if name in INVERTED_RECORDS:
        pose, covariance = inverse_with_covariance(pose, covariance)
        parent, child = "world", parent
    # The axes are rotated, so the widest of the quantiles is used for each of them.
    quantile = float(fit.quantile[place].max())
    return pose_entry((parent, child), pose, covariance, quantile, asked=asked)


def _regions(
    hand: PoseStream,
    camera: PoseStream,
    fit: ClockFit,
    middle: float,
    errors: tuple[FloatArray, FloatArray],
) -> list[dict[str, Any]]:
    """Errors in thirds of the workspace; ``errors`` is the result of ``errors_at``."""
    time = hand_times(camera, fit.offset, fit.drift, middle)
    inside = (time >= hand.time[0]) & (time <= hand.time[-1])
    reach = np.linalg.norm(hand.at(time[inside])[:, :3, 3], axis=1)
    # The RMS of one coordinate is that of the distance divided by the square root of three.
    translation, rotation = (one[:, None] / np.sqrt(3.0) for one in errors)
    return regions_of(reach, translation, rotation)


def _summary(translation: FloatArray, rotation: FloatArray) -> dict[str, Any]:
    """Root mean squares over coordinates (keys ending in ``_rms``) and of distances and angles."""
    if not len(translation):
        return {"count": 0}
    distance = float(np.sqrt(np.mean(translation**2)))
    angle = float(np.sqrt(np.mean(rotation**2)))
    return {
        "translation_rms": distance / np.sqrt(3.0),
        "rotation_rms": angle / np.sqrt(3.0),
        "distance_rms": distance,
        "angle_rms": angle,
        "distance_max": float(translation.max()),
        "count": len(translation),
    }
