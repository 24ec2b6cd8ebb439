"""Calibration observations from bags: joint states, poses during motion, /tf and images."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import written_bags as bags
import yaml
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks" / "calibration"))
sys.path.insert(0, str(Path(__file__).parents[1] / "boards"))

from rendered_boards import CAMERA, charuco, rendered_view
from simulated import draw_robot, flange_poses, rigid

from pytest_twin import cli
from pytest_twin.calibration.observations import load_observations
from pytest_twin.calibration.plan import load_plan
from pytest_twin.calibration.recordings.gather import gather
from pytest_twin.formats.sensor_messages import picture_of

pytestmark = pytest.mark.usefixtures("commands_in_process")

STOPS, STEP_S = 16, 2.0
"""In each step the robot moves for one second and is at rest for one second."""


def path_of(places: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Joint positions (n, k): a smooth motion to each of the places, then rest for one second."""
    number = np.clip((time // STEP_S).astype(int), 0, len(places) - 1)
    share = np.clip(time % STEP_S, 0.0, 1.0)[:, None]
    before = places[np.maximum(number - 1, 0)]
    return before + (3 * share**2 - 2 * share**3) * (places[number] - before)


def write_cell(folder: Path, **changed: object) -> tuple[np.ndarray, list[tuple]]:
    """Write a plan; return the true hand-eye pose and messages of joint states and target poses."""
    rng = np.random.default_rng(5)
    robot = draw_robot(rng, 6)
    (folder / "robot.xml").write_text(robot.text)
    places = rng.uniform(-1.2, 1.2, (STOPS, 6))
    mounted, world = (
        rigid(np.array([0.1, 0.2, 0.3]), np.array([0.03, 0.0, 0.06])),
        rigid(np.array([0.0, 3.0, 0.2]), np.array([0.5, 0.1, 0.0])),
    )
    states = np.arange(0.0, STOPS * STEP_S, 0.01)
    frames = np.arange(0.05, STOPS * STEP_S - 0.1, 0.1)
    messages = [
        ("/joint_states", "sensor_msgs/msg/JointState", t,
         bags.joint_state(t, list(robot.joints), q))
        for t, q in zip(states, path_of(places, states), strict=True)
    ]  # fmt: skip
    flange = flange_poses(robot, path_of(places, frames))
    seen = np.linalg.inv(flange @ mounted) @ world
    for t, pose in zip(frames, seen, strict=True):
        pose = pose @ rigid(rng.normal(0, 5e-4, 3), rng.normal(0, 2e-4, 3))
        messages.append(("/target", "geometry_msgs/msg/PoseStamped", t, bags.pose_stamped(t, pose)))
    plan = {
        "calibration": "cell", "robot": "robot.xml", "flange": "flange",
        "observations": "bag.mcap", "estimate": ["hand_eye", "robot_world"],
        "accept": {"translation": 0.002, "rotation": 0.003},
    }  # fmt: skip
    (folder / "plan.yaml").write_text(yaml.safe_dump(plan | changed))
    return mounted, messages


def calibrated(folder: Path) -> tuple[int, dict]:
    status = cli.main(["calibrate", str(folder / "plan.yaml"), "--out", str(folder / "out")])
    found = folder / "out" / "calibration.json"
    return status, json.loads(found.read_text()) if found.exists() else {}


def assert_near(found: dict, truth: np.ndarray) -> None:
    xyz = found["records"]["hand_eye"]["transform"]["xyz"]
    np.testing.assert_allclose(xyz, truth[:3, 3], atol=6e-4)


def test_joint_states_and_poses_of_a_bag_give_one_observation_per_stop(tmp_path):
    truth, messages = write_cell(tmp_path)
    bags.write(tmp_path / "bag.mcap", messages)
    status, found = calibrated(tmp_path)
    assert status == 0
    assert_near(found, truth)
    assert found["fitted"]["count"] + found["held_out"]["count"] == STOPS
    moving = [one for one in found["excluded"] if "in motion" in one["why"]]
    assert len(moving) == STOPS - 1
    assert "mrad within 100 ms of its stamp" in moving[1]["why"]
    kept = tmp_path / "out" / "observations" / "0_bag" / "observations.csv"
    assert len(kept.read_text().splitlines()) == STOPS + 1
    # The stored table gives the same calibration without the bag.
    plan = yaml.safe_load((tmp_path / "plan.yaml").read_text())
    plan["observations"] = "out/observations/0_bag/observations.csv"
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(plan))
    assert calibrated(tmp_path)[1]["records"] == found["records"]


def test_observations_can_come_from_several_files(tmp_path):
    truth, messages = write_cell(tmp_path, observations=["one.mcap", "two.mcap"])
    half = STOPS * STEP_S / 2
    bags.write(tmp_path / "one.mcap", [one for one in messages if one[2] < half])
    bags.write(tmp_path / "two.mcap", [one for one in messages if one[2] >= half])
    status, found = calibrated(tmp_path)
    assert status == 0
    assert_near(found, truth)
    assert set(found["inputs"]) >= {"one.mcap", "two.mcap", "plan.yaml", "robot.xml"}


def test_observations_have_the_payload_of_their_recording(tmp_path):
    _, messages = write_cell(tmp_path, observations=["empty.mcap", "loaded.mcap", "unknown.mcap"])
    named = {"empty": {"payload": "none"}, "loaded": {"payload": "2 kg"}, "unknown": {}}
    third = STOPS * STEP_S / 3
    for number, (name, metadata) in enumerate(named.items()):
        part = [one for one in messages if number * third <= one[2] < (number + 1) * third]
        bags.write(tmp_path / f"{name}.mcap", part, metadata)
    found = gather(load_plan(tmp_path / "plan.yaml"), tmp_path / "kept")
    payloads = found.observations.payloads
    assert payloads is not None
    assert list(dict.fromkeys(payloads)) == ["none", "2 kg", ""]
    assert all(payloads.count(name) >= STOPS // 3 - 1 for name in ("none", "2 kg", ""))
    # The stored tables state the payload too.
    kept = [load_observations(table).payloads for table in found.tables]
    assert [set(one or ("",)) for one in kept] == [{"none"}, {"2 kg"}, {""}]


def test_poses_are_computed_from_tf_frames_without_a_model(tmp_path):
    frames = {"base": "base", "flange": "tool0", "camera": "optical", "target": "tag"}
    truth, messages = write_cell(tmp_path, recordings={"frames": frames})
    plan = yaml.safe_load((tmp_path / "plan.yaml").read_text())
    del plan["robot"]
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(plan))
    rng = np.random.default_rng(5)
    robot = draw_robot(rng, 6)
    shift = rigid(np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.1, 0.2]))
    tf_messages = []
    for topic, _, t, message in messages:
        if topic == "/joint_states":
            pose = flange_poses(robot, np.array([message["position"]]))[0]
            # Base and tool are connected by a third frame; the second transform is inverted.
            tf_messages.append(("/tf", "tf2_msgs/msg/TFMessage", t, bags.transforms(
                t, ("base", "link", pose @ shift), ("tool0", "link", shift))))  # fmt: skip
        else:
            body = message["pose"]
            seen = np.eye(4)
            q = body["orientation"]
            seen[:3, :3] = Rotation.from_quat([q[k] for k in "xyzw"]).as_matrix()
            seen[:3, 3] = [body["position"][k] for k in "xyz"]
            tf_messages.append(
                ("/tf", "tf2_msgs/msg/TFMessage", t, bags.transforms(t, ("optical", "tag", seen)))
            )
    bags.write(tmp_path / "bag.mcap", tf_messages)
    status, found = calibrated(tmp_path)
    assert status == 0
    assert_near(found, truth)


