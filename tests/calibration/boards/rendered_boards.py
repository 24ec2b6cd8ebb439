"""Rendered images of calibration boards for a pinhole camera without distortion."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.calibration.boards.target import Target, make_target
from pytest_twin.calibration.cameras.intrinsics import make_intrinsics

CAMERA = make_intrinsics({"fx": 900.0, "fy": 905.0, "cx": 510.0, "cy": 378.0})
SIZE = (1024, 768)
PIXELS_PER_METRE = 4000.0
MARGIN = 0.02


def charuco(**changed: object) -> Target:
    fields = {"squares": [5, 7], "square": 0.03, "marker": 0.022, "dictionary": "DICT_5X5_100"}
    return make_target({"kind": "charuco"} | fields | changed)


def chessboard(**changed: object) -> Target:
    return make_target({"kind": "chessboard", "squares": [8, 5], "square": 0.03} | changed)


def apriltag_grid(**changed: object) -> Target:
    fields = {
        "squares": [4, 3],
        "square": 0.05,
        "marker": 0.04,
        "dictionary": "DICT_APRILTAG_36h11",
    }
    return make_target({"kind": "apriltag_grid"} | fields | changed)


def printed_board(target: Target, upwards: bool = False) -> np.ndarray:
    """An image of the printed board with a white margin."""
    columns, rows = target.squares
    size = (round(columns * target.square * PIXELS_PER_METRE),
            round(rows * target.square * PIXELS_PER_METRE))  # fmt: skip
    aruco = cv2.aruco
    if target.kind == "chessboard":
        y, x = np.mgrid[: size[1], : size[0]] / (target.square * PIXELS_PER_METRE)
        board = np.where((x.astype(int) + y.astype(int)) % 2 == 0, 0, 255).astype(np.uint8)
    elif target.kind == "charuco":
        dictionary = aruco.getPredefinedDictionary(getattr(aruco, target.dictionary))
        board = aruco.CharucoBoard(target.squares, target.square, target.marker, dictionary)
        board = board.generateImage(size)
    else:
        dictionary = aruco.getPredefinedDictionary(getattr(aruco, target.dictionary))
        board = np.full((size[1], size[0]), 255, np.uint8)
        edge = round(target.marker * PIXELS_PER_METRE)
        for tag in range(columns * rows):
            row, column = divmod(tag, columns)
            x = round(column * target.square * PIXELS_PER_METRE)
            y = round(row * target.square * PIXELS_PER_METRE)
            if upwards:
                y = size[1] - y - edge
            board[y : y + edge, x : x + edge] = aruco.generateImageMarker(dictionary, tag, edge)
    margin = round(MARGIN * PIXELS_PER_METRE)
    return np.pad(board, margin, constant_values=255)


def rendered_view(
    target: Target, rotation: list[float], position: list[float], **kind: bool
) -> np.ndarray:
    """Image of a board with the pose ``camera_from_target``.

    Args:
        target: the board.
        rotation: rotation vector of ``camera_from_target``, rad.
        position: origin of the target in the camera frame, m.
        kind: see ``printed_board``.
    """
    printed = printed_board(target, **kind)
    pose = camera_from_target(rotation, position)
    to_board = np.array(
        [[1 / PIXELS_PER_METRE, 0, -MARGIN + 0.5 / PIXELS_PER_METRE],
         [0, 1 / PIXELS_PER_METRE, -MARGIN + 0.5 / PIXELS_PER_METRE], [0, 0, 1]]
    )  # fmt: skip
    if kind.get("upwards"):
        height = target.squares[1] * target.square
        to_board = np.array([[1, 0, 0], [0, -1, height], [0, 0, 1]]) @ to_board
    onto = CAMERA.matrix @ np.column_stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]]) @ to_board
    # Render at four times the resolution, so that edges are blurred as by a lens.
    fine = np.diag([4.0, 4.0, 1.0])
    fine[:2, 2] = 1.5
    image = cv2.warpPerspective(
        printed, fine @ onto, (4 * SIZE[0], 4 * SIZE[1]), flags=cv2.INTER_AREA, borderValue=110
    )
    return cv2.resize(cv2.GaussianBlur(image, (0, 0), 2.5), SIZE, interpolation=cv2.INTER_AREA)


def camera_from_target(rotation: list[float], position: list[float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    pose[:3, 3] = position
    return pose
