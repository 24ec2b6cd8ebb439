"""Command ``pytest-twin calibrate`` for images."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "boards"))
from rendered_boards import CAMERA, apriltag_grid, charuco, chessboard, rendered_view

from pytest_twin import cli
from pytest_twin.calibration.boards.target import Target
from pytest_twin.calibration.cameras.increments import apply_change
from pytest_twin.metrics.pose import inverse

pytestmark = pytest.mark.usefixtures("commands_in_process")


def stated_target(board: Target) -> dict[str, object]:
    """A board as a plan states it."""
    return {"kind": board.kind, "squares": list(board.squares), "square": board.square,
            "marker": board.marker, "dictionary": board.dictionary}  # fmt: skip


BOARD = charuco()
TARGET = stated_target(BOARD)
POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")


def write_cell(
    folder: Path,
    *,
    count: int = 14,
    noise: float = 2e-4,
    seed: int = 11,
    board: Target = BOARD,
    **plan: object,
) -> np.ndarray:
    """Write plan, observations and images for a camera on the hand; return the hand-eye pose."""
    rng = np.random.default_rng(seed)
    hand_eye = apply_change(np.eye(4), np.array([0.05, -0.02, 0.06, 0.1, -0.2, 0.7]))
    robot_world = apply_change(np.eye(4), np.array([0.6, 0.1, 0.05, 0.2, 3.0, 0.1]))
    (folder / "images").mkdir()
    rows = [",".join(["id", "image", *(f"flange.{part}" for part in POSE)])]
    for number in range(count):
        turn = [*rng.uniform(-0.45, 0.45, 2), rng.uniform(-0.6, 0.6)]
        place = [-0.07 + 0.04 * rng.normal(), -0.1 + 0.03 * rng.normal(), rng.uniform(0.38, 0.5)]
        image = rendered_view(board, turn, place)
        cv2.imwrite(str(folder / "images" / f"{number}.png"), image)
        seen = np.eye(4)
        seen[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
        seen[:3, 3] = place
        flange = robot_world @ inverse(seen) @ inverse(hand_eye)
        flange = apply_change(flange, noise * rng.normal(size=6))
        quaternion = np.roll(Rotation.from_matrix(flange[:3, :3]).as_quat(), 1)
        numbers = [repr(float(v)) for v in (*flange[:3, 3], *quaternion)]
        rows.append(",".join([f"n{number}", f"images/{number}.png", *numbers]))
    (folder / "observations.csv").write_text("\n".join(rows) + "\n")
    stated = {
        "calibration": "cell",
        "flange": "tool0",
        "observations": "observations.csv",
        "estimate": ["hand_eye", "robot_world", "intrinsics"],
        "camera": {"mount": "hand"},
        "target": stated_target(board),
        "hold_out": {"fraction": 0.3, "seed": 1},
        "accept": {"translation": 0.002, "rotation": 0.0035},
    }
    (folder / "plan.yaml").write_text(yaml.safe_dump(stated | plan))
    return hand_eye


def calibrated(folder: Path) -> tuple[int, dict]:
    status = cli.main(["calibrate", str(folder / "plan.yaml"), "--out", str(folder / "out")])
    return status, json.loads((folder / "out" / "calibration.json").read_text())


@pytest.mark.parametrize("board", [charuco(), apriltag_grid()], ids=lambda board: board.kind)
def test_hand_eye_pose_and_intrinsics_from_images_agree_with_the_true_values(tmp_path, board):
    truth = write_cell(tmp_path, board=board)
    status, found = calibrated(tmp_path)
    assert status == 0
    record = found["records"]["hand_eye"]
    spread = np.sqrt(np.diag(record["covariance"]))
    off = np.array(record["transform"]["xyz"]) - truth[:3, 3]
    assert (np.abs(off) < 4.0 * spread[:3]).all()
    assert np.linalg.norm(off) < 1e-3
    values = found["records"]["intrinsics"]["values"]
    for name, true in zip(("fx", "fy", "cx", "cy"), CAMERA.vector, strict=False):
        assert abs(values[name]["value"] - true) < 4.0 * values[name]["std"], name
    assert found["held_out"]["reprojection_rms"] < 0.1
    assert {
        "tsai",
        "park",
        "horaud",
        "andreff",
        "daniilidis",
        "shah",
        "li",
        "least_squares",
    } <= set(found["solvers"])


def test_a_wrong_size_of_the_target_is_reported(tmp_path):
    write_cell(tmp_path, target=TARGET | {"square": 0.033, "marker": 0.0242})
    status, found = calibrated(tmp_path)
    assert status == 1
    assert "the target is probably not of the stated size" in found["reasons"][0]


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        (
            {"target": TARGET | {"square": 30.0, "marker": 22.0}},
            "its dimensions seem to be in mm; state square and marker of target in m",
        ),
        (
            {"camera": {"mount": "world"}},
            "the camera is not mounted as stated (camera: {mount: world}); state camera: "
            "{mount: hand}",
        ),
    ],
)
def test_a_plan_that_contradicts_the_images_is_reported_with_a_correction(tmp_path, plan, words):
    write_cell(tmp_path, **plan)
    status, found = calibrated(tmp_path)
    assert status == 1
    assert any(words in reason for reason in found["reasons"])
    # Corrections for tables of poses and proposals of further poses do not apply here.
    assert not any(
        "camera_from_target" in one or "turn the flange" in one for one in found["reasons"]
    )


def test_unusable_images_are_excluded_with_reasons(tmp_path):
    write_cell(tmp_path)
    images = tmp_path / "images"
    cv2.imwrite(str(images / "0.png"), np.full((768, 1024), 128, np.uint8))
    blurred = cv2.GaussianBlur(cv2.imread(str(images / "1.png"), 0), (0, 0), 5.0)
    cv2.imwrite(str(images / "1.png"), blurred)
    half = cv2.imread(str(images / "2.png"), 0)
    dark = np.flatnonzero(half.min(axis=0) < 60)
    half[:, int(dark.mean()) - 30 :] = 110
    cv2.imwrite(str(images / "2.png"), half)
    (images / "3.png").unlink()
    status, found = calibrated(tmp_path)
    assert status == 0
    why = {one["id"]: one["why"] for one in found["excluded"]}
    assert {"n0", "n1", "n2", "n3"} <= set(why)
    assert why["n0"].startswith("no target found")
    assert "blur" in why["n1"]
    assert why["n2"].startswith("target found in ")
    assert "3.png" in why["n3"]


def test_given_intrinsics_that_contradict_the_images_are_noted(tmp_path):
    wrong = {"fx": 940.0, "fy": 905.0, "cx": 510.0, "cy": 378.0}
    write_cell(tmp_path, estimate=["hand_eye", "robot_world"],
         camera={"mount": "hand", "intrinsics": wrong})  # fmt: skip
    _, found = calibrated(tmp_path)
    assert any("the given intrinsics do not fit the images" in note for note in found["notes"])


def test_intrinsics_can_be_estimated_without_a_robot(tmp_path):
    write_cell(tmp_path, estimate=["intrinsics"], accept={"reprojection": 0.5})
    table = (tmp_path / "observations.csv").read_text().splitlines()
    lines = [",".join(line.split(",")[:2]) for line in table]
    (tmp_path / "observations.csv").write_text("\n".join(lines) + "\n")
    status, found = calibrated(tmp_path)
    assert status == 0
    assert list(found["records"]) == ["intrinsics"]


def test_frontal_images_do_not_determine_the_focal_length(tmp_path):
    (tmp_path / "images").mkdir()
    rows = ["id,image"]
    for number in range(6):
        image = rendered_view(
            charuco(), [0.0, 0.0, 0.1 * number], [-0.07, -0.1, 0.4 + 0.01 * number]
        )
        cv2.imwrite(str(tmp_path / "images" / f"{number}.png"), image)
        rows.append(f"{number},images/{number}.png")
    (tmp_path / "observations.csv").write_text("\n".join(rows) + "\n")
    plan = {
        "calibration": "front",
        "estimate": ["intrinsics"],
        "observations": "observations.csv",
        "target": TARGET,
        "hold_out": {"fraction": 0.0},
    }
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(plan))
    status, found = calibrated(tmp_path)
    assert (status, found["verdict"], found["records"]) == (1, "degenerate", {})
    assert "focal length and distance cannot be distinguished" in found["unobservable"][0]


def test_images_without_the_target_are_refused_with_a_reason(tmp_path, capsys):
    write_cell(tmp_path, count=4, target=TARGET | {"dictionary": "DICT_6X6_250"})
    assert cli.main(["calibrate", str(tmp_path / "plan.yaml"), "--out", str(tmp_path / "o")]) == 2
    words = capsys.readouterr().err
    assert "no image shows the target" in words
    assert "not mirrored, of the kind, squares and dictionary that target states" in words
    assert "no target found" in words


@pytest.mark.parametrize("place", ["../outside.png", "/etc/hostname"])
def test_an_image_outside_the_folder_is_refused(tmp_path, capsys, place):
    folder = tmp_path / "plan"
    folder.mkdir()
    write_cell(folder, count=4)
    (tmp_path / "outside.png").write_bytes(b"")
    table = folder / "observations.csv"
    table.write_text(table.read_text().replace("images/0.png", place))
    assert cli.main(["calibrate", str(folder / "plan.yaml"), "--out", str(folder / "o")]) == 2
    assert "image" in capsys.readouterr().err


def test_a_board_with_half_turn_symmetry_may_be_seen_at_any_angle(tmp_path):
    board = {"kind": "chessboard", "squares": [8, 6], "square": 0.03}
    names = ("fx", "fy", "cx", "cy")
    given = dict(zip(names, CAMERA.vector.tolist(), strict=False))
    rng = np.random.default_rng(4)
    hand_eye = apply_change(np.eye(4), np.array([0.05, -0.02, 0.06, 0.1, -0.2, 0.7]))
    robot_world = apply_change(np.eye(4), np.array([0.6, 0.1, 0.05, 0.2, 3.0, 0.1]))
    rows = [",".join(["id", "image", *(f"flange.{part}" for part in POSE)])]
    middle = np.array([0.12, 0.09, 0.0])
    for number in range(10):
        # The board is rotated about its normal by any angle.
        turn = Rotation.from_rotvec([*rng.uniform(-0.4, 0.4, 2), 0.0]) * Rotation.from_rotvec(
            [0.0, 0.0, 0.7 * number]
        )
        seen = np.eye(4)
        seen[:3, :3] = turn.as_matrix()
        seen[:3, 3] = [0.0, 0.0, rng.uniform(0.45, 0.55)] - turn.apply(middle)
        image = rendered_view(
            chessboard(squares=[8, 6]), turn.as_rotvec().tolist(), seen[:3, 3].tolist()
        )
        cv2.imwrite(str(tmp_path / f"{number}.png"), image)
        flange = robot_world @ inverse(seen) @ inverse(hand_eye)
        quaternion = np.roll(Rotation.from_matrix(flange[:3, :3]).as_quat(), 1)
        numbers = [repr(float(v)) for v in (*flange[:3, 3], *quaternion)]
        rows.append(",".join([f"n{number}", f"{number}.png", *numbers]))
    (tmp_path / "observations.csv").write_text("\n".join(rows) + "\n")
    plan = {
        "calibration": "cell", "observations": "observations.csv", "estimate": ["hand_eye"],
        "camera": {"mount": "hand", "intrinsics": given}, "target": board,
        "accept": {"translation": 0.001},
    }  # fmt: skip
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(plan))
    status, found = calibrated(tmp_path)
    assert status == 0
    assert found["excluded"] == []
    xyz = found["records"]["hand_eye"]["transform"]["xyz"]
    np.testing.assert_allclose(xyz, hand_eye[:3, 3], atol=5e-4)
    assert any("taken the other way round" in note for note in found["notes"])
