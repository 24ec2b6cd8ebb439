"""``pytest-twin export`` for simulators that take configurations of actuators."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import re
import subprocess
import sys
import types
import zipfile
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from exported import Effect, Robot, diagnosis_in, robot_in

from pytest_twin.cli import main

pytestmark = pytest.mark.usefixtures("commands_in_process")
MJLAB = "TWIN_MJLAB_PYTHON"
"""Environment variable with the Python of an environment that has mjlab."""
NEWTON = "TWIN_NEWTON_PYTHON"
"""The same for Newton with newton-usd-schemas and usd-core."""
DRAKE = "TWIN_DRAKE_PYTHON"
"""The same for drake."""
MJX = "TWIN_MJX_PYTHON"
"""The same for mujoco-mjx."""
EFFECTS: list[Effect] = [
    ("coulomb_friction", 1, {"coulomb": 0.1}),
    ("viscous_friction", 0, {"coefficient": 0.1}),
    ("armature", 1, {"inertia": 0.004}),
    ("controller_gain", 1, {"stiffness_error": 0.3, "damping_error": -0.2}),
    ("torque_saturation", 0, {"inverse_limit": 1.0}),
]
ISAACLAB_WHEELS = "TWIN_ISAACLAB_WHEELS"
"""Environment variable with the wheels of Isaac Lab whose fields are compared, by os.pathsep."""
# Fields of isaaclab.actuators in versions 2.3 and 3.0.
BASE = {
    "joint_names_expr", "effort_limit", "velocity_limit", "effort_limit_sim", "velocity_limit_sim",
    "stiffness", "damping", "armature", "friction", "dynamic_friction", "viscous_friction",
}  # fmt: skip
ISAACLAB = {
    "IdealPDActuatorCfg": BASE,
    "DelayedPDActuatorCfg": BASE | {"min_delay", "max_delay"},
    "DCMotorCfg": BASE | {"saturation_effort"},
}


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return robot_in(tmp_path_factory.mktemp("robot"))


def exported(
    robot: Robot, folder: Path, target: str, effects: list[Effect]
) -> tuple[Path, dict[str, Any]]:
    out = folder / "out"
    diagnosis = diagnosis_in(folder, robot, effects)
    assert main(["export", str(diagnosis), "--to", target, "--out", str(out)]) == 0
    return out, json.loads((out / "export.json").read_text())


def actuators(
    path: Path, monkeypatch: pytest.MonkeyPatch, step: float, *, version: int = 2
) -> dict[str, Any]:
    """The configurations of a written module, with classes that only know their fields."""
    renamed = {"effort_limit", "velocity_limit"}

    def recorded(name: str, fields: set[str]) -> Any:
        def make(**given: Any) -> dict[str, Any]:
            assert set(given) <= fields, set(given) - fields
            return {"class": name, **given}

        if version == 3:
            fields = fields - renamed | {f"actuator_{field}" for field in renamed}
            vars(make)["actuator_effort_limit"] = None
        return make

    package = types.ModuleType("isaaclab.actuators")
    for name, fields in ISAACLAB.items():
        setattr(package, name, recorded(name, fields))
    monkeypatch.setitem(sys.modules, "isaaclab", types.ModuleType("isaaclab"))
    monkeypatch.setitem(sys.modules, "isaaclab.actuators", package)
    spec = importlib.util.spec_from_file_location("written", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found: dict[str, Any] = module.actuators(step)
    return found


@pytest.mark.skipif(ISAACLAB_WHEELS not in os.environ, reason=f"{ISAACLAB_WHEELS} names no wheel")
def test_the_published_classes_of_isaac_lab_have_these_fields() -> None:
    for wheel in os.environ[ISAACLAB_WHEELS].split(os.pathsep):
        with zipfile.ZipFile(wheel) as files:
            names = [
                n for n in files.namelist() if re.search(r"(^|/)isaaclab/actuators/\w+_cfg", n)
            ]
            classes = [c for n in names for c in ast.parse(files.read(n)).body
                       if isinstance(c, ast.ClassDef)]  # fmt: skip
        own = {c.name: {s.target.id for s in c.body if isinstance(s, ast.AnnAssign)
                        and isinstance(s.target, ast.Name)} for c in classes}  # fmt: skip
        bases = {c.name: [b.id for b in c.bases if isinstance(b, ast.Name)] for c in classes}
        for name in ISAACLAB:
            kinds = [name]
            for kind in kinds:
                kinds += bases.get(kind, [])
            fields = set().union(*(own.get(kind, set()) for kind in kinds))
            assert fields >= ISAACLAB[name], (wheel, name, ISAACLAB[name] - fields)
            if "-3." in wheel:
                assert {"actuator_effort_limit", "actuator_velocity_limit"} <= fields


def test_isaac_lab_gets_gains_limits_friction_and_armature(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, document = exported(robot, tmp_path, "isaaclab", EFFECTS)
    written = actuators(out / "isaaclab_actuators.py", monkeypatch, 0.002)
    assert document["checked"] == "schema"
    assert {row["verdict"] for row in document["rows"]} == {"kept"}
    left, right = written["left"], written["right"]
    assert left["effort_limit"] == pytest.approx(1.0)
    assert left["viscous_friction"] == pytest.approx(0.15)
    assert right["stiffness"] == pytest.approx(6.0 * 1.3)
    assert right["damping"] == pytest.approx(0.15 * 0.8)
    assert right["armature"] == pytest.approx(0.007)
    assert right["dynamic_friction"] == pytest.approx(0.1)
    assert right["friction"] == pytest.approx(0.1)


def test_isaac_lab_3_gets_the_limits_by_their_new_names(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    motor = {"inverse_no_load_speed": 0.2, "stall": 1.5}
    out, _ = exported(robot, tmp_path, "isaaclab", [("torque_speed_limit", 0, motor)])
    old, new = (
        actuators(out / "isaaclab_actuators.py", monkeypatch, 0.002, version=v)["left"]
        for v in (2, 3)
    )
    for name in ("effort_limit", "velocity_limit"):
        assert old[name] == new[f"actuator_{name}"] > 0.0


def test_isaac_lab_gets_both_levels_of_stribeck_friction(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    law = {"coulomb": 0.05, "stiction_excess": 0.1, "stribeck_velocity": 0.1}
    out, _ = exported(robot, tmp_path, "isaaclab", [("stribeck_friction", 1, law)])
    right = actuators(out / "isaaclab_actuators.py", monkeypatch, 0.002)["right"]
    assert right["dynamic_friction"] == pytest.approx(0.05)
    assert right["friction"] == pytest.approx(0.15)


def test_a_delay_is_whole_steps_of_the_time_step_that_is_used(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    effects: list[Effect] = [("command_delay", 1, {"delay": 0.0213})]
    out, document = exported(robot, tmp_path, "isaaclab", effects)
    for step, steps in ((0.002, 11), (0.005, 4)):
        delayed = actuators(out / "isaaclab_actuators.py", monkeypatch, step)["right"]
        assert delayed["class"] == "DelayedPDActuatorCfg"
        assert (delayed["min_delay"], delayed["max_delay"]) == (steps, steps)
    (row,) = document["rows"]
    assert row["verdict"] == "changed"
    assert "rounded to whole time steps, by up to 0.7 ms" in row["after"]


def test_what_an_actuator_cannot_hold_is_lost(robot: Robot, tmp_path: Path) -> None:
    effects: list[Effect] = [
        ("backlash", 0, {"gap": 0.05, "tooth_compliance": 0.01}),
        ("dead_zone", 1, {"width": 0.03, "of_effort": 0.0}),
    ]
    _, document = exported(robot, tmp_path, "isaaclab", effects)
    assert [row["verdict"] for row in document["rows"]] == ["lost", "lost"]


def stepped(
    robot: Robot, folder: Path, target: str, python: str, effects: list[Effect]
) -> dict[str, dict[str, Any]]:
    """Feature -> row of an export that its own simulator stepped on the held-out recording."""
    diagnosis, out = diagnosis_in(folder, robot, effects), folder / "out"
    arguments = ["export", str(diagnosis), "--to", target, "--out", str(out), "--engine", python]
    assert main([*arguments, "--held-out", str(folder / "held_out.mcap")]) == 0
    document = json.loads((out / "export.json").read_text())
    assert document["checked"] == "stepped"
    return {row["feature"]: row for row in document["rows"]}


@pytest.mark.skipif(MJLAB not in os.environ, reason=f"{MJLAB} names no environment with mjlab")
@pytest.mark.parametrize(
    "effects",
    [
        EFFECTS,
        [("command_delay", 1, {"delay": 0.0213})],
        [("torque_speed_limit", 0, {"inverse_no_load_speed": 0.2, "stall": 1.5})],
    ],
    ids=["drives", "delay", "motor"],
)
def test_mjlab_follows_the_held_out_recording_as_the_diagnosed_model(
    robot: Robot, tmp_path: Path, effects: list[Effect]
) -> None:
    for row in stepped(robot, tmp_path, "mjlab", os.environ[MJLAB], effects).values():
        assert row["difference"] <= 0.05, row


def test_drake_has_no_dry_friction(robot: Robot, tmp_path: Path) -> None:
    _, document = exported(robot, tmp_path, "drake", EFFECTS)
    verdicts = {row["feature"]: row["verdict"] for row in document["rows"]}
    assert verdicts.pop("coulomb_friction of right") == "lost"
    assert set(verdicts.values()) == {"kept"}


@pytest.mark.skipif(DRAKE not in os.environ, reason=f"{DRAKE} names no environment with drake")
def test_drake_follows_the_held_out_recording_except_where_an_effect_is_lost(
    robot: Robot, tmp_path: Path
) -> None:
    rows = stepped(robot, tmp_path, "drake", os.environ[DRAKE], EFFECTS)
    assert rows["viscous_friction of left"]["difference"] <= 0.05
    assert rows["torque_saturation of left"]["difference"] <= 0.05
    assert rows["integration"]["difference"] <= 0.05
    # Its friction is lost, so that no cost of what is kept there can be told.
    assert rows["coulomb_friction of right"]["difference"] > 1.0
    assert rows["armature of right"]["verdict"] == "kept"
    assert rows["armature of right"]["difference"] is None


@pytest.mark.parametrize(
    ("target", "engine", "with_recording", "message"),
    [
        (
            "isaaclab",
            sys.executable,
            True,
            "--engine: this target is not stepped",
        ),
        ("drake", sys.executable, False, "--engine: no held-out recording to step"),
        ("drake", "no_python", True, "--engine: no such Python"),
        ("drake", sys.executable, True, "--engine: the simulator stopped: ModuleNotFoundError"),
        (
            "mujoco",
            sys.executable,
            True,
            "--engine: this target is not stepped",
        ),
    ],
)
def test_an_engine_that_cannot_step_the_export_is_refused_in_one_line(
    robot: Robot,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    target: str,
    engine: str,
    with_recording: bool,
    message: str,
) -> None:
    diagnosis = diagnosis_in(tmp_path, robot, EFFECTS)
    arguments = ["export", str(diagnosis), "--to", target, "--out", str(tmp_path / "out")]
    recording = ["--held-out", str(tmp_path / "held_out.mcap")] if with_recording else []
    assert main([*arguments, "--engine", engine, *recording]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_newton_gets_a_layer_with_actuators_and_passive_forces(
    robot: Robot, tmp_path: Path
) -> None:
    effects: list[Effect] = [*EFFECTS, ("command_delay", 1, {"delay": 0.0213})]
    out, document = exported(robot, tmp_path, "newton", effects)
    layer = (out / "newton_actuators.usda").read_text()
    assert "float newton:maxEffort = 1.0" in layer
    assert "int newton:delaySteps = 11" in layer
    # Angular damping of joints is in N*m*s/deg.
    assert f"float newton:damping = {float(f'{np.radians(0.15):.9g}')}" in layer
    assert document["checked"] == "schema"


@pytest.mark.skipif(NEWTON not in os.environ, reason=f"{NEWTON} names no environment with newton")
@pytest.mark.parametrize(
    "effects",
    [EFFECTS, [("command_delay", 1, {"delay": 0.0213})]],
    ids=["drives", "delay"],
)
def test_newton_follows_the_held_out_recording_as_the_diagnosed_model(
    robot: Robot, tmp_path: Path, effects: list[Effect]
) -> None:
    for row in stepped(robot, tmp_path, "newton", os.environ[NEWTON], effects).values():
        assert row["difference"] <= 0.05, row


def test_playground_gets_what_mjx_has_and_the_rest_is_lost(robot: Robot, tmp_path: Path) -> None:
    effects: list[Effect] = [
        ("backlash", 0, {"gap": 0.05, "tooth_compliance": 0.01}),
        ("command_delay", 1, {"delay": 0.0213}),
        ("cogging", 0, {"sine": 0.1, "cosine": 0.05, "harmonic": 12.0}),
    ]
    out, document = exported(robot, tmp_path, "playground", effects)
    verdicts = {row["feature"]: row["verdict"] for row in document["rows"]}
    assert verdicts["backlash of left"] == "kept"
    assert verdicts["command_delay of right"] == "lost"
    assert verdicts["cogging of left"] == "lost"
    model = mujoco.MjModel.from_xml_path(str(out / "model.xml"))
    assert not model.actuator_delay.any()
    assert set(model.actuator_gaintype) == {int(mujoco.mjtGain.mjGAIN_FIXED)}


@pytest.mark.skipif(MJX not in os.environ, reason=f"{MJX} names no environment with mujoco-mjx")
def test_mjx_steps_the_playground_model_as_mujoco_does(robot: Robot, tmp_path: Path) -> None:
    effects: list[Effect] = [*EFFECTS, ("backlash", 0, {"gap": 0.05, "tooth_compliance": 0.01})]
    out, _ = exported(robot, tmp_path, "playground", effects)
    script = Path(__file__).with_name("foreign") / "step_mjx.py"
    run = subprocess.run(
        [os.environ[MJX], str(script), str(out / "model.xml"), "200"],
        capture_output=True, text=True, timeout=400, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    positions = json.loads(run.stdout.splitlines()[-1])
    np.testing.assert_allclose(positions["mjx"], positions["mujoco"], atol=1e-3)
