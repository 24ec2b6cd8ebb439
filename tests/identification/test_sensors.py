"""Identification of a force-torque sensor and an IMU; Pinocchio computes the true signals."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

from pytest_twin.budget.categories import category_of_parameter
from pytest_twin.identification.identify_files import identify_files
from pytest_twin.report import identification
from pytest_twin.sensors.encoder import Encoder, encoder_of
from pytest_twin.sensors.force_torque import ForceTorqueSensor
from pytest_twin.sensors.imu import noise_of

sys.path.append(str(Path(__file__).parents[1] / "formats"))
sys.path.append(str(Path(__file__).parent))
import sensor_bags
from sensor_arm import ARM, COM, INERTIA, MASS, PERIOD, START, pinocchio_arm, random_motion


def true_signals(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The wrench that the tool exerts on the wrist, and the inertial signals there."""
    model = pinocchio_arm()
    data = model.createData()
    offset = pin.SE3(np.eye(3), np.array([0.1, 0.0, 0.0]))
    tool = pin.Inertia(MASS, COM, INERTIA)
    wrench, inertial = np.empty((2, len(q), 6))
    for row in range(len(q)):
        pin.forwardKinematics(model, data, q[row], v[row], a[row])
        turn = data.oMi[3].rotation
        speed = offset.actInv(data.v[3])
        rate = offset.actInv(data.a[3])
        gravity = turn.T @ np.array([0.0, 0.0, -9.81])
        total = pin.Motion(rate.linear - gravity, rate.angular)
        force = tool * total + speed.cross(tool * speed)
        wrench[row] = -np.concatenate([force.linear, force.angular])
        push = rate.linear + np.cross(speed.angular, speed.linear) - gravity
        inertial[row] = np.concatenate([speed.angular, push])
    return wrench, inertial


def write_trial(
    path: Path, q: np.ndarray, readings: np.ndarray, kind: str, metadata: dict[str, str]
) -> None:
    """Write joint states as JSON and sensor readings as CDR to one file."""
    stamps = START + np.round(np.arange(len(q)) * PERIOD * 1e9).astype(np.int64)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", b"")
        states = writer.register_channel("/joint_states", "json", schema)
        own = writer.register_schema(kind, "ros2msg", b"")
        channel = writer.register_channel("/sensor", "cdr", own)
        for stamp, row, reading in zip(stamps.tolist(), q, readings, strict=True):
            sec, nanosec = divmod(stamp, 1_000_000_000)
            header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": ""}
            state = {"header": header, "name": ["j1", "j2", "j3"], "position": row.tolist()}
            writer.add_message(states, stamp, json.dumps(state).encode(), stamp)
            made = sensor_bags.message(kind, stamp, reading)
            data = bytes(sensor_bags.STORE.serialize_cdr(made, kind))
            writer.add_message(channel, stamp, data, stamp)
        writer.add_metadata("trial", metadata)
        writer.finish()


def random_sensor(seed: int) -> ForceTorqueSensor:
    rng = np.random.default_rng(100 + seed)
    scale = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    mixing = 0.03 * rng.normal(size=(6, 6)) * np.outer(scale, 1.0 / scale)
    return ForceTorqueSensor(
        rng.normal(size=6) * scale, np.eye(6) + mixing, 0.012, np.full(6, np.inf)
    )


def identified(
    folder: Path, kind: str, readings: Any, first_motion: int = 0, rest: bool = False
) -> dict[str, Any]:
    """Result for two recordings and a held-out one; ``readings`` converts the true signals.

    Args:
        rest: whether the second recording is one at rest.
    """  # fmt: skip
    (folder / "arm.xml").write_text(ARM)
    (folder / "out").mkdir()
    for seed, role in ((1, "fit"), (2, "fit"), (3, "held_out")):
        q, v, a = random_motion(first_motion + seed)
        if rest and seed == 2:
            q, v, a = np.full_like(q, 0.3), np.zeros_like(v), np.zeros_like(a)
        write_trial(folder / f"{seed}.mcap", q, readings(true_signals(q, v, a), seed), kind,
              {"role": role})  # fmt: skip
    return identify_files(
        {
            "model": str(folder / "arm.xml"),
            "recordings": [str(folder / f"{n}.mcap") for n in (3, 1, 2)],
            "held_out": [],
            "out": str(folder / "out"),
            "name": "wrist",
            "sensors": [{"name": "wrist", "topic": "/sensor", "frame": "wrist"}],
        }
    )


