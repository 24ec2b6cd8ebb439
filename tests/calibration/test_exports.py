"""Files that a calibration writes for other tools."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cells
import fr3
import numpy as np
import yaml

from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.calibration.chain import ChainParameters, forward, link_parameters
from pytest_twin.calibration.exported_mjcf import write_calibrated_mjcf
from pytest_twin.calibration.exports import (
    calibrated_urdf,
    camera_info,
    easy_handeye,
    static_transforms,
)
from pytest_twin.metrics.pose import rigid
from pytest_twin.realization.serial_chain import load_serial_chain


def pose_record(parent: str, child: str) -> dict:
    transform = {"xyz": [0.05, 0.0, -0.03], "quaternion_wxyz": [0.5, -0.5, 0.5, 0.5]}
    return {"parent": parent, "child": child, "transform": transform}


def test_each_transform_is_written_as_a_ros_static_transform_command() -> None:
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


def test_the_hand_eye_pose_is_exported_for_easy_handeye2() -> None:
    plan = cells.plan("hand_eye")
    document = {"records": {"hand_eye": pose_record("flange", "camera")}}
    found = yaml.safe_load(easy_handeye(plan, document))
    assert found["parameters"]["calibration_type"] == "eye_in_hand"
    assert found["parameters"]["robot_effector_frame"] == "flange"
    assert found["transform"]["rotation"] == {"x": -0.5, "y": 0.5, "z": 0.5, "w": 0.5}


def test_forward_kinematics_of_the_exported_urdf_agree_with_the_calibration(tmp_path: Path) -> None:
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


MJCF_ARM = """<mujoco><compiler angle="degree"/><default><joint axis="0 0 1"/></default><worldbody>
<body name="a" pos="0 0 0.3" euler="20 0 10"><geom size="0.02"/><joint name="j1" pos="0.01 0 0"/>
<body name="b" pos="0.2 0.1 0.1" quat="0.9 0.1 0.3 0.1"><geom size="0.02"/>
<joint name="j2" axis="0 1 0" ref="15"/>
<body name="c" pos="0.1 0 0.2"><geom size="0.02"/><joint name="j3" type="slide" axis="1 0 0"/>
<body name="d" pos="0.1 0 0.1"><geom size="0.02"/><joint name="j4" axis="1 0 0"/>
<body name="tool" pos="0 0 0.1" axisangle="0 1 0 90"/></body></body></body></body></worldbody>
</mujoco>"""


def test_forward_kinematics_of_the_exported_mjcf_agree_with_the_calibration(tmp_path: Path) -> None:
    robot = tmp_path / "arm.xml"
    robot.write_text(MJCF_ARM)
    chain = load_serial_chain(robot, "tool")
    links = link_parameters(chain, 1)
    rng = np.random.default_rng(2)
    zeros, values = rng.normal(0.0, 0.02, 4), rng.normal(0.0, 0.01, len(links))
    records = {
        "joint_zeros": {
            "values": {n: {"value": v} for n, v in zip(chain.joints, zeros, strict=True)}
        },
        "geometry": {
            "values": {
                link.label: {
                    "value": value, "joint": chain.joints[link.joint],
                    "kind": "rotation" if link.is_rotation else "translation",
                    "direction": link.direction.tolist(),
                }
                for link, value in zip(links, values, strict=True)
            }
        },
        "hand_eye": pose_record("tool", "camera"),
    }  # fmt: skip
    (tmp_path / "new.xml").write_text(write_calibrated_mjcf(robot, records, tmp_path))
    new = load_serial_chain(tmp_path / "new.xml", "tool")
    readings = rng.uniform(-1.0, 1.0, (10, 4))
    parameters = ChainParameters(
        len(links), zeros, (-1,) * 4, links, values, tuple(range(len(links)))
    )
    expected = forward(chain, readings, parameters)
    found = forward(new, readings, ChainParameters(0, np.zeros(4), (-1,) * 4))
    np.testing.assert_allclose(found.position, expected.position, atol=1e-12)
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-12)
    assert load_serial_chain(tmp_path / "new.xml", "camera").joints == chain.joints


def test_camera_info_has_the_fields_and_distortion_models_of_ros() -> None:
    distortion = [-0.1, 0.02, 0.001, -0.002, 0.003] + 7 * [0.0]
    matrix = [[900.0, 0.0, 510.0], [0.0, 905.0, 378.0], [0.0, 0.0, 1.0]]
    document = {
        "records": {"intrinsics": {"camera_matrix": matrix, "distortion": distortion}},
        "images": {"1": {"size": [1024, 768]}},
    }
    found = yaml.safe_load(camera_info(cells.plan("intrinsics"), document))
    assert (found["image_width"], found["image_height"]) == (1024, 768)
    assert found["distortion_model"] == "plumb_bob"
    assert found["distortion_coefficients"] == {"rows": 1, "cols": 5, "data": distortion[:5]}
    for name, rows, columns in (
        ("camera_matrix", 3, 3), ("rectification_matrix", 3, 3), ("projection_matrix", 3, 4)
    ):  # fmt: skip
        assert (found[name]["rows"], found[name]["cols"]) == (rows, columns)
        assert len(found[name]["data"]) == rows * columns
    np.testing.assert_array_equal(np.reshape(found["camera_matrix"]["data"], (3, 3)), matrix)
    distortion[5] = 0.2
    found = yaml.safe_load(camera_info(cells.plan("intrinsics"), document))
    assert found["distortion_model"] == "rational_polynomial"
    assert len(found["distortion_coefficients"]["data"]) == 8
    distortion[8] = 0.1
    assert camera_info(cells.plan("intrinsics"), document) is None
