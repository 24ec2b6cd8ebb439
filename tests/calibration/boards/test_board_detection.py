"""Detection of board corners in images, and reasons for rejecting an image."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered_boards import (
    CAMERA,
    apriltag_grid,
    camera_from_target,
    charuco,
    chessboard,
    rendered_view,
)

from pytest_twin.calibration.boards.detection import detect, detect_files, without_blurred
from pytest_twin.calibration.boards.target import make_target
from pytest_twin.calibration.cameras.pose import target_pose
from pytest_twin.errors import SpecError

TILTED = [0.35, -0.25, 0.1]
PLACE = [-0.08, -0.1, 0.42]


@pytest.mark.parametrize(
    ("target", "kind"),
    [
        (charuco(), {}),
        (charuco(squares=[6, 8]), {}),
        (chessboard(), {}),
        (apriltag_grid(), {}),
        (apriltag_grid(), {"upwards": True}),
    ],
    ids=["charuco", "charuco with even rows", "chessboard", "tags down", "tags up"],
)
def test_the_pose_of_each_kind_of_board_is_estimated_from_its_corners(target, kind):
    turned = [2.8, 0.2, 0.3] if kind else TILTED
    place = [-0.08, 0.08, 0.42] if kind else PLACE
    found = detect(rendered_view(target, turned, place, **kind), target)
    assert found.rejected == ""
    assert len(found.corner_ids) == target.corners
    pose = target_pose(found, CAMERA)
    truth = camera_from_target(turned, place)
    assert pose.rms < 0.2
    assert np.abs(pose.camera_from_target - truth).max() < 1e-3


def test_corners_with_a_hidden_marker_are_found_and_hidden_corners_are_not():
    image = rendered_view(charuco(), [0.0, 0.0, 0.0], PLACE)
    square = 900 * 0.03 / 0.42
    # The second square of the first row contains a marker.
    origin = np.array([510 + 900 * PLACE[0] / 0.42, 378 + 905 * PLACE[1] / 0.42])
    x, y = (origin + square * np.array([1.5, 0.5])).astype(int)
    hidden_marker = image.copy()
    hidden_marker[y - 20 : y + 20, x - 20 : x + 20] = 255
    assert len(detect(hidden_marker, charuco()).corner_ids) == 24
    x, y = (origin + square * np.array([1.0, 1.0])).astype(int)
    hidden_corner = image.copy()
    hidden_corner[y - 45 : y + 45, x - 45 : x + 45] = 128
    assert 0 not in detect(hidden_corner, charuco()).corner_ids


def test_an_image_without_a_board_is_rejected_with_its_blur():
    image = np.full((480, 640), 90, np.uint8)
    image[100:200, 100:300] = 200
    why = detect(image, charuco()).rejected
    assert why == "no target found; the sharpest edges have a blur of 0.4 px"


def test_a_partly_visible_board_is_rejected_with_its_number_of_corners():
    why = detect(rendered_view(charuco(), [0.0, 0.0, 0.0], [0.16, -0.1, 0.42]), charuco()).rejected
    assert why == "target found in 6 of 24 corners"


def test_a_blurred_board_is_rejected_with_its_blur():
    blurred = cv2.GaussianBlur(rendered_view(charuco(), TILTED, PLACE), (0, 0), 9.0)
    assert detect(blurred, charuco()).rejected.startswith("blurred: ")


def test_an_image_with_motion_blur_is_rejected_by_comparison_with_sharp_ones():
    sharp = [
        detect(rendered_view(charuco(), TILTED, [x, -0.1, 0.42]), charuco())
        for x in (-0.1, -0.06, 0.0)
    ]
    streak = np.zeros((7, 7), np.float32)
    streak[3] = 1 / 7
    moved = detect(cv2.filter2D(rendered_view(charuco(), TILTED, PLACE), -1, streak), charuco())
    found = without_blurred([*sharp, moved])
    assert [bool(d.rejected) for d in found] == [False, False, False, True]
    assert found[-1].rejected.startswith("blurred: the edges' blur is ")


@pytest.mark.parametrize("stated", [charuco(squares=[7, 5]), charuco(squares=[4, 7])])
def test_a_wrong_number_of_squares_is_distinguished_from_a_missing_board(stated):
    why = detect(rendered_view(charuco(), TILTED, PLACE), stated).rejected
    assert "they do not lie as on the target: check squares" in why


def test_damaged_and_missing_files_are_rejected_detections(tmp_path: Path):
    (tmp_path / "text.png").write_text("no image")
    whole = cv2.imencode(".png", rendered_view(charuco(), TILTED, PLACE))[1].tobytes()
    (tmp_path / "half.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "whole.png").write_bytes(whole)
    paths = [tmp_path / name for name in ("text.png", "half.png", "gone.png", "whole.png")]
    found = detect_files(paths, charuco())
    assert [d.is_usable for d in found] == [False, False, False, True]
    assert "no readable image" in found[0].rejected
    assert "no readable image" in found[1].rejected
    assert "gone.png" in found[2].rejected


def test_an_image_with_too_many_pixels_is_not_decoded(tmp_path: Path):
    header = b"P5 100000 100000 255\n"
    (tmp_path / "bomb.pgm").write_bytes(header + b"0" * 100)
    (found,) = detect_files([tmp_path / "bomb.pgm"], charuco())
    assert "image is too large" in found.rejected


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"kind": "circles"}, "this kind of target is not found in images"),
        ({"marker": 0.03}, "the marker does not fit into its square"),
        ({"squares": [1, 7]}, "not a usable number of squares"),
        ({"dictionary": "DICT_9X9"}, "unknown dictionary of markers"),
        ({"square": -1.0}, "not a length"),
    ],
)
def test_an_invalid_description_of_a_target_is_refused(changed, words):
    fields = {"squares": [5, 7], "square": 0.03, "marker": 0.022, "dictionary": "DICT_5X5_100"}
    with pytest.raises(SpecError, match=words):
        make_target({"kind": "charuco"} | fields | changed)
