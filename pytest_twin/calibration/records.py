"""Estimates in the form of ``calibration.json``: values, covariance, 95 % intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import t as student

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.jackknife import jackknife
from pytest_twin.calibration.observability import Direction, affected_unknowns
from pytest_twin.calibration.parameters import POSE_LABELS, State
from pytest_twin.calibration.plan import TARGET_TOLERANCE, Plan
from pytest_twin.calibration.problem import (
    INVERTED_RECORDS,
    MARKER,
    PIVOT,
    TIP,
    marker_of,
    records_of,
)
from pytest_twin.calibration.solve import Fit, prior_rows
from pytest_twin.calibration.transform_derivatives import skew
from pytest_twin.estimation.covariance import block_jackknife
from pytest_twin.metrics.pose import inverse, quaternion_of

NOT_ASKED = {
    ("camera", "hand", "mounted"): "camera",
    ("camera", "hand", "world"): "target",
    ("camera", "world", "mounted"): "target",
    ("camera", "world", "world"): "camera",
    ("tracker", "hand", "mounted"): "tool",
    ("tracker", "hand", "world"): "tracker",
}
"""Record name of a pose that is estimated although the plan does not ask for it."""

TARGET_SCALE = "target_scale"
"""Record of the stated size of a target divided by its real one, under the target's tolerance."""

HELD_BY_PRIOR = 0.7
"""Fraction of the prior's standard deviation above which a deviation reflects the prior and not the
data. The data then carry less information than the drawing."""


@dataclass(frozen=True)
class CalibrationEstimate:
    """A fit with its uncertainty.

    Attributes:
        covariance: (count, count) of the unknowns, m and rad; zero along ``directions``.
        quantile: half width of a 95 % interval in standard deviations.
        lost: (count,) True for unknowns that the observations do not determine.
        directions: directions that the observations do not determine.
        leave_one_out: RMS error of observations left out in turn, by kind of error.
    """

    fit: Fit
    covariance: FloatArray
    quantile: float
    lost: np.ndarray
    directions: tuple[Direction, ...]
    leave_one_out: Mapping[str, float]


def estimate(fit: Fit, directions: tuple[Direction, ...]) -> CalibrationEstimate:
    """Compute covariance and intervals of a fit.

    The noise is estimated from the residuals, so intervals use Student's distribution. If an
    observation has several measurements, which share the error of the robot's pose, the covariance
    is the jackknife over whole observations. For odometry it is the jackknife over blocks of
    neighbouring observations.
    """
    layout = fit.problem.layout
    left_out = jackknife(fit)
    lost = affected_unknowns(layout, directions)
    if fit.problem.is_odometry and not directions:
        slopes, residuals = _whitened_rows(fit)
        prior = prior_rows(fit.problem)
        covariance, quantile = block_jackknife(slopes, residuals, prior.T @ prior)
        return CalibrationEstimate(
            fit, covariance, quantile, lost, directions, left_out.summary(fit)
        )
    measurements = sum(int(kept.sum()) for kept in fit.kept)
    if measurements > left_out.count:
        covariance, degrees = left_out.covariance, left_out.count - 1.0
    else:
        _, singular, right = np.linalg.svd(fit.jacobian, full_matrices=False)
        sure = singular > 1e-12 * max(singular.max(initial=0.0), 1e-300)
        half = right[sure] / singular[sure, None]
        covariance, degrees = half.T @ half, fit.degrees
    quantile = float(student.ppf(0.975, max(degrees, 1.0)))
    return CalibrationEstimate(fit, covariance, quantile, lost, directions, left_out.summary(fit))


def _whitened_rows(fit: Fit) -> tuple[FloatArray, FloatArray]:
    """(n, 6, count) Jacobian and (n, 6) residuals of the fitted poses, divided by their noise."""
    (term,), (kept,), (residuals,) = fit.problem.terms, fit.kept, fit.residuals
    slopes = fit.jacobian[: residuals.size].reshape(*residuals.shape, -1)
    return slopes[kept], residuals[kept] / [fit.noise[name] for name in term.noise]


