"""Goldens compared with recorded sensors: time lags of streams and tosses of objects."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml
from check_robots import failed, measure
from scipy.spatial.transform import Rotation

from pytest_twin.checks.contact import Contact
from pytest_twin.checks.sensor_timing import SensorTiming
from pytest_twin.errors import RecordingError, SpecError
from pytest_twin.gate.specs import load_golden
from pytest_twin.golden import Golden
from pytest_twin.realization import Realization, load
from pytest_twin.twin import load_twin

sys.path.append(str(Path(__file__).parents[1] / "formats"))
import sensor_bags

CUBE = """<mujoco><worldbody>
  <geom name="table" type="plane" size="5 5 0.1"/>
  <body name="cube" pos="0 0 0.2"><freejoint/>
    <geom name="faces" type="box" size="0.05 0.05 0.05" mass="0.3" friction="{friction}"/></body>
  <body name="other"><joint name="hinge"/><geom size="0.01" contype="0" conaffinity="0"/></body>
</worldbody></mujoco>"""
START = 1_700_000_000_000_000_000


def golden_in(folder: Path, spec: dict[str, Any], model: str) -> tuple[Golden, Realization]:
    (folder / "golden").mkdir(exist_ok=True)
    (folder / "cube.xml").write_text(model)
    (folder / "twin.yaml").write_text("schema: 1\nname: cube\nmodel: cube.xml\n")
    path = folder / "golden" / "one.yaml"
    path.write_text(yaml.safe_dump({"schema": 1, **spec}))
    twin = load_twin(folder / "twin.yaml")
    return load_golden(path, twin), load(folder / "cube.xml", twin=twin)


# -- sensor_timing


def record_rotation(folder: Path, lag: float, seed: int = 0) -> Path:
    """Record an irregular rotation by a tracker and an IMU; the IMU stamps are ``lag`` s late."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 8.0, 0.005)
    knots = rng.normal(size=30)
    speed = np.interp(time, np.linspace(0.0, 8.0, 30), knots)
    angle = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * 0.005)])
    stamps = START + np.round(time * 1e9).astype(np.int64)
    turn = Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0])).as_quat()
    poses = np.hstack([np.zeros((len(time), 3)), turn])
    imu = np.zeros((len(time), 6))
    imu[:, 2] = speed + 0.01 * rng.normal(size=len(time))
    late = stamps + round(lag * 1e9)
    return sensor_bags.write(
        folder / "shake.mcap",
        {"/tracker": (sensor_bags.POSE, stamps, poses), "/imu": (sensor_bags.IMU, late, imu)},
    )


def timing(lag: float | None, bound: str = "1 ms", second: str = "/imu") -> dict[str, Any]:
    spec: dict[str, Any] = {
        "kind": "sensor_timing",
        "target": {
            "recording": "shake.mcap",
            "streams": [{"topic": "/tracker"}, {"topic": second}],
        },
        "tolerance": {"lag": bound},
    }
    return spec if lag is None else {**spec, "expected": {"lag": lag}}


@pytest.mark.parametrize("lag", [0.0173, -0.031])
def test_the_lag_between_two_streams_is_found_with_its_sign(lag: float, tmp_path: Path) -> None:
    record_rotation(tmp_path, lag)
    (found,) = measure(SensorTiming(), *golden_in(tmp_path, timing(lag), CUBE.format(friction="1")))
    assert found.measured == pytest.approx(lag, abs=3e-4)
    assert not failed([found])


def test_a_changed_lag_fails(tmp_path: Path) -> None:
    record_rotation(tmp_path, 0.02)
    (found,) = failed(
        measure(SensorTiming(), *golden_in(tmp_path, timing(0.012), CUBE.format(friction="1")))
    )
    assert found.error == pytest.approx(0.008, abs=3e-4)


