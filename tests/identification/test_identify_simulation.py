"""Identification from commands and positions only, for a pendulum with known parameters."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import mujoco
import numpy as np
import pytest

from pytest_twin import cli
from pytest_twin.formats.schema import load_schema

pytestmark = pytest.mark.usefixtures("commands_in_process")

MODEL = """<mujoco model="pendulum">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <inertial pos="0 0 -0.2" mass="1" diaginertia="0.002 0.002 0.002"/>
      <joint name="swing" axis="0 1 0" damping="{damping}" frictionloss="{friction}"
             armature="0.01"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="swing" kp="{kp}" kv="0.3"/></actuator>
</mujoco>"""
NOMINAL = {"damping": 0.05, "friction": 0.0, "kp": 10.0}
REAL = {"damping": 0.35, "friction": 0.15, "kp": 8.0}


def write_trial(path: Path, seed: int) -> Path:
    """Write the position commands and measured positions of the real pendulum."""
    model = mujoco.MjModel.from_xml_string(MODEL.format(**REAL))
    data = mujoco.MjData(model)
    random = np.random.default_rng(seed)
    frequency, phase = random.uniform(0.2, 1.5, 4), random.uniform(0, 2 * np.pi, 4)
    rows = []
    for at in range(250):
        time = at * 0.02
        command = 0.3 * np.sin(2 * np.pi * frequency * time + phase).sum()
        rows.append((time, data.qpos[0] + 1e-4 * random.standard_normal(), command))
        data.ctrl[0] = command
        mujoco.mj_step(model, data, 4)
    np.savetxt(
        path, rows, fmt="%.9g", delimiter=",", header="time,swing.position,swing.command",
        comments="",
    )  # fmt: skip
    return path


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("cell")
    (folder / "model.xml").write_text(MODEL.format(**NOMINAL))
    paths = [str(write_trial(folder / f"{name}.csv", seed)) for name, seed in
             (("one", 1), ("two", 2), ("check", 3))]  # fmt: skip
    words = ["identify", str(folder / "model.xml"), *paths[:2], "--held-out", paths[2]]
    cli.main([*words, "--command-between", "held", "--out", str(folder / "identified")])
    return folder, json.loads((folder / "identified/identification.json").read_text())


def test_the_document_is_valid_and_has_all_stages(found: tuple[Path, dict]) -> None:
    jsonschema.validate(found[1], load_schema("results/identify.schema.json"))
    assert found[1]["way"] == "commands and positions"
    assert [one["stage"] for one in found[1]["stages"]] == [
        "delay", "encoder", "gravity", "inertia", "friction", "drive", "closed_loop",
    ]  # fmt: skip


def test_friction_and_controller_gain_are_identified(found: tuple[Path, dict]) -> None:
    parameters = found[1]["parameters"]
    for name, true in (
        ("coulomb_friction", REAL["friction"]),
        ("controller_gain.stiffness_error", REAL["kp"] / NOMINAL["kp"] - 1.0),
        ("controller_gain.damping_error", 0.0),
    ):
        low, high = parameters[f"swing.{name}"]["ci95"]
        assert low <= true <= high, name
    gain = parameters["swing.controller_gain.stiffness_error"]
    assert gain["value"] == pytest.approx(-0.2, abs=0.05)


def test_only_the_sum_of_friction_and_damping_of_the_servo_is_determined(
    found: tuple[Path, dict],
) -> None:
    """A servo with 0.3 N*m*s/rad more damping moves as one in a joint with more friction."""
    parameters = found[1]["parameters"]
    friction = parameters.get("swing.viscous_friction", {"value": 0.0})["value"]
    of_servo = 0.3 * parameters["swing.controller_gain.damping_error"]["value"]
    assert friction + of_servo == pytest.approx(REAL["damping"] - NOMINAL["damping"], abs=0.03)
    low, high = parameters["swing.controller_gain.damping_error"]["ci95"]
    assert high - low > 1.0
    assert {one["expression"] for one in found[1]["unobservable"]} <= {"swing.viscous_friction"}


def test_a_stage_names_the_information_of_each_recording(found: tuple[Path, dict]) -> None:
    stages = {one["stage"]: one for one in found[1]["stages"]}
    assert set(stages["drive"]["data"]) == {"one.csv", "two.csv"}
    assert sum(stages["drive"]["data"].values()) == pytest.approx(1.0)


def test_effects_that_the_motion_excludes_are_not_called_undetermined(
    found: tuple[Path, dict],
) -> None:
    for name in ("delay", "encoder", "gravity"):
        (stage,) = (one for one in found[1]["stages"] if one["stage"] == name)
        assert stage["why"].startswith("the model's values hold")


def test_held_out_positions_are_predicted(found: tuple[Path, dict]) -> None:
    error = found[1]["held_out"]["swing"]
    assert error["position_rms"] < 0.1 * error["position_rms_nominal"]
    assert error["position_unit"] == "rad"


def test_the_written_twin_replays_with_the_stated_held_out_error(
    found: tuple[Path, dict], tmp_path: Path
) -> None:
    folder, document = found
    words = ["replay", str(folder / "identified"), str(folder / "check.csv")]
    assert cli.main([*words, "--command-between", "held", "--out", str(tmp_path / "p.mcap")]) == 0
    summary = json.loads((tmp_path / "p.json").read_text())
    error = document["held_out"]["swing"]["position_rms"]
    assert summary["joints"]["swing"]["rms"] == pytest.approx(error, rel=0.3, abs=1e-3)
