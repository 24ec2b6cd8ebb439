from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from check_robots import ARM, failed, golden, measure, record, robot

from pytest_twin.checks.limits import Limits
from pytest_twin.errors import SpecError

CHECK = Limits()
JOINTS = {
    "pan": {"hard": ["-2 rad", "2 rad"], "soft": [-1.9, 1.9], "effort": "10 N*m"},
    "lift": {"hard": [-1.5, 1.5], "effort": "20 N*m"},
    "elbow": {"hard": [-2.2, 2.2], "soft": [-2, 2], "effort": 5},
    "left": {"hard": ["0 mm", "30 mm"], "soft": [0, 0.03]},
}
TOLERANCE = {
    "angle": "1e-6 rad",
    "length": "1 um",
    "stop_angle": "2 deg",
    "stop_length": "3 mm",
    "angular_velocity": "0.01 rad/s",
    "linear_velocity": "1 mm/s",
    "torque": "0.01 N*m",
    "force": "0.01 N",
}


def arm_spec(joints: dict | None = None, **changes: object) -> object:
    fields = {"target": {"joints": joints or JOINTS}, "stimulus": {}, "tolerance": TOLERANCE}
    return golden(CHECK, **fields | changes)


def test_an_arm_with_the_declared_limits_passes(tmp_path: Path) -> None:
    measures = measure(CHECK, arm_spec(), robot(tmp_path))
    assert failed(measures) == []
    assert [m.subject for m in measures if m.subject.startswith("pan")] == [
        "pan: lower stop",
        "pan: upper stop",
        "pan: pushed past the lower stop",
        "pan: pushed past the upper stop",
        "pan: lower soft bound, inside the stop",
        "pan: upper soft bound, inside the stop",
        "pan: commanded past the lower soft bound",
        "pan: commanded past the upper soft bound",
        "pan: negative effort limit",
        "pan: positive effort limit",
        "pan: negative effort, commanded past",
        "pan: positive effort, commanded past",
    ]


