"""Find the corners of each kind of target in an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.homography import fit_homography, project
from pytest_twin.calibration.boards.image_file import Grey
from pytest_twin.calibration.boards.missing_corners import (
    refine_corners,
    refinement_window,
    square_contrast,
    with_missing_corners,
)
from pytest_twin.calibration.boards.opencv import opencv
from pytest_twin.calibration.boards.target import Target

_FEWEST_MARKERS = 3
"""With at least this many decoded markers the image shows a board, even if no corners were
found."""


@dataclass(frozen=True)
class Found:
    """Corners that a finder found in an image.

    Attributes:
        ids: (n,) indices of corners.
        pixels: (n, 2) px.
        problem: reason why the corners are no usable target; empty if they may be one.
    """

    ids: np.ndarray
    pixels: FloatArray
    problem: str = ""


def find(image: Grey, target: Target) -> Found:
    """The corners of the target in an image."""
    finder = {
        "charuco": _find_charuco,
        "chessboard": _find_chessboard,
        "apriltag_grid": _find_apriltag_grid,
    }[target.kind]
    return finder(image, target)


def _none(problem: str = "") -> Found:
    return Found(np.zeros(0, dtype=int), np.zeros((0, 2)), problem)


def _find_charuco(image: Grey, target: Target) -> Found:
    aruco = opencv().aruco
    best, markers = _none(), 0
    # Boards with an even number of rows were printed with the other colour first by OpenCV
    # before 4.6.
    for legacy in (False, True) if target.squares[1] % 2 == 0 else (False,):
        board = aruco.CharucoBoard(
            target.squares, target.square, target.marker, _dictionary(target)
        )
        board.setLegacyPattern(legacy)
        pixels, ids, _, marker_ids = aruco.CharucoDetector(board).detectBoard(image)
        markers = max(markers, 0 if marker_ids is None else len(marker_ids))
        if ids is not None and len(ids) > len(best.ids):
            best = Found(ids.ravel().astype(int), pixels.reshape(-1, 2).astype(np.float64))
    if len(best.ids) < 4:
        if markers >= _FEWEST_MARKERS:
            return _none(
                f"{markers} markers of {target.dictionary} found, but they do not lie as on the "
                f"target: check squares, or the target is seen in part"
            )
        return _none()
    return Found(*with_missing_corners(image, target, best.ids, best.pixels))


def _find_chessboard(image: Grey, target: Target) -> Found:
    cv2 = opencv()
    shape = (target.squares[0] - 1, target.squares[1] - 1)
    # OpenCV's own flag for accuracy takes four times as long and is half as accurate.
    there, pixels = cv2.findChessboardCornersSB(image, shape, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not there:
        return _none()
    grid = pixels.reshape(shape[1], shape[0], 2).astype(np.float64)
    edges = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    refined = refine_corners(image, grid.reshape(-1, 2), refinement_window(min(edges)))
    return _turn_board(image, target, refined)


def _turn_board(image: Grey, target: Target, pixels: FloatArray) -> Found:
    """Order the corners so that the first square is dark and x points to the right of the image."""
    columns, rows = target.squares[0] - 1, target.squares[1] - 1
    grid = pixels.reshape(rows, columns, 2)
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0.0:
        grid = grid[::-1]
    ids = np.arange(target.corners)
    board = target.board_points()[:, :2]
    best, right = _none(), -np.inf
    for turn in range(4) if columns == rows else (0, 2):
        order = np.rot90(grid, turn).reshape(-1, 2)
        homography = fit_homography(board, order)
        if homography is None:
            continue
        dark = float(np.median(square_contrast(image, homography, target, ids))) < 0.0
        along = order[columns - 1] - order[0]
        if dark and along[0] / np.linalg.norm(along) > right:
            best, right = Found(ids, order), along[0] / np.linalg.norm(along)
    return best


def _find_apriltag_grid(image: Grey, target: Target) -> Found:
    aruco = opencv().aruco
    parameters = aruco.DetectorParameters()
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    quads, ids, _ = aruco.ArucoDetector(_dictionary(target), parameters).detectMarkers(image)
    if ids is None:
        return _none()
    ids = ids.ravel().astype(int)
    mine = ids < target.squares[0] * target.squares[1]
    if mine.sum() < 2:
        strangers = f": tag {ids[~mine][0]} is not on the target" if (~mine).any() else ""
        return _none(f"{mine.sum()} tags of the target found{strangers}")
    quads = np.asarray(quads, dtype=np.float64).reshape(-1, 4, 2)[mine]
    tags = ids[mine]
    if len(set(tags // target.squares[0])) < 2 or len(set(tags % target.squares[0])) < 2:
        return _none("tags of one row or one column found: how they are arranged cannot be seen")
    return _arrange_tags(target, tags, quads)


def _arrange_tags(target: Target, tags: np.ndarray, quads: FloatArray) -> Found:
    """Order the corners of tags as the target does.

    A tag's corners are found clockwise on the page, from the corner that its dictionary calls the
    first. How the tag was turned when it was printed, and whether rows go up or down the page, is
    one of eight arrangements. Only one of them makes a flat board.
    """
    points = target.board_points()[:, :2]
    corner_ids = (4 * tags[:, None] + np.arange(4)).ravel()
    plane = points[corner_ids]
    best, least = _none(), np.inf
    for upwards in (False, True):
        for turn in range(4):
            order = np.roll(np.arange(4), turn)
            pixels = quads[:, order[::-1] if upwards else order].reshape(-1, 2)
            homography = fit_homography(plane, pixels)
            if homography is None:
                continue
            off = float(np.median(np.linalg.norm(project(homography, plane) - pixels, axis=1)))
            if off < least:
                best, least = Found(corner_ids, pixels), off
    return best


def _dictionary(target: Target) -> object:
    aruco = opencv().aruco
    return aruco.getPredefinedDictionary(getattr(aruco, target.dictionary))
