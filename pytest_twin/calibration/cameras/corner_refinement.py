"""Refine a fit on target poses by least squares on reprojection errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import t as student

from pytest_twin.calibration.cameras.arm import arm_of
from pytest_twin.calibration.cameras.bundle import KnownNoise, Robot, bundle
from pytest_twin.calibration.cameras.camera_calibration import Camera
from pytest_twin.calibration.cameras.images import Images
from pytest_twin.calibration.cameras.intrinsics import NAMES, Intrinsics
from pytest_twin.calibration.cameras.normal_equations import Unknowns
from pytest_twin.calibration.problem import predicted_poses
from pytest_twin.calibration.records import CalibrationEstimate, about_child, estimate_entry
from pytest_twin.calibration.terms import PoseTerm
from pytest_twin.calibration.wrong_scale import FreeScale


@dataclass(frozen=True)
class Refined:
    """Result of a fit to the corners in images.

    Attributes:
        camera: the camera and its board.
        scale: scale of the board, estimated without its tolerance.
    """

    estimate: CalibrationEstimate
    camera: Camera
    scale: FreeScale


def refine_on_corners(found: CalibrationEstimate, images: Images, camera: Camera) -> Refined | None:
    """Return the estimate, fitted to the corners in the images instead of to poses.

    Joint zeros and links are unknowns too if the plan asks for them. Returns None if other things
    than images were measured, or if the images do not determine the unknowns. The fit on poses is
    then used.
    """
    problem = found.fit.problem
    terms = problem.terms
    if len(terms) != 1 or not isinstance(terms[0], PoseTerm) or found.lost.any():
        return None
    term = terms[0]
    names = (term.mounted, term.world)
    if set(problem.layout.poses) != set(names) or problem.layout.points:
        return None
    rows = term.rows[found.fit.kept[0]]
    ids = [problem.observations.ids[row] for row in rows]
    if not all(one in images.detections for one in ids):
        return None
    poses = found.fit.state.poses
    start = Unknowns(
        poses[term.mounted],
        poses[term.world],
        camera.intrinsics.vector,
        term.measured[found.fit.kept[0]],
        images.target.board_points(),
    )
    flange = predicted_poses(problem, found.fit.state)[rows]
    arm = arm_of(problem, rows, found.fit.state)
    own = 0 if arm is None else arm.count
    tolerance = 0.0 if problem.layout.scale_prior is None else problem.layout.scale_prior
    own += tolerance > 0.0
    detections = [images.detections[one] for one in ids]
    try:
        robot = Robot(flange, term.mount, arm, tolerance)
        solved = bundle(robot, detections, start, camera.free)
        free = bundle(
            replace(robot, size_tolerance=np.inf),
            detections,
            replace(
                start,
                hand_eye=solved.solved.hand_eye,
                robot_world=solved.solved.robot_world,
                intrinsics=solved.intrinsics,
                camera_from_target=solved.camera_from_target,
            ),
            camera.free,
            noise=KnownNoise(solved.noise, is_exact=False),
        )
    except np.linalg.LinAlgError:
        return None
    scale = FreeScale(1.0 / free.scale, free.scale_std / free.scale**2, free.degrees)
    fit = found.fit
    places = {name: problem.layout.blocks[f"pose:{name}"] for name in names}
    state = replace(
        fit.state if arm is None else arm.moved(solved.arm),
        poses={**poses, names[0]: solved.solved.hand_eye, names[1]: solved.solved.robot_world},
        scale=1.0 / solved.scale,
    )
    covariance = found.covariance.copy()
    turn = np.eye(12 + own)
    # Zeros, links and scale come after the poses in both orders.
    order = np.r_[places[names[0]], places[names[1]], 12 : 12 + own]
    for at, name in enumerate(names):
        turn[6 * at : 6 * at + 6, 6 * at : 6 * at + 6] = about_child(state.poses[name])
    if tolerance > 0.0:
        turn[-1, -1] = -(state.scale**2)
    both = solved.covariance[: 12 + own, : 12 + own]
    covariance[np.ix_(order, order)] = turn @ both @ turn.T
    noise = {**fit.noise, "reprojection": solved.noise.pixel}
    better = replace(
        found,
        fit=replace(fit, state=state, noise=noise),
        covariance=covariance,
        quantile=float(student.ppf(0.975, solved.degrees)),
    )
    new_camera = Camera(
        Intrinsics(solved.intrinsics),
        solved.board,
        solved.free,
        solved.covariance[12 + own :, 12 + own :],
        solved.noise.pixel,
        solved.noise.board if solved.is_board_estimated else 0.0,
    )
    return Refined(better, new_camera, scale)


def intrinsics_record(camera: Camera, quantile: float = 1.96) -> dict[str, Any]:
    """Return the record ``intrinsics`` of ``calibration.json``."""
    spread = np.sqrt(np.diag(camera.covariance))
    vector = camera.intrinsics.vector
    values = {}
    for name, std in zip(camera.free, spread, strict=True):
        value = float(vector[NAMES.index(name)])
        unit = "px" if name in ("fx", "fy", "cx", "cy") else "1"
        values[name] = estimate_entry(value, unit, float(std), quantile)
    return {
        "values": values,
        "distortion_model": "opencv: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4",
        "camera_matrix": camera.intrinsics.matrix.tolist(),
        "distortion": camera.intrinsics.distortion.tolist(),
        "covariance": camera.covariance.tolist(),
        "covariance_of": list(camera.free),
        "pixel_noise": {"value": camera.pixel_noise, "unit": "px"},
        "board_deviation": {"value": camera.board_noise, "unit": "m"},
    }
