"""Dead zone and limits of a drive, from measured effort and the motion in the closed loop."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import mujoco
import numpy as np
import pytest
from driven_pendulum import Motion, Plant, write_run
from test_further_effects import (
    DAMPING,
    Drive,
    exact,
    limited,
    with_dead_zone,
    with_lag,
    with_rolloff,
)
from test_further_effects import INTERVAL as OTHER_INTERVAL
from test_identify_simulation import MODEL, NOMINAL, REAL

from pytest_twin.effects import catalogue
from pytest_twin.formats.schema import load_schema
from pytest_twin.identification.drive_effects import changed_attributes
from pytest_twin.identification.effort.identify_effort import identify_effort
from pytest_twin.identification.effort.servo_gains import servo_gains
from pytest_twin.identification.identify_files import identify_files
from pytest_twin.identification.measured_recordings import MeasuredRecordings, read_measured
from pytest_twin.realization import load
from pytest_twin.recording_options import NO_OPTIONS
from pytest_twin.signals import NO_SIGNALS
from pytest_twin.twin import DEFAULT_TOPICS, load_twin

INTERVAL = 0.001
"""Step of the plant, s."""


def write(path: Path, seed: int, drive: Drive, effort_noise: float = 5e-3) -> Path:
    """Write a run of the real pendulum with a drive; standard deviation of its effort in N*m."""
    servo = f'<position name="servo" joint="swing" kp="{{kp}}" kv="{DAMPING}"/>'
    text = MODEL.replace(servo, '<motor name="servo" joint="swing"/>')
    assert text != MODEL

    def actuate(data: mujoco.MjData, command: float) -> None:
        position, velocity = float(data.qpos[0]), float(data.qvel[0])
        data.ctrl[0] = drive(REAL["kp"] * (command - position) - DAMPING * velocity, velocity)

    plant = Plant(text.format(**REAL), actuate, INTERVAL)
    return write_run(path, seed, plant, Motion(5.0, 0.3, highest=1.5), (1e-3, effort_noise))


def identified(folder: Path, drive: Drive) -> dict[str, Any]:
    """``identification.json`` of two runs to fit and one held out."""
    (folder / "model.xml").write_text(MODEL.format(**NOMINAL))
    *fit, held = (write(folder / f"{n}.csv", seed, drive) for seed, n in enumerate("abc", 1))
    (folder / "out").mkdir()
    return identify_files({
        "model": str(folder / "model.xml"),
        "recordings": [str(path) for path in fit],
        "held_out": [str(held)],
        "out": str(folder / "out"),
        "name": "drive",
        "options": {"command_between": "interpolated"},
    })  # fmt: skip


@pytest.fixture(scope="module")
def saturated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("saturated")
    return folder, identified(folder, limited(1.0))


def stage_of(document: dict[str, Any], name: str) -> dict[str, Any]:
    (stage,) = (one for one in document["stages"] if one["stage"] == name)
    return stage


def test_the_limit_of_a_drive_is_identified_beside_its_measured_effort(
    saturated: tuple[Path, dict[str, Any]],
) -> None:
    document = saturated[1]
    jsonschema.validate(document, load_schema("results/identify.schema.json"))
    assert document["way"] == "measured effort"
    inverse = document["parameters"]["swing.torque_saturation.inverse_limit"]
    low, high = inverse["ci95"]
    assert low < 1.0 < high
    assert high - low < 0.1
    assert inverse["stage"] == "drive"
    assert "swing.torque_saturation" in stage_of(document, "drive")["parameters"]


def test_no_effect_takes_up_the_errors_of_the_friction_from_effort(
    saturated: tuple[Path, dict[str, Any]],
) -> None:
    """A filter of velocities and a scale of the encoder, which the plant lacks, would lower it."""
    together = stage_of(saturated[1], "closed_loop")["parameters"]
    effects = {name.split(".")[1] for name in together}
    assert "torque_saturation" in effects
    assert {catalogue()[effect].stage for effect in effects} <= {"drive", "friction"}


def test_the_model_with_the_limit_predicts_the_held_out_motion(
    saturated: tuple[Path, dict[str, Any]],
) -> None:
    error = saturated[1]["held_out"]["swing"]
    assert error["position_rms"] < 0.05 * error["position_rms_nominal"]
    assert stage_of(saturated[1], "closed_loop")["state"] == "accepted"
    assert not list((saturated[0] / "out").glob("with_*"))


def test_the_covariance_has_the_effects_of_the_drive_too(
    saturated: tuple[Path, dict[str, Any]],
) -> None:
    document = saturated[1]
    names = document["covariance"]["names"]
    matrix = np.array(document["covariance"]["matrix"])
    assert matrix.shape == (len(names),) * 2
    at = names.index("swing.torque_saturation.inverse_limit")
    low, high = document["parameters"][names[at]]["ci95"]
    assert 3.92 * np.sqrt(matrix[at, at]) == pytest.approx(high - low, rel=1e-3)
    assert "swing.viscous_friction" in names


def test_a_twin_takes_the_limit_from_the_record(saturated: tuple[Path, dict[str, Any]]) -> None:
    folder, document = saturated
    (folder / "record.json").write_text(json.dumps(document))
    (folder / "twin.yaml").write_text("model: model.xml\nfit: [{file: record.json}]\n")
    robot = load(folder / "model.xml", twin=load_twin(folder / "twin.yaml"))
    fitted = load(folder / "out" / "realization" / "model.xml")
    assert robot.model.actuator_forcerange[0] == pytest.approx([-1.0, 1.0], rel=0.05)
    assert changed_attributes(fitted.model, robot.model) == {}


@pytest.mark.nightly
def test_a_dead_zone_is_identified_and_only_the_realization_contains_it(tmp_path: Path) -> None:
    document = identified(tmp_path, with_dead_zone(0.3))
    low, high = document["parameters"]["swing.dead_zone"]["ci95"]
    assert low < 0.3 / REAL["kp"] < high
    error = document["held_out"]["swing"]
    assert error["position_rms"] < 0.1 * error["position_rms_nominal"]
    (note,) = (one for one in document["notes"] if "only realization/ contains" in one)
    assert "dead_zone of swing" in note
    assert "name the folder of this identification as its model:" in note


def test_a_servo_whose_effort_follows_its_law_gets_no_further_effects(tmp_path: Path) -> None:
    document = identified(tmp_path, exact())
    assert document["parameters"]["swing.servo_stiffness"]["value"] == pytest.approx(8.0, rel=0.01)
    assert not any("dead_zone" in name or "limit" in name for name in document["parameters"])
    assert stage_of(document, "closed_loop")["state"] == "accepted"


@pytest.mark.parametrize(
    ("drive", "effort_noise", "follows"),
    [
        (exact(), 0.05, True),
        (with_dead_zone(0.05), 5e-3, False),
        (with_rolloff(4.0), 5e-3, False),
        (with_lag(0.04 * OTHER_INTERVAL / INTERVAL), 5e-3, False),
    ],
    ids=["noise of 3 %", "dead zone of 2 %", "roll-off", "lag of 40 ms"],
)
def test_only_systematic_differences_from_the_law_of_a_servo_count(
    tmp_path: Path, drive: Drive, effort_noise: float, follows: bool
) -> None:
    (tmp_path / "model.xml").write_text(MODEL.format(**NOMINAL))
    robot = load(tmp_path / "model.xml")
    runs = [write(tmp_path / f"{n}.csv", k, drive, effort_noise) for k, n in enumerate("ab", 1)]
    read = [
        one
        for path in runs
        for one in read_measured(path, robot, DEFAULT_TOPICS, NO_OPTIONS, NO_SIGNALS)
    ]
    found = identify_effort(robot, MeasuredRecordings(tuple(read), ()), NO_SIGNALS)
    gains = servo_gains(robot, read, found, NO_SIGNALS)
    assert all(gain.misfit < 0.01 for gain in gains) == follows
    assert len(gains) == 1


def test_attributes_that_differ_are_those_of_fit() -> None:
    before = mujoco.MjModel.from_xml_string(MODEL.format(**NOMINAL))
    after = mujoco.MjModel.from_xml_string(MODEL.format(**{**NOMINAL, "kp": 8.0, "friction": 0.1}))
    found = changed_attributes(before, after)
    assert found["joint"] == {"swing": {"frictionloss": pytest.approx(0.1)}}
    servo = found["actuator"]["servo"]
    assert set(servo) == {"gainprm", "biasprm"}
    assert servo["gainprm"][0] == pytest.approx(8.0)
    assert changed_attributes(before, before) == {}
