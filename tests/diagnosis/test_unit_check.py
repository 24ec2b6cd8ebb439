"""Angles in degrees or encoder counts are detected by comparison with the model."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from two_pendulums import JOINTS, KP, KV, STEP, mjcf, reference, simulate, write

from pytest_twin import cli
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.diagnosis.unit_check import drop_other_units
from pytest_twin.errors import RecordingError
from pytest_twin.loaded_model import LoadedModel, load_model

pytestmark = pytest.mark.usefixtures("commands_in_process")

COUNTS = 4096 / (2.0 * np.pi)
TURN = 2.0 * np.pi
INERTIA, DAMPING = 0.02, 0.05


def record_pendulums(path: Path, seed: int, scale: float = 1.0, slower: int = 1) -> Path:
    """Record two pendulums with all angles times ``scale``, ``slower`` times as slow."""
    setpoints = np.repeat(reference(seed, 2.0, 2)[: 20000 // slower], slower, axis=0)
    moved = simulate(setpoints, viscous=0.02)
    sent, seen = np.arange(0, len(setpoints), 100), np.arange(0, len(setpoints), 50)
    noise = 1e-4 * np.random.default_rng(seed).standard_normal((len(seen), 2))
    write(
        path,
        JOINTS,
        sent * STEP,
        scale * setpoints[sent],
        seen * STEP,
        scale * (moved[seen] + noise),
    )
    return path


def record_wheel(path: Path, mode: str, *, effort: float = 0.4, scale: float = 1.0) -> Path:
    """Record one wheel under oscillating effort commands, or under a servo without a limit."""
    time = np.arange(round(2.0 / STEP)) * STEP
    held = (np.arange(len(time)) // 100) * 100
    u = (effort * np.sin(TURN * 0.7 * time))[held]
    q, v, out = 0.0, 0.0, np.empty(len(time))
    for k in range(len(time)):
        out[k] = q
        demand = u[k] if mode == "effort" else KP * (40.0 * u[k] - q) - KV * v
        v += STEP * (demand - DAMPING * v) / INERTIA
        q += STEP * v
    sent, seen = np.arange(0, len(time), 100), np.arange(0, len(time), 50)
    commands = u[sent] if mode == "effort" else 40.0 * u[sent]
    noise = 1e-4 * np.random.default_rng(0).standard_normal(len(seen))
    write(
        path, ("wheel",), sent * STEP, commands[:, None], seen * STEP,
        (scale * (out[seen] + noise))[:, None], mode=mode,
    )  # fmt: skip
    return path


def wheel_model(folder: Path, actuator: str) -> LoadedModel:
    (folder / "model.xml").write_text(
        '<mujoco><compiler angle="radian"/><option gravity="0 0 0"/><worldbody><body>'
        f'<inertial pos="0 0 0" mass="1" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>'
        f'<joint name="wheel" axis="0 0 1" damping="{DAMPING}"/></body></worldbody>'
        f'<actuator><{actuator} name="wheel" joint="wheel"/></actuator></mujoco>'
    )
    return load_model(folder / "model.xml")


@pytest.fixture
def pendulums(tmp_path: Path) -> LoadedModel:
    (tmp_path / "model.xml").write_text(mjcf())
    return load_model(tmp_path / "model.xml")


def read(loaded: LoadedModel, *paths: Path) -> TrialSet:
    return read_trials(paths, (), loaded.topics, loaded.realization.structure)


@pytest.mark.parametrize(
    ("scale", "unit"),
    [(np.degrees(1.0), "degrees"), (COUNTS, r"counts of \d+ a turn")],
    ids=["degrees", "counts"],
)
def test_states_and_commands_in_the_same_wrong_unit_are_refused(
    pendulums: LoadedModel,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    scale: float,
    unit: str,
) -> None:
    files = [record_pendulums(tmp_path / f"{k}.mcap", k, scale) for k in range(2)]
    words = ["diagnose", "--seconds", "0", str(tmp_path / "model.xml"), *map(str, files), "--out"]
    assert cli.main([*words, str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert re.fullmatch(
        rf"pytest-twin diagnose: \S+0\.mcap: states and commands seem to be in {unit}: in this "
        r"unit the model follows them \(expected rad \(m for a sliding joint\); convert the "
        r"recording\)\n",
        message,
    ), message


def test_of_several_recordings_those_in_degrees_are_left_out(
    pendulums: LoadedModel, tmp_path: Path
) -> None:
    good = [record_pendulums(tmp_path / f"good{k}.mcap", k) for k in range(3)]
    odd = record_pendulums(tmp_path / "odd.mcap", 5, np.degrees(1.0))
    notes: list[str] = []
    found = drop_other_units(pendulums.realization, read(pendulums, odd, *good), notes)
    assert {t.path for t in (*found.fit, *found.held_out)} == set(good)
    (note,) = notes
    assert note.startswith(f"left out: {odd}: states and commands seem to be in degrees")


def test_degrees_are_detected_if_most_recordings_are_slow(
    pendulums: LoadedModel, tmp_path: Path
) -> None:
    """A servo follows a slow motion in every unit, with a larger error in a wrong one."""
    slow = [
        record_pendulums(tmp_path / f"slow{k}.mcap", k, np.degrees(1.0), slower=2) for k in range(2)
    ]
    odd = read(pendulums, *slow, record_pendulums(tmp_path / "fast.mcap", 2, np.degrees(1.0)))
    with pytest.raises(RecordingError, match="states and commands seem to be in degrees"):
        drop_other_units(pendulums.realization, odd, [])


def test_states_in_degrees_under_effort_commands_are_refused(tmp_path: Path) -> None:
    loaded = wheel_model(tmp_path, "motor")
    odd = read(loaded, record_wheel(tmp_path / "a.mcap", "effort", scale=np.degrees(1.0)))
    with pytest.raises(
        RecordingError, match="states seem to be in degrees: in this unit the model"
    ):
        drop_other_units(loaded.realization, odd, [])


@pytest.mark.parametrize(
    ("mode", "actuator"),
    [
        ("effort", "motor"),
        # The servo is so weak that it could follow this recording only if it was in degrees.
        ("position", f'position kp="{KP}" kv="{KV}" forcerange="-0.2 0.2"'),
    ],
    ids=["effort commands", "weak position servo"],
)
def test_a_wheel_in_rad_that_turns_several_times_is_accepted(
    tmp_path: Path, mode: str, actuator: str
) -> None:
    loaded = wheel_model(tmp_path, actuator)
    trials = read(loaded, record_wheel(tmp_path / "a.mcap", mode, effort=4.0))
    assert np.ptp(trials.fit[0].position) > 4 * TURN
    assert drop_other_units(loaded.realization, trials, []) is trials


@pytest.mark.parametrize("scale", [1.0, 8.0], ids=["in rad", "in an unknown unit"])
def test_a_recording_that_the_model_follows_in_no_other_unit_is_accepted(
    pendulums: LoadedModel, tmp_path: Path, scale: float
) -> None:
    """With the unknown unit, the model follows the recording in no unit."""
    trials = read(pendulums, record_pendulums(tmp_path / "a.mcap", 3, scale))
    assert drop_other_units(pendulums.realization, trials, []) is trials


def test_effort_commands_for_a_model_with_a_position_servo_are_no_unit_error(
    tmp_path: Path,
) -> None:
    """The missing actuator is reported by a later step."""
    loaded = wheel_model(tmp_path, f'position kp="{KP}" kv="{KV}"')
    trials = read(loaded, record_wheel(tmp_path / "a.mcap", "effort", effort=4.0))
    assert drop_other_units(loaded.realization, trials, []) is trials
