"""Cameras without a metric scale are reported; a plan can ask for an estimate of the scale."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cells
import cv2
import numpy as np
import pytest
import yaml

sys.path.insert(0, str(Path(__file__).parent / "boards"))
from rendered_boards import charuco, rendered_view

from pytest_twin.calibration.calibrate import calibrate, calibrate_file
from pytest_twin.calibration.closed_form import scale_of_seen
from pytest_twin.calibration.problem import make_problem
from pytest_twin.calibration.record_prediction import held_out_observations, recorded_state
from pytest_twin.calibration.residual_errors import errors_of
from pytest_twin.errors import SpecError
from pytest_twin.formats.calibration_record import read_calibration_record

BOARD = {"kind": "charuco", "squares": [5, 7], "square": 0.03, "marker": 0.022,
         "dictionary": "DICT_5X5_100"}  # fmt: skip


def cell_with_scale(
    rng: np.random.Generator, scale: float, mount: str = "hand", translation: float = 2e-3
) -> cells.Cell:
    """A cell whose camera measures positions in units of 1/scale m."""
    flange = np.array([cells.pose(rng, 0.3) for _ in range(30)])
    cell = cells.flange_cell(rng, flange, mount=mount, translation=translation, rotation=2e-3)
    poses = cell.observations.camera_from_target.copy()
    poses[:, :3, 3] *= scale
    return replace(cell, observations=replace(cell.observations, camera_from_target=poses))


@pytest.mark.parametrize(("scale", "mount"), [(0.37, "hand"), (2.5, "world"), (1e-4, "hand")])
def test_the_scale_of_a_camera_is_estimated_and_held_out_errors_are_in_metres(
    scale: float, mount: str
) -> None:
    cell = cell_with_scale(np.random.default_rng(3), scale, mount)
    plan = cells.plan("hand_eye", "robot_world", mount=mount, camera={"scale": "estimate"})
    found = calibrate(plan, cell.observations, None)
    stated = found["records"]["scale"]
    assert found["verdict"] == "accepted"
    assert stated["value"] == pytest.approx(scale, rel=0.01)
    assert stated["ci95"][0] < stated["value"] < stated["ci95"][1]
    # Errors are in m, independent of the camera's unit.
    assert found["held_out"]["translation_rms"] == pytest.approx(2e-3, rel=0.5)
    name = "hand_eye" if mount == "hand" else "target"
    assert np.allclose(found["records"][name]["transform"]["xyz"], cell.mounted[:3, 3], atol=5e-3)


def test_intervals_of_scale_and_hand_eye_contain_the_true_values() -> None:
    inside, together = [], []
    for seed in range(12):
        cell = cell_with_scale(np.random.default_rng(seed), 0.6)
        plan = cells.plan("hand_eye", camera={"scale": "estimate"})
        found = calibrate(plan, cell.observations, None)
        low, high = found["records"]["scale"]["ci95"]
        inside.append(low <= 0.6 <= high)
        together += cells.truth_inside(found, "hand_eye", cell.mounted)
    # With 95 % coverage, fewer than 9 of 12 intervals contain the truth with probability 1/400.
    assert sum(inside) >= 9
    assert np.mean(together) >= 0.85


@pytest.mark.parametrize("translation", [2e-3, 0.02])
def test_a_camera_without_a_metric_scale_is_reported(translation: float) -> None:
    cell = cell_with_scale(np.random.default_rng(4), 0.7, translation=translation)
    found = calibrate(cells.plan("hand_eye"), cell.observations, None)
    assert found["verdict"] == "rejected"
    (mistake,) = found["suspected"]
    told = re.search(r"the camera's motion is (\S+) times the robot's", mistake["what"])
    assert told is not None
    assert float(told[1]) == pytest.approx(0.7, rel=0.05)
    assert "camera: {scale: estimate}" in mistake["mend"]


def test_a_missing_scale_is_reported_even_if_the_plan_accepts_its_errors() -> None:
    cell = cell_with_scale(np.random.default_rng(5), 0.8)
    accept = cells.Accept(translation=0.5, rotation=1.0)
    found = calibrate(cells.plan("hand_eye", accept=accept), cell.observations, None)
    assert found["verdict"] == "rejected"
    assert "times the robot's" in found["suspected"][0]["what"]


@pytest.mark.parametrize("seed", range(4))
def test_noisy_metric_poses_cause_no_suspicion_of_a_scale(seed: int) -> None:
    cell = cell_with_scale(np.random.default_rng(seed), 1.0, translation=0.02)
    found = calibrate(cells.plan("hand_eye"), cell.observations, None)
    assert found["suspected"] == []


def test_wrong_joint_zeros_cause_no_suspicion_of_a_scale() -> None:
    rng = np.random.default_rng(6)
    cell = cells.joint_cell(rng, cells.arm(6, rng), 60, zeros=rng.normal(0.0, 0.03, 6))
    found = calibrate(cells.plan("hand_eye"), cell.observations, cell.chain)
    assert found["suspected"] == []


def test_rotations_alone_do_not_determine_a_scale() -> None:
    rng = np.random.default_rng(7)
    flange = np.array([cells.pose(rng, 0.0) for _ in range(30)])
    cell = cells.flange_cell(rng, flange)
    plan = cells.plan("hand_eye", camera={"scale": "estimate"})
    found = calibrate(plan, cell.observations, None)
    assert found["verdict"] == "degenerate"
    assert "scale" not in found["records"]
    assert any("scale" in words for words in found["unobservable"])


def test_a_scale_without_camera_poses_is_refused() -> None:
    rng = np.random.default_rng(8)
    cell = cell_with_scale(rng, 1.0)
    points = replace(
        cell.observations,
        camera_from_target=None,
        points={"tip": cell.observations.flange[:, :3, 3]},
    )
    with pytest.raises(SpecError, match="no poses of a camera"):
        calibrate(cells.plan("tcp", camera={"scale": "estimate"}), points, None)


def test_a_scale_is_refused_for_images_of_a_target_with_stated_size(tmp_path: Path) -> None:
    (tmp_path / "view.png").write_bytes(
        cv2.imencode(".png", rendered_view(charuco(), [0.3, 0.2, 0.1], [-0.07, -0.1, 0.42]))[1]
    )
    header = [
        "id",
        "image",
        *(f"flange.{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz")),
    ]
    rows = [",".join(header), "a,view.png,0,0,0,1,0,0,0"]
    (tmp_path / "observations.csv").write_text("\n".join(rows))
    error = plan_error(tmp_path, {"observations": "observations.csv", "target": BOARD})
    assert error.problem == "the scale cannot be estimated with images of a target of known size"
    assert error.expected == "no scale, or camera_from_target in place of images"


def test_a_scale_is_refused_for_streams_with_two_clocks(tmp_path: Path) -> None:
    for name in ("hand.csv", "camera.csv"):
        (tmp_path / name).write_text("0,0,0,0,0,0,0,1")
    error = plan_error(tmp_path, {"streams": {"hand": "hand.csv", "camera": "camera.csv"}})
    assert error.problem == "the scale cannot be estimated from streams on two clocks"
    assert error.expected == "observations: poses at rest, or at stamps of one clock"


def plan_error(folder: Path, fields: dict[str, Any]) -> SpecError:
    """The error of a plan with an estimated scale; it contains the field and its line."""
    stated = {"calibration": "cell", "estimate": ["hand_eye"]} | fields
    text = yaml.safe_dump(stated) + "camera:\n  mount: hand\n  scale: estimate\n"
    (folder / "plan.yaml").write_text(text)
    with pytest.raises(SpecError) as caught:
        calibrate_file(str(folder / "plan.yaml"))
    assert (caught.value.where, caught.value.value) == ("camera.scale", "estimate")
    assert caught.value.line == len(text.splitlines())
    return caught.value


def test_the_closed_form_gives_the_exact_scale_for_exact_poses() -> None:
    cell = cell_with_scale(np.random.default_rng(9), 3.0, translation=0.0)
    exact = cells.seen(cell.observations.flange, cell.mounted, cell.world, "world")
    exact[:, :3, 3] *= 3.0
    factor, mounted, _ = scale_of_seen(cell.observations.flange, exact)
    assert factor == pytest.approx(1 / 3, rel=1e-9)
    assert np.allclose(mounted, cell.mounted, atol=1e-9)


def test_held_out_errors_are_reproduced_from_a_record_with_a_scale(tmp_path: Path) -> None:
    cell = cell_with_scale(np.random.default_rng(10), 0.37)
    plan = cells.plan("hand_eye", "robot_world", camera={"scale": "estimate"})
    found = calibrate(plan, cell.observations, None)
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(found))
    record = read_calibration_record(path)
    assert record.scale == found["records"]["scale"]["value"]
    held = held_out_observations(cell.observations, record)
    problem = make_problem(plan, held, None).in_unit(1.0 / record.scale)
    again = errors_of(problem, recorded_state(problem, record)).summary()
    stated = found["held_out"]["translation_rms"]
    assert again["translation_rms"] == pytest.approx(stated, rel=0.01)