def test_images_are_read_from_the_bag_and_stored(tmp_path):
    rng = np.random.default_rng(3)
    mounted, world = (
        rigid(np.array([0.1, 0.2, 0.3]), np.array([0.05, 0.0, 0.06])),
        rigid(np.array([0.2, 3.0, 0.1]), np.array([0.6, 0.1, 0.0])),
    )
    messages = []
    for number in range(9):
        turn = [*rng.uniform(-0.45, 0.45, 2), rng.uniform(-0.6, 0.6)]
        seen = rigid(np.array(turn), np.array([-0.07, -0.1, rng.uniform(0.38, 0.5)]))
        flange = world @ np.linalg.inv(seen) @ np.linalg.inv(mounted)
        for t in np.arange(number, number + 0.9, 0.05):
            messages.append(
                ("/flange", "geometry_msgs/msg/PoseStamped", t, bags.pose_stamped(t, flange))
            )
        picture = rendered_view(charuco(), turn, [-0.07, -0.1, seen[2, 3]])
        at = number + 0.5
        messages.append(
            ("/camera", "sensor_msgs/msg/CompressedImage", at, bags.compressed(at, picture))
        )
    bags.write(tmp_path / "bag.mcap", messages)
    names = ("fx", "fy", "cx", "cy")
    plan = {
        "calibration": "cell", "observations": "bag.mcap", "estimate": ["hand_eye"],
        "recordings": {"topics": {"flange": "/flange"}},
        "camera": {"intrinsics": dict(zip(names, CAMERA.vector.tolist(), strict=False))},
        "target": {"kind": "charuco", "squares": [5, 7], "square": 0.03, "marker": 0.022,
                   "dictionary": "DICT_5X5_100"},
        "accept": {"translation": 0.002},
    }  # fmt: skip
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(plan))
    status, found = calibrated(tmp_path)
    assert status == 0
    assert_near(found, mounted)
    images = list((tmp_path / "out" / "observations" / "0_bag" / "images").iterdir())
    assert len(images) == 9
    assert sum("images" in name for name in found["inputs"]) == 9


