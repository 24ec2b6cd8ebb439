from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from check_robots import ARM, failed, from_first, golden, measure, record, robot

from pytest_twin.checks.joint_direction import JointDirection
from pytest_twin.errors import SpecError
from pytest_twin.realization import load
from pytest_twin.realization.engine import GAIN_PID

CHECK = JointDirection()
JOINTS = {
    "pan": {"frame": "turret", "rotation": [0, 0, 1], "actuator": "pan"},
    "lift": {"frame": "upper_arm", "rotation": [0, 1, 0], "actuator": "lift"},
    "elbow": {"frame": "tcp", "translation": [1, 0, 0], "actuator": "elbow"},
    "left": {"frame": "left", "translation": [1, 0, 0], "in": "palm", "actuator": "grip"},
    "right": {"frame": "right", "translation": [-1, 0, 0]},
}


def arm_spec(joints: dict | None = None, **changes: object) -> object:
    fields = {
        "target": {"joints": joints or JOINTS},
        "stimulus": {},
        "tolerance": {"direction": "0.1 deg"},
    }
    return golden(CHECK, **fields | changes)


def test_joints_that_move_in_the_declared_direction_pass(tmp_path: Path) -> None:
    measures = measure(CHECK, arm_spec(), robot(tmp_path))
    assert failed(measures) == []
    assert [m.subject for m in measures] == [
        "pan: rotation of turret",
        "pan: command of pan",
        "lift: rotation of upper_arm",
        "lift: command of lift",
        "elbow: translation of tcp",
        "elbow: command of elbow",
        "left: translation of left",
        "left: command of grip",
        "right: translation of right",
    ]
    assert all(m.error < 1e-9 and m.unit == "rad" for m in measures)


def test_directions_are_expressed_in_the_declared_frame(tmp_path: Path) -> None:
    joints = {
        "left": {"frame": "left", "translation": [1, 0, 0], "in": "palm"},
        "right": {"frame": "right", "translation": [0, 0, 1]},
    }
    # In this pose the x axis of the palm points down.
    spec = arm_spec(joints, stimulus={"pose": {"joints": {"elbow": "90 deg"}}})
    assert failed(measure(CHECK, spec, robot(tmp_path))) == []


