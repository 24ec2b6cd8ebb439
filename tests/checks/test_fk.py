from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from check_robots import (
    ARM,
    QUICK,
    failed,
    from_first,
    golden,
    measure,
    random_robots,
    record,
    robot,
)
from hypothesis import given

from pytest_twin.checks.base import NothingToProposeError
from pytest_twin.checks.fk import ForwardKinematics
from pytest_twin.errors import SpecError

CHECK = ForwardKinematics()


def arm_spec(**changes: object) -> object:
    fields = {
        "target": {"frames": ["tcp", "left"]},
        "stimulus": {"poses": ["home", {"joints": {"elbow": "90 deg"}}, {"seed": 1, "count": 5}]},
        "tolerance": {"position": "1 um", "orientation": "1e-6 rad"},
    }
    return golden(CHECK, **fields | changes)


def test_forward_kinematics_of_an_unchanged_arm_pass_against_record_and_pinocchio(
    tmp_path: Path,
) -> None:
    arm = robot(tmp_path)
    measures = measure(CHECK, record(CHECK, arm_spec(), arm), arm)
    assert failed(measures) == []
    assert len(measures) == 8
    assert all(m.error < 1e-12 for m in measures)


def test_the_tool_position_at_a_bent_elbow_equals_the_closed_form(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    spec = arm_spec(stimulus={"poses": [{"name": "bent", "joints": {"elbow": "90 deg"}}]})
    observation = CHECK.observe(spec, arm, lambda fraction: None)
    position = observation.values["frames"]["bent"]["tcp"][:3]
    np.testing.assert_allclose(position, [0.25, 0, 0.1 + 0.08 + 0.3], atol=1e-12)


# Faults as they occur in updated models of suppliers.
FAULTS = {
    "flipped axis": ('name="elbow" axis="0 1 0"', 'name="elbow" axis="0 -1 0"', "both"),
    "swapped axis": ('name="elbow" axis="0 1 0"', 'name="elbow" axis="1 0 0"', "both"),
    "millimetres": (
        '<body name="forearm" pos="0 0 0.3">',
        '<body name="forearm" pos="0 0 300">',
        "both",
    ),
    "rotated tool": ('euler="0 0 0.3"', 'euler="0 0 0.31"', "tcp"),
    "moved tool": ('pos="0 0 0.05" euler', 'pos="0 0 0.0501" euler', "tcp"),
    "reversed mimic": ("0 1 0 0 0", "0 -1 0 0 0", "none"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_changed_kinematic_chain_fails_the_affected_frames(tmp_path: Path, fault: str) -> None:
    old, new, frames = FAULTS[fault]
    spec = record(CHECK, arm_spec(), robot(tmp_path))
    assert ARM.count(old) == 1
    faults = failed(measure(CHECK, spec, robot(tmp_path, ARM.replace(old, new))))
    expected = {"both": {"tcp", "left"}, "tcp": {"tcp"}, "none": set()}[frames]
    assert {m.subject.split()[0] for m in faults} == expected
    assert {m.against for m in faults} <= {"golden"}


def test_a_reversed_mimic_fails_the_following_finger(tmp_path: Path) -> None:
    spec = record(CHECK, arm_spec(target={"frames": ["right"]}), robot(tmp_path))
    turned = robot(tmp_path, ARM.replace("0 1 0 0 0", "0 -1 0 0 0"))
    assert {m.name for m in failed(measure(CHECK, spec, turned))} == {"position"}


def test_a_failure_names_the_worst_pose_with_its_error(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    spec = record(CHECK, arm_spec(), arm)
    observation = CHECK.observe(spec, arm, lambda fraction: None)
    observation.values["frames"]["seed 1 #3"]["tcp"][2] += 0.0021
    [fault] = failed([m for m in CHECK.compare(spec, observation, None) if m.against == "golden"])
    assert fault.subject == "tcp at seed 1 #3"
    assert fault.error == pytest.approx(0.0021)
    assert fault.margin == pytest.approx(1e-6 - 0.0021)
    assert fault.unit == "m"


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_non_finite_position_fails(tmp_path: Path, bad: float) -> None:
    arm = robot(tmp_path)
    spec = record(CHECK, arm_spec(), arm)
    observation = CHECK.observe(spec, arm, lambda fraction: None)
    observation.values["frames"]["home"]["tcp"][0] = bad
    assert {m.subject for m in failed(CHECK.compare(spec, observation, None))} == {"tcp at home"}


def test_a_pose_without_recorded_value_fails(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    spec = record(CHECK, arm_spec(), arm)
    del spec.expected["frames"]["home"]
    faults = failed(measure(CHECK, spec, arm))
    assert {(m.subject, m.against) for m in faults} == {
        ("tcp at home", "golden"),
        ("left at home", "golden"),
    }


@QUICK
@given(text=random_robots())
def test_forward_kinematics_of_random_robots_agree_with_pinocchio(
    tmp_path: Path, text: str
) -> None:
    realization = robot(tmp_path, text)
    spec = from_first(CHECK, realization)
    measures = measure(CHECK, spec, realization)
    assert failed(measures) == []
    assert measures


def test_a_simulator_that_disagrees_with_pinocchio_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = robot(tmp_path)
    assert arm.reference.mass() > 0  # the reference is built before the model is changed
    arm.model.jnt_axis[arm.joint_index("lift")] *= -1.0
    faults = failed(measure(CHECK, arm_spec(), arm))
    assert {m.against for m in faults} == {"pinocchio"}


def test_an_unknown_frame_is_refused_with_its_line(tmp_path: Path) -> None:
    spec = arm_spec(target={"frames": ["tpc"]}, lines={"target.frames": 4, "target.frames.0": 5})
    with pytest.raises(SpecError) as caught:
        measure(CHECK, spec, robot(tmp_path))
    assert str(caught.value) == (
        "golden/spec.yaml:5: target.frames.0: no frame of this name "
        "(got 'tpc'; expected did you mean 'tcp'?)"
    )


def test_forward_kinematics_depend_on_kinematics_poses_and_couplings_only(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    parts = set(CHECK.depends(arm_spec(), arm.structure))
    assert parts <= set(arm.parts)
    assert "mujoco/kinematics:forearm" in parts
    assert "mujoco/keyframe:home" in parts
    assert not any(":limit" in p or "/inertia:" in p or "/actuator:" in p for p in parts)
    assert not any(p.startswith("mujoco/limit:") for p in parts)
    [only] = [
        p
        for p in CHECK.depends(arm_spec(target={"frames": ["right"]}), arm.structure)
        if "coupling" in p
    ]
    assert "mimic" in only


def test_the_proposed_golden_covers_sites_and_last_links(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    assert CHECK.first(arm)[0]["target"] == {"frames": ["left", "right", "tcp"]}
    spec = record(CHECK, from_first(CHECK, arm), arm)
    assert failed(measure(CHECK, spec, arm)) == []


def test_for_a_model_without_joints_nothing_is_proposed(tmp_path: Path) -> None:
    rigid = robot(tmp_path, '<mujoco><worldbody><body><geom size="1"/></body></worldbody></mujoco>')
    with pytest.raises(NothingToProposeError, match="no joint moves a frame that has a name"):
        CHECK.first(rigid)
