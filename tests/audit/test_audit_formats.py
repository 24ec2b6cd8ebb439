"""The audit of MJCF and USD files reads the same quantities as that of URDF files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from audited import findings_of, line_of, only, robots, write_clean
from scipy.spatial.transform import Rotation

from pytest_twin.audit.coupling import degrees_of_freedom
from pytest_twin.audit.finding import LAYERS
from pytest_twin.audit.read import read
from pytest_twin.audit.read_usd import fan
from pytest_twin.errors import ModelError, PathError
from pytest_twin.realization import load

MJCF = """<mujoco model="m">
  <compiler angle="radian"/>
  <worldbody>
    <body name="a">
      <joint name="hinge" axis="0 0 2" range="-1 1" damping="0.1"/>
      <inertial pos="0.1 0 0" mass="1" diaginertia="0.001 0.01 0.01"/>
      <geom type="box" size="0.15 0.03 0.03" pos="0.1 0 0"/>
      <body name="b" pos="0.3 0 0">
        <joint name="slide" type="slide" axis="1 0 0" frictionloss="1"/>
        <geom type="sphere" size="0.05"/>
        <site name="tcp" pos="0.05 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="hinge" kp="100"/>
    <motor name="push" joint="slide"/>
    <general name="odd" joint="slide" gaintype="affine" gainprm="1 1 1"/>
  </actuator>
  <keyframe><key name="home" qpos="0.5 0.1"/></keyframe>