FAULTS = {
    "a reversed axis": (
        'name="elbow" axis="0 1 0"',
        'name="elbow" axis="0 -1 0"',
        {"elbow: translation of tcp": np.pi},
    ),
    "a swapped axis": (
        'name="lift" axis="0 1 0"',
        'name="lift" axis="1 0 0"',
        {"lift: rotation of upper_arm": np.pi / 2},
    ),
    "a negative gear": (
        'joint="lift" gear="20"',
        'joint="lift" gear="-20"',
        {"lift: command of lift": np.pi},
    ),
    "a negative gain": (
        'joint="elbow" kp="30"',
        'joint="elbow" gear="-1" kp="30"',
        {"elbow: command of elbow": np.pi},
    ),
    "a tilted axis": (
        'name="pan" axis="0 0 1"',
        'name="pan" axis="0 0.01 1"',
        {"pan: rotation of turret": np.arctan(0.01)},
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_axis_or_gear_fails_with_its_angle(tmp_path: Path, fault: str) -> None:
    old, new, expected = FAULTS[fault]
    assert ARM.count(old) == 1
    faults = failed(measure(CHECK, arm_spec(), robot(tmp_path, ARM.replace(old, new))))
    assert {m.subject for m in faults} == set(expected)
    for fault_measure in faults:
        assert fault_measure.error == pytest.approx(expected[fault_measure.subject], rel=1e-6)


def test_swapped_joint_names_fail_because_the_frame_does_not_move(tmp_path: Path) -> None:
    swapped = (
        ARM.replace('<joint name="lift"', '<joint name="x"')
        .replace('<joint name="elbow"', '<joint name="lift"')
        .replace('<joint name="x"', '<joint name="elbow"')
    )
    faults = failed(measure(CHECK, arm_spec(), robot(tmp_path, swapped)))
    assert [m.subject for m in faults] == ["lift: rotation of upper_arm"]
    assert np.isnan(faults[0].error)


def test_a_motor_that_drives_another_joint_is_refused(tmp_path: Path) -> None:
    swapped = ARM.replace('name="lift" joint="lift"', 'name="lift" joint="elbow"')
    with pytest.raises(SpecError) as caught:
        measure(CHECK, arm_spec(lines={"target.joints.lift": 6}), robot(tmp_path, swapped))
    assert str(caught.value) == (
        "golden/spec.yaml:6: target.joints.lift.actuator: this actuator does not drive joint "
        "'lift' (got 'lift'; expected no actuator: nothing drives this joint)"
    )


def test_a_motor_without_effect_fails(tmp_path: Path) -> None:
    dead = robot(tmp_path, ARM.replace('joint="lift" gear="20"', 'joint="lift" gear="0"'))
    [fault] = failed(measure(CHECK, arm_spec(), dead))
    assert fault.subject == "lift: command of lift"
    assert np.isnan(fault.error)


def test_a_reversed_motor_passes_if_declared_negative(tmp_path: Path) -> None:
    joints = {"lift": JOINTS["lift"] | {"command": "negative"}}
    backwards = robot(tmp_path, ARM.replace('gear="20"', 'gear="-20"'))
    assert failed(measure(CHECK, arm_spec(joints), backwards)) == []
    assert len(failed(measure(CHECK, arm_spec(joints), robot(tmp_path)))) == 1


def test_a_frame_on_the_axis_has_no_translation(tmp_path: Path) -> None:
    joints = {"pan": {"frame": "turret", "translation": [1, 0, 0]}}
    [fault] = failed(measure(CHECK, arm_spec(joints), robot(tmp_path)))
    assert np.isnan(fault.error)


def test_a_strong_motor_on_a_light_link_gets_a_small_command(tmp_path: Path) -> None:
    text = """<mujoco><option timestep="0.002"/><worldbody>
      <body name="f"><joint name="j" axis="0 0 1"/>
        <inertial mass="0.01" pos="0 0 0.01" diaginertia="1e-6 1e-6 1e-6"/></body></worldbody>
      <actuator><motor name="m" joint="j" ctrlrange="-1000 1000"/></actuator></mujoco>"""
    model = robot(tmp_path, text)
    observation = CHECK.observe(from_first(CHECK, model), model, lambda fraction: None)
    assert 0 < observation.values["command"]["j"] <= 0.1


@pytest.mark.parametrize(
    "actuator",
    [
        '<velocity name="lift" joint="lift" kv="2" ctrlrange="-1 1"/>',
        '<position name="lift" joint="lift" kp="20" timeconst="0.02"/>',
        '<intvelocity name="lift" joint="lift" kp="20" actrange="-1 1"/>',
        '<dcmotor name="lift" joint="lift" motorconst="0.5" resistance="1"/>',
        '<pid name="lift" joint="lift" kp="20"/>',
    ],
)
@pytest.mark.parametrize("gear", [1, -1])
def test_the_direction_of_every_actuator_type_is_detected(
    tmp_path: Path, actuator: str, gear: int
) -> None:
    if "<pid" in actuator and GAIN_PID < 0:
        pytest.skip("this MuJoCo has no pid")
    old = '<motor name="lift" joint="lift" gear="20" ctrlrange="-1 1"/>'
    text = ARM.replace(old, actuator.replace("/>", f' gear="{gear}"/>'))
    assert text != ARM
    faults = failed(measure(CHECK, arm_spec({"lift": JOINTS["lift"]}), robot(tmp_path, text)))
    assert [m.error for m in faults] == ([] if gear > 0 else [np.pi])


def test_unknown_joints_and_frames_are_refused_with_their_line(tmp_path: Path) -> None:
    spec = arm_spec({"lift": {"frame": "uper_arm", "rotation": [0, 1, 0]}})
    with pytest.raises(SpecError, match=r"target.joints.lift.frame: .*did you mean 'upper_arm'"):
        measure(CHECK, spec, robot(tmp_path))
    spec = arm_spec({"lif": JOINTS["lift"]}, lines={"target.joints.lif": 4})
    with pytest.raises(SpecError, match=r"yaml:4: target.joints.lif: .*did you mean 'lift'"):
        measure(CHECK, spec, robot(tmp_path))


def test_joint_direction_depends_on_dynamics_only_if_an_actuator_is_declared(
    tmp_path: Path,
) -> None:
    structure = robot(tmp_path).structure
    still = set(CHECK.depends(arm_spec({"right": JOINTS["right"]}), structure))
    assert not any("actuator" in part or "inertia" in part for part in still)
    driven = set(CHECK.depends(arm_spec({"lift": JOINTS["lift"]}), structure))
    assert {"mujoco/actuator:lift", "mujoco/inertia:forearm"} <= driven


def test_the_proposed_golden_declares_the_directions_of_the_model(tmp_path: Path) -> None:
    arm = robot(tmp_path, ARM.replace('gear="20"', 'gear="-20"'))
    spec = record(CHECK, from_first(CHECK, arm), arm)
    assert spec.target["joints"]["lift"] == {
        "frame": "upper_arm",
        "rotation": [0.0, 1.0, 0.0],
        "actuator": "lift",
        "command": "negative",
    }
    assert failed(measure(CHECK, spec, arm)) == []


def test_joints_of_unnamed_bodies_are_not_proposed(tmp_path: Path) -> None:
    path = tmp_path / "pendulum.xml"
    path.write_text(
        "<mujoco><worldbody><body><joint name='a' axis='0 1 0'/><geom size='0.1'/>"
        "<body name='tip' pos='0 0 1'><joint name='b' axis='0 1 0'/><geom size='0.1'/></body>"
        "</body></worldbody></mujoco>"
    )
    (spec,) = CHECK.first(load(path))
    assert set(spec["target"]["joints"]) == {"b"}