def test_a_recording_without_stops_is_refused_with_a_remedy(tmp_path, capsys):
    _, messages = write_cell(tmp_path)
    names = [f"joint{i + 1}" for i in range(6)]
    moving = [
        (topic, kind, t, bags.joint_state(t, names, np.full(6, 0.3 * t)))
        if topic == "/joint_states"
        else (topic, kind, t, message)
        for topic, kind, t, message in messages
    ]
    bags.write(tmp_path / "bag.mcap", moving)
    assert calibrated(tmp_path)[0] == 2
    words = capsys.readouterr().err
    assert "the robot is at rest in no image or pose" in words
    assert "two streams recorded in motion belong under streams:" in words


@pytest.mark.parametrize("encoding", ["mono8", "rgb8"])
def test_pixels_of_an_image_are_read(encoding: str, tmp_path: Path) -> None:
    grey = np.random.default_rng(0).integers(0, 255, (7, 5), dtype=np.uint8)
    message = bags.image(1.5, grey, encoding)
    text = encoding.encode() + b"\0"
    header = np.array([message["header"]["stamp"][k] for k in ("sec", "nanosec")], "<u4")
    data = b"\0\1\0\0" + header.tobytes() + b"\1\0\0\0\0" + b"\0\0\0"
    data += np.array([7, 5, len(text)], "<u4").tobytes() + text + b"\0"
    data += b"\0" * (-(len(data) - 4) % 4) + np.array([message["step"]], "<u4").tobytes()
    data += np.array([len(message["data"])], "<u4").tobytes() + message["data"]
    found = picture_of(data, "sensor_msgs/msg/Image", "cdr")
    np.testing.assert_array_equal(found.grey, grey)


def test_a_final_recording_is_refused_for_calibration(tmp_path, capsys):
    _, messages = write_cell(tmp_path)
    bags.write(tmp_path / "bag.mcap", messages[:2], {"role": "final"})
    status = cli.main(["calibrate", str(tmp_path / "plan.yaml"), "--out", str(tmp_path / "out")])
    assert status == 2
    stderr = capsys.readouterr().err
    assert "a final recording only checks ranges: it is not used for a calibration" in stderr
    assert "bag.mcap" in stderr
