"""What ``pytest-twin identify`` says about efforts that a person must judge."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arms import JOINTS, REAL, simulated_effort, true_arm, write_model, write_recording
from drawn_robots import drawn_arm, mjcf, write_log

from pytest_twin import cli

pytestmark = pytest.mark.usefixtures("commands_in_process")


def identified(model: Path, paths: list[Path], out: Path) -> tuple[int, dict[str, Any]]:
    """Exit status and record of the command; the last recording is held out."""
    words = ["identify", str(model), *map(str, paths[:-1]), "--held-out", str(paths[-1])]
    status = cli.main([*words, "--out", str(out)])
    return status, json.loads((out / "identification.json").read_text())


def test_a_constant_of_a_current_is_as_uncertain_as_the_inertia_of_the_model(
    tmp_path: Path,
) -> None:
    """Without a known payload a heavier arm and a weaker motor look the same."""
    gain = 0.2
    robot = true_arm(tmp_path, mass=1.2 * REAL["mass"])
    paths = []
    for seed in (1, 2, 3):
        time, position, effort = simulated_effort(robot, seed)
        paths.append(write_recording(tmp_path / f"{seed}.csv", time, position, gain * effort))
    write_model(tmp_path)
    twin = tmp_path / "twin.yaml"
    twin.write_text("model: model.xml\nsignals: {default: {effort: {quantity: current}}}\n")
    _, document = identified(twin, paths, tmp_path / "out")
    for joint in JOINTS:
        found = document["parameters"][f"{joint}.effort_scale"]
        low, high = found["ci95"]
        assert low <= gain <= high, joint
        assert high - low >= 0.6 * found["value"]
        assert found["estimator"].endswith("against the inertia of the model")


def test_a_negative_armature_is_said_and_rejects_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A torque sensor on the link's side of the gear does not see the rotor."""
    random = np.random.default_rng(11)
    links = [replace(link, armature=-0.15) for link in drawn_arm(random, 3)]
    (tmp_path / "model.xml").write_text(mjcf(links))
    paths = [write_log(tmp_path / f"log{k}.csv", links, random) for k in range(3)]
    identified(tmp_path / "model.xml", paths, tmp_path / "out")
    lines = [one for one in capsys.readouterr().out.splitlines() if one.startswith("suspected:")]
    assert any("armature (reflected rotor inertia) of 'joint" in one for one in lines)
    assert any("is negative" in one and "kg*m^2" in one for one in lines)


def test_a_suspicion_that_a_person_answers_in_the_twin_rejects_nothing(tmp_path: Path) -> None:
    """The sign of a joint's effort looks wrong; ``checked: true`` says that it is right."""
    random = np.random.default_rng(3)
    links = drawn_arm(random, 2)
    (tmp_path / "model.xml").write_text(mjcf(links))
    paths = []
    for k in range(3):
        path = write_log(tmp_path / f"log{k}.csv", links, random)
        head, *rows = path.read_text().splitlines()
        column = head.split(",").index("joint2.effort")
        for at, row in enumerate(rows):
            values = row.split(",")
            values[column] = str(-float(values[column]))
            rows[at] = ",".join(values)
        path.write_text("\n".join([head, *rows]) + "\n")
        paths.append(path)
    fatal = {}
    for checked in ("false", "true"):
        twin = tmp_path / f"twin_{checked}.yaml"
        twin.write_text(
            f"model: model.xml\nsignals: {{joints: {{joint2: {{checked: {checked}}}}}}}\n"
        )
        status, document = identified(twin, paths, tmp_path / checked)
        own = [one for one in document["suspected"] if one["what"].startswith("joint2")]
        assert own
        fatal[checked] = any(one["fatal"] for one in own)
        assert status == (1 if fatal[checked] else status)
    assert fatal == {"false": True, "true": False}