</mujoco>
"""

USDA = """#usda 1.0
(
    defaultPrim = "robot"
    metersPerUnit = 0.01
    kilogramsPerUnit = 0.001
    upAxis = "Z"
)
def Xform "robot" (
    prepend apiSchemas = ["PhysicsArticulationRootAPI"]
)
{
    def Xform "base" (
        prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]
    )
    {
        float physics:mass = 4000
        float3 physics:diagonalInertia = (50000, 50000, 50000)
        def Cube "shape" (
            prepend apiSchemas = ["PhysicsCollisionAPI"]
        )
        {
            double size = 20
        }
    }
    def Xform "arm" (
        prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]
    )
    {
        float physics:mass = 1000
        float3 physics:diagonalInertia = (10000, 1000, 1000)
        double3 xformOp:translate = (0, 0, 30)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        def Capsule "shape" (
            prepend apiSchemas = ["PhysicsCollisionAPI"]
        )
        {
            uniform token axis = "X"
            double radius = 3
            double height = 20
        }
    }
    def PhysicsFixedJoint "mount"
    {
        rel physics:body1 = </robot/base>
    }
    def PhysicsRevoluteJoint "turn"
    {
        uniform token physics:axis = "Y"
        rel physics:body0 = </robot/base>
        rel physics:body1 = </robot/arm>
        point3f physics:localPos0 = (0, 0, 30)
        float physics:lowerLimit = -90
        float physics:upperLimit = 45
    }
}
"""


def test_an_mjcf_is_read_as_mujoco_compiles_it(tmp_path: Path) -> None:
    path = tmp_path / "m.xml"
    path.write_text(MJCF)
    asset = read(path)
    assert [body.name for body in asset.bodies] == ["world", "a", "b"]
    assert asset.body["a"].place.line == 4
    assert asset.body["a"].stated
    assert not asset.body["b"].stated
    assert asset.body["b"].mass == pytest.approx(1000 * 4 / 3 * np.pi * 0.05**3)
    assert asset.poses == {"home": {"hinge": 0.5, "slide": 0.1}}
    assert asset.at({"hinge": np.pi / 2, "slide": 0.2})["b"][0] == pytest.approx([0, 0.5, 0])
    rows = findings_of(path)
    assert [row["element"] for row in only(rows, "commands.unknown")] == ["actuator 'odd'"]
    assert "position setpoint" in only(rows, "commands.declared")[0]["title"]
    # MuJoCo normalizes axes, so this is not a fault in MJCF.
    assert only(rows, "joints.axis_not_unit") == []


def test_a_joint_with_an_offset_rotates_about_its_own_anchor(tmp_path: Path) -> None:
    import mujoco

    text = MJCF.replace('<joint name="hinge"', '<joint name="hinge" pos="0.1 -0.2 0.3" ref="0.4"')
    path = tmp_path / "m.xml"
    path.write_text(text)
    asset = read(path)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    for values in ((0.4, 0.0), (-0.7, 0.2)):
        data.qpos[:] = values
        mujoco.mj_kinematics(model, data)
        found = asset.at({"hinge": values[0], "slide": values[1]})
        for body in ("a", "b"):
            assert found[body][0] == pytest.approx(data.body(body).xpos, abs=1e-12)
            assert found[body][1].ravel() == pytest.approx(data.body(body).xmat, abs=1e-12)


def test_an_mjcf_that_does_not_compile_is_a_finding(tmp_path: Path) -> None:
    path = tmp_path / "m.xml"
    path.write_text(MJCF.replace('diaginertia="0.001 0.01 0.01"', 'diaginertia="1 0.1 0.1"'))
    rows = findings_of(path)
    assert only(rows, "inertia.refused")[0]["severity"] == "critical"
    unseen = [row["layer"] for row in rows if row["code"].endswith("not_looked_at")]
    assert sorted(unseen) == sorted(set(LAYERS) - {"tree", "inertia"})
    triangle = only(rows, "inertia.triangle")[0]
    assert (triangle["element"], triangle["line"]) == ("link 'a'", 6)


def test_a_duplicate_name_in_an_mjcf_is_a_finding(tmp_path: Path) -> None:
    path = tmp_path / "m.xml"
    path.write_text(MJCF.replace('<body name="b"', '<body name="a"'))
    found = only(findings_of(path), "tree.duplicate_name")
    assert [(row["element"], row["line"]) for row in found] == [("body 'a'", 8)]


def test_a_range_in_radians_in_an_mjcf_in_degrees_is_a_finding(tmp_path: Path) -> None:
    path = tmp_path / "m.xml"
    text = MJCF.replace('<compiler angle="radian"/>', "")
    path.write_text(text.replace('type="slide" axis="1 0 0"', 'range="-2 2" axis="1 0 0"'))
    found = only(findings_of(path), "joints.range_radians")
    assert found[0]["severity"] == "critical"
    assert found[0]["value"] == pytest.approx(np.radians(2))


def test_an_mjcf_that_includes_a_file_outside_its_folder_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.xml"
    path.write_text('<mujoco><include file="../../etc/hosts"/></mujoco>')
    with pytest.raises(PathError, match=r"m\.xml:1.*leaves the declared roots"):
        read(path)


def test_a_usd_stage_in_other_units_is_converted_to_si(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    path = tmp_path / "robot.usda"
    path.write_text(USDA)
    asset = read(path)
    assert asset.roots == ["world"]
    arm, base = asset.body["arm"], asset.body["base"]
    assert base.mass == pytest.approx(4.0)
    assert arm.inertia is not None
    assert np.diag(arm.inertia) == pytest.approx([1e-3, 1e-4, 1e-4])
    turn = asset.joint["turn"]
    assert (turn.lower, turn.upper) == pytest.approx((-np.pi / 2, np.pi / 4))
    assert turn.axis == pytest.approx([0, 1, 0])
    assert asset.drawn["arm"][0] == pytest.approx([0, 0, 0.3])
    box, capsule = asset.shapes
    assert (box.kind, box.size) == ("box", pytest.approx((0.2, 0.2, 0.2)))
    assert (capsule.kind, capsule.size) == ("capsule", pytest.approx((0.03, 0.2)))
    # The capsule axis is x.
    assert abs(capsule.rotation @ [0, 0, 1]) == pytest.approx([1, 0, 0])
    triangle = only(findings_of(path), "inertia.triangle")
    assert [row["element"] for row in triangle] == ["link 'arm'"]
    assert triangle[0]["line"] == line_of(USDA, 'def Xform "arm"')


def test_a_usd_joint_with_swapped_bodies_has_the_opposite_sign(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    straight, turned = tmp_path / "straight.usda", tmp_path / "turned.usda"
    straight.write_text(USDA)
    text = USDA.replace(
        "body0 = </robot/base>\n        rel physics:body1 = </robot/arm>",
        "body0 = </robot/arm>\n        rel physics:body1 = </robot/base>",
    ).replace("localPos0", "localPos1")
    assert text.count("localPos1") == 1
    turned.write_text(text)
    assert read(turned).above["arm"].parent == "base"
    one = read(straight).at({"turn": 0.3})["arm"]
    other = read(turned).at({"turn": -0.3})["arm"]
    # Swapping the bodies inverts the joint's rotation.
    assert one[0] == pytest.approx(other[0])
    assert one[1] == pytest.approx(other[1])
    assert one[1][0, 2] == pytest.approx(np.sin(0.3))


def test_a_closed_loop_in_a_usd_stage_is_a_coupling(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    path = tmp_path / "robot.usda"
    closing = (
        '    def PhysicsSphericalJoint "closure"\n    {\n        rel physics:body0 = </robot/arm>\n'
        "        rel physics:body1 = </robot/base>\n    }\n}\n"
    )
    path.write_text(USDA.rstrip().removesuffix("}") + closing)
    rows = findings_of(path)
    assert [row["element"] for row in only(rows, "coupling.constraint")] == ["loop joint 'closure'"]
    assert not [row for row in rows if row["layer"] == "tree"]


def test_without_openusd_the_error_names_the_package_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "pxr", None)
    path = tmp_path / "robot.usda"
    path.write_text(USDA)
    with pytest.raises(Exception, match=r"the extra 'usd' is not installed.*pytest-twin\[usd\]"):
        read(path)


def test_polygons_are_split_into_triangles() -> None:
    faces = fan(np.array([4, 3, 2]), np.array([0, 1, 2, 3, 4, 5, 6, 7, 8]))
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 5, 6]]
    assert len(fan(np.array([4]), np.array([0, 1, 2]))) == 0


@pytest.mark.parametrize("name", ["panda.urdf", "so101.urdf"])
def test_body_poses_agree_with_pinocchio(name: str) -> None:
    path = next(robots().glob(f"*/*/{name}"))
    asset = read(path)
    reference = load(path, accept_invalid_inertia=True).reference
    generator = np.random.default_rng(7)
    leaders = [j for j in asset.joints if j.name not in {m.follower for m in asset.mimics}]
    for _ in range(5):
        values = {
            joint.name: float(generator.uniform(joint.lower or 0, joint.upper or 0))
            for joint in leaders
        }
        for mimic in asset.mimics:
            values[mimic.follower] = mimic.multiplier * values[mimic.leader] + mimic.offset
        for body, (position, rotation) in asset.at(values).items():
            pose = reference.frame_pose(values, body)
            assert position == pytest.approx(pose[:3, 3], abs=1e-9)
            turned = Rotation.from_matrix(rotation.T @ pose[:3, :3]).magnitude()
            assert turned < 1e-7


def test_a_file_with_an_unknown_root_element_is_refused(tmp_path: Path) -> None:
    path = write_clean(tmp_path, "<sdf/>", "robot.sdf")
    with pytest.raises(ModelError, match=r"robot\.sdf:1: not a robot model"):
        read(path)


UNNAMED = """<mujoco model="four_bar">
  <compiler angle="radian"/>
  <worldbody>
    <body name="crank">
      <joint name="a" axis="0 1 0" range="-1 1"/>
      <geom type="box" size="0.01 0.01 0.1" pos="0 0 0.1"/>
      <body pos="0 0 0.2">
        <joint name="b" axis="0 1 0"/>
        <inertial pos="0.1 0 0" mass="1" diaginertia="1 1 1.9"/>
        <geom type="box" size="0.1 0.01 0.01" pos="0.1 0 0"/>
      </body>
    </body>
    <body name="rocker" pos="0.2 0 0">
      <joint axis="0 1 0"/>
      <geom type="box" size="0.01 0.01 0.1" pos="0 0 0.1"/>
      <site name="end" pos="0 0 0.2"/>
    </body>
  </worldbody>
  <equality>
    <connect body1="rocker" body2="body_2" anchor="0 0 0.2"/>
  </equality>
