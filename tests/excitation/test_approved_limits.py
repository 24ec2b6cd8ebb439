"""Limits that a person has to approve: missing and impossible ones are refused with a reason."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from approved_arms import ARM, approved_for_arm, loaded, write_twin

from pytest_twin import cli
from pytest_twin.errors import TwinError
from pytest_twin.excitation.approved_limits import missing_lines
from pytest_twin.excitation.excite import excite, missing_template
from pytest_twin.excitation.read_limits import read_approved

pytestmark = pytest.mark.usefixtures("commands_in_process")

JOINTS = ("lift", "elbow")


def changed_limits(field: str, value: Any) -> dict[str, Any]:
    """The approved limits of the arm with one field changed, or removed if the value is None."""
    section = approved_for_arm()
    at: Any = section
    *tables, last = field.split(".")
    for name in tables:
        at = at[int(name)] if isinstance(at, list) else at[name]
    if value is None:
        del at[last]
    else:
        at[last] = value
    return section


@pytest.mark.parametrize(
    "field",
    [
        "approved_by", "mechanisms", "duration", "rate", "task_band", "joints.lift.position",
        "joints.elbow.velocity", "joints.lift.acceleration", "joints.elbow.effort",
        "joints.lift.start", "workspace", "clearance.self", "clearance.environment",
        "supply.voltage", "supply.current", "stop.category", "stop.reaction", "stop.plan",
    ],
)  # fmt: skip
def test_each_missing_limit_is_reported(field: str) -> None:
    assert missing_lines(approved_for_arm(), JOINTS) == []
    assert missing_lines(changed_limits(field, None), JOINTS) == [field]


def test_the_limits_of_a_missing_joint_and_incomplete_limits_are_reported() -> None:
    lines = [f"joints.elbow.{n}" for n in ("position", "velocity", "acceleration", "effort")]
    assert missing_lines(changed_limits("joints.elbow", None), JOINTS) == [
        *lines,
        "joints.elbow.start",
    ]
    section = approved_for_arm()
    section["joints"]["lift"]["position"] = [None, 1.0]
    assert missing_lines(section, JOINTS) == ["joints.lift.position"]


def test_a_joint_held_still_needs_no_limits(tmp_path: Path) -> None:
    section = changed_limits("joints.elbow", None)
    section["hold"] = ["elbow"]
    assert missing_lines(section, JOINTS) == []
    realization, twin = loaded(write_twin(tmp_path, section))
    assert read_approved(realization, twin).names == ("lift",)


def test_without_limits_the_command_prints_a_template_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tmp_path / "arm.xml"
    model.write_text(ARM)
    out = tmp_path / "out"
    assert cli.main(["excite", str(model), "--out", str(out)]) == 2
    words, err = capsys.readouterr()
    (line,) = err.splitlines()
    assert "no motion without approved limits; missing: excitation.approved_by" in line
    assert "excitation.joints.elbow.effort" in line
    assert not out.exists()
    blank = yaml.safe_load(words)
    assert blank["model"] == "arm.xml"
    assert set(blank["excitation"]["joints"]) == {"lift", "elbow"}
    assert blank["excitation"]["joints"]["lift"] == dict.fromkeys(
        ("position", "velocity", "acceleration", "effort", "start")
    )
    assert re.search(r"position: +# rad, .*the model: -2 to 2", words)


def test_a_template_is_complete_once_it_is_filled_in(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    text = missing_template(str(tmp_path / "arm.xml"))["template"]
    (tmp_path / "twin.yaml").write_text(text)
    # A twin with an unfilled template can still be loaded.
    realization, twin = loaded(tmp_path / "twin.yaml")
    with pytest.raises(TwinError, match=r"missing: excitation\.approved_by"):
        read_approved(realization, twin)
    blank = yaml.safe_load(text)["excitation"]

    def fill(empty: Any, given: Any) -> Any:
        if isinstance(empty, dict):
            return {name: fill(value, given[name]) for name, value in empty.items()}
        return given

    realization, twin = loaded(write_twin(tmp_path, fill(blank, approved_for_arm())))
    assert read_approved(realization, twin).names == JOINTS


REFUSED = [
    ("joints.lift.position", [1.2, -1.2], "the lowest position is not below the highest",
     "got '1.2 to -1.2' rad"),
    ("joints.lift.position", [-3.0, 1.2], "beyond the joint's range",
     "expected within -2 to 2 rad"),
    ("joints.lift.start", 1.3, "starts outside the approved positions", "between -1.2 and 1.2 rad"),
    ("joints.elbow.velocity", -2.0, "not a positive limit", "got -2.0 rad/s"),
    ("joints.elbow.acceleration", 0, "not a positive limit", "got 0.0 rad/s^2"),
    ("joints.lift.effort", 21.0, "above the limit of the model's joint",
     "got 21.0 N*m; expected at most 20 N*m"),
    ("task_band", [2.0, 0.2], "no band of frequencies", "got '2 to 0.2' Hz"),
    ("rate", 10.0, "too few commands for the task's highest frequency", "at least 20 Hz"),
    ("duration", 1.0, "shorter than one period", "at least 4.5 s"),
    ("workspace.0.frame", "tp", "the model has no frame 'tp'", "tip"),
    ("workspace.0.max", [1.0, -1.0, 1.0], "an empty box along y", "more than -1 m"),
    ("clearance.ignore", [["upper", "lowr"]], "no body or geom of this name", "lower"),
    ("supply.voltage", 0.0, "no supply", "got 0.0 V"),
    ("joints.wrist", {"velocity": 1.0}, "the model has no joint 'wrist'", "expected one of"),
]  # fmt: skip


@pytest.mark.parametrize(("field", "value", "problem", "details"), REFUSED)
def test_impossible_limits_are_refused_with_line_and_reason(
    tmp_path: Path, field: str, value: Any, problem: str, details: str
) -> None:
    realization, twin = loaded(write_twin(tmp_path, changed_limits(field, value)))
    with pytest.raises(TwinError) as caught:
        read_approved(realization, twin)
    words = str(caught.value)
    assert re.search(rf"twin\.yaml:\d+: excitation\.{re.escape(field.rpartition('.')[0])}", words)
    assert problem in words
    assert details in words


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("mechanisms", ["everything"]), ("duration", -1), ("clearance.self", -0.1),
        ("stop.category", 3), ("joints.lift.velocity", "fast"), ("surprise", 1),
        ("joints.lift.effort_noise", 0), ("margin", 1.5),
    ],
)  # fmt: skip
def test_the_schema_refuses_invalid_values(tmp_path: Path, field: str, value: Any) -> None:
    with pytest.raises(TwinError, match=r"twin\.yaml:\d+: excitation"):
        loaded(write_twin(tmp_path, changed_limits(field, value)))


def test_a_start_pose_with_too_little_clearance_is_refused_with_the_pairs(tmp_path: Path) -> None:
    section = approved_for_arm(clearance={"self": 0.01, "environment": 0.5})
    realization, twin = loaded(write_twin(tmp_path, section))
    with pytest.raises(TwinError) as caught:
        excite(realization, twin)
    words = str(caught.value)
    assert "the start is not clear: lower and world 0.4257 m" in words
    assert "upper and world 0.47 m (least 0.525 m)" in words
    assert "clearance.ignore" in words


def test_a_start_pose_with_too_large_gravity_torque_is_refused(tmp_path: Path) -> None:
    realization, twin = loaded(write_twin(tmp_path, changed_limits("joints.lift.effort", 1.0)))
    with pytest.raises(TwinError, match="gravity alone needs more at the start"):
        excite(realization, twin)


def test_a_model_without_collision_shapes_needs_clearance_none(tmp_path: Path) -> None:
    bare = ARM.replace('size=".03"', 'size=".03" contype="0" conaffinity="0"')
    bare = bare.replace('<geom name="floor"', '<geom name="floor" contype="0" conaffinity="0"')
    section = approved_for_arm()
    realization, twin = loaded(write_twin(tmp_path, section, bare))
    with pytest.raises(TwinError, match="no two bodies with shapes that can collide"):
        read_approved(realization, twin)
    section = approved_for_arm(clearance="none")
    realization, twin = loaded(write_twin(tmp_path, section, bare))
    assert read_approved(realization, twin).clearance is None
