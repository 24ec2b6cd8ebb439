from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from check_robots import ARM, golden, robot
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pytest_twin.checks.fk import ForwardKinematics
from pytest_twin.checks.poses import Pose, recorded_poses, resolve_poses
from pytest_twin.errors import SpecError
from pytest_twin.realization import Realization

CHECK = ForwardKinematics()

FOUR_BAR = """
<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
  <body name="crank" pos="0 0 0"><joint name="crank" axis="0 1 0" range="-0.6 0.6"/>
    <geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.01"/>
    <body name="coupler" pos="0 0 0.3"><joint name="coupler" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.01"/></body></body>
  <body name="rocker" pos="0.5 0 0"><joint name="rocker" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.01"/></body>
</worldbody>
<equality><connect name="pin" body1="coupler" body2="rocker" anchor="0.5 0 0"/></equality>
</mujoco>
"""


def poses(realization: Realization, *entries: Any, **more: Any) -> list[Pose]:
    spec = golden(CHECK, target={"frames": ["x"]}, stimulus={"poses": list(entries)}, **more)
    return resolve_poses(spec, realization)


def test_poses_are_given_as_reference_keyframe_or_joint_values_with_units(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    reference, home, first, named = poses(
        arm,
        "reference",
        "home",
        {"joints": {"pan": "90 deg", "left": "5 mm"}},
        {"name": "reach", "joints": {"lift": 0.25}},
    )
    assert [p.name for p in (reference, home, first, named)] == [
        "reference", "home", "pose 3", "reach",
    ]  # fmt: skip
    assert set(reference.joints.values()) == {0.0}
    assert home.joints["elbow"] == 1.0
    assert first.joints["pan"] == pytest.approx(np.pi / 2)
    assert first.joints["left"] == pytest.approx(0.005)
    assert named.joints["lift"] == 0.25
    np.testing.assert_array_equal(arm.qpos(named.joints), named.qpos)


def test_a_mimic_joint_follows_its_leading_joint(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    for pose in poses(
        arm,
        {"joints": {"left": 0.02}},
        {"name": "b", "joints": {"right": 0.01}},
        {"seed": 1, "count": 9},
    ):
        assert pose.joints["right"] == pose.joints["left"]


@pytest.mark.parametrize("coefficients", ["0.01 0.5 0 0 0", "0 -1 0.3 0 0", "0.1 0 0 0 0"])
def test_poses_satisfy_polynomial_joint_couplings(tmp_path: Path, coefficients: str) -> None:
    text = f"""<mujoco><compiler autolimits="true"/><worldbody>
      <body><joint name="a" type="slide" range="-1 1" ref="0.3"/><geom size="0.1"/>
      <body><joint name="b" type="slide" range="-1 1" ref="-0.1"/><geom size="0.1"/>
      <body><joint name="c" type="slide" range="-2 2"/><geom size="0.1"/></body></body></body>
      </worldbody><equality>
        <joint joint1="c" joint2="b" polycoef="0 2 0 0 0"/>
        <joint joint1="b" joint2="a" polycoef="{coefficients}"/>
      </equality></mujoco>"""
    model = robot(tmp_path, text)
    data = mujoco.MjData(model.model)
    for pose in poses(model, {"joints": {"a": 0.5}}, {"seed": 2, "count": 10}):
        data.qpos[:] = pose.qpos
        mujoco.mj_forward(model.model, data)
        equality = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        assert np.count_nonzero(equality) == 2
        assert np.max(np.abs(data.efc_pos[equality])) < 1e-12
        assert set(pose.drawn or {}) <= {"a"}


def test_random_poses_respect_limits_of_coupled_joints(tmp_path: Path) -> None:
    narrow = ARM.replace(
        'axis="-1 0 0"\n                range="0 0.03"',
        'axis="-1 0 0" range="0 0.012"',
    )
    assert narrow != ARM
    arm = robot(tmp_path, narrow)
    drawn = poses(arm, {"seed": 4, "count": 100})
    for pose in drawn:
        for joint, value in pose.joints.items():
            lower, upper = arm.model.joint(joint).range
            slack = 1e-6 + 1e-3 * (upper - lower)
            assert lower - slack <= value <= upper + slack
    spread = np.ptp([pose.joints["left"] for pose in drawn])
    assert 0.01 < spread <= 0.0121


def test_random_values_of_a_continuous_joint_lie_within_one_turn(tmp_path: Path) -> None:
    arm = robot(tmp_path, ARM.replace('axis="0 0 1" range="-2 2"', 'axis="0 0 1"'))
    values = [pose.joints["pan"] for pose in poses(arm, {"seed": 0, "count": 200})]
    assert max(np.abs(values)) <= np.pi
    assert np.ptp(values) > 6.0


def test_random_values_of_a_joint_do_not_depend_on_other_joints(tmp_path: Path) -> None:
    before = poses(robot(tmp_path), {"seed": 7, "count": 3})
    more = ARM.replace(
        "<worldbody>",
        '<worldbody><body name="lid"><joint name="lid"/><geom size="0.01"/></body>',
    ).replace('qpos="0 0.5', 'qpos="0 0 0.5')
    after = poses(robot(tmp_path, more), {"seed": 7, "count": 3})
    for old, new in zip(before, after, strict=True):
        assert {k: v for k, v in new.joints.items() if k != "lid"} == old.joints


def test_recorded_random_poses_are_kept_if_a_joint_range_changes(tmp_path: Path) -> None:
    drawn = poses(robot(tmp_path), {"seed": 7, "count": 3})
    recorded = recorded_poses(drawn)
    wider = robot(tmp_path, ARM.replace('range="-2 2"', 'range="-3 3"'))
    assert poses(wider, {"seed": 7, "count": 3})[0].joints != drawn[0].joints
    again = poses(wider, {"seed": 7, "count": 3}, expected={"poses": recorded})
    assert [p.joints for p in again] == [p.joints for p in drawn]
    # Another seed gives other poses even if poses are recorded.
    other = poses(wider, {"seed": 8, "count": 1}, expected={"poses": recorded})
    assert other[0].joints != drawn[0].joints


@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(seed=st.integers(0, 1000))
def test_random_poses_satisfy_closed_kinematic_loops(tmp_path: Path, seed: int) -> None:
    loop = robot(tmp_path, FOUR_BAR)
    data = mujoco.MjData(loop.model)
    [pose] = poses(loop, {"seed": seed, "count": 1})
    data.qpos[:] = pose.qpos
    mujoco.mj_kinematics(loop.model, data)
    gap = data.body("coupler").xmat.reshape(3, 3) @ [0.5, 0, 0] + data.body("coupler").xpos
    tip = data.body("rocker").xmat.reshape(3, 3) @ [0, 0, 0.3] + data.body("rocker").xpos
    assert np.linalg.norm(gap - tip) < 1e-9


def test_a_pose_of_a_closed_loop_keeps_the_given_joints(tmp_path: Path) -> None:
    loop = robot(tmp_path, FOUR_BAR)
    [pose] = poses(loop, {"joints": {"crank": 0.4}})
    assert pose.joints["crank"] == 0.4
    assert pose.joints["rocker"] == pytest.approx(0.4)
    assert pose.joints["coupler"] == pytest.approx(-0.4)


def test_recorded_poses_of_a_closed_loop_adapt_to_a_changed_link(tmp_path: Path) -> None:
    [drawn] = poses(robot(tmp_path, FOUR_BAR), {"seed": 1, "count": 1})
    expected = {"poses": recorded_poses([drawn])}
    longer = robot(tmp_path, FOUR_BAR.replace('anchor="0.5 0 0"', 'anchor="0.5 0 0.01"'))
    [again] = poses(longer, {"seed": 1, "count": 1}, expected=expected)
    [same] = poses(robot(tmp_path, FOUR_BAR), {"seed": 1, "count": 1}, expected=expected)
    assert same.joints == drawn.joints
    for joint, value in drawn.joints.items():
        assert again.joints[joint] == pytest.approx(value, abs=0.1)


def test_a_rounded_keyframe_of_a_closed_loop_is_used_unchanged(tmp_path: Path) -> None:
    text = FOUR_BAR.replace(
        "</mujoco>", '<keyframe><key name="k" qpos="0.3 -0.3001 0.3"/></keyframe></mujoco>'
    )
    [pose] = poses(robot(tmp_path, text), "k")
    assert pose.joints == {"crank": 0.3, "coupler": -0.3001, "rocker": 0.3}


def test_a_pose_that_cannot_close_the_loop_is_refused(tmp_path: Path) -> None:
    loop = robot(tmp_path, FOUR_BAR)
    with pytest.raises(SpecError, match="closed loop of the model does not close there"):
        poses(loop, {"joints": {"crank": 0.4, "rocker": -0.4, "coupler": 0.0}})


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("hom", r"spec.yaml:5: stimulus.poses.0: no pose or keyframe of this name .*'home'\?"),
        ({"joints": {"lft": 0}}, r"spec.yaml:5: stimulus.poses.0.joints.lft: no hinge or slide"),
        ({"joints": {"lift": "3 mm"}}, r"unit 'mm' does not fit .*got '3 mm'; expected .*rad"),
        ({"joints": {"left": "3 deg"}}, r"unit 'deg' does not fit"),
        ({"joints": {"left": float("nan")}}, r"not a finite number"),
        ({"joints": {"left": "five"}}, r"not a quantity with a unit"),
    ],
)
def test_invalid_poses_are_refused_with_the_expected_form(
    tmp_path: Path, entry: Any, words: str
) -> None:
    with pytest.raises(SpecError, match=words):
        poses(robot(tmp_path), entry, lines={"stimulus.poses.0": 5})


def test_two_poses_with_the_same_name_are_refused(tmp_path: Path) -> None:
    words = r"two poses have the same name \(got 'home'; expected a different name for each pose"
    with pytest.raises(SpecError, match=words):
        poses(robot(tmp_path), "home", {"name": "home", "joints": {"pan": 1}})