FAULTS = {
    "a wider range": (
        'axis="0 0 1" range="-2 2"',
        'axis="0 0 1" range="-2 2.1"',
        {"pan: upper stop": 0.1},
    ),
    "degrees for radians": (
        'range="-2.2 2.2"',
        'range="-126 126"',
        {"elbow: lower stop": 123.8, "elbow: upper stop": 123.8},
    ),
    "no stop": (
        'axis="0 1 0" range="-1.5 1.5"',
        'axis="0 1 0"',
        {"lift: lower stop": np.inf, "lift: upper stop": np.inf},
    ),
    "a wider command": (
        'kp="30" ctrlrange="-2 2"',
        'kp="30" ctrlrange="-2 2.05"',
        {"elbow: commanded past the upper soft bound": 0.05},
    ),
    "no bound on commands": (
        'kp="30" ctrlrange="-2 2"',
        'kp="30"',
        {
            "elbow: commanded past the lower soft bound": 998.0,
            "elbow: commanded past the upper soft bound": 998.0,
        },
    ),
    "a stronger servo": (
        'forcerange="-5 5"',
        'forcerange="-5 6"',
        {"elbow: positive effort limit": 1.0, "elbow: positive effort, commanded past": 1.0},
    ),
    "a stronger gear": (
        'gear="20"',
        'gear="21"',
        {
            "lift: negative effort limit": 1.0,
            "lift: positive effort limit": 1.0,
            "lift: negative effort, commanded past": 1.0,
            "lift: positive effort, commanded past": 1.0,
        },
    ),
    "a motor without bound": (
        'gear="20" ctrlrange="-1 1"',
        'gear="20"',
        {
            "lift: negative effort, commanded past": 19980.0,
            "lift: positive effort, commanded past": 19980.0,
        },
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_limit_fails_with_its_size(tmp_path: Path, fault: str) -> None:
    old, new, expected = FAULTS[fault]
    assert ARM.count(old) == 1
    faults = failed(measure(CHECK, arm_spec(), robot(tmp_path, ARM.replace(old, new))))
    assert {m.subject for m in faults} == set(expected)
    for found in faults:
        assert found.error == pytest.approx(expected[found.subject], rel=1e-6)


def test_commands_that_are_not_limited_fail(tmp_path: Path) -> None:
    text = ARM.replace(
        '<option timestep="0.001"/>',
        '<option timestep="0.001"><flag clampctrl="disable"/></option>',
    )
    subjects = {m.subject for m in failed(measure(CHECK, arm_spec(), robot(tmp_path, text)))}
    assert "pan: commanded past the upper soft bound" in subjects
    assert "lift: positive effort, commanded past" in subjects


def test_a_compliant_stop_fails(tmp_path: Path) -> None:
    weak = ARM.replace('axis="0 0 1" range', 'axis="0 0 1" solreflimit="0.3 1" range')
    faults = failed(measure(CHECK, arm_spec(), robot(tmp_path, weak)))
    assert {m.subject for m in faults} == {
        "pan: pushed past the lower stop",
        "pan: pushed past the upper stop",
    }
    assert {m.name for m in faults} == {"stop_angle"}
    assert failed(measure(CHECK, arm_spec(stimulus={"push": 0.001}), robot(tmp_path, weak))) == []
    subjects = [m.subject for m in measure(CHECK, arm_spec(stimulus={"push": 0}), robot(tmp_path))]
    assert not any("pushed" in subject for subject in subjects)


def test_deflection_of_a_stop_follows_push_and_time_constant(tmp_path: Path) -> None:
    """At rest the deflection is proportional to the push and to the squared time constant."""

    def deflection(push: float, time_constant: float) -> list[float]:
        text = f"""<mujoco><compiler angle="radian" autolimits="true"/>
          <option timestep="0.0005"/><worldbody><body name="b">
          <joint name="j" range="-1 1" damping="1" solreflimit="{time_constant} 1"
            solimplimit="0.9 0.9 0.001"/>
          <inertial mass="1" pos="0 0 0" diaginertia="0.1 0.1 0.1"/></body></worldbody></mujoco>"""
        spec = arm_spec({"j": {"hard": [-1, 1], "effort": push}}, stimulus={"duration": "3 s"})
        observation = CHECK.observe(spec, robot(tmp_path, text), lambda fraction: None)
        return observation.values["joints"]["j"]["stop"]

    lower, upper = deflection(0.5, 0.05)
    assert lower == pytest.approx(upper)
    assert upper > 1e-4
    assert deflection(1.0, 0.05)[1] == pytest.approx(2 * upper, rel=1e-3)
    assert deflection(0.5, 0.1)[1] == pytest.approx(4 * upper, rel=1e-3)


def test_held_arm_joints_do_not_change_the_stop_deflection_of_a_light_finger(
    tmp_path: Path,
) -> None:
    """The stop of a 20 g finger deflects as much on an arm with held joints as alone."""
    alone = """<mujoco><option timestep="0.001"/><worldbody><body name="left">
      <joint name="left" type="slide" axis="1 0 0" range="0 0.03" damping="5"/>
      <geom type="box" size="0.004 0.01 0.02" mass="0.02"/></body></worldbody></mujoco>"""
    joints = {"left": {"hard": [0, 0.03], "effort": "0.5 N"}}
    single = ARM.replace(' armature="0.2"', "").replace(
        '<joint name="mimic" joint1="right" joint2="left" polycoef="0 1 0 0 0"/>', ""
    )
    assert 'armature="0.2"' not in single
    assert "mimic" not in single
    stops = [
        CHECK.observe(arm_spec(joints), robot(tmp_path, text), lambda fraction: None).values[
            "joints"
        ]["left"]["stop"]
        for text in (alone, single)
    ]
    assert max(stops[0]) > 1e-4
    assert stops[1] == pytest.approx(stops[0], rel=1e-3)


def test_velocity_limit_is_compared_with_the_reached_speed(tmp_path: Path) -> None:
    # At 20 N*m the damping of 0.5 N*m*s/rad limits the speed of the lift joint.
    fast = CHECK.observe(
        arm_spec({"lift": {"velocity": "1 rad/s"}}), robot(tmp_path), lambda fraction: None
    ).values["joints"]["lift"]["velocity_reached"]
    assert 1.0 < fast < 40.0
    spec = arm_spec({"lift": {"velocity": fast}})
    assert failed(measure(CHECK, spec, robot(tmp_path))) == []
    [fault] = failed(measure(CHECK, arm_spec({"lift": {"velocity": 1}}), robot(tmp_path)))
    assert fault.subject == "lift: speed, commanded past"
    assert fault.error == pytest.approx(fast - 1.0)


URDF = """<robot name="r"><link name="a"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="b"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
  <limit lower="-1" upper="2" effort="7" velocity="3"/></joint></robot>"""


def test_velocity_and_effort_limits_of_a_urdf_are_checked(tmp_path: Path) -> None:
    joints = {"j": {"hard": [-1, 2], "velocity": "3 rad/s", "effort": "7 N*m"}}
    assert failed(measure(CHECK, arm_spec(joints), robot(tmp_path, URDF, "r.urdf"))) == []
    changed = URDF.replace('velocity="3"', 'velocity="4"').replace('effort="7"', 'effort="8"')
    faults = failed(measure(CHECK, arm_spec(joints), robot(tmp_path, changed, "r.urdf")))
    assert {m.subject for m in faults} >= {"j: velocity limit", "j: positive effort limit"}


def test_a_declared_limit_missing_in_the_model_fails(tmp_path: Path) -> None:
    joints = {"right": {"velocity": "1 m/s", "effort": "3 N"}}
    faults = failed(measure(CHECK, arm_spec(joints), robot(tmp_path)))
    assert [m.subject for m in faults] == [
        "right: effort limit, which the model lacks",
        "right: velocity limit, which the model lacks",
    ]


def test_a_continuous_joint_passes_only_if_declared_without_stops(tmp_path: Path) -> None:
    joints = {"pan": {"hard": "none"}}
    free = robot(tmp_path, ARM.replace('axis="0 0 1" range="-2 2"', 'axis="0 0 1"'))
    assert failed(measure(CHECK, arm_spec(joints), free)) == []
    assert len(failed(measure(CHECK, arm_spec(joints), robot(tmp_path)))) == 1


def test_a_soft_limit_beyond_the_stop_fails(tmp_path: Path) -> None:
    joints = {"lift": {"hard": [-1.5, 1.5], "soft": [-1.4, 1.6]}}
    [fault] = failed(measure(CHECK, arm_spec(joints), robot(tmp_path)))
    assert fault.subject == "lift: upper soft bound, inside the stop"
    assert fault.error == pytest.approx(0.1)


def test_a_non_finite_stop_deflection_fails(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    observation = CHECK.observe(arm_spec(), arm, lambda fraction: None)
    observation.values["joints"]["lift"]["stop"][0] = float("nan")
    assert {m.subject for m in failed(CHECK.compare(arm_spec(), observation, None))} == {
        "lift: pushed past the lower stop"
    }


@pytest.mark.parametrize(
    ("joints", "words"),
    [
        ({"pann": {"hard": [0, 1]}}, r"yaml:3: target.joints.pann: .*did you mean 'pan'\?"),
        ({"pan": {"hard": [1, 0]}}, r"target.joints.pan.hard: not a range .*lower, upper"),
        ({"pan": {"effort": "-3 N*m"}}, r"target.joints.pan.effort: not a limit .*above zero"),
        ({"pan": {"effort": "3 N"}}, r"target.joints.pan.effort: unit 'N' does not fit"),
        ({"left": {"velocity": "3 rad/s"}}, r"unit 'rad/s' does not fit"),
    ],
)
def test_invalid_limits_are_refused_with_the_expected_form(
    tmp_path: Path, joints: dict, words: str
) -> None:
    with pytest.raises(SpecError, match=words):
        measure(CHECK, arm_spec(joints, lines={"target.joints": 3}), robot(tmp_path))


def test_a_missing_tolerance_of_a_limit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=r"tolerance.angle: missing: pan: lower stop"):
        measure(CHECK, arm_spec(tolerance={}), robot(tmp_path))


def test_limits_depend_on_stops_actuators_and_joints(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    parts = set(CHECK.depends(arm_spec(), arm.structure))
    assert parts <= set(arm.parts)
    assert {"mujoco/limit:pan", "mujoco/actuator:pan", "mujoco/joint:pan"} <= parts


def test_proposed_limit_goldens_pass_and_push_weak_stops_less(tmp_path: Path) -> None:
    weak = robot(
        tmp_path,
        ARM.replace('axis="0 0 1" range="-2 2"', 'axis="0 0 1" range="-2 2" solreflimit="0.3 1"'),
    )
    specs = CHECK.first(weak)
    assert [spec["name"] for spec in specs] == ["limits", "limits_tenth"]
    assert set(specs[1]["target"]["joints"]) == {"pan"}
    assert specs[1]["stimulus"] == {"push": 0.1}
    for spec in specs:
        first = golden(
            CHECK, target=spec["target"], stimulus=spec["stimulus"], tolerance=spec["tolerance"]
        )
        assert failed(measure(CHECK, record(CHECK, first, weak), weak)) == []


def test_a_motor_limited_by_its_control_range_gets_an_effort_limit(tmp_path: Path) -> None:
    text = """<mujoco><compiler angle="radian"/><worldbody><body name="link">
      <joint name="knee" axis="0 1 0" range="-1 1"/><geom size=".1"/></body></worldbody>
      <actuator><motor name="knee" joint="knee" gear="15" ctrlrange="{} 3"/></actuator></mujoco>"""
    (spec,) = CHECK.first(robot(tmp_path, text.format(-3)))
    assert spec["target"]["joints"]["knee"]["effort"] == pytest.approx(45.0)
    recorded = golden(CHECK, **{key: spec[key] for key in ("target", "stimulus", "tolerance")})
    weaker = measure(CHECK, recorded, robot(tmp_path, text.format(-2)))
    assert "knee: negative effort limit" in [measure.subject for measure in failed(weaker)]
