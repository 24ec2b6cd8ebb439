"""Identification of camera delay and joint torque sensor, and their readings in a replay."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import jsonschema
import mujoco
import numpy as np
import pinocchio as pin
import pytest
from mcap.writer import Writer
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation, Slerp

from pytest_twin import cli
from pytest_twin.checks import check_of
from pytest_twin.checks.base import Measure
from pytest_twin.errors import RecordingError, SpecError
from pytest_twin.formats.identification_record import read_identification_record
from pytest_twin.formats.schema import load_schema
from pytest_twin.gate.specs import load_golden
from pytest_twin.golden import Golden
from pytest_twin.identification.sensing.camera_frames import CameraTrial, delay_of
from pytest_twin.realization import Realization, load
from pytest_twin.twin import load_twin

sys.path += [str(Path(__file__).parents[1] / "formats"), str(Path(__file__).parent)]
import sensor_bags
from sensor_arm import ARM, COM, INERTIA, MASS, START, pinocchio_arm

pytestmark = pytest.mark.usefixtures("commands_in_process")

JOINTS = ["j1", "j2", "j3"]
PERIOD = 0.004
DELAY, FRAME, LOST = 0.042, 1.0 / 30.0, 0.05
SCALE, BIAS, SLOW = 1.06, -0.25, 0.008
DRIVES = "".join(f'<position joint="{j}" kp="80" kv="8"/>' for j in JOINTS)
# Armature, friction and damping act on the motor side and do not load the joint torque sensor.
DRIVEN = ARM.replace("<joint name", '<joint armature="0.2" damping="0.5" frictionloss="0.3" name')
DRIVEN = DRIVEN.replace("</mujoco>", f"<actuator>{DRIVES}</actuator></mujoco>")


def simulated(seed: int, seconds: float = 10.0) -> tuple[np.ndarray, ...]:
    """Commands, positions, velocities and accelerations with a sample period of 4 ms."""
    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(DRIVEN)
    data = mujoco.MjData(model)
    time = np.arange(0.0, seconds, PERIOD)
    command = np.zeros((len(time), 3))
    for joint in range(3):
        for rate in rng.uniform(0.1, 0.8, 4):
            phase = rng.uniform(0.0, 2.0 * np.pi)
            wave = np.sin(2.0 * np.pi * rate * time + phase) - np.sin(phase)
            command[:, joint] += 0.3 * np.minimum(1.0, time) * wave
    q = np.zeros((len(time), 3))
    for row in range(len(time)):
        data.ctrl[:] = command[row]
        q[row] = data.qpos
        for _ in range(2):
            mujoco.mj_step(model, data)
    v = np.gradient(q, PERIOD, axis=0)
    return command, q, v, np.gradient(v, PERIOD, axis=0)


def true_load(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Torque on the second joint from the links it carries, by Pinocchio's inverse dynamics."""
    model = pinocchio_arm()
    tool = pin.Inertia(MASS, COM, INERTIA)
    model.appendBodyToJoint(3, tool, pin.SE3(np.eye(3), np.array([0.1, 0.0, 0.0])))
    data = model.createData()
    return np.array([pin.rnea(model, data, *row)[1] for row in zip(q, v, a, strict=True)])


def wrist_rotations(q: np.ndarray) -> Rotation:
    return Rotation.from_euler("ZYX", q)


