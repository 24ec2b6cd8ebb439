"""Images of a calibration's observations, from files to target poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.detection import Detection, detect_files
from pytest_twin.calibration.boards.target import KINDS, Target, make_target
from pytest_twin.calibration.cameras.camera_calibration import (
    FEWEST_IMAGES,
    MODELS,
    Camera,
    calibrate_camera,
    camera_of,
    fit_images,
)
from pytest_twin.calibration.cameras.intrinsics import Intrinsics, make_intrinsics
from pytest_twin.calibration.cameras.pose import AMBIGUOUS, TargetPose, target_pose
from pytest_twin.calibration.cameras.reprojection import corners_of, reprojection_residuals
from pytest_twin.calibration.coincident_markers import ExcludedMeasurement
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.plan import Plan
from pytest_twin.errors import TwinError
from pytest_twin.formats.paths import Roots
from pytest_twin.metrics.pose import pose_vector

MISFIT_RATIO = 1.5
"""The given intrinsics are reported as wrong if estimated ones reduce the reprojection error by
this factor. Overfitting nine intrinsics to five images of 24 corners reduces it by less than
1.1."""


@dataclass(frozen=True)
class Images:
    """Detections of the target in the images of a plan's observations.

    Attributes:
        target: target that was searched for.
        detections: id of an observation -> its usable detection.
        rejected: detections that are not usable.
        files: id of an observation -> its image, relative to the table of observations.
        given: intrinsics of the plan, or None.
        is_estimated: whether the intrinsics are to be estimated.
        paths: paths of the existing images.
    """

    target: Target
    detections: Mapping[str, Detection]
    rejected: tuple[Detection, ...]
    files: Mapping[str, str]
    given: Intrinsics | None
    is_estimated: bool
    paths: tuple[Path, ...] = ()

    def camera(self, ids: Sequence[str]) -> Camera:
        """Estimate the camera from the images of some observations, or return the given one.

        Raises:
            SpecError: the intrinsics are to be estimated, and the images do not determine them.
        """
        found = [self.detections[one] for one in ids if one in self.detections]
        board = self.target.board_points()
        if self.is_estimated or self.given is None:
            return calibrate_camera(found, board, self.given)
        try:
            return camera_of(fit_images(found, board, self.given, ()))
        except (ValueError, np.linalg.LinAlgError):
            return Camera(self.given, board, (), np.zeros((0, 0)), 0.3, 0.0)

    def misfit(self, ids: Sequence[str], camera: Camera) -> str:
        """Message that the given intrinsics do not fit the images; empty if they do."""
        if self.is_estimated or self.given is None or len(ids) < 5:
            return ""
        found = [self.detections[one] for one in ids if one in self.detections]
        try:
            better = fit_images(found, self.target.board_points(), self.given, MODELS[3])
        except (ValueError, np.linalg.LinAlgError):
            return ""
        if camera.pixel_noise < MISFIT_RATIO * better.noise.pixel:
            return ""
        fx, fy, cx, cy = better.intrinsics[:4]
        return (
            f"the given intrinsics do not fit the images: reprojection error "
            f"{camera.pixel_noise:.2f} px, {better.noise.pixel:.2f} px with fx {fx:.1f}, "
            f"fy {fy:.1f}, cx {cx:.1f}, cy {cy:.1f} and distortion; add intrinsics to estimate"
        )

    def posed(self, observations: Observations, camera: Camera) -> tuple[Observations, list[str]]:
        """Return the observations with the pose of the target in each image, and notes."""
        poses = np.full((len(observations), 4, 4), np.nan)
        if observations.camera_from_target is not None:
            poses = observations.camera_from_target.copy()
        unsure = []
        for row, one in enumerate(observations.ids):
            if one not in self.detections:
                continue
            pose = self.pose(one, camera)
            if pose is not None:
                poses[row] = pose.camera_from_target
                if pose.ambiguity < AMBIGUOUS:
                    unsure.append(one)
        notes = []
        if unsure:
            notes.append(
                f"in the images of {', '.join(unsure)} the target's tilt is ambiguous: it is seen "
                "from the front or from far; move closer or tilt it"
            )
        return replace(observations, camera_from_target=poses), notes

    def pose(self, name: str, camera: Camera) -> TargetPose | None:
        """Return the pose of the target in the image of one observation."""
        detection = self.detections[name]
        on_board = replace(detection, board_points=camera.board[detection.corner_ids])
        return target_pose(on_board, camera.intrinsics)

    def detected(self, ids: Sequence[str], camera: Camera) -> dict[str, Any]:
        """Return the detections in each image for ``calibration.json`` and its report."""
        found = {}
        for one in ids:
            pose = self.pose(one, camera) if one in self.detections else None
            if pose is None:
                continue
            detection = self.detections[one]
            on_board = replace(detection, board_points=camera.board[detection.corner_ids])
            residuals, _, _ = reprojection_residuals(
                camera.intrinsics.vector, pose.camera_from_target[None], corners_of([on_board])
            )
            found[one] = {
                "file": self.files[one],
                "size": list(detection.size),
                "blur": detection.sharpness,
                "reprojection_rms": pose.rms,
                "camera_from_target": pose_vector(pose.camera_from_target).tolist(),
                "corner_ids": detection.corner_ids.tolist(),
                "pixels": detection.pixels.tolist(),
                "residuals": residuals.tolist(),
            }
        return found

    def reprojection_rms(self, ids: Sequence[str], camera: Camera) -> float:
        """RMS reprojection error, px, with the target pose of each image estimated."""
        squares, count = 0.0, 0
        for one in ids:
            pose = self.pose(one, camera) if one in self.detections else None
            if pose is not None:
                corners = len(self.detections[one].corner_ids)
                squares, count = squares + corners * pose.rms**2, count + corners
        return float(np.sqrt(squares / count)) if count else float("nan")


def read_images(
    plan: Plan,
    observations: Observations,
    folder: Path | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> tuple[Observations, Images | None, tuple[ExcludedMeasurement, ...]]:
    """Detect the target in the images of the observations; None if the plan has no images.

    Images are read from the plan's folder, or from ``folder`` for images extracted from recordings.
    Observations without a usable image and without another measurement are left out.

    Raises:
        SpecError: target or intrinsics are missing or invalid, or no image is usable.
        PathError: a path leaves the plan's folder.
    """
    kind = plan.target.get("kind")
    if observations.images is None or not any(observations.images):
        return observations, None, ()
    if kind not in KINDS:
        raise plan.error(
            "target.kind",
            "there are images, and no target that is found in images",
            value=kind,
            expected=", ".join(KINDS),
        )
    try:
        target = make_target(plan.target)
        given = make_intrinsics(plan.camera["intrinsics"]) if "intrinsics" in plan.camera else None
    except TwinError as error:
        raise plan.error(
            error.where or "target", error.problem, value=error.value, expected=error.expected
        ) from None
    names = [one for one, image in zip(observations.ids, observations.images, strict=True) if image]
    paths = _paths(plan, observations, folder)
    found = detect_files(paths, target, names, progress)
    usable = {one.image: one for one in found if one.is_usable}
    rejected = tuple(one for one in found if not one.is_usable)
    if not usable:
        raise plan.error(
            "target",
            "no image shows the target",
            value=rejected[0].rejected,
            expected=f"a {kind} in the images, not mirrored, of the kind, squares and dictionary "
            f"that target states; the first reason is that of {rejected[0].image}",
        )
    estimated = "intrinsics" in plan.estimate or given is None
    if estimated and rejected and len(usable) < FEWEST_IMAGES:
        raise plan.error(
            "target",
            f"{len(usable)} of {len(found)} images show the target, too few for the intrinsics",
            value=rejected[0].rejected,
            expected=f"at least {FEWEST_IMAGES} images with a {kind}, not mirrored, of the kind, "
            "squares and dictionary that target states; the first reason is that of "
            f"{rejected[0].image}",
        )
    other = _differs_from_image(observations)
    without = {one.image for one in rejected}
    keep = [i for i, name in enumerate(observations.ids) if name not in without or other[i]]
    left_out = tuple(ExcludedMeasurement(one.image, one.rejected) for one in rejected)
    files = dict(zip(observations.ids, observations.images, strict=True))
    there = tuple(path for path in paths if path.is_file())
    images = Images(target, usable, rejected, files, given, estimated, there)
    return observations.rows(keep), images, left_out


def _paths(plan: Plan, observations: Observations, folder: Path | None) -> list[Path]:
    """Paths of the images; the reader reports a missing file."""
    declared = () if plan.roots is None else plan.roots.extra
    roots = Roots(plan.path.parent, (*declared, *(() if folder is None else (folder,))))
    table = plan.observations[0] if plan.observations else plan.path
    found = []
    for reference in observations.images or ():
        if not reference:
            continue
        plain = Path(reference)
        wanted = table.parent / plain
        missing = not wanted.exists() and not plain.is_absolute() and ".." not in plain.parts
        if not missing:
            wanted = roots.resolve(reference, at=table, where="image")
        found.append(wanted)
    return found


def _differs_from_image(observations: Observations) -> FloatArray:
    """(rows,) True where a row has another measurement than its image."""
    found = np.zeros(len(observations), dtype=bool)
    if observations.camera_from_target is not None:
        found |= np.isfinite(observations.camera_from_target).all(axis=(1, 2))
    for values in observations.points.values():
        found |= np.isfinite(values).all(axis=1)
    return found
