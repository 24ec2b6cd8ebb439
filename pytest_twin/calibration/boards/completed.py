"""Corners of a chessboard whose markers were too small to read."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.homography import fit_homography, project
from pytest_twin.calibration.boards.image_file import Grey
from pytest_twin.calibration.boards.opencv import opencv
from pytest_twin.calibration.boards.target import Target

_WINDOW = 0.16
"""Half of the window of the refinement as a share of a square: markers stay outside."""
_LEAST_WINDOW_PX, _MOST_WINDOW_PX = 2, 10
_FARTHEST = 0.12
"""How far a corner may be from where its neighbours say, as a share of a square: lens distortion
moves it by less, the next edge is farther."""
_PROBE = 0.17
"""Where the four squares around a corner are looked at, as a share of a square from each edge:
outside of the markers and of the blur."""
_LEAST_CONTRAST = 0.3
"""Contrast of the four squares around a corner against that of the corners that were found."""
_FEWEST = 6


def completed(
    image: Grey, target: Target, ids: np.ndarray, pixels: FloatArray
) -> tuple[np.ndarray, FloatArray]:
    """Ids and pixels of the corners, with those added that the image shows where they belong.

    The corners of the squares are there even where a marker is not read. Each missing one is
    predicted from the others, refined, and kept if two dark and two bright squares meet there.
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
    refined = refined_corners(image, guess, refinement_window(float(edge.min())))
    steady = np.linalg.norm(refined - guess, axis=1) < _FARTHEST * edge
    usual = float(np.median(square_contrast(image, homography, target, ids)))
    there = np.sign(usual) * square_contrast(image, homography, target, missing)
    clear = there > _LEAST_CONTRAST * abs(usual)
    keep = steady & clear
    all_ids = np.concatenate([ids, missing[keep]])
    order = np.argsort(all_ids)
    return all_ids[order], np.concatenate([pixels, refined[keep]])[order]


def refinement_window(edge_px: float) -> int:
    """Half of the window of the refinement, px, for squares of an edge in px."""
    return int(np.clip(_WINDOW * edge_px, _LEAST_WINDOW_PX, _MOST_WINDOW_PX))


def refined_corners(image: Grey, pixels: FloatArray, window: int) -> FloatArray:
    """Corners moved to where the edges around them meet, (n, 2) px.

    Args:
        image: (height, width).
        pixels: (n, 2) first guesses, px.
        window: half of the edge of the window that is looked at, px.
    """
    cv2 = opencv()
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(image, start, (window, window), (-1, -1), criteria)
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)


def square_contrast(
    image: Grey, homography: FloatArray, target: Target, ids: np.ndarray
) -> FloatArray:
    """(n,) grey values between the two pairs of squares that meet in each corner.

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
