"""Encoder errors inside and outside the servo loop, and sensor delay at a window's start."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment

KP, KV, MASS, LENGTH, STEP = 20.0, 1.0, 0.5, 0.2, 0.001
WEIGHT = MASS * 9.81 * LENGTH
BIAS = 0.15


def pendulum(drive: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody><body>'
        f'<inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="1e-9 1e-9 1e-9"/>'
        f'<joint name="j" axis="0 -1 0" armature="0.01"/></body></worldbody>'
        f"<actuator>{drive}</actuator></mujoco>"
    )


def segment(mode: str, drive: str, time: FloatArray, command: FloatArray, start: float) -> Segment:
    """``command`` at every step of the whole trial; the window begins at ``start``."""
    return Segment(
        trial=0, model=pendulum(drive), mode=mode, start=start, time=time,
        position=np.zeros((len(time), 1)), velocity=None, effort=None,
        command_time=STEP * np.arange(len(command)), command=command[:, None],
        initial_position=np.zeros(1), initial_velocity=np.zeros(1),
    )  # fmt: skip


@pytest.mark.parametrize("in_loop", [0.0, 1.0])
def test_encoder_bias_shifts_the_joint_only_if_it_is_in_the_servo_loop(in_loop: float) -> None:
    target = 0.8
    drive = f'<position joint="j" kp="{KP}" kv="{KV}"/>'
    held = segment("position", drive, STEP * np.arange(5000), np.full(5000, target), 0.0)
    values = {"encoder_bias": {"bias": np.full((1, 1), BIAS), "in_loop": np.full((1, 1), in_loop)}}
    reading = BatchSimulator([held], ("j",), threads=1).simulate(np.array([0]), values)
    # Statics: kp (target - q - in_loop bias) = weight sin(q), and the encoder reads q + bias.
    q = target
    for _ in range(60):
        q = target - in_loop * BIAS - WEIGHT * np.sin(q) / KP
    assert reading[0].position[-1, 0] == pytest.approx(q + BIAS, abs=1e-5)


@pytest.mark.parametrize("zeroed", [0.0, 1.0])
def test_an_eccentric_encoder_starts_from_the_recorded_reading(zeroed: float) -> None:
    drive = f'<position joint="j" kp="{KP}" kv="{KV}"/>'
    held = segment("position", drive, STEP * np.arange(5), np.zeros(5), 0.0)
    wheel = {"sine": 0.03, "cosine": 0.02, "zeroed": zeroed}
    values = {"encoder_eccentricity": {n: np.full((1, 1), v) for n, v in wheel.items()}}
    # The first reading is 0; the joint starts at the position that gives this reading.
    reading = BatchSimulator([held], ("j",), threads=1).simulate(np.array([0]), values)
    assert reading[0].position[0, 0] == pytest.approx(0.0, abs=1e-9)
    assert bool(np.abs(reading[0].position[1:]).max() > 1e-6) is (zeroed == 0.0)


def test_sensor_delay_starts_a_window_before_its_first_stamp() -> None:
    """The first reading shows an earlier state; commands appear in readings one delay later."""
    delay, start = 0.05, 0.4
    time = start + STEP * np.arange(300)
    command = np.where(np.arange(1000) < 450, 0.0, 2.0)
    window = segment("effort", '<motor joint="j"/>', time, command, start)
    late = {"sensor_delay": {"delay": np.full((1, 1), delay)}}
    found = BatchSimulator([window], ("j",), threads=1).simulate(np.array([0]), late)[0].position
    moved = time[np.flatnonzero(np.abs(found[:, 0]) > 1e-7)[0]]
    # It rests at the first reading; readings move one delay after the command at 0.45 s.
    assert moved == pytest.approx(0.45 + delay, abs=2.5 * STEP)


@pytest.mark.parametrize(
    ("form", "read"),
    [
        (4.0, [0.3, -0.2 + 0.1 * 0.3, 0.5 + 0.2 * -0.2]),
        (5.0, [0.3 + 0.3 * -0.2, -0.2 + 0.1 * 0.5, 0.5]),
    ],
)
def test_coupled_encoder_readings_are_inverted_exactly(form: float, read: list[float]) -> None:
    coupling = catalogue()["joint_coupling"]
    values = {"ratio": np.array([[0.3, 0.1, 0.2]]), "form": np.full((1, 3), form)}
    true = np.array([[0.3, -0.2, 0.5]])
    # Velocities are coupled in the same way as positions.
    sensed = coupling.sense(np.zeros((1, 1, 3)), true[:, None], true[:, None], values)
    for x in sensed:
        assert x[0, 0] == pytest.approx(read, abs=1e-15)
    behind = coupling.unsense(sensed[0][:, 0], sensed[1][:, 0], values)
    for x in behind:
        assert x == pytest.approx(true, abs=1e-15)


def test_mechanical_forms_of_a_coupling_leave_readings_unchanged() -> None:
    coupling = catalogue()["joint_coupling"]
    position, velocity = np.full((1, 1, 3), 0.4), np.full((1, 1, 3), 0.2)
    for form in range(4):
        values = {"ratio": np.full((1, 3), 0.2), "form": np.full((1, 3), float(form))}
        sensed = coupling.sense(np.zeros((1, 1, 3)), position, velocity, values)
        assert np.array_equal(sensed[0], position)
        assert np.array_equal(sensed[1], velocity)


def test_encoder_errors_apply_in_the_order_eccentricity_scale_bias() -> None:
    """The reading is (1 + scale) (q + wheel(q)) + bias; efforts are (1 + scale) effort + bias."""
    drive = f'<position joint="j" kp="{KP}" kv="{KV}"/>'
    held = segment("position", drive, STEP * np.arange(3000), np.full(3000, 0.8), 0.0)
    told = {
        "encoder_bias": {"bias": BIAS, "in_loop": 0.0},
        "encoder_eccentricity": {"sine": 0.03, "cosine": 0.02, "zeroed": 1.0},
        "encoder_scale": {"scale_error": 0.1},
        "effort_bias": {"bias": 0.5},
        "effort_scale": {"scale_error": 0.3},
    }
    values = {e: {n: np.full((1, 1), v) for n, v in vs.items()} for e, vs in told.items()}
    (read,) = BatchSimulator([held], ("j",), threads=1).simulate(np.array([0]), values)
    q = 0.8
    for _ in range(60):
        q = 0.8 - WEIGHT * np.sin(q) / KP
    wheel = 0.03 * np.sin(q) + 0.02 * (np.cos(q) - 1.0)
    assert read.position[-1, 0] == pytest.approx(1.1 * (q + wheel) + BIAS, abs=1e-5)
    assert read.effort[-1, 0] == pytest.approx(1.3 * WEIGHT * np.sin(q) + 0.5, abs=1e-4)
    # The first reading is 0.
    assert read.position[0, 0] == pytest.approx(0.0, abs=1e-9)