def with_directions(
    found: CalibrationEstimate, directions: tuple[Direction, ...]
) -> CalibrationEstimate:
    """Return the estimate without the unknowns that belong to the given directions."""
    lost = affected_unknowns(found.fit.problem.layout, directions)
    return replace(found, directions=directions, lost=lost)


def records(found: CalibrationEstimate) -> dict[str, Any]:
    """Return the records that the plan asks for, and those that were estimated with them."""
    plan, layout = found.fit.problem.plan, found.fit.problem.layout
    made: dict[str, Any] = {}
    for name in layout.poses:
        place = layout.blocks[f"pose:{name}"]
        if found.lost[place].any():
            continue
        family, _, role = name.partition(".")
        mount = plan.mount if family == "camera" else "hand"
        asked = [one for one in records_of(role, family, mount) if one in plan.estimate]
        for record in asked or [NOT_ASKED[family, mount, role]]:
            made[record] = _pose_record(found, name, record, asked=bool(asked))
    made |= _points(found)
    for block, scalars in (("joint_zeros", _zeros), ("geometry", _geometry)):
        if block in layout.blocks and (values := scalars(found)):
            made[block] = values
    if layout.scale and not found.lost[layout.blocks["scale"]].any():
        made["scale" if plan.has_free_scale else TARGET_SCALE] = _scale(found)
    order = [name for name in plan.estimate if name in made]
    return {name: made[name] for name in [*order, *(n for n in made if n not in order)]}


def solver_transforms(found: CalibrationEstimate, state: State) -> dict[str, Any]:
    """Return the transforms of another solver, by the names of the records."""
    made = {}
    plan, layout = found.fit.problem.plan, found.fit.problem.layout
    for name in layout.poses:
        family, _, role = name.partition(".")
        mount = plan.mount if family == "camera" else "hand"
        asked = [one for one in records_of(role, family, mount) if one in plan.estimate]
        for record in asked or [NOT_ASKED[family, mount, role]]:
            pose = state.poses[name]
            made[record] = _transform(inverse(pose) if record in INVERTED_RECORDS else pose)
    return made


def _transform(pose: FloatArray) -> dict[str, Any]:
    return {
        "xyz": [float(value) for value in pose[:3, 3]],
        "quaternion_wxyz": [float(value) for value in quaternion_of(pose[:3, :3])],
    }


def _frames(found: CalibrationEstimate, name: str, record: str) -> tuple[str, str]:
    problem = found.fit.problem
    base = "base" if problem.chain is None else problem.chain.base
    # Records call the fixed frame of the cell "world". In an MJCF the robot's base has that name.
    base = "base" if base == "world" else base
    role = name.rpartition(".")[2]
    if record == "base_world":
        return "world", base
    parent = problem.plan.flange if role == "mounted" else base
    child = {
        "hand_eye": "camera",
        "camera": "camera",
        "robot_world": "world",
        "fixture": "fixture",
        "tracker": "tracker",
        "target": "target",
        "tool": "tool",
        "tcp": "tcp",
    }[record]
    return parent, child


def _pose_record(
    found: CalibrationEstimate, name: str, record: str, *, asked: bool
) -> dict[str, Any]:
    layout = found.fit.problem.layout
    place = layout.blocks[f"pose:{name}"]
    pose = found.fit.state.poses[name]
    covariance = found.covariance[place, place]
    if record in INVERTED_RECORDS:
        pose, covariance = inverse_with_covariance(pose, covariance)
    parent, child = _frames(found, name, record)
    return pose_entry((parent, child), pose, covariance, found.quantile, asked=asked)


