"""Currents of unknown torque constants: a known payload determines the drive gains."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from arms import REAL, TRUE, simulated_effort, write_mcap, write_model
from test_fits_in_twin import SPEC, measures_of

from pytest_twin.formats.schema import load_schema
from pytest_twin.identification.identify_files import identify_files
from pytest_twin.realization import load
from pytest_twin.twin import load_twin

GAINS = {"shoulder": 0.1, "elbow": 0.4}
"""A/(N*m) of the real arm."""
TWIN = (
    "model: model.xml\npayloads: {kg3: {lower: {mass: 3, com: [0.4, 0, 0.1]}}}\n"
    "signals: {default: {effort: {quantity: current}}}\n"
)


def identified(folder: Path, payloads: tuple[str, str, str]) -> dict[str, Any]:
    """Identification from the currents of three recordings, of which the last is held out."""
    write_model(folder)
    (folder / "twin.yaml").write_text(TWIN)
    twin = load_twin(folder / "twin.yaml")
    (folder / "real.xml").write_text(TRUE.format(**REAL))
    robot = load(folder / "real.xml", twin=twin)
    for seed, (name, payload) in enumerate(zip(("one", "two", "check"), payloads, strict=True)):
        real = robot if payload == "none" else robot.variant(payload=payload)
        time, q, effort = simulated_effort(real, seed)
        current = effort * np.array(list(GAINS.values()))
        write_mcap(folder / f"{name}.mcap", time, q, current, payload)
    (folder / "out").mkdir()
    document = identify_files({
        "model": str(folder / "twin.yaml"),
        "recordings": [str(folder / "one.mcap"), str(folder / "two.mcap")],
        "held_out": [str(folder / "check.mcap")],
        "out": str(folder / "out"),
        "name": "october",
    })  # fmt: skip
    (folder / "record.json").write_text(json.dumps(document))
    return document


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("currents")
    return folder, identified(folder, ("kg3", "none", "none"))


def test_the_drive_gains_lie_in_their_intervals(cell: tuple[Path, dict[str, Any]]) -> None:
    document = cell[1]
    jsonschema.validate(document, load_schema("results/identify.schema.json"))
    for joint, gain in GAINS.items():
        one = document["parameters"][f"{joint}.effort_scale"]
        assert one["ci95"][0] <= gain <= one["ci95"][1]
        assert one["ci95"][1] - one["ci95"][0] < 0.1 * gain
        assert (one["unit"], one["stage"], one["prior"]) == ("A/(N*m)", "drive", None)
        assert document["drive_gains"][joint] == one["value"]
    (drive,) = (stage for stage in document["stages"] if stage["stage"] == "drive")
    assert drive["state"] == "accepted"
    assert "recorded current per torque, from known payloads" in drive["why"]


def test_with_the_gains_inertia_and_friction_are_identified_in_newton_metres(
    cell: tuple[Path, dict[str, Any]],
) -> None:
    parameters = cell[1]["parameters"]
    true = {
        "mx1 + 0.5*m2": 4 * 0.3 + 2 * 0.5,
        "elbow.mx": 0.4,
        "shoulder.viscous_friction": REAL["damping"],
        "shoulder.coulomb_friction": REAL["friction"],
    }
    for name, value in true.items():
        low, high = parameters[name]["ci95"]
        assert low <= value <= high, name
    assert parameters["shoulder.viscous_friction"]["unit"] == "N*m*s/rad"
    error = cell[1]["held_out"]["elbow"]
    assert error["effort_unit"] == "N*m"
    assert error["effort_relative"] < 0.1 * error["effort_relative_nominal"]


def test_intervals_allow_for_the_error_of_the_gain(cell: tuple[Path, dict[str, Any]]) -> None:
    parameters = cell[1]["parameters"]

    def width(name: str) -> float:
        one = parameters[name]
        return (one["ci95"][1] - one["ci95"][0]) / abs(one["value"])

    # All torques of a joint are uncertain by the same share.
    assert width("shoulder.viscous_friction") >= width("shoulder.effort_scale")
    assert width("elbow.coulomb_friction") >= width("elbow.effort_scale")


def test_a_golden_divides_the_currents_by_the_gains_of_its_record(
    cell: tuple[Path, dict[str, Any]],
) -> None:
    folder, document = cell
    text = (folder / "twin.yaml").read_text()
    (folder / "twin.yaml").write_text(f"{text}fit: [{{file: record.json}}]\n")
    (folder / "golden").mkdir()
    (folder / "golden" / "effort.yaml").write_text(SPEC.replace("check.csv", "check.mcap"))
    assert document["verdict"] == "accepted"
    found = [m for m in measures_of(folder) if m.name == "effort"]
    assert len(found) == 2
    assert all(one.passed and one.error < 0.02 for one in found)


def test_with_one_payload_in_all_recordings_the_model_inertia_determines_the_constant(
    tmp_path: Path,
) -> None:
    document = identified(tmp_path, ("kg3", "kg3", "kg3"))
    assert document["drive_gains"] == {}
    # The nominal inertia with its payload is off by less than 40 %.
    for joint, gain in GAINS.items():
        assert document["parameters"][f"{joint}.effort_scale"]["value"] == pytest.approx(
            gain, rel=0.4
        )
        assert document["held_out"][joint]["effort_relative"] < 0.4
