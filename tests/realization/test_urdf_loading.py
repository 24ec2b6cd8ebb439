"""Loading of URDF: conversion, notes and refusals."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from model_texts import ARM, example_robot, written
from test_mjcf_loading import FACES, TETRAHEDRON, binary_stl

from pytest_twin.errors import FormatError, LimitError, ModelError, TwinError
from pytest_twin.realization import Realization, load

MESH = '<collision><geometry><box size="0.2 0.1 0.1"/></geometry></collision>'


def arm(folder: Path, old: str = "", new: str = "") -> Path:
    assert old in ARM
    return written(folder, ARM.replace(old, new) if old else ARM, "arm.urdf")


def refusal(path: Path, kind: type[TwinError] = ModelError) -> str:
    with pytest.raises(kind) as caught:
        load(path)
    return str(caught.value)


def with_mesh(folder: Path, file: str, scale: str = "1 1 1") -> Path:
    new = f"<collision><geometry><mesh filename='{file}' scale='{scale}'/></geometry></collision>"
    return arm(folder, MESH, new)


def test_joints_limits_actuators_and_joint_dynamics_are_converted(tmp_path: Path) -> None:
    realization = load(arm(tmp_path))
    model = realization.model
    assert realization.joints == ("shoulder", "elbow")
    assert realization.names("body") == ("world", "base", "upper", "lower", "tool")
    assert model.body_weldid[realization.frame_index("base")[1]] == 0
    kinds = [mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE]
    assert model.jnt_type.tolist() == kinds
    np.testing.assert_array_equal(model.jnt_range, [[-1, 2], [0, 0.4]])
    np.testing.assert_allclose(model.jnt_axis, [[0, 1, 0], np.array([1, 0, 2]) / np.sqrt(5)])
    np.testing.assert_array_equal(model.dof_damping, [0.7, 0])
    np.testing.assert_array_equal(model.dof_frictionloss, [0.2, 0])
    np.testing.assert_array_equal(model.jnt_actfrcrange, [[-40, 40], [-100, 100]])
    assert realization.velocity_limit == {"shoulder": 3.0, "elbow": 0.5}
    assert realization.actuators == ("shoulder", "elbow")
    np.testing.assert_array_equal(model.actuator_forcerange, [[-40, 40], [-100, 100]])
    assert not realization.notes


def test_a_motor_applies_its_control_up_to_the_effort_limit(tmp_path: Path) -> None:
    realization = load(arm(tmp_path))
    data = mujoco.MjData(realization.model)
    for control, force in ((5.0, 5.0), (90.0, 40.0)):
        data.ctrl[realization.control_index("shoulder")] = control
        mujoco.mj_forward(realization.model, data)
        assert data.qfrc_actuator[realization.joint_dof_index("shoulder")] == force


def test_a_mimic_joint_follows_with_multiplier_and_offset(tmp_path: Path) -> None:
    old = '<limit lower="0" upper="0.4" effort="100" velocity="0.5"/>'
    mimic = '<mimic joint="shoulder" multiplier="0.1" offset="0.1"/>'
    realization = load(arm(tmp_path, old, old + mimic))
    model = realization.model
    assert realization.actuators == ("shoulder",)
    assert "mimic of 'elbow' became a stiff equality with 'shoulder'" in realization.notes[0]
    assert realization.notes[0].startswith(f"{tmp_path}/arm.urdf:30: ")
    data = mujoco.MjData(model)
    data.qpos[:] = realization.qpos({"shoulder": 0.5, "elbow": 0.15})
    data.ctrl[0] = 30.0
    for _ in range(500):
        mujoco.mj_step(model, data)
    shoulder, elbow = data.qpos
    assert elbow == pytest.approx(0.1 * shoulder + 0.1, abs=2e-4)


def test_planar_and_floating_joints_are_split_into_simple_joints(tmp_path: Path) -> None:
    realization = load(
        arm(tmp_path, '<joint name="elbow" type="prismatic">', '<joint name="elbow" type="planar">')
    )
    assert realization.joints == ("shoulder", "elbow_x", "elbow_y", "elbow_yaw")
    axes = realization.model.jnt_axis[1:]
    np.testing.assert_allclose(axes[:2] @ axes[2], 0, atol=1e-15)
    np.testing.assert_allclose(axes[2], np.array([1, 0, 2]) / np.sqrt(5))
    assert any("planar joint 'elbow' became" in note for note in realization.notes)
    realization = load(
        arm(
            tmp_path,
            '<joint name="elbow" type="prismatic">',
            '<joint name="elbow" type="floating">',
        )
    )
    assert realization.joints == ("shoulder", "elbow_x", "elbow_y", "elbow_z", "elbow_ball")


def test_a_floating_joint_on_the_world_becomes_a_free_joint(tmp_path: Path) -> None:
    text = ARM.replace('"base"', '"world"').replace(
        'name="shoulder" type="revolute"', 'name="shoulder" type="floating"'
    )
    realization = load(written(tmp_path, text, "arm.urdf"))
    assert realization.model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    assert realization.names("body") == ("world", "upper", "lower", "tool")


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ('<mass value="2"/>', '<mass value="-2"/>', 6, "link 'upper' has a negative mass"),
        ('<mass value="2"/>', '<mass value="nan"/>', 6, "mass.value: not a finite number"),
        ('<mass value="2"/>', '<mass value="1e300"/>', 6, "mass.value: too large"),
        ('ixx="0.02"', 'ixx="1e308"', 7, "inertia.ixx: too large"),
        ('<mass value="2"/>', "<mass/>", 6, "mass.value: missing"),
        ('ixx="0.02"', 'ixx="0.2"', 4, "link 'upper' has an inertia that no body can have"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>', 22, "axis without direction"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 1"/>', 22, "another count of numbers"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="a b c"/>', 22, "no number"),
        ('lower="-1" upper="2"', 'lower="3" upper="2"', 23, "lower limit above its upper"),
        ('effort="40"', 'effort="-40"', 23, "negative effort"),
        ('damping="0.7"', 'damping="-1"', 24, "negative damping"),
        ('type="revolute"', 'type="rotary"', 19, "no such type of joint"),
        ('<parent link="base"/>', '<parent link="bass"/>', 19, "no such link"),
        ('<parent link="base"/>', "", 19, "no link"),
        ('<link name="tool"/>', "", 32, "no such link"),
        ('<link name="tool"/>', '<link name="base"/>', 18, "two links of one name"),
        ('<joint name="elbow"', '<joint name="shoulder"', 26, "two joints of one name"),
        (
            '<link name="tool"/>',
            '<link name="tool"/><link name="x"/>',
            1,
            "do not form a single tree",
        ),
        (
            '<parent link="base"/>',
            '<parent link="tool"/>',
            1,
            "a loop of links that is not connected to the root",
        ),
        (
            '<child link="tool"/>',
            '<child link="upper"/>',
            32,
            "is already attached to joint 'shoulder'",
        ),
        ('<axis xyz="0 1 0"/>', '<mimic joint="shoulder"/>', 22, "follow each other in a circle"),
        ('<box size="0.2 0.1 0.1"/>', '<box size="-1 1 1"/>', 9, "negative size"),
        ('<box size="0.2 0.1 0.1"/>', '<cone r="1"/>', 9, "no known shape"),
        ('<box size="0.2 0.1 0.1"/>', "<mesh/>", 9, "no file"),
        ('<box size="0.2 0.1 0.1"/>', '<mesh filename="a.stl" scale="0 1 1"/>', 9, "no such file"),
    ],
)
def test_an_impossible_robot_is_refused_with_file_and_line(
    tmp_path: Path, old: str, new: str, line: int, words: str
) -> None:
    said = refusal(arm(tmp_path, old, new), TwinError)
    assert words in said
    assert said.startswith(f"{tmp_path}/arm.urdf:{line}: ")


def test_an_impossible_inertia_is_repaired_and_noted_only_if_accepted(
    tmp_path: Path,
) -> None:
    path = arm(
        tmp_path,
        'ixx="0.02" iyy="0.03" izz="0.04" ixy="0.001"',
        'ixx="0.02" iyy="0.03" izz="0.2" ixy="0"',
    )
    assert "got '0.02, 0.03, 0.2' kg*m^2" in refusal(path)
    realization = load(path, accept_invalid_inertia=True)
    index = realization.frame_index("upper")[1]
    # The second moment -0.075 becomes 0: the two small moments grow by 0.075, the large one stays.
    np.testing.assert_allclose(
        sorted(realization.model.body_inertia[index]), [0.095, 0.105, 0.2], rtol=1e-6
    )
    assert set(realization.source.inertia_repairs) == {"upper"}
    assert realization.notes == (
        f"{path}:4: inertia of link 'upper' breaks the triangle inequality: principal moments "
        "0.02, 0.03, 0.2 became 0.095, 0.105, 0.2 kg*m^2 (accepted repair)",
    )


def test_a_moving_link_without_mass_gets_the_minimum_mass_and_a_note(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        '<robot name="r"><link name="a"/><link name="b"/><link name="c"/>'
        '<joint name="p" type="continuous"><parent link="a"/><child link="b"/></joint>'
        '<joint name="q" type="fixed"><parent link="b"/><child link="c"/></joint></robot>',
        "r.urdf",
    )
    realization = load(path)
    masses = dict(zip(realization.names("body"), realization.model.body_mass, strict=True))
    assert masses == {"world": 0, "a": 0, "b": 1e-12, "c": 0}
    assert any("moving link 'b' has no inertia" in note for note in realization.notes)


def test_links_connected_by_a_joint_do_not_collide(tmp_path: Path) -> None:
    box = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
    inertial = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'
    links = "".join(f'<link name="l{i}">{inertial}{box}</link>' for i in range(4))
    joints = "".join(
        f'<joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/></joint>'
        for i, kind in enumerate(("revolute", "fixed", "revolute"))
    )
    realization = load(written(tmp_path, f'<robot name="r">{links}{joints}</robot>', "r.urdf"))
    data = mujoco.MjData(realization.model)
    mujoco.mj_forward(realization.model, data)
    bodies = realization.model.geom_bodyid[data.contact.geom]
    names = realization.names("body")
    touching = {frozenset(names[body] for body in pair) for pair in bodies}
    assert touching == {frozenset({"l0", "l3"})}


@pytest.mark.parametrize("scale", ["1 1 1", "0.5 2 1", "1 -1 1", "-2 -2 -2"])
def test_mesh_scale_scales_and_mirrors_the_vertices(tmp_path: Path, scale: str) -> None:
    (tmp_path / "t.stl").write_bytes(binary_stl())
    realization = load(with_mesh(tmp_path, "t.stl", scale))
    data = mujoco.MjData(realization.model)
    mujoco.mj_kinematics(realization.model, data)
    pose = np.linalg.inv(realization.frame_pose(data, "upper"))
    vertices = realization.model.mesh_vert.reshape(-1, 3)
    world = vertices @ data.geom_xmat[0].reshape(3, 3).T + data.geom_xpos[0]
    local = world @ pose[:3, :3].T + pose[:3, 3]
    expected = TETRAHEDRON * np.array(scale.split(), dtype=float)
    assert sorted(local.round(6).tolist()) == sorted((expected.round(6) + 0.0).tolist())


def test_a_flat_collision_mesh_becomes_a_thin_box_with_a_note(tmp_path: Path) -> None:
    square = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]]) * 0.1
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    (tmp_path / "t.stl").write_bytes(binary_stl(square, faces))
    realization = load(with_mesh(tmp_path, "t.stl"))
    assert realization.model.geom_type[0] == mujoco.mjtGeom.mjGEOM_BOX
    np.testing.assert_allclose(sorted(realization.model.geom_size[0]), [0.0005, 0.05, 0.1])
    np.testing.assert_allclose(realization.model.geom_pos[0], [0.1, 0.05, 0], atol=1e-9)
    assert any("flat collision mesh of link 'upper'" in note for note in realization.notes)


OBJ = "".join(f"v {x} {y} {z}\n" for x, y, z in TETRAHEDRON) + "".join(
    f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in FACES
)
COLLADA = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="0.01" name="centimeter"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="12">0 0 0 10 0 0 0 10 0 0 0 10</float_array>
<technique_common><accessor source="#pa" count="4" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/>
<p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><translate>0 0 5</translate>
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def test_obj_and_collada_meshes_are_converted_to_metres(tmp_path: Path) -> None:
    (tmp_path / "t.obj").write_text(OBJ)
    (tmp_path / "t.dae").write_text(COLLADA)
    volumes = []
    for name in ("t.obj", "t.dae"):
        realization = load(with_mesh(tmp_path, name))
        vertices = realization.model.mesh_vert.reshape(-1, 3)
        volumes.append(np.ptp(vertices, axis=0))
        extent = np.linalg.norm(vertices[:, None] - vertices[None], axis=2).max()
        assert extent == pytest.approx(0.1 * np.sqrt(2), rel=1e-6)
    np.testing.assert_allclose(volumes[0], volumes[1], atol=1e-7)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("t.stl", b"", "broken STL|without triangles"),
        ("t.stl", b"solid x\nfacet\n", "broken STL|without triangles"),
        ("t.stl", bytes(80) + b"\xff\xff\xff\x7f" + bytes(50), "broken STL|without triangles"),
        ("t.obj", b"v 0 0 0\nf 1 2 3\n", "broken OBJ|not there|without"),
        ("t.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not finite|broken OBJ"),
        ("t.dae", b"<COLLADA", "not well-formed"),
        ("t.dae", b"<!DOCTYPE a [<!ENTITY b 'c'>]><COLLADA/>", "document type"),
        ("t.dae", b"<COLLADA/>", "broken DAE|without triangles"),
        ("t.blend", b"x", "not a mesh that can be read"),
    ],
)
def test_invalid_mesh_files_are_refused(
    tmp_path: Path, name: str, content: bytes, words: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FormatError, match=words) as caught:
        load(with_mesh(tmp_path, name))
    assert "arm.urdf:9" in str(caught.value)


def test_a_mesh_above_the_size_limits_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dataclasses import replace

    from pytest_twin.realization import mesh
    from pytest_twin.realization.limits import LIMITS

    (tmp_path / "t.stl").write_bytes(binary_stl())
    path = with_mesh(tmp_path, "t.stl")
    monkeypatch.setattr(mesh, "LIMITS", replace(LIMITS, mesh_faces=3))
    with pytest.raises(LimitError, match="too many triangles"):
        load(path)
    monkeypatch.setattr(mesh, "LIMITS", replace(LIMITS, asset_bytes=100))
    with pytest.raises(LimitError, match="too large"):
        load(path)


@pytest.mark.parametrize(
    "reference",
    [
        "../secret.stl",
        "/etc/secret.stl",
        "file:///etc/secret.stl",
        "package://robot/../secret.stl",
        "package://etc/secret.stl",
        "package:///etc/secret.stl",
        "http://host/secret.stl",
        "link.stl",
    ],
)
def test_mesh_references_outside_the_checkout_are_refused(tmp_path: Path, reference: str) -> None:
    (tmp_path / "secret.stl").write_bytes(binary_stl())
    inside = tmp_path / "robot"
    (inside / ".git").mkdir(parents=True)
    (inside / "link.stl").symlink_to(tmp_path / "secret.stl")
    said = refusal(with_mesh(inside, reference), TwinError)
    assert said.startswith(f"{inside}/arm.urdf:9: ")


ROBOTS = [
    "panda.urdf",
    "ur5_robot.urdf",
    "so101.urdf",
    "allegro_left_hand.urdf",
    "allegro_right_hand.urdf",
    "solo12.urdf",
    "talos_left_arm.urdf",
    "talos_full_v2.urdf",
]


def check_forward_is_finite(realization: Realization) -> None:
    data = mujoco.MjData(realization.model)
    mujoco.mj_forward(realization.model, data)
    assert np.isfinite(data.qacc).all()


@pytest.mark.parametrize("name", ROBOTS)
def test_urdfs_of_real_robots_compile(name: str) -> None:
    realization = load(example_robot(name), accept_invalid_inertia=True)
    check_forward_is_finite(realization)
    assert realization.actuators
    repaired = 4 if name.startswith("allegro") else 0
    assert len(realization.source.inertia_repairs) == repaired


def test_a_robot_without_links_is_refused() -> None:
    assert "a robot without links" in refusal(example_robot("ur3.urdf"))