def pose_entry(
    frames: tuple[str, str],
    pose: FloatArray,
    covariance: FloatArray,
    quantile: float,
    *,
    asked: bool,
) -> dict[str, Any]:
    """Return the record of a pose: transform, covariance and 95 % intervals.

    Args:
        frames: parent and child frame.
        covariance: (6, 6) of x y z and rx ry rz.
        quantile: half width of a 95 % interval in standard deviations.
        asked: whether the plan asks for it.
    """
    middle = [*pose[:3, 3], 0.0, 0.0, 0.0]
    return {
        "parent": frames[0],
        "child": frames[1],
        "transform": _transform(pose),
        "covariance": covariance.tolist(),
        "covariance_of": list(POSE_LABELS),
        "perturbation": "x y z along the parent's axes [m]; rx ry rz a rotation vector about the "
        "child's axes [rad]: R exp(r), so that its intervals are about 0",
        "ci95": dict(zip(POSE_LABELS, intervals(middle, covariance, quantile), strict=True)),
        **({} if asked else {"asked": False}),
    }


def intervals(
    values: Iterable[float], covariance: FloatArray, quantile: float
) -> list[list[float]]:
    """Return the 95 % interval of each value."""
    spread = quantile * np.sqrt(np.diag(covariance))
    return [
        [float(value - width), float(value + width)]
        for value, width in zip(values, spread, strict=True)
    ]


def estimate_entry(value: float, unit: str, std: float, quantile: float) -> dict[str, Any]:
    """Return the entry of one estimated number, with its 95 % interval."""
    width = quantile * std
    return {"value": value, "unit": unit, "std": std, "ci95": [value - width, value + width]}


def about_child(pose: FloatArray) -> FloatArray:
    """(6, 6) matrix from a change in the parent's axes to one with rotation in the child's axes."""
    turn = np.eye(6)
    turn[3:, 3:] = pose[:3, :3].T
    return turn


