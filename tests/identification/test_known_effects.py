"""Measured effort with a model of an earlier diagnosis: effects beside its MJCF, springs, drag."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from driven_pendulum import Motion, Plant, write_run
from test_identify_simulation import MODEL, NOMINAL, REAL

from pytest_twin.effects.sensing import EffortBias, EffortScale
from pytest_twin.errors import RecordingError
from pytest_twin.identification.identify_files import identify_files
from pytest_twin.identification.known_effects import kept_effects, known_efforts, notes_on_effects
from pytest_twin.identification.recheck import recheck
from pytest_twin.realization import Realization, load
from pytest_twin.twin import load_twin

SPRING, DRAG = 0.8, 0.06
"""N*m/rad and N*m*s^2/rad^2, which the MJCF contains."""
OFFSET, RIPPLE, HARMONIC, BIAS = 0.4, 0.3, 3.0, 0.06
"""N*m, N*m, periods per turn and rad, which it does not contain."""
EFFECTS = [
    ("asymmetric_friction", {"coulomb": 0.0, "offset": OFFSET}),
    ("cogging", {"sine": RIPPLE, "cosine": 0.0, "harmonic": HARMONIC}),
    ("encoder_bias", {"bias": BIAS, "in_loop": 1.0}),
]


def text(values: dict[str, float]) -> str:
    """MJCF of the pendulum with a spring and drag."""
    plain = MODEL.format(**values)
    out = plain.replace(
        f'damping="{values["damping"]}"',
        f'damping="{values["damping"]} {DRAG}" stiffness="{SPRING}" springref="0.2"',
    )
    assert out != plain
    return out


def actuate(data: mujoco.MjData, command: float) -> None:
    """The servo sees its encoder; the forces of the effects act on the joint."""
    data.ctrl[0] = command - BIAS
    data.qfrc_applied[0] = -OFFSET + RIPPLE * np.sin(HARMONIC * data.qpos[0])


def write(path: Path, seed: int) -> Path:
    """Write a run of the real pendulum."""
    plant = Plant(text(REAL), actuate, interval=0.0005, encoder_bias=BIAS)
    return write_run(path, seed, plant, Motion(8.0, amplitude=0.4, highest=1.2), (1e-4, 5e-3))


@pytest.fixture(scope="module")
def diagnosed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder that a diagnosis wrote, with the pendulum's true effects and wrong friction."""
    folder = tmp_path_factory.mktemp("diagnosed")
    (folder / "model.xml").write_text(text(NOMINAL))
    effects = [
        {"effect": effect, "joint": "swing", "values": values, "in_model": False}
        for effect, values in EFFECTS
    ]
    (folder / "effects.json").write_text(
        json.dumps({"schema": 1, "joints": ["swing"], "effects": effects})
    )
    return folder


@pytest.fixture(scope="module")
def identified(diagnosed: Path) -> dict[str, Any]:
    *fit, held = (write(diagnosed / f"{n}.csv", seed) for seed, n in enumerate("abc", 1))
    (diagnosed / "out").mkdir()
    document = identify_files({
        "model": str(diagnosed / "model.xml"),
        "recordings": [str(path) for path in fit],
        "held_out": [str(held)],
        "out": str(diagnosed / "out"),
        "name": "out",
        "options": {"command_between": "interpolated"},
    })  # fmt: skip
    (diagnosed / "out" / "identification.json").write_text(json.dumps(document))
    return document


def test_friction_is_found_beside_the_effects_of_the_given_model(
    identified: dict[str, Any],
) -> None:
    for name, true in (
        ("viscous_friction", REAL["damping"]), ("coulomb_friction", REAL["friction"]),
    ):  # fmt: skip
        assert identified["parameters"][f"swing.{name}"]["value"] == pytest.approx(true, rel=0.1)
    assert identified["held_out"]["swing"]["effort_rms"] < 0.02


def test_the_fitted_model_keeps_these_effects(identified: dict[str, Any], diagnosed: Path) -> None:
    written = json.loads((diagnosed / "out/realization/effects.json").read_text())
    kept = [(one["effect"], one["values"]) for one in written["effects"] if not one["in_model"]]
    assert kept[: len(EFFECTS)] == EFFECTS
    assert identified["held_out"]["swing"]["position_rms"] < 0.003
    (note,) = (one for one in identified["notes"] if "act in the fit and in the fitted" in one)
    assert note.endswith("asymmetric_friction of swing, cogging of swing, encoder_bias of swing")


def test_the_golden_predicts_the_same_effort(identified: dict[str, Any], diagnosed: Path) -> None:
    (diagnosed / "twin.yaml").write_text("model: out\nfit: [{file: out/identification.json}]\n")
    twin = load_twin(diagnosed / "twin.yaml")
    (fit,) = twin.fits
    robot = load(twin.first_realization.file, twin=twin)
    found = recheck(robot, fit.record, [diagnosed / "c.csv"])
    # The full parameters, the nearest to the model's, also have those that are not significant.
    assert found["swing"].rms < 1.1 * identified["held_out"]["swing"]["effort_rms"]


def pendulum(folder: Path, effects: list[dict[str, Any]]) -> Realization:
    """Load a pendulum without spring and drag, with these effects beside its MJCF."""
    (folder / "model.xml").write_text(MODEL.format(**NOMINAL))
    (folder / "effects.json").write_text(
        json.dumps({"schema": 1, "joints": ["swing"], "effects": effects})
    )
    return load(folder / "model.xml")