def camera_poses(
    time: np.ndarray, q: np.ndarray, on_hand: bool, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Time stamps (s) and poses (n, 7) of a target from a camera with delay."""
    shown = np.arange(time[0] + 0.1, time[-1] - 0.1, FRAME)
    shown = shown[rng.random(len(shown)) > LOST]
    angles = np.column_stack([np.interp(shown, time, column) for column in q.T])
    mounted, placed = Rotation.random(2, rng=rng)
    seen = placed * wrist_rotations(angles) * mounted
    if on_hand:
        seen = seen.inv()
    seen = seen * Rotation.from_rotvec(0.002 * rng.normal(size=(len(shown), 3)))
    stamps = shown + DELAY + 0.0005 * rng.normal(size=len(shown))
    return stamps, np.hstack([np.ones((len(shown), 3)), seen.as_quat()])


def write_bag(path: Path, seed: int, role: str) -> None:
    """Write a bag with commands, camera poses, and the sensor's torque as joint effort."""
    rng = np.random.default_rng(50 + seed)
    command, q, v, a = simulated(seed)
    load = true_load(q, v, a)
    pole = np.exp(-PERIOD / SLOW)
    slow = lfilter([1.0 - pole], [1.0, -pole], load, zi=[pole * load[0]])[0]
    effort = np.zeros_like(q)
    effort[:, 1] = SCALE * slow + BIAS + 0.02 * rng.normal(size=len(q))
    time = PERIOD * np.arange(len(q))
    stamps, poses = camera_poses(time, q, True, rng)

    def nanoseconds(seconds: float) -> int:
        return START + round(1e9 * seconds)

    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", b"")
        topics = {
            topic: writer.register_channel(topic, "json", schema)
            for topic in ("/joint_states", "/joint_commands")
        }
        pose = writer.register_schema(sensor_bags.POSE, "ros2msg", b"")
        camera = writer.register_channel("/camera", "cdr", pose)
        for row, at in enumerate(time):
            sec, nanosec = divmod(nanoseconds(at), 1_000_000_000)
            header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": ""}
            header_and_names = {"header": header, "name": JOINTS}
            state = {
                **header_and_names,
                "position": q[row].tolist(),
                "effort": effort[row].tolist(),
            }
            for topic, message in (
                ("/joint_states", state),
                ("/joint_commands", {**header_and_names, "position": command[row].tolist()}),
            ):
                data = json.dumps(message).encode()
                writer.add_message(topics[topic], nanoseconds(at), data, nanoseconds(at))
        for at, values in zip(stamps, poses, strict=True):
            made = sensor_bags.message(sensor_bags.POSE, nanoseconds(at), values)
            data = bytes(sensor_bags.STORE.serialize_cdr(made, sensor_bags.POSE))
            writer.add_message(camera, nanoseconds(at), data, nanoseconds(at))
        writer.add_metadata("trial", {"role": role, "command_between": "held"})
        writer.finish()


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with recordings of an arm and the identification of its two sensors."""
    folder = tmp_path_factory.mktemp("arm")
    (folder / "arm.xml").write_text(DRIVEN)
    for seed, role in ((1, "fit"), (2, "fit"), (3, "held_out")):
        write_bag(folder / f"{seed}.mcap", seed, role)
    files = [str(folder / f"{seed}.mcap") for seed in (1, 2, 3)]
    status = cli.main(
        ["identify", str(folder / "arm.xml"), *files, "--out", str(folder / "sensors"),
         "--sensor", "elbow=/joint_states@j2", "--sensor", "eye=/camera@tool"]
    )  # fmt: skip
    assert status == 0
    return folder


def identified(arm: Path) -> dict[str, Any]:
    return json.loads((arm / "sensors/identification.json").read_text())


def test_a_joint_torque_sensor_is_identified_despite_friction_and_armature_of_the_drive(
    arm: Path,
) -> None:
    found = identified(arm)["parameters"]
    for name, truth in (("scale_torque", SCALE), ("bias_torque", BIAS), ("filter_time", SLOW)):
        one = found[f"elbow.sensor_{name}"]
        wide = 1.5 * (one["ci95"][1] - one["ci95"][0])
        assert one["value"] == pytest.approx(truth, abs=max(wide, 1e-9))
    assert found["elbow.sensor_scale_torque"]["value"] == pytest.approx(SCALE, abs=0.01)
    assert found["elbow.sensor_filter_time"]["value"] == pytest.approx(SLOW, abs=0.002)


def test_the_delay_of_a_camera_is_identified_without_its_calibration(arm: Path) -> None:
    document = identified(arm)
    delay = document["parameters"]["eye.sensor_delay"]
    assert delay["value"] == pytest.approx(DELAY, abs=0.002)
    assert delay["ci95"][1] - delay["ci95"][0] < 0.004
    eye = document["sensors"]["eye"]
    assert eye["mount"] == "hand"
    assert eye["period"] == pytest.approx(FRAME, rel=0.01)
    assert eye["jitter"] == pytest.approx(0.0005, rel=0.3)
    assert eye["lost"] == pytest.approx(LOST, abs=0.03)
    held = document["held_out"]["eye"]
    assert held["sensor_rms"]["turn"] < 0.2 * held["sensor_rms_nominal"]["turn"]


def test_a_replay_predicts_the_readings_of_the_identified_sensors(arm: Path) -> None:
    (arm / "twin.yaml").write_text(
        "model: arm.xml\nfit:\n  - {file: sensors/identification.json}\n"
    )
    out = arm / "predicted.mcap"
    assert cli.main(["replay", str(arm / "twin.yaml"), str(arm / "3.mcap"), "--out", str(out)]) == 0
    summary = json.loads(out.with_suffix(".json").read_text())
    jsonschema.validate(summary, load_schema("results/replay.schema.json"))
    elbow, eye = summary["sensors"]["elbow"], summary["sensors"]["eye"]
    assert elbow["unit"] == {"torque": "N*m"}
    assert elbow["rms"]["torque"] < 0.3 * elbow["rms_ideal"]["torque"]
    assert eye["rms"]["turn"] < 0.3 * eye["rms_ideal"]["turn"]


def golden_of(arm: Path, sensors: str, step: float = 0.0) -> tuple[Golden, Realization]:
    """A replay golden with tolerances for sensors, in a twin with this encoder resolution."""
    document = identified(arm)
    if step:
        document["encoder_steps"] = dict.fromkeys(JOINTS, step)
    (arm / "record.json").write_text(json.dumps(document))
    (arm / "twin.yaml").write_text("model: arm.xml\nfit:\n  - {file: record.json}\n")
    (arm / "golden").mkdir(exist_ok=True)
    path = arm / "golden" / "replay.yaml"
    path.write_text(
        "schema: 1\nkind: replay\n"
        f"target: {{recording: 3.mcap, sensors: {sensors}}}\n"
        "tolerance: {angle_rms: 0.2 rad}\n"
    )
    twin = load_twin(arm / "twin.yaml")
    return load_golden(path, twin), load(arm / "arm.xml", twin=twin)


def measures_of(golden: Golden, robot: Realization) -> list[Measure]:
    check = check_of("replay")
    return check.compare(golden, check.observe(golden, robot, lambda fraction: None), None)


def test_a_replay_golden_tests_sensor_readings_against_their_tolerances(arm: Path) -> None:
    bounds = "{elbow: {torque_rms: 0.1 N*m}, eye: {angle_rms: 10 mrad}}"
    golden, robot = golden_of(arm, bounds)
    found = {m.subject: m for m in measures_of(golden, robot) if ", " in m.subject}
    assert set(found) == {"elbow, torque", "eye, turn"}
    assert all(m.passed for m in found.values())
    assert "sensor:elbow" in check_of("replay").depends(golden, robot.structure)
    tight = "{elbow: {torque_rms: 0.0001 N*m}}"
    assert not all(m.passed for m in measures_of(*golden_of(arm, tight)) if ", " in m.subject)


@pytest.mark.parametrize(
    ("sensors", "words"),
    [
        ("{wrist: {force_rms: 1 N}}", "target.sensors.wrist"),
        ("{elbow: {force_rms: 1 N}}", "no channel of elbow has this unit"),
    ],
)
def test_a_tolerance_for_an_unknown_sensor_or_channel_is_refused(
    arm: Path, sensors: str, words: str
) -> None:
    with pytest.raises(SpecError) as error:
        measures_of(*golden_of(arm, sensors))
    assert words in str(error.value)


def test_a_replay_golden_rounds_positions_to_the_encoder_resolution(arm: Path) -> None:
    bounds = "{elbow: {torque_rms: 0.1 N*m}}"
    smooth = {m.subject: m.error for m in measures_of(*golden_of(arm, bounds))}
    coarse = {m.subject: m.error for m in measures_of(*golden_of(arm, bounds, step=0.2))}
    for joint in JOINTS:
        assert coarse[joint] > smooth[joint] + 0.01
    assert coarse["elbow, torque"] == smooth["elbow, torque"]


def test_intervals_of_a_camera_delay_contain_the_true_value_and_both_mountings_are_recognized() -> (
    None
):
    time = PERIOD * np.arange(2500)
    inside, mounts = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        rates, phases = rng.uniform(0.2, 0.9, (3, 1)), rng.uniform(0.0, 6.0, (3, 1))
        q = 0.5 * np.sin(2.0 * np.pi * rates * time + phases).T
        stamps, poses = camera_poses(time, q, seed % 2 == 1, rng)
        keep = (stamps > 0.4) & (stamps < time[-1] - 0.4)
        found = delay_of(
            [CameraTrial(Path("a.mcap"), stamps[keep], Rotation.from_quat(poses[keep, 3:]),
                         Slerp(time, wrist_rotations(q)))]
        )  # fmt: skip
        inside.append(abs(found.timing.delay - DELAY) < 2.05 * found.deviation)
        mounts.append(found.mount == ("hand" if seed % 2 else "world"))
    assert all(mounts)
    assert sum(inside) >= 6


def test_a_target_that_does_not_rotate_with_the_hand_is_refused() -> None:
    rng = np.random.default_rng(0)
    time = PERIOD * np.arange(2500)
    q = 0.5 * np.sin(np.outer(time, [1.0, 2.0, 3.0]))
    seen = Rotation.from_rotvec(np.cumsum(0.01 * rng.normal(size=(300, 3)), axis=0))
    trial = CameraTrial(
        Path("a.mcap"), 0.4 + FRAME * np.arange(270), seen[:270], Slerp(time, wrist_rotations(q))
    )
    with pytest.raises(RecordingError, match="the target does not rotate as the frame does"):
        delay_of([trial])


@pytest.mark.parametrize(
    "broken",
    [{"matrix": [[[1.0]], [[1.0]]]}, {"limit": [None, None]}, {"kind": "lidar"},
     {"bias": [[float("nan")]]}],
)  # fmt: skip
def test_a_record_with_an_impossible_sensor_is_refused(
    arm: Path, tmp_path: Path, broken: dict[str, Any]
) -> None:
    document = identified(arm)
    document["sensors"]["elbow"] |= broken
    (tmp_path / "identification.json").write_text(json.dumps(document))
    with pytest.raises(Exception, match=r"identification\.json"):
        read_identification_record(tmp_path / "identification.json")