def test_streams_of_unrelated_motions_have_no_lag_and_are_refused(tmp_path: Path) -> None:
    record_rotation(tmp_path, 0.0, seed=1)
    rng = np.random.default_rng(5)
    stamps = START + 5_000_000 * np.arange(1600)
    imu = np.zeros((1600, 6))
    imu[:, 0] = np.interp(np.arange(1600), np.linspace(0, 1600, 60), rng.normal(size=60))
    poses = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (1600, 1))
    poses[:, 3:] = Rotation.from_rotvec(
        np.outer(np.sin(np.arange(1600) * 0.01) ** 3, [0, 0, 1])
    ).as_quat()
    sensor_bags.write(
        tmp_path / "shake.mcap",
        {"/tracker": (sensor_bags.POSE, stamps, poses), "/imu": (sensor_bags.IMU, stamps, imu)},
    )
    with pytest.raises(SpecError, match="streams"):
        measure(SensorTiming(), *golden_in(tmp_path, timing(0.0), CUBE.format(friction="1")))


def test_a_missing_stream_is_refused(tmp_path: Path) -> None:
    record_rotation(tmp_path, 0.0)
    with pytest.raises(RecordingError, match="no such stream"):
        measure(
            SensorTiming(),
            *golden_in(tmp_path, timing(0.0, second="/gone"), CUBE.format(friction="1")),
        )


def test_a_lag_golden_depends_on_the_recording_only(tmp_path: Path) -> None:
    record_rotation(tmp_path, 0.0)
    golden, robot = golden_in(tmp_path, timing(0.0), CUBE.format(friction="1"))
    assert set(SensorTiming().depends(golden, robot.structure)) == {"recording:shake.mcap"}


# -- contact: toss


def record_tosses(folder: Path) -> None:
    model = mujoco.MjModel.from_xml_string(CUBE.format(friction="0.3"))
    tables = {}
    for seed in range(3):
        rng = np.random.default_rng(seed)
        data = mujoco.MjData(model)
        data.qpos[:7] = [0.0, 0.0, 0.12, *(q := rng.normal(size=4)) / np.linalg.norm(q)]
        data.qvel[:6] = [1.0, 0.5, 0.0, *rng.uniform(-3.0, 3.0, 3)]
        rows = []
        for _ in range(60):
            rows.append(np.concatenate([data.qpos[:7], data.qvel[:6]]))
            mujoco.mj_step(model, data, nstep=3)
        tables[f"t{seed}"] = np.array(rows)
    np.savez(folder / "tosses.npz", **tables)


def toss(**target: Any) -> dict[str, Any]:
    return {
        "kind": "contact",
        "target": {
            "primitive": "toss", "pair": ["cube", "table"], "recording": "tosses.npz",
            "rate": 1.0 / 0.006, "length_unit": 1, **target,
        },
        "tolerance": {"toss_position": "2 mm", "toss_rotation_mean": "20 mrad"},
    }  # fmt: skip


def test_a_model_with_the_right_friction_passes_its_recorded_tosses(tmp_path: Path) -> None:
    record_tosses(tmp_path)
    model = CUBE.format(friction="0.3").replace("<mujoco>", "<mujoco><option/>")
    # The table's default friction of 1 determines the pair; recording and model have the same.
    measures = measure(Contact(), *golden_in(tmp_path, toss(), model))
    assert {m.name for m in measures} == {"toss_position", "toss_rotation_mean"}
    assert all(m.against == "recording" for m in measures)
    assert not failed(measures)


def test_a_model_with_too_little_friction_fails_and_names_the_worst_toss(tmp_path: Path) -> None:
    record_tosses(tmp_path)
    model = CUBE.format(friction="0.05").replace('name="faces"', 'name="faces" priority="1"')
    faults = failed(measure(Contact(), *golden_in(tmp_path, toss(), model)))
    assert {m.name for m in faults} == {"toss_position", "toss_rotation_mean"}
    assert any("toss t" in m.subject for m in faults)


def test_an_unknown_toss_is_refused(tmp_path: Path) -> None:
    record_tosses(tmp_path)
    with pytest.raises(SpecError, match=r"no toss of this name.*one of t0, t1, t2"):
        measure(Contact(), *golden_in(tmp_path, toss(tosses=["t7"]), CUBE.format(friction="0.3")))


def test_a_toss_golden_depends_on_its_recording_and_all_contact_parameters(tmp_path: Path) -> None:
    record_tosses(tmp_path)
    golden, robot = golden_in(tmp_path, toss(), CUBE.format(friction="0.3"))
    parts = set(Contact().depends(golden, robot.structure))
    assert "recording:tosses.npz" in parts
    assert set(robot.structure.contact()) <= parts
