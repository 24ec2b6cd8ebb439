"""Use of images in a calibration: target poses, refinement on corners, and the record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from scipy.stats import t as student

from pytest_twin.calibration.cameras.corner_refinement import intrinsics_record, refine_on_corners
from pytest_twin.calibration.cameras.images import Images
from pytest_twin.calibration.coincident_markers import ExcludedMeasurement
from pytest_twin.calibration.document import new_document
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.plan import Plan
from pytest_twin.calibration.records import CalibrationEstimate
from pytest_twin.calibration.repeated_rows import without_repeats
from pytest_twin.calibration.residual_errors import acceptance_failures
from pytest_twin.calibration.split import split
from pytest_twin.calibration.wrong_scale import FreeScale
from pytest_twin.time_limit import is_over

MOST_FOCAL_SPREAD = 0.02
"""Relative standard deviation of a focal length above which the views do not determine it. It
corresponds to 20 mm of distance at 1 m."""


class ImageRefinement:
    """Images of one calibration with the current camera and the estimate refined on their corners.

    Args:
        observations: rows that the images belong to.
        fitted: indices of the rows from which the camera is estimated.
    """

    def __init__(self, images: Images, observations: Observations, fitted: np.ndarray) -> None:
        self._images, self._ids = images, observations.ids
        self._fitted = [observations.ids[row] for row in fitted]
        self.camera = images.camera(self._fitted)
        self.scale: FreeScale | None = None
        self._estimate: CalibrationEstimate | None = None
        misfit = images.misfit(self._fitted, self.camera)
        self.notes: list[str] = [misfit] if misfit else []

    @property
    def estimate(self) -> CalibrationEstimate:
        """The refined estimate. Valid only after ``refine`` returned True."""
        assert self._estimate is not None
        return self._estimate

    def posed(self, observations: Observations) -> Observations:
        """Return the observations with target poses from the current camera."""
        found, notes = self._images.posed(observations, self.camera)
        self.notes += [note for note in notes if note not in self.notes]
        return found

    def refine(self, found: CalibrationEstimate) -> bool:
        """Refine an estimate on poses with the corners in images; False if that is impossible."""
        if is_over():
            return False
        better = refine_on_corners(found, self._images, self.camera)
        if better is None:
            return False
        self._estimate, self.camera = better.estimate, better.camera
        self.scale = better.scale
        return True

    def complete(self, document: dict[str, Any], held_out: np.ndarray) -> list[str]:
        """Add the intrinsics and the reprojection errors to the document ``calibration.json``.

        Returns:
            Sentences that name what the images do not determine.
        """
        held = [self._ids[row] for row in held_out]
        _add_errors(document, self._images, self, self._fitted, held)
        document["images"] = self._images.detected(self._ids, self.camera)
        quantile = 1.96 if self._estimate is None else self._estimate.quantile
        return _add_intrinsics(document, self, quantile)


def calibrate_intrinsics(
    plan: Plan, observations: Observations, images: Images, rejected: Sequence[ExcludedMeasurement]
) -> dict[str, Any]:
    """Return the content of ``calibration.json`` for a plan that asks for the intrinsics only.

    Raises:
        SpecError: the images do not determine the intrinsics.
    """
    observations, repeats = without_repeats(plan, observations, images)
    rejected = (*rejected, *repeats)
    fitted, held_out = split(plan, observations, [one.id for one in rejected])
    seen = ImageRefinement(images, observations, fitted)
    document: dict[str, Any] = {
        **new_document(plan),
        "held_out": {"count": len(held_out)},
        "fitted": {"count": len(fitted)},
        "excluded": [one.to_json() for one in rejected],
    }
    document["images"] = images.detected(observations.ids, seen.camera)
    degrees = sum(2 * len(d.corner_ids) - 6 for d in images.detections.values())
    quantile = float(student.ppf(0.975, max(degrees, 1)))
    held = [observations.ids[row] for row in held_out]
    _add_errors(document, images, seen, [observations.ids[row] for row in fitted], held)
    document["unobservable"] = _add_intrinsics(document, seen, quantile)
    if not document["unobservable"]:
        reasons = acceptance_failures(document["held_out"], asdict(plan.accept))
        document["verdict"] = "rejected" if reasons else "accepted"
        document["reasons"] = reasons
    else:
        document["reasons"] = list(document["unobservable"])
    document["notes"] = list(seen.notes)
    return document


def _add_errors(
    document: dict[str, Any],
    images: Images,
    seen: ImageRefinement,
    fitted: Sequence[str],
    held_out: Sequence[str],
) -> None:
    for name, ids in (("fitted", fitted), ("held_out", held_out)):
        error = images.reprojection_rms(ids, seen.camera)
        if np.isfinite(error):
            document[name]["reprojection_rms"] = error


def _add_intrinsics(document: dict[str, Any], seen: ImageRefinement, quantile: float) -> list[str]:
    """Add the intrinsics' record; return sentences on what the images do not determine."""
    camera = seen.camera
    if not camera.free:
        return []
    spread = np.sqrt(np.diag(camera.covariance))[:2] / camera.intrinsics.vector[:2]
    if not np.isfinite(spread).all() or spread.max() > MOST_FOCAL_SPREAD:
        return [
            f"the focal length (its standard deviation is {100 * spread.max():.1f} %): focal "
            "length and distance cannot be distinguished; tilt the target by 20 to 50 degrees"
        ]
    document["records"]["intrinsics"] = intrinsics_record(camera, quantile)
    return []
