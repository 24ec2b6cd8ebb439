"""Gains of position servos from command, position and measured effort."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import mujoco
import numpy as np
import pytest
from arms import JOINTS, NOMINAL, REAL, TRUE
from fourier_motion import fourier

from pytest_twin.formats.schema import load_schema
from pytest_twin.identification import closed_loop
from pytest_twin.identification.drive_effects import DriveRecordings, drive_recordings
from pytest_twin.identification.effort.identify_effort import identify_effort
from pytest_twin.identification.effort.servo_gains import servo_gains
from pytest_twin.identification.fit_patches import patches_of
from pytest_twin.identification.identify_files import identify_files
from pytest_twin.identification.measured_recordings import MeasuredRecordings, read_measured
from pytest_twin.identification.write import ModelChanges
from pytest_twin.realization import Realization, load
from pytest_twin.recording_options import NO_OPTIONS
from pytest_twin.signals import NO_SIGNALS
from pytest_twin.twin import DEFAULT_TOPICS, load_twin

GAINS = {"shoulder": (900.0, 40.0), "elbow": (300.0, 12.0)}
"""Stiffness (N*m/rad) and damping (N*m*s/rad) of the real servos."""
SERVOS = """<actuator>
    <position name="s1" joint="shoulder" kp="{}" kv="{}" gear="{gear}"/>
    <position name="s2" joint="elbow" kp="{}" kv="{}"/>
  </actuator></mujoco>"""
GEAR = 2.0
RATE, INNER = 200.0, 5


def model_text(values: dict[str, float], factor: float) -> str:
    """MJCF of the arm with servos whose gains are ``factor`` times the real ones."""
    numbers = [factor * value for joint in JOINTS for value in GAINS[joint]]
    numbers[:2] = [value / GEAR**2 for value in numbers[:2]]
    text = TRUE.format(**values).replace("</mujoco>", SERVOS.format(*numbers, gear=GEAR))
    head = '<option timestep="0.001" integrator="implicitfast"/><worldbody>'
    return text.replace("<worldbody>", head)


def write_run(path: Path, seed: int, law: str) -> Path:
    """Write commands, positions and efforts of the real arm.

    Args:
        law: ``servo``, or ``other`` for a controller that adds the torque of gravity.
    """
    model = mujoco.MjModel.from_xml_string(model_text(REAL, 1.0))
    data = mujoco.MjData(model)
    random = np.random.default_rng(seed)
    time = np.arange(round(12.0 * RATE)) / RATE
    wave, _, _ = fourier(random, time, 2, 5, 0.1, (0.2, 1.2))
    # A replay starts at rest, because no velocity is recorded.
    wave = wave[0] + (wave - wave[0]) * np.clip(time - 0.5, 0.0, 1.0)[:, None] ** 2
    data.qpos[:] = wave[0]
    data.ctrl[:] = wave[0] * [GEAR, 1.0]
    mujoco.mj_step(model, data, 2000)
    rows = []
    for at, asked in enumerate(wave[:-1]):
        for part in range(INNER):
            data.ctrl[:] = (asked + part / INNER * (wave[at + 1] - asked)) * [GEAR, 1.0]
            mujoco.mj_forward(model, data)
            data.qfrc_applied[:] = data.qfrc_bias if law == "other" else 0.0
            if not part:
                effort = data.qfrc_actuator + data.qfrc_applied + 0.05 * random.standard_normal(2)
                noisy = data.qpos + 1e-5 * random.standard_normal(2)
                rows.append([time[at], *noisy, *effort, *asked])
            mujoco.mj_step(model, data)
    names = [f"{joint}.{what}" for what in ("position", "effort", "command") for joint in JOINTS]
    head = ",".join(["time", *names])
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=head, comments="")
    return path


def identified(folder: Path) -> dict[str, Any]:
    (folder / "model.xml").write_text(model_text(NOMINAL, 0.7))
    runs = [write_run(folder / f"{name}.csv", seed, "servo") for seed, name in enumerate("abc")]
    (folder / "out").mkdir()
    return identify_files({
        "model": str(folder / "model.xml"),
        "recordings": [str(path) for path in runs[:2]],
        "held_out": [str(runs[2])],
        "out": str(folder / "out"),
        "name": "servos",
        "options": {"command_between": "interpolated"},
    })  # fmt: skip


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("servos")
    return folder, identified(folder)


def test_stiffness_and_damping_of_the_servos_are_identified(
    cell: tuple[Path, dict[str, Any]],
) -> None:
    document = cell[1]
    jsonschema.validate(document, load_schema("results/identify.schema.json"))
    for joint, true in GAINS.items():
        for name, value in zip(("servo_stiffness", "servo_damping"), true, strict=True):
            one = document["parameters"][f"{joint}.{name}"]
            assert one["value"] == pytest.approx(value, rel=0.1)
            assert one["prior"] == pytest.approx(0.7 * value)
    assert document["parameters"]["elbow.servo_stiffness"]["unit"] == "N*m/rad"


def test_the_closed_loop_stage_is_accepted_by_the_simulated_position_error(
    cell: tuple[Path, dict[str, Any]],
) -> None:
    (stage,) = (one for one in cell[1]["stages"] if one["stage"] == "closed_loop")
    assert stage["state"] == "accepted"
    assert "servo stiffness from effort and tracking error: shoulder" in stage["why"]
    assert set(stage["parameters"]) == {
        f"{joint}.servo_{name}" for joint in JOINTS for name in ("stiffness", "damping")
    }
    for error in cell[1]["held_out"].values():
        assert error["position_rms"] < 0.2 * error["position_rms_nominal"]


def test_the_fitted_model_has_the_gains(cell: tuple[Path, dict[str, Any]]) -> None:
    folder, document = cell
    fitted = load(folder / "out" / "realization" / "model.xml").model
    stiffness = -fitted.actuator_biasprm[:, 1] * np.array([GEAR**2, 1.0])
    damping = -fitted.actuator_biasprm[:, 2] * np.array([GEAR**2, 1.0])
    for k, joint in enumerate(JOINTS):
        parameters = document["parameters"]
        assert stiffness[k] == pytest.approx(
            parameters[f"{joint}.servo_stiffness"]["value"], rel=1e-4
        )
        assert damping[k] == pytest.approx(parameters[f"{joint}.servo_damping"]["value"], rel=1e-4)
    assert set(document["fit"]["actuator"]) == {"s1", "s2"}
    assert not (folder / "out" / "with_servo_gains").exists()


def test_a_twin_takes_the_gains_from_the_record(cell: tuple[Path, dict[str, Any]]) -> None:
    folder, document = cell
    (folder / "record.json").write_text(json.dumps(document))
    (folder / "twin.yaml").write_text("model: model.xml\nfit: [{file: record.json}]\n")
    robot = load(folder / "model.xml", twin=load_twin(folder / "twin.yaml"))
    fitted = load(folder / "out" / "realization" / "model.xml").model
    assert robot.model.actuator_biasprm == pytest.approx(fitted.actuator_biasprm, rel=1e-4)
    assert robot.model.actuator_gainprm == pytest.approx(fitted.actuator_gainprm, rel=1e-4)


def test_an_effort_that_follows_another_law_gives_no_gains(tmp_path: Path) -> None:
    (tmp_path / "model.xml").write_text(model_text(NOMINAL, 0.7))
    robot = load(tmp_path / "model.xml")
    for law, count in (("servo", 2), ("other", 0)):
        run = write_run(tmp_path / f"{law}.csv", 0, law)
        (one,) = read_measured(run, robot, DEFAULT_TOPICS, NO_OPTIONS, NO_SIGNALS)
        found = identify_effort(robot, MeasuredRecordings((one,), ()), NO_SIGNALS)
        gains = servo_gains(robot, [one], found, NO_SIGNALS)
        assert len(gains) == count
        assert all(gain.misfit < 0.01 for gain in gains)


def test_recordings_of_a_declared_controller_give_no_gains(tmp_path: Path) -> None:
    (tmp_path / "model.xml").write_text(model_text(NOMINAL, 0.7))
    (tmp_path / "twin.yaml").write_text(
        "model: model.xml\ncontrollers: {soft: {s1: {kp: 100}, s2: {kp: 100}}}\n"
    )
    robot = load(tmp_path / "model.xml", twin=load_twin(tmp_path / "twin.yaml"))
    run = write_run(tmp_path / "a.csv", 0, "servo")
    (one,) = read_measured(run, robot, DEFAULT_TOPICS, NO_OPTIONS, NO_SIGNALS)
    found = identify_effort(robot, MeasuredRecordings((one,), ()), NO_SIGNALS)
    assert len(servo_gains(robot, [one], found, NO_SIGNALS)) == 2
    soft = replace(one, metadata={"controller": "soft"})
    assert servo_gains(robot, [soft], found, NO_SIGNALS) == []


def test_drives_are_fitted_beside_the_gains_of_servos_that_follow_their_law(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "model.xml").write_text(model_text(NOMINAL, 0.7))
    robot = load(tmp_path / "model.xml")
    run = write_run(tmp_path / "a.csv", 0, "servo")
    (one,) = read_measured(run, robot, DEFAULT_TOPICS, NO_OPTIONS, NO_SIGNALS)
    measured = MeasuredRecordings((one,), ())
    found = identify_effort(robot, measured, NO_SIGNALS)
    shoulder, elbow = servo_gains(robot, [one], found, NO_SIGNALS)
    given = (measured, DEFAULT_TOPICS, NO_OPTIONS, NO_SIGNALS, found)
    assert drive_recordings(*given, [shoulder, elbow]) is None
    recordings = drive_recordings(*given, [shoulder, replace(elbow, misfit=0.05)])
    assert recordings is not None
    assert recordings.known == (shoulder,)
    stiffness = []

    def fit_none(fitted: Realization, recordings: DriveRecordings, folder: Path) -> None:
        stiffness.extend(-fitted.model.actuator_biasprm[:, 1] * [GEAR**2, 1.0])

    monkeypatch.setattr(closed_loop, "fit_drives", fit_none)
    (tmp_path / "out").mkdir()
    folder = tmp_path / "out/realization"
    folder.mkdir()
    trials = closed_loop.trials_of(robot, [run], DEFAULT_TOPICS, NO_OPTIONS)
    changes = ModelChanges(patches_of(robot, found))
    loop = closed_loop.close_loop(robot, changes, [shoulder, elbow], recordings, trials, folder)
    true, _ = GAINS["shoulder"]
    nominal = 0.7 * GAINS["elbow"][0]
    assert stiffness == pytest.approx([true, nominal], rel=0.02)
    assert set(loop.parameters) == {
        f"{joint}.servo_{n}" for joint in JOINTS for n in ("stiffness", "damping")
    }
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["realization"]
