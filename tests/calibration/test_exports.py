"""What a calibration writes for other tools."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cells
import fr3
import numpy as np
import yaml

from pytest_twin.calibration.chain import ChainParameters, forward
from pytest_twin.calibration.closed_form import rigid
from pytest_twin.calibration.exports import calibrated_urdf, easy_handeye, static_transforms
from pytest_twin.calibration.run import calibrate
from pytest_twin.realization.serial_chain import load_serial_chain


def pose_record(parent: str, child: str) -> dict:
    transform = {"xyz": [0.05, 0.0, -0.03], "quaternion_wxyz": [0.5, -0.5, 0.5, 0.5]}
    return {"parent": parent, "child": child, "transform": transform}


def test_each_transform_is_one_command_of_ros() -> None:
    records = {
        "hand_eye": pose_record("tool0", "camera"),
        "base_world": pose_record("world", "base"),
        "robot_world": pose_record("base", "world"),
        "joint_zeros": {"values": {}},
    }
    lines = list(static_transforms(records))
    assert lines[0] == (
        "ros2 run tf2_ros static_transform_publisher --x 0.050000000 --y 0.000000000 "
        "--z -0.030000000 --qx -0.500000000 --qy 0.500000000 --qz 0.500000000 --qw 0.500000000 "
        "--frame-id tool0 --child-frame-id camera"
    )
    assert len(lines) == 2


def test_easy_handeye2_gets_the_camera_on_the_flange() -> None:
    plan = cells.plan("hand_eye")
    document = {"records": {"hand_eye": pose_record("flange", "camera")}}
    found = yaml.safe_load(easy_handeye(plan, document))
    assert found["parameters"]["calibration_type"] == "eye_in_hand"
    assert found["parameters"]["robot_effector_frame"] == "flange"
    assert found["transform"]["rotation"] == {"x": -0.5, "y": 0.5, "z": 0.5, "w": 0.5}


def test_the_urdf_moves_as_the_calibration_says(tmp_path: Path) -> None:
    robot = tmp_path / "fr3.urdf"
    robot.write_text(fr3.urdf())
    chain = load_serial_chain(robot, "fr3_link8")
    rng = np.random.default_rng(0)
    zeros = np.array([0.0, 0.01, -0.02, 0.0, 0.03, 0.0, 0.0])
    cell = cells.joint_cell(rng, chain, 50, zeros=zeros)
    plan = cells.plan("joint_zeros", "geometry", "hand_eye", "base_world")
    found = calibrate(replace(plan, flange="fr3_link8"), cell.observations, chain)
    records = found["records"]
    (tmp_path / "new.urdf").write_text(calibrated_urdf(robot, records, tmp_path))
    patched = load_serial_chain(tmp_path / "new.urdf", "fr3_link8")
    readings = rng.uniform(-1, 1, (4, 7))
    nothing = ChainParameters(0, np.zeros(7), (-1,) * 7)
    now = forward(patched, readings, nothing)
    expected = []
    for values in readings:
        total = np.eye(4)
        for at, joint in enumerate(chain.joints):
            total = total @ chain.placements[at]
            for one in records["geometry"]["values"].values():
                if one["joint"] == joint and one["kind"] == "translation":
                    total = total @ rigid(np.eye(3), np.array(one["direction"]) * one["value"])
            tilt = sum(
                np.array(one["direction"]) * one["value"]
                for one in records["geometry"]["values"].values()
                if one["joint"] == joint and one["kind"] == "rotation"
            )
            turn = cells.Rotation.from_rotvec(np.zeros(3) + tilt).as_matrix()
            zero = records["joint_zeros"]["values"].get(joint, {"value": 0.0})["value"]
            about = cells.Rotation.from_rotvec(chain.axes[at] * (values[at] + zero)).as_matrix()
            total = total @ rigid(turn @ about, np.zeros(3))
        expected.append((total @ chain.end)[:3, 3])
    np.testing.assert_allclose(now.position, expected, atol=1e-9)
    assert load_serial_chain(tmp_path / "new.urdf", "camera").frame == "camera"
