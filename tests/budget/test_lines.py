"""Lines and categories of the budget: each error counts once; unmeasured ones have no number."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parent))

from budget_files import (
    ARM,
    FORE,
    POSES,
    UPPER,
    declared,
    fit_record,
    make_twin,
    record_motion,
    with_pose,
    zeros_record,
)

from pytest_twin.budget.budget_of_twin import budget_of_file
from pytest_twin.budget.categories import CATEGORIES

SMALL = [[1e-6, 0.0], [0.0, 1e-6]]


def test_without_records_all_categories_are_not_measured(tmp_path: Path) -> None:
    found = budget_of_file(str(make_twin(tmp_path)))
    assert [one["category"] for one in found["categories"]] == [one.id for one in CATEGORIES]
    for one in found["categories"]:
        assert one["state"] == "not_measured"
        assert one["estimates"] == []
        assert one["moves"] is one["beyond"] is one["owner"] is None
        assert one["measured_by"].startswith("pytest-twin ")
    assert found["total"]["linear"] is found["total"]["sampled"] is None
    # Without a declaration, the defaults for frame and poses are reported.
    assert "end of the longest chain" in found["output"]["frame_source"]
    assert "drawn within the joints' ranges" in found["output"]["poses_source"]


def test_independent_records_add_up_in_quadrature(tmp_path: Path) -> None:
    records = [
        zeros_record([[4e-6]], ["shoulder"], "first"),
        zeros_record([[1e-6]], ["elbow"], "second"),
    ]
    found = budget_of_file(str(make_twin(tmp_path, records, budget=declared())))
    sizes = {line["id"]: line["linear"]["position"] for line in found["lines"]}
    assert sizes["second"] == pytest.approx(1e-3 * FORE, rel=1e-9)
    total = found["total"]["linear"]["position"]
    assert total == pytest.approx(np.hypot(sizes["first"], sizes["second"]), rel=1e-9)


def test_of_two_records_of_the_same_frame_only_the_newer_one_counts(tmp_path: Path) -> None:
    covariances = [9e-6 * np.eye(6), 1e-6 * np.eye(6)]
    records = [
        with_pose(
            zeros_record(np.zeros((0, 0)), [], f"eye{at}"),
            "hand_eye", ("flange", "camera"), (0.0, 0.0, 0.0), covariance,
        )
        for at, covariance in enumerate(covariances)
    ]  # fmt: skip
    found = budget_of_file(str(make_twin(tmp_path, records, budget=declared())))
    assert [line["id"] for line in found["lines"]] == ["eye1"]
    assert found["total"]["linear"]["position"] == pytest.approx(np.sqrt(3e-6), rel=1e-9)
    assert any("eye0" in note and "a newer calibration" in note for note in found["notes"])


def test_jointly_estimated_parameters_of_a_record_form_one_line(tmp_path: Path) -> None:
    """A joint zero and an offset of its link: the category of the smaller error refers to the
    line in which it is counted."""
    record = zeros_record([[1e-6]], ["elbow"])
    record["records"]["geometry"] = {
        "values": {
            "offset along x of elbow": {
                "value": 0.001, "joint": "elbow", "kind": "translation", "direction": [1, 0, 0],
            }
        }
    }  # fmt: skip
    together = record["covariance"]
    together["of"].append("geometry.offset along x of elbow")
    together["matrix"] = [[1e-6, 5e-8], [5e-8, 1e-8]]
    found = budget_of_file(str(make_twin(tmp_path, [record], budget=declared())))
    (line,) = found["lines"]
    assert {part["category"] for part in line["parts"]} == {
        "asset_and_geometry",
        "frame_calibration",
    }
    assert line["correlated"][0]["correlation"] == pytest.approx(0.5)
    categories = {one["category"]: one for one in found["categories"]}
    assert categories["asset_and_geometry"]["state"] == "counted_elsewhere"
    assert categories["asset_and_geometry"]["counted_in"] == ["zeros"]
    assert categories["asset_and_geometry"]["moves"] is None
    # The offset is along the upper arm, the zero moves the tool perpendicular to the forearm:
    # the cross term is -2 FORE c sin(elbow).
    squares = [
        1e-6 * FORE**2 + 1e-8 - 2 * FORE * 5e-8 * np.sin(pose["elbow"] + 0.01) for pose in POSES
    ]
    assert line["linear"]["position"] == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-9)


def test_shares_owners_and_goldens_are_taken_from_the_twin(tmp_path: Path) -> None:
    more = (
        "  tolerance: {position: 0.002}\n"
        "  owners: {frame_calibration: metrology, timing: controls}\n"
    )
    twin = make_twin(tmp_path, [zeros_record(SMALL)], budget=declared(more=more))
    golden = tmp_path / "golden" / "home.yaml"
    golden.parent.mkdir()
    golden.write_text(
        "schema: 1\nkind: fk\ntitle: home\ntarget: {frames: [tool]}\n"
        "stimulus: {poses: [reference]}\n"
        "tolerance: {position: 1 mm, orientation: 5 mrad}\n"
    )
    found = budget_of_file(str(twin))
    share = found["total"]["share"]
    assert share["position"] == pytest.approx(found["total"]["sampled"]["position"] / 0.002)
    assert share["rotation"] is None
    categories = {one["category"]: one for one in found["categories"]}
    assert categories["frame_calibration"]["owner"] == "metrology"
    assert categories["sensing"]["owner"] is None
    assert categories["sensing"]["owner_said"] == "no owner is declared"
    assert found["notes"] == []
    assert categories["asset_and_geometry"]["evidence"]["goldens"] == ["golden/home"]
    (record,) = categories["frame_calibration"]["evidence"]["records"]
    assert (record["id"], record["file"], len(record["sha256"])) == (
        "zeros", "calibrations0.json", 64,
    )  # fmt: skip


def test_held_out_error_above_the_predicted_one_counts_as_unmodelled(tmp_path: Path) -> None:
    record = zeros_record(SMALL, held_out={"distance_rms": 0.003})
    found = budget_of_file(str(make_twin(tmp_path, [record], budget=declared())))
    explained = found["lines"][0]["linear"]["position"]
    (one,) = found["unmodelled"]
    assert one["position"]["beyond"] == pytest.approx(np.sqrt(0.003**2 - explained**2), rel=1e-9)
    category = found["categories"][-1]
    assert (category["category"], category["state"]) == ("unmodelled", "measured")
    assert category["moves"] is None
    assert found["total"]["linear"]["position"] == pytest.approx(explained)


def test_held_out_errors_of_joints_are_converted_to_errors_of_the_frame(tmp_path: Path) -> None:
    names, units = ["shoulder.viscous_friction"], ["N*m*s/rad"]
    record = fit_record(names, [0.01], units, {"shoulder": 0.004, "elbow": 0.003})
    twin = make_twin(tmp_path, fits=[record], budget=declared([{"shoulder": 0.2}]))
    (one,) = budget_of_file(str(twin))["unmodelled"]
    # For a straight arm, the lever of the shoulder is the whole arm, that of the elbow the forearm.
    expected = np.hypot(0.004 * (UPPER + FORE), 0.003 * FORE)
    assert one["position"]["held_out"] == pytest.approx(expected, rel=1e-9)
    assert one["rotation"]["held_out"] == pytest.approx(np.hypot(0.004, 0.003), rel=1e-9)


def test_parameters_without_a_counterpart_in_the_model_are_reported_as_left_out(
    tmp_path: Path,
) -> None:
    record = with_pose(
        zeros_record(SMALL), "hand_eye", ("wrist", "camera"), (0, 0, 0), 1e-6 * np.eye(6)
    )
    found = budget_of_file(str(make_twin(tmp_path, [record], budget=declared())))
    assert "hand_eye: the model has no frame 'wrist'" in found["lines"][0]["left_out"]
    record["records"]["hand_eye"]["parent"] = "upper"
    found = budget_of_file(str(make_twin(tmp_path, [record], budget=declared())))
    assert any("not fixed to the link of 'tool'" in t for t in found["lines"][0]["left_out"])
    names = ["elbow.joint_spring", "robot.gear_efficiency"]
    twin = make_twin(tmp_path, fits=[fit_record(names, [1e-3, 1e-3], ["N*m/rad", "1"])])
    found = budget_of_file(str(twin))
    (line,) = found["lines"]
    assert line["linear"] is None
    assert all(any(name in text for text in line["left_out"]) for name in names)
    states = {one["category"]: one for one in found["categories"]}
    assert states["compliance_and_backlash"]["estimates"][0]["std"] == pytest.approx(1e-3)


def test_an_expression_of_base_parameters_is_assigned_to_its_joint_or_left_out(
    tmp_path: Path,
) -> None:
    """Symbols number the joints from 1; with a joint without effort they are ambiguous."""
    arm = ARM.replace('axis="0 0 1"', 'axis="0 1 0"')
    record = fit_record(["mx2 + 0.1*m2"], [0.02], ["kg*m"])
    twin = make_twin(tmp_path, fits=[record], budget=declared([{"elbow": 0.0}]), arm=arm)
    (line,) = budget_of_file(str(twin))["lines"]
    # The weight of the forearm acts on both joints.
    for joint in ("shoulder", "elbow"):
        assert line["effort"][joint]["rms"] == pytest.approx(0.02 * 9.81, rel=1e-9)
    record["without_effort"] = ["wrist"]
    twin = make_twin(tmp_path, fits=[record], budget=declared([{"elbow": 0.0}]), arm=arm)
    (line,) = budget_of_file(str(twin))["lines"]
    assert line["effort"] == {}
    assert line["left_out"][0].startswith("mx2 + 0.1*m2: no rule carries it")


def test_contact_and_sensor_parameters_have_a_category_but_cause_no_position_error(
    tmp_path: Path,
) -> None:
    contact = fit_record(["cube.contact_friction", "cube.contact_offset"], [0.01, 1e-4], ["1", "m"])
    sensor = fit_record(
        ["wrist.sensor_bias_fx", "wrist.sensor_filter_time"], [0.02, 1e-4], ["N", "s"]
    )
    for ident, record in (("table", contact), ("wrist", sensor)):
        record.update(identification=ident, held_out={}, fit={})
    found = budget_of_file(str(make_twin(tmp_path, fits=[contact, sensor], budget=declared())))
    states = {one["category"]: one for one in found["categories"]}
    for category, name in (
        ("contact_and_material", "cube.contact_friction"),
        ("sensing", "wrist.sensor_bias_fx"),
        ("timing", "wrist.sensor_filter_time"),
    ):
        own = states[category]
        assert name in {one["name"] for one in own["estimates"]}
        assert {record["id"] for record in own["evidence"]["records"]} & {"table", "wrist"}
        assert own["moves"] is None
    # One record is one line: filter time and bias are counted together in it.
    assert [line["id"] for line in found["lines"]] == ["table", "wrist"]
    assert states["timing"]["state"] in ("measured", "counted_elsewhere")
    assert states["timing"]["lines"] + states["sensing"]["lines"] == ["wrist"]
    assert found["total"]["linear"] is None


_HELD = 9.81 * 1.0 * 0.1
"""Torque that holds the forearm level, N*m: 1 kg at 0.1 m."""


@pytest.mark.parametrize(
    ("name", "unit", "deviation", "moved"),
    [
        ("elbow.backlash", "rad", 0.002, 0.5 * 0.002),
        ("elbow.joint_elasticity", "N*m/rad", 0.001, _HELD / 0.5**2 * 0.001),
        ("elbow.joint_elasticity", "rad/(N*m)", 0.001, _HELD * 0.001),
        ("elbow.controller_gain", "1", 0.02, _HELD / (100.0 * 1.5**2) * 0.02),
        ("elbow.controller_gain.stiffness_error", "1", 0.02, _HELD / (100.0 * 1.5**2) * 0.02),
        ("elbow.servo_stiffness", "N*m/rad", 0.01, _HELD / 0.5**2 * 0.01),
    ],
)
def test_errors_of_gears_and_gains_deflect_the_joint_under_the_weight_of_the_links(
    tmp_path: Path, name: str, unit: str, deviation: float, moved: float
) -> None:
    """Closed-form deflections of a level forearm; the value in the record is 0.5."""
    arm = ARM.replace('axis="0 0 1"', 'axis="0 1 0"').replace(
        '<motor name="m2" joint="elbow"/>', '<position name="m2" joint="elbow" kp="100"/>'
    )
    record = fit_record([name], [deviation], [unit])
    record["fit"] = {}
    twin = make_twin(tmp_path, fits=[record], budget=declared([{"elbow": 0.0}]), arm=arm)
    (line,) = budget_of_file(str(twin))["lines"]
    assert line["linear"]["position"] == pytest.approx(moved * FORE, rel=1e-6)
    assert line["sampled"]["position"] == pytest.approx(moved * FORE, rel=0.02)
    assert "gears and gains" in line["method"]


@pytest.mark.parametrize("by", ["effects.json", "fit"])
def test_the_gain_that_the_model_contains_is_counted_once(tmp_path: Path, by: str) -> None:
    """The servo has 100 N*m/rad in the nominal model, and 1.5 times as much in the fitted one."""
    nominal = ARM.replace('axis="0 0 1"', 'axis="0 1 0"').replace(
        '<motor name="m2" joint="elbow"/>', '<position name="m2" joint="elbow" kp="100"/>'
    )
    record = fit_record(["elbow.controller_gain.stiffness_error"], [0.02], ["1"])
    record["fit"] = {"actuator": {"m2": {"kp": 150.0}}} if by == "fit" else {}
    path = make_twin(tmp_path, fits=[record], budget=declared([{"elbow": 0.0}]), arm=nominal)
    if by == "effects.json":
        gain = {
            "effect": "controller_gain", "joint": "elbow", "in_model": True,
            "values": {"stiffness_error": 0.5, "damping_error": 0.0},
        }  # fmt: skip
        listed = {"schema": 1, "joints": ["shoulder", "elbow"], "effects": [gain]}
        (tmp_path / "effects.json").write_text(json.dumps(listed))
        model = tmp_path / "arm.xml"
        model.write_text(model.read_text().replace('kp="100"', 'kp="150"'))
    (line,) = budget_of_file(str(path))["lines"]
    moved = _HELD / (100.0 * 1.5**2) * 0.02
    assert line["linear"]["position"] == pytest.approx(moved * FORE, rel=1e-6)


def test_a_controller_gain_of_a_joint_without_servo_is_left_out_with_a_reason(
    tmp_path: Path,
) -> None:
    record = fit_record(["elbow.controller_gain"], [0.02], ["1"])
    found = budget_of_file(str(make_twin(tmp_path, fits=[record], budget=declared())))
    (line,) = found["lines"]
    assert line["linear"] is None
    assert any("no position servo drives this joint" in words for words in line["left_out"])


def test_an_error_of_joint_elasticity_deflects_the_joint_under_the_recorded_effort(
    tmp_path: Path,
) -> None:
    """Constant effort: the deflection per error of the stiffness is effort / stiffness^2."""
    effort, deviation = 0.02, 0.001
    names = ["elbow.joint_elasticity", "elbow.armature"]
    record = fit_record(names, [deviation, 0.0], ["N*m/rad", "kg*m^2"])
    record["fit"] = {}
    budget = "budget:\n  frame: tool\n  recordings: [motion.mcap]\n"
    twin = make_twin(tmp_path, fits=[record], budget=budget)
    record_motion(tmp_path / "motion.mcap", np.zeros((51, 2)), np.tile([0.0, effort], (51, 1)))
    (line,) = budget_of_file(str(twin))["lines"]
    expected = effort / 0.5**2 * deviation * FORE
    assert line["linear"]["position"] == pytest.approx(expected, rel=0.02)
