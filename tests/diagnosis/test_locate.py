"""Location of an error: joint of the missing force, time windows, regime and frequency."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from pytest_twin.diagnosis.locate import (
    Motion,
    compute_missing_force,
    error_windows,
    list_regimes,
    locate_error,
)
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.smoothing import derivatives
from pytest_twin.estimation.hypothesis import EMPTY
from pytest_twin.formats.mcap import JointSeries, read_recording, write_recording
from pytest_twin.realization import load
from pytest_twin.trial import make_trial

CHAIN = """
<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="upper"><inertial pos="0 0 0.15" mass="1" diaginertia="0.01 0.01 0.002"/>
 <joint name="shoulder" axis="0 1 0" damping="0.1"/>
 <body name="lower" pos="0 0 0.3">
  <inertial pos="0 0 0.12" mass="0.8" diaginertia="0.01 0.01 0.002"/>
  <joint name="elbow" axis="0 1 0" damping="0.1"/></body></body></worldbody>
<actuator><position name="shoulder" joint="shoulder" kp="40" kv="3"/>
 <position name="elbow" joint="elbow" kp="15" kv="1"/></actuator></mujoco>
"""


def motion(time: np.ndarray, position: np.ndarray, name: str = "a.mcap") -> Motion:
    q, v, a = derivatives(time, position[:, None])
    return Motion(name, time, q, v, a, np.cos(0.37 * time)[:, None], np.zeros_like(q))


def test_derivatives_of_a_cubic_are_exact_at_irregular_stamps() -> None:
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.004, 0.006, 400))
    coefficients = np.array([0.3, -1.0, 0.8, 0.5])
    values = np.polynomial.polynomial.polyval(time, coefficients)[:, None]
    inside = slice(40, -40)
    for order, found in enumerate(derivatives(time, values)):
        exact = np.polynomial.polynomial.polyval(
            time, np.polynomial.polynomial.polyder(coefficients, order)
        )
        assert np.allclose(found[inside, 0], exact[inside], rtol=2e-3, atol=2e-3)


def test_windows_contain_the_times_of_large_error_and_little_else() -> None:
    time = np.arange(0.0, 10.0, 0.01)
    blame = 0.01 + np.exp(-(((time - 3.0) / 0.2) ** 2)) + np.exp(-(((time - 7.0) / 0.3) ** 2))
    (first, second) = error_windows(time, blame)
    assert 2.5 < first[0] < 2.9 < 3.1 < first[1] < 3.5
    assert 6.3 < second[0] < 6.9 < 7.1 < second[1] < 7.7
    assert error_windows(time, np.zeros_like(time)) == []


def test_a_recording_in_pieces_has_the_same_error_windows_as_the_whole() -> None:
    time = np.arange(0.0, 12.0, 0.01)
    whole = motion(time, np.sin(1.3 * time))
    # Noise throughout, and a large error for one second.
    blame = np.random.default_rng(0).uniform(0.0, 0.02, len(time))
    blame[(time > 4.3) & (time < 5.3)] += 1.0
    pieces = [motion(part, np.sin(1.3 * part)) for part in np.split(time, 24)]
    cut, together = locate_error(pieces, blame, 0, "rad"), locate_error([whole], blame, 0, "rad")
    assert cut.windows == together.windows
    ((start, end),) = cut.windows["a.mcap"]
    assert 4.2 < start < end < 5.4


def test_the_regime_has_a_larger_share_of_the_error_than_of_the_time() -> None:
    time = np.arange(0.0, 12.0, 0.005)
    moving = motion(time, 0.8 * np.sin(1.3 * time) + 0.3 * np.sin(4.7 * time + 1.0))
    speed = np.abs(moving.velocity[:, 0])
    fast = locate_error([moving], np.where(speed > np.quantile(speed, 0.75), 1.0, 0.0), 0, "rad")
    assert fast.summary.startswith("fast, |velocity| > ")
    assert "rad/s" in fast.summary
    patch = np.abs(moving.position[:, 0] - 0.3) < 0.05
    region = locate_error([moving], patch.astype(float), 0, "m").summary
    low, high = (float(x) for x in region.split(" m (")[0].split()[1::2])
    assert 0.2 < low < 0.3 < high < 0.4
    assert locate_error([moving], np.ones_like(time), 0, "rad").summary == "throughout the motion"
    assert set(fast.windows) == {"a.mcap"}


def test_velocity_regimes_of_a_joint_that_mostly_rests_follow_from_its_motion() -> None:
    """It moves out at 4 s and back at 7 s, and rests otherwise."""
    time = np.arange(0.0, 10.0, 0.01)
    out = 0.5 * (1.0 + np.tanh((time - 4.0) / 0.1)) - 0.5 * (1.0 + np.tanh((time - 7.0) / 0.1))
    mostly_at_rest = motion(time, out + 1e-9 * np.sin(300.0 * time))
    found = dict(list_regimes([mostly_at_rest], 0, "rad"))
    (slow,) = [text for text in found if text.startswith("slow")]
    (fast,) = [text for text in found if text.startswith("fast")]
    top = np.abs(mostly_at_rest.velocity).max()
    assert float(slow.split("<")[1].split()[0]) == pytest.approx(0.02 * top, rel=0.1)
    assert float(fast.split(">")[1].split()[0]) > 0.1 * top
    (hard,) = [text for text in found if text.startswith("accelerating")]
    assert float(hard.split(">")[1].split()[0]) > 0.02 * np.abs(mostly_at_rest.acceleration).max()
    (turns,) = [mask for text, mask in found.items() if text.startswith("reversals")]
    # It reverses once, between its stop and its restart.
    assert time[turns].min() > 4.0
    assert time[turns].max() < 7.0
    assert not turns[(time > 5.0) & (time < 6.0)].any()


@pytest.mark.parametrize("cause", [0, 1], ids=["shoulder", "elbow"])
def test_an_external_force_is_located_at_the_joint_on_which_it_acts(
    tmp_path: Path, cause: int
) -> None:
    """The force at one joint moves both joints."""
    model = mujoco.MjModel.from_xml_string(CHAIN)
    model.opt.timestep = 2e-4
    data = mujoco.MjData(model)
    time = np.arange(0.0, 3.0, 0.005)
    command = np.stack([0.4 * np.sin(2.0 * time), 0.5 * np.sin(3.1 * time)], axis=1)
    position = np.empty_like(command)
    for k, t in enumerate(time):
        position[k] = data.qpos
        data.ctrl[:] = command[k]
        data.qfrc_applied[:] = 0.0
        data.qfrc_applied[cause] = 1.5 * (1.2 < t < 1.7)
        for _ in range(25):
            mujoco.mj_step(model, data)
    stamp = 10**18 + np.rint(time * 1e9).astype(np.int64)
    names = ("shoulder", "elbow")
    noisy = position + 1e-4 * np.random.default_rng(0).standard_normal(position.shape)
    write_recording(
        tmp_path / "a.mcap",
        [
            JointSeries("/joint_commands", names, stamp, stamp, command, None, None),
            JointSeries("/joint_states", names, stamp, stamp, noisy, None, None),
        ],
        {},
    )
    (tmp_path / "chain.xml").write_text(CHAIN)
    realization = load(tmp_path / "chain.xml")
    trial = make_trial(read_recording(tmp_path / "a.mcap"), realization.structure)
    problem = prepare(realization, [trial], []).problem
    residual = problem.residuals([EMPTY], np.array([0]))[0]
    shown = np.sqrt(np.mean(residual**2, axis=0)) / problem.floor
    assert shown.min() > 3.0, "both joints must have a residual above the noise floor"
    found = compute_missing_force(problem, residual, np.full(2, 1e-4))
    other = 1 - cause
    assert found.strength[cause] > 3.0 * found.strength[other]
    pushed = (time > 1.3) & (time < 1.6)
    assert np.median(found.force[pushed, cause]) == pytest.approx(1.5, rel=0.15)
    assert np.abs(np.median(found.force[pushed, other])) < 0.25


def test_recordings_are_grouped_by_their_metadata() -> None:
    """A value that all recordings have, or only one, forms no group."""
    time = np.arange(0.0, 4.0, 0.01)
    paths = [
        replace(
            motion(time, 0.2 * np.sin(5.0 * time + k), f"{k}.mcap"),
            conditions={"temperature": "cold" if k % 2 else "warm", "robot": "a", "run": str(k)},
        )
        for k in range(8)
    ]
    slices = {text: mask for text, mask in list_regimes(paths, 0, "rad") if " within " not in text}
    labels = {text for text in slices if text.startswith(("temperature", "robot", "run"))}
    assert labels == {"temperature cold", "temperature warm"}
    warm = np.concatenate([np.full(len(time), k % 2 == 0) for k in range(8)])
    assert (slices["temperature warm"] == warm).all()
    assert locate_error(paths, 0.01 + warm, 0, "rad").summary == (
        "temperature warm (99 % of the error in 50 % of the time)"
    )


def test_measured_conditions_are_rounded_if_they_remain_distinguishable() -> None:
    time = np.arange(0.0, 4.0, 0.01)
    recorded = ({"volts": "7.28959306204136", "run": "1.00001"}, {"volts": "7.4", "run": "1.00002"})
    paths = [
        replace(motion(time, 0.2 * np.sin(5.0 * time + k), f"{k}.mcap"), conditions=conditions)
        for k, conditions in enumerate(recorded)
    ]
    labels = {
        text for text, _ in list_regimes(paths, 0, "rad") if text.startswith(("volts", "run"))
    }
    assert labels == {"volts 7.29", "volts 7.4", "run 1.00001", "run 1.00002"}


def test_many_measured_temperatures_are_grouped_into_a_colder_and_a_warmer_half() -> None:
    """Each recording has its own temperature, so a single value would only identify it."""
    time = np.arange(0.0, 4.0, 0.01)
    measured = [f"{20.0 + 1.25 * k:.2f} C" for k in (6, 0, 3, 7, 1, 5, 2, 4)]
    paths = [
        replace(
            motion(time, 0.2 * np.sin(5.0 * time + k), f"{k}.mcap"),
            conditions={"temperature": recorded, "hall": f"{k}.5"},
        )
        for k, recorded in enumerate(measured)
    ]
    slices = dict(list_regimes(paths, 0, "rad"))
    labels = {text for text in slices if text.startswith(("temperature", "hall"))}
    assert labels == {"temperature up to 23.75 C", "temperature from 25.00 C"}
    cold = np.concatenate([np.full(len(time), float(m[:5]) < 24.0) for m in measured])
    assert (slices["temperature up to 23.75 C"] == cold).all()
    assert locate_error(paths, 0.01 + cold, 0, "rad").summary == (
        "temperature up to 23.75 C (99 % of the error in 50 % of the time)"
    )
