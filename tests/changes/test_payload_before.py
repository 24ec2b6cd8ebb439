"""``diagnose --before`` with measured effort: a payload that was added between two sessions."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pytest_twin.cli import main
from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import JointSeries

sys.path.append(str(Path(__file__).parents[1] / "identification"))
from drawn_robots import Link, drawn_arm, mjcf, motion, names_of, plant_effort

pytestmark = pytest.mark.usefixtures("commands_in_process")
MASS, PLACE = 0.8, np.array([0.06, -0.03, 0.05])
EARLIER = 4


def loaded(links: list[Link], mass: float, place: np.ndarray) -> list[Link]:
    """The arm with a point mass on its last link, m in the frame of its joint."""
    last = links[-1]
    total = last.mass + mass
    com = (last.mass * np.array(last.com) + mass * place) / total
    inertia = np.array(last.inertia)
    for weight, point in ((last.mass, np.array(last.com)), (mass, place)):
        arm = point - com
        inertia = inertia + weight * (arm @ arm - arm**2)
    return [*links[:-1], replace(last, mass=total, com=tuple(com), inertia=tuple(inertia))]


def record(
    folder: Path, name: str, links: list[Link], seed: int, payload: str = "", factor: float = 1.0
) -> Path:
    """A recording with a ripple that no model has; the motion is another one for each seed."""
    random = np.random.default_rng(seed)
    time, q, v, a = motion(random, len(links), 14.0, 60.0)
    effort = factor * (plant_effort(links, q, v, a) + 0.2 * np.sin(9.0 * q))
    effort += 0.05 * random.standard_normal(effort.shape)
    stamp = np.round(time * 1e9).astype(np.int64)
    series = JointSeries("/joint_states", tuple(names_of(links)), stamp, stamp, q, None, effort)
    write_recording(folder / name, [series], {"payload": payload} if payload else {})
    return folder / name


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Link]]:
    """A folder with a model without friction and armature, and recordings without payload."""
    folder = tmp_path_factory.mktemp("arm")
    links = drawn_arm(np.random.default_rng(4), 3)
    (folder / "model.xml").write_text(mjcf(links, errors=np.array([0.1, -0.1, 0.15])))
    for seed in range(EARLIER):
        record(folder, f"old{seed}.mcap", links, seed)
    return folder, links


def compare(folder: Path, new: Path, out: Path, model: str = "model.xml") -> tuple[int, Any]:
    earlier = [str(folder / f"old{seed}.mcap") for seed in range(EARLIER)]
    status = main([
        "diagnose", str(folder / model), str(new), "--before", *earlier, "--out", str(out)
    ])  # fmt: skip
    return status, json.loads((out / "diagnosis.json").read_text()) if status < 2 else {}


@pytest.mark.parametrize("payload", ["", "box"])
def test_a_payload_is_named_with_its_mass_whether_its_name_is_recorded_or_not(
    arm: tuple[Path, list[Link]], tmp_path: Path, payload: str
) -> None:
    folder, links = arm
    new = record(tmp_path, "new.mcap", loaded(links, MASS, PLACE), 20, payload)
    status, document = compare(folder, new, tmp_path / "out")
    assert (status, document["verdict"]) == (1, "changed")
    (finding,) = document["findings"]
    assert (finding["effect"], finding["joint"]) == ("payload", None)
    assert finding["confidence"] > 0.9
    mass = finding["change"]["mass"]
    low, high = mass["ci95"]
    assert low < MASS < high
    assert (mass["unit"], high - low < 0.4 * MASS) == ("kg", True)
    assert finding["known_before"]["mass"]["value"] == 0.0
    noted = any("payload none before, box now" in note for note in document["notes"])
    assert noted == bool(payload)


def test_a_payload_that_was_removed_has_a_negative_mass(
    arm: tuple[Path, list[Link]], tmp_path: Path
) -> None:
    folder, links = arm
    for seed in range(EARLIER):
        record(tmp_path, f"old{seed}.mcap", loaded(links, MASS, PLACE), seed)
    (tmp_path / "model.xml").write_text((folder / "model.xml").read_text())
    _, document = compare(tmp_path, record(tmp_path, "new.mcap", links, 20), tmp_path / "out")
    (finding,) = document["findings"]
    assert finding["effect"] == "payload"
    low, high = finding["change"]["mass"]["ci95"]
    assert low < -MASS < high


def test_efforts_that_the_bodies_of_the_model_contradict_are_refused(
    arm: tuple[Path, list[Link]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Currents of 12 N*m/A that nothing declares."""
    folder, links = arm
    for seed in range(EARLIER):
        record(tmp_path, f"old{seed}.mcap", links, seed, factor=1.0 / 12.0)
    (tmp_path / "model.xml").write_text((folder / "model.xml").read_text())
    new = record(tmp_path, "new.mcap", links, 20, factor=1.0 / 12.0)
    assert compare(tmp_path, new, tmp_path / "out")[0] == 2
    error = capsys.readouterr().err
    assert "times what the model's bodies need" in error
    assert "unit of its effort" in error
    assert len(error.strip().splitlines()) == 1


def test_a_current_without_a_torque_constant_is_refused(
    arm: tuple[Path, list[Link]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, links = arm
    (folder / "twin.yaml").write_text(
        "model: model.xml\nsignals: {default: {effort: {quantity: current}}}\n"
    )
    new = record(tmp_path, "new.mcap", links, 20)
    assert compare(folder, new, tmp_path / "out", model="twin.yaml")[0] == 2
    error = capsys.readouterr().err
    assert "every effort is a current of unknown torque constant: joint1, joint2, joint3" in error
