"""Which goldens ``init`` proposes for a robot, and the reasons for those left out."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from pytest_twin.checks import check_of, proposals
from pytest_twin.checks.base import NothingToProposeError
from pytest_twin.errors import SpecError
from pytest_twin.golden import Golden
from pytest_twin.realization import Realization, load
from pytest_twin.setup import inspection
from pytest_twin.setup.writing import FirstTwin, write_twin_file
from pytest_twin.twin import load_twin
from pytest_twin.units import parse_quantity

LINK = """<link name="{name}"><inertial><origin xyz="{x} 0 0"/><mass value="{mass}"/>
<inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="{type}"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{x} 0 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="20" velocity="2"/></joint>"""
MASSES = {"upper": 2.0, "fore": 1.0, "hand": 0.3}

GRIPPER = """\
<mujoco><worldbody><body name="palm"><geom type="box" size=".03 .03 .03" mass=".5"/>
<body name="left" pos="0 .05 .05"><joint name="left_finger" type="slide" axis="0 1 0"
range="0 .04" damping="5"/><geom type="box" size=".01 .005 .03" mass=".05"/></body>
<body name="right" pos="0 -.05 .05"><joint name="right_finger" type="slide" axis="0 -1 0"
range="0 .04" damping="5"/><geom type="box" size=".01 .005 .03" mass=".05"/></body></body>
</worldbody><tendon><fixed name="split"><joint joint="left_finger" coef=".5"/>
<joint joint="right_finger" coef=".5"/></fixed></tendon>
<equality><joint joint1="left_finger" joint2="right_finger"/></equality>
<actuator><general name="grip" tendon="split" ctrlrange="0 255" gainprm=".0157" biastype="affine"
biasprm="0 -100 -10"/></actuator></mujoco>
"""
QUADRUPED = """\
<mujoco><worldbody>{floor}<body name="trunk" pos="0 0 .16"><freejoint name="root"/>
<geom type="box" size=".2 .1 .03" mass="5"/>{legs}</body></worldbody>
<actuator>{servos}</actuator></mujoco>
"""
LEGS = "".join(
    f"<body name='leg{i}' pos='{x} {y} 0'><joint name='hip{i}' axis='0 1 0' range='-60 60' "
    "damping='.2' armature='.01'/><geom type='capsule' fromto='0 0 0 0 0 -.13' size='.02' "
    "mass='.4'/></body>"
    for i, (x, y) in enumerate([(0.15, 0.13), (0.15, -0.13), (-0.15, 0.13), (-0.15, -0.13)])
)
SERVOS = "".join(f"<position joint='hip{i}' name='hip{i}' kp='60' kv='2'/>" for i in range(4))
FLOOR = "<geom name='floor' type='plane' size='5 5 .1'/>"


def arm(tmp_path: Path, masses: Mapping[str, float] = MASSES, *, name: str = "arm") -> Realization:
    """A planar URDF arm with motors; inertias grow with their masses."""
    links = "".join(
        LINK.format(name=link, mass=mass, x=0.1, i=0.004 * mass) for link, mass in masses.items()
    )
    joints = "".join(
        JOINT.format(name=f"joint{i}", type="revolute", parent=parent, child=child, x=0.2 * (i > 0))
        for i, (parent, child) in enumerate(zip(["base", *masses], masses, strict=False))
    )
    path = tmp_path / f"{name}.urdf"
    path.write_text(f"<robot name='arm'><link name='base'/>{links}{joints}</robot>")
    return load(path)


def mjcf(tmp_path: Path, text: str) -> Realization:
    path = tmp_path / "robot.xml"
    path.write_text(text)
    return load(path)


def proposed_specs(kind: str, realization: Realization) -> dict[str, Mapping[str, Any]]:
    return {str(spec["name"]): spec for spec in check_of(kind).first(realization)}


def golden_of(spec: Mapping[str, Any], kind: str) -> Golden:
    units = check_of(kind).tolerances
    return Golden(
        id=str(spec["name"]),
        path=Path("spec.yaml"),
        kind=kind,
        title=spec["title"],
        realizations=("mujoco",),
        criticality="critical",
        target=spec["target"],
        stimulus=spec["stimulus"],
        tolerance={
            name: parse_quantity(text, (units[name],)) for name, text in spec["tolerance"].items()
        },
    )


def golden_passes(spec: Mapping[str, Any], kind: str, then: Realization, now: Realization) -> bool:
    """Whether a golden that was recorded on the robot ``then`` passes on the robot ``now``."""
    check, proposed = check_of(kind), golden_of(spec, kind)
    values, trace = check.expect(proposed, check.observe(proposed, then, lambda _: None))
    kept = Golden(
        **{name: getattr(proposed, name) for name in Golden.__slots__} | {"expected": values}
    )
    measures = check.compare(kept, check.observe(kept, now, lambda _: None), trace)
    assert measures
    return all(measure.passed for measure in measures)


@pytest.mark.parametrize("link", MASSES)
def test_a_torque_step_fails_for_a_mass_that_is_7_percent_too_large(
    link: str, tmp_path: Path
) -> None:
    robot = arm(tmp_path)
    heavier = arm(tmp_path, {**MASSES, link: 1.07 * MASSES[link]}, name="heavier")
    steps = proposed_specs("step", robot)
    assert list(steps) == ["joint0", "joint1", "joint2"]
    carrying = [f"joint{i}" for i in range(list(MASSES).index(link) + 1)]
    failing = [
        name for name, spec in steps.items() if not golden_passes(spec, "step", robot, heavier)
    ]
    assert failing == carrying
    assert all(golden_passes(spec, "step", robot, robot) for spec in steps.values())


def test_a_link_too_light_to_affect_the_step_is_noted(tmp_path: Path) -> None:
    robot = arm(tmp_path, {**MASSES, "cover": 1e-5})
    notes = " ".join(proposed_specs("step", robot)["joint0"]["notes"])
    assert "Not tested by this step: the mass of cover (less than 0.4 % of the inertia" in notes


def test_for_a_robot_without_servos_a_fall_under_gravity_is_proposed(tmp_path: Path) -> None:
    specs = proposed_specs("settling", arm(tmp_path))
    assert list(specs) == ["gravity"]
    assert specs["gravity"]["title"] == "Fall from the pose under gravity; nothing holds the joints"
    notes = " ".join(specs["gravity"]["notes"])
    assert "No controller: a URDF states none, and its motors take torques." in notes
    assert "Left out: motion without gravity, because no servo would move the joints." in notes


def test_for_a_joint_with_a_tiny_range_no_step_is_proposed(tmp_path: Path) -> None:
    robot = arm(tmp_path)
    text = (tmp_path / "arm.urdf").read_text().replace('lower="-2" upper="2"', "@", 1)
    (tmp_path / "arm.urdf").write_text(text.replace("@", 'lower="0" upper="1e-9"'))
    assert list(proposed_specs("step", load(tmp_path / "arm.urdf"))) == ["joint1", "joint2"]
    assert list(proposed_specs("step", robot)) == ["joint0", "joint1", "joint2"]


def test_for_a_urdf_without_efforts_a_note_says_that_motors_come_from_the_effort_limit(
    tmp_path: Path,
) -> None:
    arm(tmp_path)
    text = (tmp_path / "arm.urdf").read_text().replace('effort="20"', 'effort="0"')
    (tmp_path / "arm.urdf").write_text(text)
    (spec,) = proposed_specs("settling", load(tmp_path / "arm.urdf")).values()
    assert "a URDF joint gets a motor where its <limit> states an effort above zero" in " ".join(
        spec["notes"]
    )


def test_for_a_urdf_with_several_limbs_a_note_says_that_its_base_is_fixed(tmp_path: Path) -> None:
    trunk = LINK.format(name="trunk", mass=5, x=0, i=0.1)
    limbs = "".join(
        LINK.format(name=f"leg{i}", mass=1, x=0.1, i=0.01)
        + JOINT.format(name=f"hip{i}", type="revolute", parent="trunk", child=f"leg{i}", x=i)
        for i in range(2)
    )
    (tmp_path / "dog.urdf").write_text(f"<robot name='dog'>{trunk}{limbs}</robot>")
    note_text = "trunk is fixed to the world: a URDF does not say whether a base floats."
    assert any(
        note_text in note for note in inspection.inspect_model(str(tmp_path / "dog.urdf"))["notes"]
    )
    spec = proposed_specs("settling", load(tmp_path / "dog.urdf"))["gravity"]
    assert any(note_text in note for note in spec["notes"])
    robot = arm(tmp_path)
    assert not any(
        "fixed to the world" in n for n in inspection.inspect_model(str(robot.path))["notes"]
    )


def test_without_servos_no_title_mentions_servos(tmp_path: Path) -> None:
    robot = arm(tmp_path)
    for kind in ("step", "settling", "frequency_response", "limits", "joint_direction"):
        for spec in check_of(kind).first(robot):
            assert "servo" not in spec["title"]


def test_a_robot_with_servos_gets_settling_goldens_with_and_without_gravity(tmp_path: Path) -> None:
    robot = mjcf(
        tmp_path,
        "<mujoco><worldbody><body name='link'><joint name='hinge' axis='0 1 0' range='-90 90'/>"
        "<geom type='capsule' fromto='0 0 0 0 0 .3' size='.02'/></body></worldbody>"
        "<actuator><position name='hinge' joint='hinge' kp='50' kv='2'/></actuator></mujoco>",
    )
    specs = proposed_specs("settling", robot)
    assert specs["gravity"]["title"] == "Servos hold the pose under gravity"
    assert specs["no_gravity"]["stimulus"]["displacement"] == {"hinge": 0.05}
    assert specs["gravity"]["notes"] == []


def test_a_floating_base_with_a_floor_gets_a_golden_of_settling_on_the_floor(
    tmp_path: Path,
) -> None:
    robot = mjcf(tmp_path, QUADRUPED.format(floor=FLOOR, legs=LEGS, servos=SERVOS))
    specs = proposed_specs("settling", robot)
    assert specs["gravity"]["title"].startswith("Come to rest on the floor under gravity")
    assert golden_passes(specs["gravity"], "settling", robot, robot)


def test_for_a_floating_base_without_a_floor_no_fall_is_proposed(tmp_path: Path) -> None:
    robot = mjcf(tmp_path, QUADRUPED.format(floor="", legs=LEGS, servos=SERVOS))
    specs = proposed_specs("settling", robot)
    assert list(specs) == ["no_gravity"]
    assert "the base floats" in specs["no_gravity"]["title"]
    assert "because the base floats and nothing is under it" in " ".join(
        specs["no_gravity"]["notes"]
    )


def test_for_a_floating_base_without_servos_and_floor_no_settling_is_proposed(
    tmp_path: Path,
) -> None:
    robot = mjcf(tmp_path, QUADRUPED.format(floor="", legs=LEGS, servos=""))
    with pytest.raises(NothingToProposeError, match=r"nothing is under it.*no servo would move"):
        check_of("settling").first(robot)


def test_a_free_object_is_not_taken_for_a_floating_base(tmp_path: Path) -> None:
    robot = mjcf(
        tmp_path,
        "<mujoco><worldbody><geom name='floor' type='plane' size='2 2 .1'/><body name='link' "
        "pos='0 0 .5'><joint name='hinge' axis='0 1 0' range='-90 90'/><geom type='capsule' "
        "fromto='0 0 0 0 0 .3' size='.02'/></body><body name='cube' pos='.5 0 .3'><freejoint "
        "name='cube'/><geom type='box' size='.02 .02 .02' mass='.1'/></body></worldbody>"
        "<actuator><position name='hinge' joint='hinge' kp='50' kv='2'/></actuator></mujoco>",
    )
    for spec in proposed_specs("settling", robot).values():
        assert "floats" not in spec["title"]
    notes = " ".join(proposed_specs("settling", robot)["gravity"]["notes"])
    assert "No position servo holds cube" in notes


def test_a_tendon_driven_gripper_gets_a_step_of_its_actuator(tmp_path: Path) -> None:
    robot = mjcf(tmp_path, GRIPPER)
    spec = proposed_specs("step", robot)["grip"]
    assert spec["target"] == {"joint": "left_finger", "actuator": "grip"}
    assert abs(spec["stimulus"]["amplitude"]) == 25.5
    found = check_of("step").observe(golden_of(spec, "step"), robot, lambda _: None)
    assert found.trace is not None
    assert found.trace.columns["command:left_finger"][0] == "1"
    moved = found.trace.columns["position:left_finger"][1]
    assert abs(moved[-1] - moved[0]) > 1e-3
    assert golden_passes(spec, "step", robot, robot)


def test_for_a_robot_without_moving_joints_the_reasons_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "stand.urdf"
    path.write_text(
        "<robot name='stand'><link name='base'/>"
        + LINK.format(name="post", mass=2, x=0.1, i=0.01)
        + "<joint name='weld' type='fixed'><parent link='base'/><child link='post'/></joint>"
        + "</robot>"
    )
    (tmp_path / "twin.yaml").write_text("schema: 1\nname: stand\nmodel: stand.urdf\n")
    found = inspection.first_specs(str(tmp_path / "twin.yaml"), lambda _: None)
    assert found["silent"] == {}
    assert found["none"]["step"] == "no joint takes a command"
    assert found["none"]["limits"] == "no joint with a name states a limit"
    assert found["none"]["settling"] == "the robot has no joints"
    assert all(why for why in found["none"].values())
    assert json.dumps(found)


def test_the_commented_servo_lines_of_twin_yaml_are_valid_once_gains_are_filled_in(
    tmp_path: Path,
) -> None:
    robot = arm(tmp_path)
    look = inspection.inspect_model(str(robot.path))
    first_twin = FirstTwin(
        name="arm", model=robot.path, source=[robot.path], roots={}, tcp=None,
        inertia_repairs={}, motors=look["motors"], reading={},
    )  # fmt: skip
    written = write_twin_file(tmp_path, first_twin)
    lines = written.read_text().splitlines()
    begin = lines.index("# fit:")
    end = next(
        i for i, line in enumerate(lines) if line.startswith("# Dependencies that are in no file")
    )
    gains = [line.removeprefix("# ") for line in lines[begin:end]]
    written.write_text("\n".join([*lines[:begin], *gains, *lines[end:]]))
    with pytest.raises(SpecError, match=r"fit\.actuator\.joint0\.kp"):
        load_twin(written)
    text = written.read_text().replace("N*m/rad", "120").replace("N*m*s/rad", "8")
    written.write_text(text)
    twin = load_twin(written)
    realization = load(twin.realizations["mujoco"].file, twin=twin)
    assert inspection.inspect_model(str(robot.path))["motors"] == dict.fromkeys(
        ["joint0", "joint1", "joint2"], "hinge"
    )
    assert proposed_specs("settling", realization)["gravity"]["title"] == (
        "Servos hold the pose under gravity"
    )


@pytest.mark.parametrize(
    ("actuator", "words"),
    [
        ("", "the model has no actuators."),
        ('<motor joint="j"/>', "the model has no actuators with a name."),
        ('<motor name="m" joint="j"/>', "the model has no position servos; its motors take torq"),
    ],
)
def test_a_model_without_position_servos_gets_a_note_with_the_reason(
    tmp_path: Path, actuator: str, words: str
) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><worldbody><body name="b"><joint name="j"/><geom size=".1" mass="1"/></body>'
        f"</worldbody><actuator>{actuator}</actuator></mujoco>"
    )
    realization = load(path)
    note_text = proposals.Actuation.of(realization).no_controller(realization)
    assert note_text is not None
    assert words in note_text