def test_efforts_of_effects_along_a_motion_follow_their_laws(tmp_path: Path) -> None:
    robot = pendulum(tmp_path, [
        {"effect": "stribeck_friction", "joint": "swing", "in_model": False, "values":
            {"coulomb": 0.2, "stiction_excess": 0.3, "stribeck_velocity": 0.5}},
        {"effect": "motor_load_friction", "joint": "swing", "in_model": False, "values":
            {"coefficient": 0.1, "stiction_excess": 0.0, "stribeck_velocity": 0.5}},
        {"effect": "command_delay", "joint": "swing", "in_model": False, "values":
            {"delay": 0.02}},
    ])  # fmt: skip
    time = np.linspace(0.0, 1.0, 101)
    position, velocity = np.sin(time)[:, None], np.cos(3.0 * time)[:, None]
    delivered = 2.0 * np.sin(5.0 * time)[:, None]
    found = known_efforts(robot, ["swing"]).along(
        time, (position, velocity), delivered, Recorded(tmp_path)
    )
    level = 0.2 + 0.3 * np.exp(-((velocity / 0.5) ** 2)) + 0.1 * np.abs(delivered)
    np.testing.assert_allclose(found, -level * np.sign(velocity), atol=1e-12)


def test_an_effect_with_a_memory_is_stepped_along_the_motion(tmp_path: Path) -> None:
    values = {"coulomb": 0.4, "presliding_distance": 0.05}
    robot = pendulum(
        tmp_path,
        [{"effect": "presliding_hysteresis", "joint": "swing", "in_model": False,
          "values": values}],
    )  # fmt: skip
    time = np.linspace(0.0, 2.0, 401)
    velocity = np.full((401, 1), 0.1)
    found = known_efforts(robot, ["swing"]).along(
        time, (velocity * time[:, None], velocity), np.zeros_like(velocity), Recorded(tmp_path)
    )
    travelled = 0.1 * (time + 0.5 * time[1])
    np.testing.assert_allclose(found[:, 0], -0.4 * (1.0 - np.exp(-travelled / 0.05)), atol=2e-3)


def test_friction_that_depends_on_temperature_needs_the_temperature(tmp_path: Path) -> None:
    robot = pendulum(
        tmp_path,
        [{"effect": "thermal_friction", "joint": "swing", "in_model": False, "values":
            {"excess": 0.5, "viscous_excess": 0.0, "warm_up_time": 1e6}}],
    )  # fmt: skip
    file = tmp_path / "effects.json"
    cold = {"20 C": 1.0, "40 C": 0.0}
    file.write_text(json.dumps({**json.loads(file.read_text()), "coldness": cold}))
    known = known_efforts(robot, ["swing"])
    time, speed = np.linspace(0.0, 1.0, 11), np.ones((11, 1))

    def pushed(metadata: dict[str, str]) -> float:
        recording = Recorded(tmp_path, metadata)
        return float(known.along(time, (speed, speed), speed, recording)[0, 0])

    assert pushed({"temperature": "20 C"}) == pytest.approx(-0.5)
    assert pushed({"temperature": "30 C"}) == pytest.approx(-0.25)
    with pytest.raises(RecordingError, match="depends on temperature"):
        pushed({})


def test_readings_are_converted_to_the_joint_and_the_drive(tmp_path: Path) -> None:
    robot = pendulum(tmp_path, [
        {"effect": "encoder_scale", "joint": "swing", "in_model": False, "values":
            {"scale_error": 0.1}},
        {"effect": "encoder_bias", "joint": "swing", "in_model": False, "values":
            {"bias": 0.2, "in_loop": 0.0}},
        {"effect": "effort_scale", "joint": "swing", "in_model": False, "values":
            {"scale_error": -0.2}},
        {"effect": "effort_bias", "joint": "swing", "in_model": False, "values": {"bias": 0.3}},
    ])  # fmt: skip
    known = known_efforts(robot, ["swing"])
    true = np.linspace(-1.0, 1.0, 7)[:, None]
    position, velocity = known.true_motion(1.1 * true + 0.2, 1.1 * true)
    np.testing.assert_allclose(position, true)
    np.testing.assert_allclose(velocity, true)
    read = EffortScale().sense_effort(true[None], {"scale_error": np.array([[-0.2]])})
    read = EffortBias().sense_effort(read, {"bias": np.array([[0.3]])})[0]
    np.testing.assert_allclose(known.true_effort(read), true)


def test_a_payload_of_the_given_model_is_identified_anew(tmp_path: Path) -> None:
    payload = {"mass": 0.5, "distance": 0.1, "sideways": 0.0, "across": 0.0, "form": 0.0}
    robot = pendulum(
        tmp_path,
        [{"effect": "payload", "joint": None, "in_model": False, "values": payload}],
    )
    kept = kept_effects(robot)
    assert kept is not None
    assert kept.effects == ()
    (note,) = notes_on_effects(robot)
    assert note.endswith("identified anew, and not kept: payload")


@dataclass(frozen=True)
class Recorded:
    """A recording with its metadata."""

    path: Path
    metadata: dict[str, str] = field(default_factory=dict)
