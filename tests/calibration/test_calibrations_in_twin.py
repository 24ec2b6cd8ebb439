"""Accepted calibrations listed in ``twin.yaml``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pytest_twin.errors import TwinError
from pytest_twin.realization import load
from pytest_twin.twin import load_twin

MODEL = """<mujoco><worldbody><body name="a"><joint name="elbow"/><geom size="0.1"/></body>
</worldbody></mujoco>"""


def write_record(folder: Path, name: str, **changes: Any) -> str:
    document = {
        "schema": 1,
        "calibration": name,
        "verdict": "accepted",
        "records": {
            "joint_zeros": {"values": {"elbow": {"value": 0.02, "unit": "rad"}}},
            "base_world": {
                "transform": {"xyz": [1.0, 0.0, 0.5], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
            },
        },
        "held_out": {"translation_rms": 0.001},
    } | changes
    (folder / f"{name}.json").write_text(json.dumps(document))
    return f"{name}.json"


def load_twin_with(folder: Path, text: str):
    (folder / "model.xml").write_text(MODEL)
    (folder / "twin.yaml").write_text("model: model.xml\n" + text)
    return load_twin(folder / "twin.yaml")


def test_the_twin_applies_joint_zeros_and_keeps_the_sign(tmp_path: Path) -> None:
    file = write_record(tmp_path, "october")
    found = load_twin_with(
        tmp_path,
        "calibration: {id: wiring, joints: {elbow: {sign: -1, offset: 0.3}}}\n"
        f"calibrations: [{{file: {file}, date: 2026-10-01}}]\n",
    )
    assert found.calibration is not None
    assert found.calibration.id == "wiring+october"
    assert found.calibration.joints["elbow"].offset == 0.02
    assert found.calibration.joints["elbow"].sign == -1
    assert found.calibration.transform_world_to_base is None
    assert tmp_path / "october.json" in found.files
    assert found.calibrations[0].record.held_out == {"translation_rms": 0.001}


def test_the_base_pose_is_applied_only_on_request(tmp_path: Path) -> None:
    file = write_record(tmp_path, "october")
    found = load_twin_with(tmp_path, f"calibrations: [{{file: {file}, use: [base_world]}}]\n")
    assert found.calibration is not None
    assert found.calibration.joints == {}
    assert found.calibration.transform_world_to_base is not None
    assert found.calibration.transform_world_to_base.position == (1.0, 0.0, 0.5)


def test_a_later_record_supersedes_an_earlier_one(tmp_path: Path) -> None:
    first = write_record(tmp_path, "october")
    zeros = {"joint_zeros": {"values": {"elbow": {"value": 0.05}}}}
    second = write_record(tmp_path, "november", records=zeros)
    found = load_twin_with(
        tmp_path,
        f"calibrations:\n- {{file: {first}}}\n- {{file: {second}, supersedes: [october]}}\n",
    )
    assert found.calibration is not None
    assert found.calibration.id == "november"
    assert found.calibration.joints["elbow"].offset == 0.05


def test_two_records_with_the_zero_of_the_same_joint_are_refused(tmp_path: Path) -> None:
    first, second = write_record(tmp_path, "october"), write_record(tmp_path, "november")
    with pytest.raises(TwinError) as error:
        load_twin_with(tmp_path, f"calibrations:\n- {{file: {first}}}\n- {{file: {second}}}\n")
    assert str(error.value).endswith(
        "twin.yaml:4: calibrations.1: zero of elbow is in two calibrations (got 'october, "
        "november'; expected supersedes: [october], or use: with other records)"
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"verdict": "rejected"}, "a calibration that is not accepted (got 'rejected'"),
        ({"held_out": None}, "a field is missing or unusable"),
        ({"held_out": {"translation_rms": -0.001}}, "held_out.translation_rms: a field is missing"),
        ({"schema": 2}, "a field is missing or unusable: 'schema'"),
        (
            {"records": {"joint_zeros": {"values": {"elbow": {"value": "x"}}}}},
            "joint_zeros.elbow: a field is missing or unusable (got 'x'; expected a number",
        ),
    ],
)
def test_an_invalid_record_is_refused(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    file = write_record(tmp_path, "october", **change)
    with pytest.raises(TwinError) as error:
        load_twin_with(tmp_path, f"calibrations: [{{file: {file}}}]\n")
    assert words in str(error.value)


@pytest.mark.parametrize("is_record", [True, False])
def test_the_zero_of_a_joint_that_the_model_lacks_is_refused(
    tmp_path: Path, is_record: bool
) -> None:
    """Of another robot, or misspelled: it would be left out without a word."""
    zeros = {"joint_zeros": {"values": {"elbow_joint": {"value": 0.02, "unit": "rad"}}}}
    file = write_record(tmp_path, "october", records=zeros)
    twin = load_twin_with(
        tmp_path,
        f"calibrations: [{{file: {file}}}]\n"
        if is_record
        else "calibration: {id: wiring, joints: {elbow_joint: {sign: -1}}}\n",
    )
    with pytest.raises(TwinError) as error:
        load(tmp_path / "model.xml", twin=twin)
    assert "calibration.joints.elbow_joint: the model has no such joint" in str(error.value)
    assert "expected perhaps 'elbow'" in str(error.value)


def home_records(sign: float = 1.0) -> dict[str, Any]:
    value = {"value": 0.031, "unit": "rad", "ci95": [0.029, 0.033], "sign": sign}
    return {"encoder_home": {"values": {"elbow": value}}}


def test_the_home_of_an_encoder_is_applied_with_its_uncertainty(tmp_path: Path) -> None:
    file = write_record(tmp_path, "encoders", records=home_records())
    found = load_twin_with(tmp_path, f"calibrations: [{{file: {file}}}]\n")
    assert found.calibration is not None
    assert found.calibration.joints["elbow"].offset == 0.031
    record = found.calibrations[0].record
    assert record.covariance_names == ("joint_zeros.elbow",)
    assert record.covariance[0][0] == pytest.approx((0.002 / 1.96) ** 2, rel=1e-3)


def test_a_joint_zero_overrides_an_earlier_home_and_a_later_home_is_refused(tmp_path: Path) -> None:
    first = write_record(tmp_path, "encoders", records=home_records())
    second = write_record(tmp_path, "october")
    found = load_twin_with(tmp_path, f"calibrations:\n- {{file: {first}}}\n- {{file: {second}}}\n")
    assert found.calibration is not None
    assert found.calibration.joints["elbow"].offset == 0.02
    with pytest.raises(TwinError, match="zero of elbow is in two calibrations"):
        load_twin_with(tmp_path, f"calibrations:\n- {{file: {second}}}\n- {{file: {first}}}\n")


def test_a_home_measured_with_another_encoder_sign_is_refused(tmp_path: Path) -> None:
    file = write_record(tmp_path, "encoders", records=home_records())
    text = (
        "calibration: {id: wiring, joints: {elbow: {sign: -1}}}\n"
        f"calibrations: [{{file: {file}}}]\n"
    )
    with pytest.raises(TwinError) as error:
        load_twin_with(tmp_path, text)
    assert str(error.value).endswith(
        "twin.yaml:3: calibrations.0.file: the home of elbow was found with another sign of its "
        "encoder (got 1.0; expected -1, as calibration.joints.elbow states it; measure the home "
        "with robot: twin.yaml)"
    )
    file = write_record(tmp_path, "encoders", records=home_records(-1.0))
    found = load_twin_with(tmp_path, text)
    assert found.calibration is not None
    assert (found.calibration.joints["elbow"].sign, found.calibration.joints["elbow"].offset) == (
        -1.0,
        0.031,
    )
