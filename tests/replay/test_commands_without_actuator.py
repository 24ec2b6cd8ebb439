"""Commands of joints that have no actuator of their own: followers, grippers, passive joints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from replay_trials import recording, series

from pytest_twin.errors import SpecError
from pytest_twin.open_loop import replay
from pytest_twin.realization import Realization, load
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.trial import Trial, make_trial

GRIPPER = """
<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
  <body><joint name="arm" axis="0 0 1" damping="1"/>
    <geom size=".05" mass="1" contype="0" conaffinity="0"/>
    <body pos=".1 0 0"><joint name="left" type="slide" axis="0 1 0" damping="5"/>
      <geom size=".01" mass=".1" contype="0" conaffinity="0"/></body>
    <body pos=".1 0 0"><joint name="right" type="slide" axis="0 -1 0" damping="5"/>
      <geom size=".01" mass=".1" contype="0" conaffinity="0"/></body>
    <body pos="0 .1 0"><joint name="flap" axis="1 0 0" damping=".1"/>
      <geom size=".01" mass=".1" contype="0" conaffinity="0"/></body>
    <body pos="0 .2 0"><joint name="mimic" axis="1 0 0" damping=".1"/>
      <geom size=".01" mass=".1" contype="0" conaffinity="0"/></body></body></worldbody>
<tendon><fixed name="both"><joint joint="left" coef=".5"/><joint joint="right" coef=".5"/></fixed>
</tendon>
<equality><joint joint1="mimic" joint2="arm" polycoef="0 -1 0 0 0"/></equality>
<actuator><position name="arm" joint="arm" kp="50" kv="5"/>
  <position name="fingers" tendon="both" kp="500"/></actuator></mujoco>"""
JOINTS = ("arm", "left", "right", "flap", "mimic")
TIME = np.arange(0.0, 1.0, 0.01)


@pytest.fixture(scope="module")
def gripper(tmp_path_factory: pytest.TempPathFactory) -> Realization:
    file = tmp_path_factory.mktemp("gripper") / "gripper.xml"
    file.write_text(GRIPPER)
    return load(file)


def commanded(
    gripper: Realization, joints: tuple[str, ...] = JOINTS, mode: str = "position",
    options: RecordingOptions | None = None,
) -> Trial:  # fmt: skip
    position = np.tile([0.0, 0.02, 0.02, 0.0, 0.0], (len(TIME), 1))
    command = np.tile(0.02, (len(TIME), len(joints)))
    return make_trial(
        recording(
            series("/s", JOINTS, TIME, position=position),
            series("/c", joints, TIME, **{mode: command}),
        ),
        gripper.structure,
        options or RecordingOptions(),
    )


def test_commands_of_joints_without_an_actuator_are_left_out_with_the_reason(
    gripper: Realization,
) -> None:
    trial = commanded(gripper)
    assert trial.command_joints == ("arm",)
    notes = "\n".join(trial.notes)
    assert "commands of 'mimic' are not used, in the model it has no actuator: it follows" in notes
    assert "commands of 'left' are not used, in the model it has no actuator of its own" in notes
    assert "'fingers' moves it with other joints" in notes
    assert "commands of 'flap' are not used, in the model it has no actuator and moves" in notes


def test_the_servo_of_a_tendon_holds_its_joints(gripper: Realization) -> None:
    (replayed,) = replay(gripper, [commanded(gripper)])
    at = JOINTS.index("left")
    # The arm's acceleration shakes them by 0.2 mm; without a setpoint they would close, 20 mm.
    assert np.abs(replayed.position[:, at] - 0.02).max() < 1e-3
    assert replayed.position[-1, 0] == pytest.approx(0.02, abs=2e-3)


def test_a_mode_for_all_joints_leaves_out_the_same_ones(gripper: Realization) -> None:
    options = RecordingOptions(command_mode="position")
    assert commanded(gripper, options=options).command_joints == ("arm",)


def test_an_effort_acts_on_a_passive_joint_but_not_on_a_follower(gripper: Realization) -> None:
    efforts = np.tile(0.02, (len(TIME), 3))
    made = recording(
        series("/s", JOINTS, TIME, position=np.zeros((len(TIME), 5))),
        series(
            "/c", ("arm", "flap", "mimic"), TIME,
            position=np.where([True, False, False], efforts, np.nan),
            effort=np.where([False, True, True], efforts, np.nan),
        ),
    )  # fmt: skip
    assert make_trial(made, gripper.structure).command_joints == ("arm", "flap")


def test_commands_for_joints_without_actuators_alone_are_refused(gripper: Realization) -> None:
    with pytest.raises(SpecError, match="joint 'flap': no actuator takes position commands"):
        replay(gripper, [commanded(gripper, ("flap", "mimic"))])


def test_the_structure_of_a_mimic_of_a_urdf_names_its_leader(tmp_path: Path) -> None:
    link = """<link name="{0}"><inertial><mass value="1"/>
      <inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
    joint = """<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/>
      <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/>{3}</joint>"""
    mimic = '<mimic joint="j1" multiplier="-1"/>'
    (tmp_path / "arm.urdf").write_text(
        '<robot name="arm"><link name="base"/>'
        + "".join(link.format(name) for name in ("l1", "l2"))
        + joint.format("j1", "base", "l1", "")
        + joint.format("j2", "l1", "l2", mimic)
        + "</robot>"
    )
    assert load(tmp_path / "arm.urdf").structure.leaders == {"j2": "j1"}