def inverse_with_covariance(
    pose: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the inverse of a (4, 4) pose with its (6, 6) covariance, in the same convention."""
    back = inverse(pose)
    change = np.zeros((6, 6))
    change[:3, :3] = -back[:3, :3]
    change[:3, 3:] = skew(back[:3, 3])
    change[3:, 3:] = -pose[:3, :3]
    return back, change @ covariance @ change.T


def _points(found: CalibrationEstimate) -> dict[str, Any]:
    problem, layout = found.fit.problem, found.fit.problem.layout
    markers = [name for name in layout.points if name.startswith(MARKER)]
    made: dict[str, Any] = {}
    tip = TIP if TIP in layout.points else None
    if tip is None and "tcp" in problem.plan.estimate and len(markers) == 1:
        tip = markers[0]
    if tip is not None and not found.lost[layout.blocks[f"point:{tip}"]].any():
        place = layout.blocks[f"point:{tip}"]
        xyz = found.fit.state.points[tip]
        covariance = found.covariance[place, place]
        made["tcp"] = {
            "parent": problem.plan.flange,
            "child": "tcp",
            "transform": {"xyz": xyz.tolist(), "quaternion_wxyz": None},
            "orientation": "not determined by a point. To have it, give poses of the tool "
            "(camera_from_target with camera: {mount: world}), or three markers at known places "
            "in the tool (target: {kind: points, points: ...})",
            "covariance": covariance.tolist(),
            "covariance_of": ["x", "y", "z"],
            "ci95": dict(zip("xyz", intervals(xyz, covariance, found.quantile), strict=True)),
        }
    values = {}
    for name in layout.points:
        place = layout.blocks[f"point:{name}"]
        if name == tip or found.lost[place].any():
            continue
        xyz = found.fit.state.points[name]
        covariance = found.covariance[place, place]
        base = "base" if problem.chain is None else problem.chain.base
        values[marker_of(name)] = {
            "parent": base if name.startswith(PIVOT) else problem.plan.flange,
            "xyz": xyz.tolist(),
            "unit": "m",
            "covariance": covariance.tolist(),
            "ci95": intervals(xyz, covariance, found.quantile),
        }
    if values:
        made["points"] = {"values": values, "asked": False}
    return made


def _scalars(found: CalibrationEstimate, block: str) -> list[tuple[int, float]]:
    """Return column and standard deviation of each determined unknown of a block."""
    place = found.fit.problem.layout.blocks[block]
    spread = np.sqrt(np.diag(found.covariance))
    return [(at, float(spread[at])) for at in range(place.start, place.stop) if not found.lost[at]]


def _zeros(found: CalibrationEstimate) -> dict[str, Any]:
    layout, chain = found.fit.problem.layout, found.fit.problem.chain
    assert chain is not None
    place = layout.blocks["joint_zeros"]
    values = {}
    kept = _scalars(found, "joint_zeros")
    for at, spread in kept:
        joint = layout.zeros[at - place.start]
        # The sum includes the offset that twin.yaml already adds to the reading.
        value = float(found.fit.state.zeros[joint] + chain.offsets[joint])
        unit = layout.parameters[at].unit
        values[layout.joints[joint]] = estimate_entry(value, unit, spread, found.quantile)
    if not values:
        return {}
    columns = [at for at, _ in kept]
    return {
        "values": values,
        "meaning": "model position = sign * encoder reading + value",
        "covariance": found.covariance[np.ix_(columns, columns)].tolist(),
        "covariance_of": list(values),
    }


def _scale(found: CalibrationEstimate) -> dict[str, Any]:
    problem = found.fit.problem
    ((_, spread),) = _scalars(found, "scale")
    value, std = (one / problem.camera_unit for one in (found.fit.state.scale, spread))
    return scale_record(value, std, found.quantile, problem.layout.scale_prior)


def scale_record(value: float, std: float, quantile: float, prior: float | None) -> dict[str, Any]:
    """Return the record of the scale of the camera's positions.

    Args:
        value: scale, 1 for positions in m.
        quantile: half width of the 95 % interval in standard deviations.
        prior: standard deviation of the target's size relative to the stated one; None if the scale
            has no prior.
    """
    made = {
        **estimate_entry(value, "1", std, quantile),
        "meaning": "position in camera_from_target = value * position in m",
    }
    if prior is not None:
        source = "prior" if std > HELD_BY_PRIOR * prior else "data"
        made |= {"prior_std": prior, "determined_by": source, "asked": False}
    return made


def size_note(plan: Plan) -> str:
    """Return the note on the assumed tolerance of the target's size; empty if it is stated."""
    if "tolerance" in plan.target:
        return ""
    return (
        f"the target's size may differ from the stated one by {100 * TARGET_TOLERANCE:g} % "
        "(standard deviation), which is in the intervals; after measuring it, state target: "
        "{tolerance: ...}"
    )


def _geometry(found: CalibrationEstimate) -> dict[str, Any]:
    layout = found.fit.problem.layout
    place = layout.blocks["geometry"]
    values = {}
    for at, spread in _scalars(found, "geometry"):
        link = layout.links[at - place.start]
        parameter = layout.parameters[at]
        value = float(found.fit.state.links[at - place.start])
        prior = float(parameter.prior or np.inf)
        values[link.label] = {
            **estimate_entry(value, parameter.unit, spread, found.quantile),
            "joint": layout.joints[link.joint],
            "kind": "rotation" if link.is_rotation else "translation",
            "direction": link.direction.tolist(),
            "prior_std": prior,
            "determined_by": "prior" if spread > HELD_BY_PRIOR * prior else "data",
        }
    return {"values": values, "frame": "of each joint, at position 0"} if values else {}


def full_covariance(found: CalibrationEstimate) -> Mapping[str, Any]:
    """Return the joint covariance of all unknowns."""
    names = [parameter.name for parameter in found.fit.problem.layout.parameters]
    kept = np.flatnonzero(~found.lost)
    return {
        "of": [names[at] for at in kept],
        "matrix": found.covariance[np.ix_(kept, kept)].tolist(),
    }
