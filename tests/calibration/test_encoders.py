"""Repeatability, hysteresis and home offset of encoders agree with the simulated values."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from pytest_twin import cli
from pytest_twin.calibration.encoders import calibrate_encoders
from pytest_twin.calibration.observations import load_observations
from pytest_twin.calibration.plan import load_plan
from pytest_twin.errors import FormatError, SpecError
from pytest_twin.twin import load_twin

pytestmark = pytest.mark.usefixtures("commands_in_process")

NOISE, GAP, HOME = 2e-4, 1e-3, 0.031
STOP = -1.5


def write_plan(
    folder: Path, seed: int = 0, *, times: int = 4, noise: float = NOISE, sides: str = "+-"
) -> Path:
    """Write a plan and readings of a joint that repeatedly approaches three poses."""
    rng = np.random.default_rng(seed)
    rows = [["id", "joint.elbow", "pose", "approach"]]
    for name, position in (("stop", STOP), ("a", 0.3), ("b", 1.1)):
        for side in sides:
            for _ in range(times):
                half = GAP / 2 if side == "+" else -GAP / 2
                reading = position - HOME + half + noise * rng.normal()
                rows.append([str(len(rows)), repr(float(reading)), name, side])
    with (folder / "observations.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    plan = {
        "calibration": "encoders",
        "observations": "observations.csv",
        "estimate": ["encoder_repeatability"],
        "references": {"stop": {"elbow": STOP}},
    }
    (folder / "plan.yaml").write_text(yaml.safe_dump(plan))
    return folder / "plan.yaml"


def calibrated(plan: Path) -> dict:
    return calibrate_encoders(
        load_plan(plan), load_observations(plan.with_name("observations.csv")), None
    )


def test_the_command_estimates_repeatability_hysteresis_and_home(tmp_path, capsys):
    plan = write_plan(tmp_path, times=20)
    assert cli.main(["calibrate", str(plan), "--out", str(tmp_path / "out")]) == 0
    records = json.loads((tmp_path / "out" / "calibration.json").read_text())["records"]
    values = {name: record["values"]["elbow"] for name, record in records.items()}
    assert values["encoder_repeatability"]["value"] == pytest.approx(NOISE, rel=0.2)
    assert values["encoder_hysteresis"]["value"] == pytest.approx(GAP, rel=0.2)
    assert values["encoder_home"]["value"] == pytest.approx(HOME, rel=0.01)
    assert "encoder_hysteresis:" in capsys.readouterr().out


def test_95_percent_intervals_contain_the_true_values_in_90_to_99_percent_of_runs(tmp_path):
    truth = {
        "encoder_repeatability": NOISE, "encoder_hysteresis": GAP, "encoder_home": HOME,
    }  # fmt: skip
    inside: dict[str, list[bool]] = {name: [] for name in truth}
    for seed in range(200):
        records = calibrated(write_plan(tmp_path, seed, times=3))["records"]
        for name, value in truth.items():
            low, high = records[name]["values"]["elbow"]["ci95"]
            inside[name].append(low < value < high)
    for name, held in inside.items():
        assert 0.90 <= np.mean(held) <= 0.99, name


def test_repeatability_without_repeated_poses_is_refused(tmp_path):
    found = calibrated(write_plan(tmp_path, times=1))
    assert (found["verdict"], found["records"]) == ("degenerate", {})
    assert found["reasons"][0].startswith("the repeatability of elbow: no pose repeats. Return to")


def test_repeatability_below_the_resolution_is_refused(tmp_path):
    found = calibrated(write_plan(tmp_path, noise=0.0))
    assert found["verdict"] == "degenerate"
    assert "their resolution hides it" in found["reasons"][0]


def test_approaches_from_one_side_give_no_hysteresis_and_a_note(tmp_path):
    found = calibrated(write_plan(tmp_path, sides="+"))
    assert set(found["records"]) == {"encoder_repeatability", "encoder_home"}
    assert any("no pose was approached from both sides" in note for note in found["notes"])
    assert any("half of the hysteresis is in its home" in note for note in found["notes"])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"references": {"other": {"elbow": 0.0}}}, "a pose that no observation has"),
        ({"references": {"stop": {"wrist": 0.0}}}, "a joint without a column"),
        (
            {"estimate": ["encoder_repeatability", "hand_eye"]},
            "cannot be combined with other estimates",
        ),
    ],
)
def test_unknown_names_in_the_plan_are_refused(tmp_path, change, words):
    plan = write_plan(tmp_path)
    plan.write_text(yaml.safe_dump(yaml.safe_load(plan.read_text()) | change))
    with pytest.raises(SpecError, match=words) as error:
        calibrated(plan)
    assert error.value.line is not None


def test_an_invalid_side_of_approach_is_refused_with_its_line(tmp_path):
    plan = write_plan(tmp_path)
    table = plan.with_name("observations.csv")
    table.write_text(table.read_text().replace("stop,+", "stop,up", 1))
    with pytest.raises(FormatError, match="no approach direction") as error:
        load_observations(table)
    assert error.value.line == 2


def test_a_twin_applies_the_estimated_home_of_an_encoder(tmp_path):
    """With the record listed in the twin, the reading at the stop gives its position."""
    rng = np.random.default_rng(3)
    (tmp_path / "model.xml").write_text(
        '<mujoco><worldbody><body name="arm"><joint name="elbow"/><geom size="0.1"/></body>'
        "</worldbody></mujoco>"
    )
    own = "model: model.xml\ncalibration: {id: wiring, joints: {elbow: {sign: -1}}}\n"
    twin = tmp_path / "twin.yaml"
    twin.write_text(own)
    rows = [["id", "joint.elbow", "pose", "approach"]]
    for number in range(20):
        reading = -(STOP - HOME) + NOISE * rng.normal()
        rows.append([str(number), repr(float(reading)), "stop", "+-"[number % 2]])
    with (tmp_path / "observations.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    plan = tmp_path / "plan.yaml"
    plan.write_text(
        "calibration: encoders\nrobot: twin.yaml\nflange: arm\nobservations: observations.csv\n"
        f"estimate: [encoder_repeatability]\nreferences: {{stop: {{elbow: {STOP}}}}}\n"
    )
    assert cli.main(["calibrate", str(plan), "--out", str(tmp_path / "out")]) == 0
    twin.write_text(own + "calibrations: [{file: out/calibration.json}]\n")
    found = load_twin(twin).calibration
    assert found is not None
    joint = found.joints["elbow"]
    reading = -(STOP - HOME)
    assert joint.sign * reading + joint.offset == pytest.approx(STOP, abs=3 * NOISE)
