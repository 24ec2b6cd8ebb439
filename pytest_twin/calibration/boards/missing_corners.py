"""Add chessboard corners of a ChArUco board whose markers were too small to be decoded."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.homography import fit_homography, project
from pytest_twin.calibration.boards.image_file import Grey
from pytest_twin.calibration.boards.opencv import opencv
from pytest_twin.calibration.boards.target import Target

_WINDOW = 0.16
"""Half width of the refinement window as a fraction of a square's edge. The window must not
reach the markers."""
_LEAST_WINDOW_PX, _MOST_WINDOW_PX = 2, 10
"""Limits of the half width of the refinement window."""
_FARTHEST = 0.12
"""Largest distance of a refined corner from its predicted position, as a fraction of a square's
edge. Lens distortion moves a corner by less; the next edge is farther away."""
_PROBE = 0.17
"""Distance from each edge at which the four squares around a corner are sampled, as a fraction of a
square's edge. The samples lie outside of the markers and of the blurred edge."""
_LEAST_CONTRAST = 0.3
"""Smallest contrast of the four squares around an added corner, as a fraction of the median
contrast of the detected corners."""
_FEWEST = 6
"""Smallest number of detected corners from which a homography is fitted; 4 determine one without a
residual."""


def with_missing_corners(
    image: Grey, target: Target, ids: np.ndarray, pixels: FloatArray
) -> tuple[np.ndarray, FloatArray]:
    """Return ids and pixels of the corners, detected and added ones, in the order of their ids.

    The corners of the squares are visible even where a marker cannot be decoded. The position of
    each missing corner is predicted from the others and refined. The corner is added if two dark
    and two bright squares meet there.
    """
    board = target.board_points()[:, :2]
    missing = np.setdiff1d(np.arange(target.corners), ids)
    homography = fit_homography(board[ids], pixels) if len(ids) >= _FEWEST else None
    if homography is None or not len(missing):
        return ids, pixels
    guess = project(homography, board[missing])
    sides = [project(homography, board[missing] + step) - guess
             for step in ((target.square, 0.0), (0.0, target.square))]  # fmt: skip
    edge = np.minimum(*(np.linalg.norm(side, axis=1) for side in sides))
    room = _MOST_WINDOW_PX + 2
    height, width = image.shape
    inside = (
        np.isfinite(guess).all(axis=1)
        & (guess > room).all(axis=1)
        & (guess < np.array([width, height]) - room).all(axis=1)
        & (_WINDOW * edge >= _LEAST_WINDOW_PX)
    )
    if not inside.any():
        return ids, pixels
    missing, guess, edge = missing[inside], guess[inside], edge[inside]
    refined = refine_corners(image, guess, refinement_window(float(edge.min())))
    steady = np.linalg.norm(refined - guess, axis=1) < _FARTHEST * edge
    usual = float(np.median(square_contrast(image, homography, target, ids)))
    there = np.sign(usual) * square_contrast(image, homography, target, missing)
    clear = there > _LEAST_CONTRAST * abs(usual)
    keep = steady & clear
    all_ids = np.concatenate([ids, missing[keep]])
    order = np.argsort(all_ids)
    return all_ids[order], np.concatenate([pixels, refined[keep]])[order]


def refinement_window(edge_px: float) -> int:
    """Half width of the refinement window, px, for squares with an edge of ``edge_px``."""
    return int(np.clip(_WINDOW * edge_px, _LEAST_WINDOW_PX, _MOST_WINDOW_PX))


def refine_corners(image: Grey, pixels: FloatArray, window: int) -> FloatArray:
    """(n, 2) corners refined to the intersection of the edges around them, px.

    Args:
        image: (height, width).
        pixels: (n, 2) first guesses, px.
        window: half width of the refinement window, px.
    """
    cv2 = opencv()
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(image, start, (window, window), (-1, -1), criteria)
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)


def square_contrast(
    image: Grey, homography: FloatArray, target: Target, ids: np.ndarray
) -> FloatArray:
    """(n,) difference in grey value between the two pairs of squares that meet in each corner.

    The sign is the same for all corners of a chessboard: negative where its first square is dark.
    """
    columns = target.squares[0] - 1
    sign = np.where((ids // columns + ids % columns) % 2 == 0, 1.0, -1.0)
    corner = target.board_points()[ids, :2]
    values = {}
    for side in ((-1, -1), (1, 1), (-1, 1), (1, -1)):
        places = project(homography, corner + _PROBE * target.square * np.array(side))
        sampled = opencv().remap(
            image,
            places[:, :1].astype(np.float32),
            places[:, 1:].astype(np.float32),
            interpolation=opencv().INTER_LINEAR,
            borderMode=opencv().BORDER_REPLICATE,
        )
        values[side] = sampled[:, 0].astype(np.float64)
    pairs = values[-1, -1] + values[1, 1] - values[-1, 1] - values[1, -1]
    return np.asarray(sign * pairs / 2.0, dtype=np.float64)
