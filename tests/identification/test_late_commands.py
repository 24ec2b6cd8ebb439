"""Command delay and gains of servos from measured effort: intervals that hold the truth."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from arms import JOINTS, NOMINAL, REAL, TRUE
from fourier_motion import fourier

from pytest_twin.identification.effort.identify_effort import identify_effort
from pytest_twin.identification.effort.servo_gains import servo_gains
from pytest_twin.identification.identify_files import identify_files
from pytest_twin.identification.measured_recordings import MeasuredRecordings, read_measured
from pytest_twin.realization import load
from pytest_twin.recording_options import NO_OPTIONS
from pytest_twin.signals import NO_SIGNALS
from pytest_twin.twin import DEFAULT_TOPICS

SERVOS = """<actuator>
    <position name="s1" joint="shoulder" kp="{}" kv="{}"/>
    <position name="s2" joint="elbow" kp="{}" kv="{}"/>
  </actuator></mujoco>"""


def model_text(values: dict[str, float], gains: np.ndarray) -> str:
    text = TRUE.format(**values).replace("</mujoco>", SERVOS.format(*gains))
    head = '<option timestep="0.001" integrator="implicitfast"/><worldbody>'
    return text.replace("<worldbody>", head)


def write_run(
    path: Path, seed: int, gains: np.ndarray, rate: int, held: bool, delay: float
) -> Path:
    """Write commands, positions and efforts of servos that act on commands late.

    Args:
        gains: stiffness and damping of shoulder and elbow.
        rate: commands and states per second.
        held: whether the drive holds a command until the next one, or interpolates.
        delay: delay of commands, s.
    """
    random = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(model_text(REAL, gains))
    data = mujoco.MjData(model)
    inner = round(1000 / rate)
    time = np.arange(10 * rate) / rate
    wave, _, _ = fourier(random, time, 2, 5, 0.1, (0.2, 1.2))
    wave = wave[0] + (wave - wave[0]) * np.clip(time - 0.5, 0.0, 1.0)[:, None] ** 2
    fine = np.arange(len(time) * inner) * 1e-3
    asked = np.repeat(wave, inner, axis=0)
    if not held:
        asked = np.stack([np.interp(fine, time, one) for one in wave.T], axis=1)
    lost = round(1000 * delay)
    asked = np.concatenate([np.repeat(asked[:1], lost, axis=0), asked])[: len(fine)]
    data.qpos[:] = data.ctrl[:] = wave[0]
    mujoco.mj_step(model, data, 2000)
    rows = []
    for k, setpoint in enumerate(asked):
        data.ctrl[:] = setpoint
        mujoco.mj_forward(model, data)
        if k % inner == 0:
            effort = data.qfrc_actuator + 0.05 * random.standard_normal(2)
            position = data.qpos + 1e-5 * random.standard_normal(2)
            rows.append([fine[k], *position, *effort, *wave[k // inner]])
        mujoco.mj_step(model, data)
    names = [f"{joint}.{what}" for what in ("position", "effort", "command") for joint in JOINTS]
    head = ",".join(["time", *names])
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=head, comments="")
    return path


def drawn_gains(random: np.random.Generator) -> np.ndarray:
    return random.uniform([500.0, 20.0, 200.0, 5.0], [1500.0, 80.0, 500.0, 25.0])


def test_intervals_of_servo_gains_and_delays_hold_the_truth(tmp_path: Path) -> None:
    inside = []
    for seed in range(6):
        random = np.random.default_rng(seed)
        true = drawn_gains(random)
        rate, held = int(random.choice([100, 200, 500])), bool(random.integers(2))
        delay = float(random.choice([0.0, 0.012, 0.02]))
        (tmp_path / "model.xml").write_text(model_text(NOMINAL, 0.7 * true))
        robot = load(tmp_path / "model.xml")
        read = []
        for k in range(2):
            run = write_run(tmp_path / f"{seed}{k}.csv", 10 * seed + k, true, rate, held, delay)
            read += read_measured(run, robot, DEFAULT_TOPICS, NO_OPTIONS, NO_SIGNALS)
        found = identify_effort(robot, MeasuredRecordings(tuple(read), ()), NO_SIGNALS)
        for one, (stiffness, damping) in zip(
            servo_gains(robot, read, found, NO_SIGNALS), true.reshape(2, 2), strict=True
        ):
            assert one.stiffness == pytest.approx(stiffness, rel=0.02)
            inside.append(abs(one.damping - damping) <= one.half_widths[1])
            inside.append(abs(one.command_delay(held) - delay) <= one.delay[1] + 1e-3)
            assert one.is_late == (delay > 0.0)
    assert np.mean(inside) >= 0.9


@pytest.mark.parametrize(("held", "delay"), [(True, 0.012), (False, 0.015)])
def test_a_command_delay_is_estimated_beside_measured_efforts(
    tmp_path: Path, held: bool, delay: float
) -> None:
    true = np.array([900.0, 40.0, 300.0, 12.0])
    (tmp_path / "model.xml").write_text(model_text(NOMINAL, 0.7 * true))
    runs = [write_run(tmp_path / f"{k}.csv", k, true, 200, held, delay) for k in range(3)]
    (tmp_path / "out").mkdir()
    document = identify_files({
        "model": str(tmp_path / "model.xml"),
        "recordings": [str(one) for one in runs[:2]],
        "held_out": [str(runs[2])],
        "out": str(tmp_path / "out"),
        "name": "late",
        "options": {"command_between": "held" if held else "interpolated"},
    })  # fmt: skip
    stage = next(one for one in document["stages"] if one["stage"] == "delay")
    assert stage["state"] == "accepted"
    effects = json.loads((tmp_path / "out/realization/effects.json").read_text())["effects"]
    written = {e["joint"]: e["values"] for e in effects if e["effect"] == "command_delay"}
    for joint in JOINTS:
        one = document["parameters"][f"{joint}.command_delay"]
        assert one["value"] == pytest.approx(delay, abs=1e-3)
        assert one["ci95"][0] <= delay <= one["ci95"][1]
        assert written[joint]["delay"] == pytest.approx(one["value"])
        error = document["held_out"][joint]
        assert error["position_rms"] < 0.03 * error["position_rms_nominal"]
