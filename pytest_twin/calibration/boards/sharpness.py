"""Measure the sharpness of an image: the standard deviation of the blur of its edges."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.image_file import Grey
from pytest_twin.calibration.boards.opencv import opencv
from pytest_twin.calibration.boards.target import Target

_SAMPLES = 97
"""Number of samples of the brightness across an edge."""
_REACH = 0.45
"""Length of a grey-value profile on either side of an edge, as a fraction of the edge's length."""
_BLURRED_SHARE = 80.0
"""Percentile of the blur over the edges. It is above the median because motion blurs edges of one
direction only."""
_LEAST_CONTRAST = 12.0
"""Smallest difference in grey value between the two sides of an edge."""


def blur_px(image: Grey, target: Target, ids: np.ndarray, pixels: FloatArray) -> float:
    """Standard deviation of the blur across the target's edges, px; NaN if no edge is visible.

    A grey-value profile is taken across the middle of each edge between two neighbouring corners. A
    step blurred by a Gaussian has the steepest slope height / (sigma sqrt(2 pi)).
    """
    starts, ends = _edges(target, ids, pixels)
    if not len(starts):
        return float("nan")
    along = ends - starts
    length = np.linalg.norm(along, axis=1)
    keep = length > 4.0
    if not keep.any():
        return float("nan")
    starts, along, length = starts[keep], along[keep], length[keep]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1) / length[:, None]
    steps = np.linspace(-_REACH, _REACH, _SAMPLES)
    places = (starts + 0.5 * along)[:, None, :] + (
        steps[None, :, None] * (length[:, None, None] * across[:, None, :])
    )
    profile = (
        opencv()
        .remap(
            image,
            places[..., 0].astype(np.float32),
            places[..., 1].astype(np.float32),
            interpolation=opencv().INTER_LINEAR,
            borderMode=opencv().BORDER_REPLICATE,
        )
        .astype(np.float64)
    )
    height = np.ptp(profile, axis=1)
    seen = height > _LEAST_CONTRAST
    if not seen.any():
        return float("nan")
    spacing = length * (steps[1] - steps[0])
    slope = np.abs(np.diff(profile, axis=1)).max(axis=1) / spacing
    widths = height[seen] / (slope[seen] * np.sqrt(2.0 * np.pi))
    return float(np.percentile(widths, _BLURRED_SHARE))


def image_blur_px(image: Grey) -> float:
    """Standard deviation of the blur of the sharpest edges of a whole image, px."""
    values = image.astype(np.float64)
    low, high = np.percentile(values, (1.0, 99.0))
    slopes = [np.abs(np.diff(values, axis=axis)) for axis in (0, 1)]
    steepest = max(float(np.percentile(slope, 99.9)) if slope.size else 0.0 for slope in slopes)
    if steepest <= 0.0:
        return float("inf")
    return float((high - low) / (steepest * np.sqrt(2.0 * np.pi)))


def _edges(target: Target, ids: np.ndarray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(edges, 2) both ends of the edges whose two corners were detected, px."""
    place = np.full((target.corners, 2), np.nan)
    place[ids] = pixels
    if target.kind == "apriltag_grid":
        tags = place.reshape(-1, 4, 2)
        starts = tags.reshape(-1, 2)
        ends = np.roll(tags, -1, axis=1).reshape(-1, 2)
    else:
        grid = place.reshape(target.squares[1] - 1, target.squares[0] - 1, 2)
        starts = np.concatenate([grid[:, :-1].reshape(-1, 2), grid[:-1].reshape(-1, 2)])
        ends = np.concatenate([grid[:, 1:].reshape(-1, 2), grid[1:].reshape(-1, 2)])
    both = np.isfinite(starts).all(axis=1) & np.isfinite(ends).all(axis=1)
    return starts[both], ends[both]