</mujoco>
"""


def test_a_finding_of_an_unnamed_element_of_an_mjcf_is_at_its_line(tmp_path: Path) -> None:
    text = UNNAMED[: UNNAMED.index("  <equality>")] + "</mujoco>\n"
    path = tmp_path / "unnamed.xml"
    path.write_text(text)
    rows = findings_of(path)
    lines = {row["line"] for row in rows if row["element"] == "joint 'joint 2'"}
    assert lines == {line_of(text, '<joint axis="0 1 0"/>')}
    lines = {row["line"] for row in rows if row["code"] == "inertia.too_large"}
    assert lines == {line_of(text, "<inertial")}


def test_a_closed_chain_removes_degrees_of_freedom(tmp_path: Path) -> None:
    path = tmp_path / "four_bar.xml"
    path.write_text(UNNAMED.replace('<body pos="0 0 0.2">', '<body name="body_2" pos="0 0 0.2">'))
    # A planar four-bar linkage has three joints and one degree of freedom.
    free = degrees_of_freedom(read(path))
    assert (free.total, free.constrained, free.independent) == (3, 2, 1)
    path.write_text(path.read_text().replace("<connect ", '<connect active="false" '))
    assert degrees_of_freedom(read(path)).independent == 3


def test_a_finger_coupled_by_a_tendon_removes_a_degree_of_freedom(tmp_path: Path) -> None:
    path = tmp_path / "finger.xml"
    # A limit and dry friction of the tendon, as grippers have them, make further rows.
    path.write_text("""<mujoco><worldbody><body><geom size=".02"/><joint name="a" axis="0 1 0"/>
      <body pos="0 0 .1"><geom size=".02"/><joint name="b" axis="0 1 0" range="-1 1"/>
      </body></body></worldbody>
      <tendon><fixed name="t" limited="true" range="-5 5" frictionloss=".4">
      <joint joint="a" coef=".4"/><joint joint="b" coef="-.4"/></fixed></tendon>
      <equality><tendon tendon1="t"/></equality></mujoco>""")
    free = degrees_of_freedom(read(path))
    assert (free.total, free.constrained, free.independent) == (2, 1, 1)
