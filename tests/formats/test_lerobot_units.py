"""Per cent of a motor's range: asked for, or converted by the arm's motor calibration."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot_files import write_dataset

from pytest_twin.errors import FormatError
from pytest_twin.formats.recordings import read_one

TIME = np.arange(100) / 50
RANGES = {"shoulder_pan": (1000, 3200, 0), "elbow_flex": (900, 3100, 0), "gripper": (2000, 3400, 0)}
NAMES = tuple(f"{joint}.pos" for joint in RANGES)


def calibration(folder: Path, **changed: Any) -> Path:
    motors = {
        name: {"id": number, "drive_mode": mode, "homing_offset": -37, "range_min": low,
               "range_max": high}
        for number, (name, (low, high, mode)) in enumerate((RANGES | changed).items(), 1)
    }  # fmt: skip
    path = folder / "arm.json"
    path.write_text(json.dumps(motors))
    return path


def counts() -> np.ndarray:
    """Encoder counts of a motion over the whole range of each motor."""
    share = 0.5 + 0.5 * np.sin(2 * np.pi * TIME[:, None] / 2.0 + np.arange(3))
    low, high = (np.array([limits[k] for limits in RANGES.values()]) for k in (0, 1))
    return low + share * (high - low)


def recorded(
    counts: np.ndarray, *, degrees: bool, modes: tuple[int, ...] = (0, 0, 0)
) -> np.ndarray:
    """Positions as LeRobot's drivers write them."""
    columns = []
    for column, (low, high, _) in enumerate(RANGES.values()):
        share = (counts[:, column] - low) / (high - low)
        if column == 2:
            columns.append(100 * (1 - share if modes[column] else share))
        elif degrees:
            columns.append((counts[:, column] - (low + high) / 2) * 360 / 4095)
        else:
            columns.append((200 * share - 100) * (-1 if modes[column] else 1))
    return np.column_stack(columns)


def expected(counts: np.ndarray) -> np.ndarray:
    """Angles in rad: from the middle of the range, those of the gripper from its closed end."""
    zero = [(low + high) / 2 for low, high, _ in RANGES.values()]
    zero[2] = RANGES["gripper"][0]
    return (counts - zero) * 2 * math.pi / 4095


def dataset(folder: Path, values: np.ndarray, **info: Any) -> Path:
    one = {"time": TIME, "state": values, "action": values}
    return write_dataset(folder / "set", [one], names=NAMES, **info)


def test_per_cent_is_converted_by_the_motor_calibration(tmp_path: Path) -> None:
    folder = dataset(tmp_path, recorded(counts(), degrees=False))
    found = read_one(folder, motor_calibration=calibration(tmp_path))
    np.testing.assert_allclose(found.series["state"].position, expected(counts()), atol=1e-9)
    assert "per cent of the calibrated range" in " ".join(found.notes)


def test_a_reversed_motor_has_the_direction_of_its_encoder(tmp_path: Path) -> None:
    values = recorded(counts(), degrees=False, modes=(1, 0, 1))
    motors = {name: (*RANGES[name][:2], 1) for name in ("shoulder_pan", "gripper")}
    found = read_one(
        dataset(tmp_path, values),
        units="percent",
        motor_calibration=calibration(tmp_path, **motors),
    )
    np.testing.assert_allclose(found.series["state"].position, expected(counts()), atol=1e-9)
    assert "drive_mode 1" in " ".join(found.notes)


def test_with_degrees_the_calibration_converts_the_gripper_alone(tmp_path: Path) -> None:
    folder = dataset(tmp_path, recorded(counts(), degrees=True))
    found = read_one(folder, units="deg", motor_calibration=calibration(tmp_path))
    np.testing.assert_allclose(found.series["state"].position, expected(counts()), atol=1e-9)


def test_a_gripper_in_per_cent_of_an_unknown_range_is_left_out(tmp_path: Path) -> None:
    folder = dataset(tmp_path, recorded(counts(), degrees=True))
    found = read_one(folder, units="deg")
    for one in found.series.values():
        assert one.names == ("shoulder_pan", "elbow_flex")
        np.testing.assert_allclose(one.position, expected(counts())[:, :2], atol=1e-9)
    said = " ".join(found.notes)
    assert "left out: gripper: LeRobot's drivers record a gripper in per cent" in said
    assert "--motor-calibration FILE.json" in said


def test_a_gripper_of_another_robot_has_the_unit_of_its_joints(tmp_path: Path) -> None:
    folder = dataset(tmp_path, recorded(counts(), degrees=True), robot_type="my_arm")
    found = read_one(folder, units="deg")
    assert found.series["state"].names == tuple(RANGES)


@pytest.mark.parametrize("robot", ["so101_follower", "my_arm"])
def test_values_that_touch_100_without_a_unit_are_refused(tmp_path: Path, robot: str) -> None:
    folder = dataset(tmp_path, recorded(counts(), degrees=False), robot_type=robot)
    with pytest.raises(FormatError, match=r"may be degrees or per cent.*--motor-calibration"):
        read_one(folder)


def test_values_that_fit_both_units_are_refused_with_a_calibration(tmp_path: Path) -> None:
    folder = dataset(tmp_path, 0.5 * recorded(counts(), degrees=False))
    with pytest.raises(FormatError, match=r"--units deg, or --units percent"):
        read_one(folder, motor_calibration=calibration(tmp_path))


def test_per_cent_without_a_calibration_is_refused(tmp_path: Path) -> None:
    folder = dataset(tmp_path, recorded(counts(), degrees=False))
    with pytest.raises(FormatError, match=r"range that is not known .got 'elbow_flex, gripper"):
        read_one(folder, units="percent")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "not JSON"),
        ("[]", "not a motor calibration of LeRobot"),
        ('{"a": {"id": 1}}', "a.drive_mode: not a motor calibration"),
        (
            '{"a": {"id": 1, "drive_mode": 0, "homing_offset": 0, "range_min": 9, "range_max": 9}}',
            "range_min 9, range_max 9",
        ),
        ('{"motor_names": ["a"], "calib_mode": ["DEGREE"]}', "LeRobot before 2025"),
    ],
)
def test_another_file_is_no_motor_calibration(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "arm.json"
    path.write_text(content)
    folder = dataset(tmp_path, recorded(counts(), degrees=False))
    with pytest.raises(FormatError) as caught:
        read_one(folder, motor_calibration=path)
    assert caught.value.path == path
    assert words in str(caught.value)


def test_per_cent_of_another_format_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("time,a.position\n0.0,1\n0.1,2\n")
    with pytest.raises(FormatError, match="are of LeRobot data sets"):
        read_one(path, units="percent")


def test_joints_in_rad_beside_a_gripper_in_per_cent_are_refused(tmp_path: Path) -> None:
    values = recorded(counts(), degrees=True)
    values[:, :2] = np.radians(values[:, :2])
    with pytest.raises(FormatError, match=r"joints and gripper are in .*--units rad"):
        read_one(dataset(tmp_path, values))


def test_encoder_counts_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="as encoder counts are"):
        read_one(dataset(tmp_path, counts()))