def test_a_force_torque_sensor_is_identified_and_its_intervals_contain_the_true_values(
    tmp_path: Path,
) -> None:
    sensor = random_sensor(0)
    noise = np.array([0.05, 0.05, 0.05, 0.003, 0.003, 0.003])

    def readings(true: Any, seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        clean = sensor.measured(true[0], PERIOD)
        return np.asarray(clean + noise * rng.normal(size=clean.shape))

    found = identified(tmp_path, sensor_bags.WRENCH, readings)
    assert found["verdict"] == "accepted"
    assert found["trials"]["held_out"] == ["3.mcap"]
    inside = []
    axes = ("fx", "fy", "fz", "tx", "ty", "tz")
    for row, axis in enumerate(axes):
        truth = {f"sensor_bias_{axis}": sensor.bias[row]}
        for column, source in enumerate(axes):
            name = f"scale_{axis}" if row == column else f"coupling_{axis}_{source}"
            truth[f"sensor_{name}"] = sensor.coupling[row, column]
        for name, value in truth.items():
            one = found["parameters"].get(f"wrist.{name}")
            if one is not None:
                inside.append(one["ci95"][0] <= value <= one["ci95"][1])
    assert len(inside) == 42
    assert np.mean(inside) > 0.9
    slow = found["parameters"]["wrist.sensor_filter_time"]
    assert slow["value"] == pytest.approx(0.012, abs=0.001)
    held = found["held_out"]["wrist"]
    assert all(held["sensor_rms"][a] < 0.2 * held["sensor_rms_nominal"][a] for a in axes)
    assert "ideal sensor" in identification.render(found)


def test_bias_and_scale_of_an_imu_are_identified(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    turned = Rotation.from_rotvec([0.02, -0.03, 0.01]).as_matrix()
    matrix = np.block([[1.02 * turned, np.zeros((3, 3))], [np.zeros((3, 3)), 0.97 * turned]])
    bias = np.array([0.01, -0.02, 0.005, 0.1, -0.2, 0.15])

    def readings(true: Any, seed: int) -> np.ndarray:
        clean = true[1] @ matrix.T + bias
        return np.asarray(clean + 0.01 * rng.normal(size=clean.shape))

    found = identified(tmp_path, sensor_bags.IMU, readings)["parameters"]
    for row, axis in enumerate(("gx", "gy", "gz", "ax", "ay", "az")):
        assert found[f"wrist.sensor_bias_{axis}"]["value"] == pytest.approx(bias[row], abs=0.02)
        assert found[f"wrist.sensor_scale_{axis}"]["value"] == pytest.approx(
            matrix[row, row], abs=0.004
        )


def test_a_recording_at_rest_gives_the_noise_of_each_axis_of_an_imu(tmp_path: Path) -> None:
    pytest.importorskip("allantools", reason="the extra 'sensors' is not installed")
    density = np.array([1e-3, 2e-3, 4e-3, 1e-2, 2e-2, 4e-2])

    def readings(true: Any, seed: int) -> np.ndarray:
        noise = np.random.default_rng(seed).normal(size=true[1].shape)
        return np.asarray(true[1] + density / np.sqrt(PERIOD) * noise)

    found = identified(tmp_path, sensor_bags.IMU, readings, rest=True)
    noise = found["sensors"]["wrist"]["noise"]
    for axis, expected in zip(("gx", "gy", "gz", "ax", "ay", "az"), density, strict=True):
        one = noise[axis]
        assert one["density"] == pytest.approx(expected, abs=4.0 * one["density_std"])
        # White noise alone still averages out at the longest time.
        assert one["instability"] is None


def test_without_a_recording_at_rest_an_imu_has_no_noise(tmp_path: Path) -> None:
    found = identified(tmp_path, sensor_bags.IMU, lambda true, seed: true[1])
    assert "noise" not in found["sensors"]["wrist"]


def flicker_noise(seed: int) -> np.ndarray:
    """White noise, flicker noise of the two-sided density B^2 / (2 pi f), and a random walk.

    The readings are of 44 minutes at 50 Hz, B is 0.01.
    """
    rng = np.random.default_rng(seed)
    rate, count, instability, white, walk = 50.0, 2**17, 0.01, 0.002, 0.0008
    frequency = np.fft.rfftfreq(count, 1.0 / rate)[1:]
    amplitude = np.sqrt(instability**2 / (2.0 * np.pi * frequency) * rate * count / 2.0)
    waves = amplitude * (rng.normal(size=len(frequency)) + 1j * rng.normal(size=len(frequency)))
    flicker = np.fft.irfft(np.concatenate([[0.0], waves]), count)
    still = flicker + white * np.sqrt(rate) * rng.normal(size=count)
    return np.asarray(still + walk / np.sqrt(rate) * np.cumsum(rng.normal(size=count)))


def test_the_bias_instability_of_flicker_noise_is_identified() -> None:
    pytest.importorskip("allantools", reason="the extra 'sensors' is not installed")
    found = [noise_of(flicker_noise(seed)[:, None], 50.0)[0].instability for seed in range(12)]
    # Of a recording whose deviation does not rise again it is not stated.
    stated = [one for one in found if one is not None]
    assert len(stated) >= 11
    assert stated == pytest.approx([0.01] * len(stated), rel=0.2)
    assert np.mean(stated) == pytest.approx(0.01, rel=0.05)
    (cut_short,) = noise_of(flicker_noise(1)[:200, None], 50.0)
    assert cut_short.instability is None


def test_a_saturated_force_torque_sensor_has_its_limit_and_keeps_its_scales(
    tmp_path: Path,
) -> None:
    """The vertical force saturates in a part of the samples, which are left out of the fit."""
    sensor = random_sensor(0)
    limit = np.full(6, np.inf)
    limit[2] = 13.0
    sensor = ForceTorqueSensor(sensor.bias, sensor.coupling, 0.0, limit)

    def readings(true: Any, seed: int) -> np.ndarray:
        noise = np.random.default_rng(seed).normal(size=(len(true[0]), 6))
        clean = sensor.coupling @ true[0].T + sensor.bias[:, None]
        return np.asarray(np.clip(clean.T + 0.01 * noise, -limit, limit))

    found = identified(tmp_path, sensor_bags.WRENCH, readings)
    stated = found["sensors"]["wrist"]["limit"]
    assert stated == [None, None, pytest.approx(13.0), None, None, None]
    scale = found["parameters"]["wrist.sensor_scale_fz"]["value"]
    assert scale == pytest.approx(sensor.coupling[2, 2], abs=0.003)


def test_the_density_of_white_noise_is_identified() -> None:
    pytest.importorskip("allantools", reason="the extra 'sensors' is not installed")
    rng = np.random.default_rng(0)
    rate, density = 200.0, 0.003
    still = density * np.sqrt(rate) * rng.normal(size=(40_000, 2))
    for one in noise_of(still, rate):
        assert one.density == pytest.approx(density, abs=4.0 * one.density_std)
        assert one.density_std < 0.1 * density


def test_the_stated_deviation_of_a_noise_density_is_that_over_recordings() -> None:
    pytest.importorskip("allantools", reason="the extra 'sensors' is not installed")
    rate, density = 200.0, 0.003
    errors = []
    for seed in range(30):
        noise = np.random.default_rng(seed).normal(size=(4000, 1))
        (one,) = noise_of(density * np.sqrt(rate) * noise, rate)
        errors.append((one.density - density) / one.density_std)
    # It is stated up to twice as large as it is, and not smaller.
    assert 0.4 < np.std(errors) < 1.1


def test_the_resolution_of_an_encoder_is_identified_and_a_smooth_signal_has_none() -> None:
    step = 2.0 * np.pi / 4096
    angle = np.sin(np.linspace(0.0, 9.0, 4000))
    found = encoder_of(Encoder(step).measured(angle))
    assert found is not None
    assert found.step == pytest.approx(step, rel=1e-6)
    assert encoder_of(angle) is None


def test_sensor_parameters_belong_to_sensing_and_filters_and_delays_to_timing() -> None:
    assert category_of_parameter("wrist.sensor_bias_fx") == "sensing"
    assert category_of_parameter("wrist.sensor_filter_time") == "timing"
    assert category_of_parameter("elbow.sensor_delay") == "timing"
    assert category_of_parameter("cube.contact_friction") == "contact_and_material"
