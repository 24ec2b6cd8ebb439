"""Loading of MJCF: refusals before MuJoCo compiles, and equality with MuJoCo's own loading."""

from __future__ import annotations

import struct
from pathlib import Path

import mujoco
import numpy as np
import pytest
from model_texts import PENDULUM, recordings, written

from pytest_twin.errors import FormatError, LimitError, ModelError, PathError, TwinError
from pytest_twin.formats.paths import Roots
from pytest_twin.realization import load

TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * 0.1
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def binary_stl(vertices: np.ndarray = TETRAHEDRON, faces: np.ndarray = FACES) -> bytes:
    body = b"".join(
        struct.pack("<12fH", 0, 0, 0, *vertices[face].ravel().tolist(), 0) for face in faces
    )
    return bytes(80) + struct.pack("<I", len(faces)) + body


def model_with(body: str = "", asset: str = "", head: str = "") -> str:
    return (
        f"<mujoco>{head}<asset>{asset}</asset><worldbody><body name='b'><joint name='j'/>"
        f"<geom size='0.1'/>{body}</body></worldbody></mujoco>"
    )


def refusal(folder: Path, text: str, kind: type[TwinError] = ModelError) -> str:
    with pytest.raises(kind) as caught:
        load(written(folder, text))
    return str(caught.value)


@pytest.mark.parametrize("name", ["so101", "xl330", "emps"])
def test_the_loaded_model_equals_the_model_that_mujoco_loads(name: str) -> None:
    path = recordings() / name / "model.xml"
    ours, theirs = load(path).model, mujoco.MjModel.from_xml_path(str(path))
    for field in dir(theirs):
        value = getattr(theirs, field)
        if not field.startswith("_") and isinstance(value, np.ndarray):
            np.testing.assert_array_equal(getattr(ours, field), value, err_msg=field)


def test_includes_meshes_and_attached_models_compile_as_in_mujoco(
    tmp_path: Path,
) -> None:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes/Tip.STL").write_bytes(binary_stl())
    written(tmp_path, "<mujoco><body name='inner'><geom size='.2'/></body></mujoco>", "part.xml")
    written(
        tmp_path,
        "<mujoco model='tool'><worldbody><body name='root'><geom size='.1' mass='3'/></body>"
        "</worldbody></mujoco>",
        "tool.xml",
    )
    text = (
        "<mujoco><compiler meshdir='meshes'/><asset><mesh file='Tip.STL' scale='2 2 2'/>"
        "<model name='tool' file='tool.xml'/></asset><worldbody><include file='part.xml'/>"
        "<body name='b'><geom type='mesh' mesh='Tip'/><attach model='tool' body='root'"
        " prefix='t_'/></body></worldbody></mujoco>"
    )
    path = written(tmp_path, text)
    realization = load(path)
    theirs = mujoco.MjModel.from_xml_path(str(path))
    assert realization.names("body") == ("world", "inner", "b", "t_root")
    np.testing.assert_array_equal(realization.model.body_inertia, theirs.body_inertia)
    np.testing.assert_array_equal(realization.model.mesh_vert, theirs.mesh_vert)
    names = {file.name for file in realization.source.files}
    assert names == {"model.xml", "part.xml", "tool.xml", "Tip.STL"}


def test_a_model_in_a_linked_folder_finds_its_files(tmp_path: Path) -> None:
    real = tmp_path / "real"
    real.mkdir()
    written(real, "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>", "part.xml")
    written(real, "<mujoco><include file='part.xml'/></mujoco>")
    (tmp_path / "link").symlink_to(real)
    assert load(tmp_path / "link/model.xml").model.ngeom == 1


@pytest.mark.parametrize(
    "element",
    [
        "<include file='../secret.xml'/>",
        "<include file='/etc/passwd'/>",
        "<include file='link.xml'/>",
        "<asset><mesh name='m' file='../secret.stl'/></asset>",
        "<asset><hfield name='m' file='/etc/hostname.png' size='1 1 1 1'/></asset>",
        "<asset><texture name='t' type='2d' file='../secret.png'/></asset>",
        "<asset><texture name='t' type='cube' fileright='../secret.png'/></asset>",
        "<asset><skin name='s' file='../secret.skn'/></asset>",
        "<asset><model name='s' file='../secret.xml'/></asset>",
        "<worldbody><flexcomp name='f' type='mesh' file='../secret.stl'/></worldbody>",
        "<compiler meshdir='..'/><asset><mesh name='m' file='secret.stl'/></asset>",
        "<compiler assetdir='/etc'/><asset><mesh name='m' file='secret.stl'/></asset>",
    ],
)
def test_mjcf_references_outside_the_checkout_are_refused(tmp_path: Path, element: str) -> None:
    for suffix in ("xml", "stl", "png", "skn"):
        (tmp_path / f"secret.{suffix}").write_text("<mujoco/>")
    inside = tmp_path / "robot"
    (inside / ".git").mkdir(parents=True)
    (inside / "link.xml").symlink_to(tmp_path / "secret.xml")
    with pytest.raises(PathError, match="roots") as caught:
        load(written(inside, f"<mujoco>\n{element}\n</mujoco>"))
    assert caught.value.path == inside / "model.xml"
    assert caught.value.line == 2


def test_declared_roots_permit_references_outside_the_checkout(tmp_path: Path) -> None:
    inside, shared = tmp_path / "robot", tmp_path / "shared"
    (inside / ".git").mkdir(parents=True)
    shared.mkdir()
    (shared / "tip.stl").write_bytes(binary_stl())
    text = model_with("<geom type='mesh' mesh='tip'/>", "<mesh file='../shared/tip.stl'/>")
    path = written(inside, text)
    with pytest.raises(PathError):
        load(path)
    assert load(path, roots=Roots(inside, (shared,))).model.nmesh == 1


def test_a_missing_file_is_reported_with_the_line_of_its_reference(tmp_path: Path) -> None:
    words = refusal(
        tmp_path,
        "<mujoco><asset>\n<texture type='2d' name='t' file='t.png'/></asset></mujoco>",
        PathError,
    )
    assert words.startswith(f"{tmp_path}/model.xml:2: ")
    assert "no such file" in words


def test_cyclic_includes_are_refused(tmp_path: Path) -> None:
    written(tmp_path, "<mujoco><include file='b.xml'/></mujoco>", "a.xml")
    written(tmp_path, "<mujoco><include file='a.xml'/></mujoco>", "b.xml")
    assert "includes itself" in refusal(tmp_path, "<mujoco><include file='a.xml'/></mujoco>")


def test_cyclic_model_attachments_are_refused(tmp_path: Path) -> None:
    text = "<mujoco><asset><model name='m' file='model.xml'/></asset></mujoco>"
    assert "nested too deep" in refusal(tmp_path, text, LimitError)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            model_with("<inertial pos='0 0 0' mass='nan' diaginertia='1 1 1'/>"),
            "inertial.mass: not",
        ),
        (model_with("<inertial pos='0 0 0' mass='-1' diaginertia='1 1 1'/>"), "mass: negative"),
        (model_with("<joint axis='1 0 0' damping='-0.1'/>"), "joint.damping: negative"),
        (model_with("<joint axis='1 0 0' damping='1e999'/>"), "joint.damping: not a finite"),
        (model_with("<joint axis='1 0 0' armature='-0.1'/>"), "joint.armature: negative"),
        (model_with("<joint axis='1 0 0' frictionloss='-1'/>"), "joint.frictionloss: negative"),
        (model_with(head="<option timestep='0'/>"), "option.timestep: not positive"),
        (model_with(head="<option timestep='-0.1'/>"), "option.timestep: not positive"),
        (model_with(head="<option gravity='0 0 inf'/>"), "option.gravity: not a finite"),
        (model_with(head="<default><joint damping='-1'/></default>"), "joint.damping: negative"),
        (model_with("<geom size='.1' density='-5'/>"), "geom.density: negative"),
        (model_with(head="<extension><plugin plugin='x'/></extension>"), "native code"),
        (model_with("<site file='a.png'/>"), "no file is allowed here"),
        (model_with(asset="<mesh name='m' file='a.blend'/>"), "no such file"),
        ("<sdf/>", "not a robot model"),
    ],
)
def test_impossible_values_are_refused_with_file_and_line(
    tmp_path: Path, text: str, words: str
) -> None:
    said = refusal(tmp_path, text, TwinError)
    assert said.startswith(f"{tmp_path}/model.xml")
    assert words in said


@pytest.mark.parametrize(
    "text",
    [
        model_with(
            "<replicate count='100000' euler='0 0 1'><body><geom size='1'/></body></replicate>"
        ),
        model_with(
            "<replicate count='1000'><replicate count='1000'>"
            "<geom size='1'/></replicate></replicate>"
        ),
        model_with("<flexcomp name='f' type='grid' count='1000 1000 1000' spacing='1 1 1'/>"),
        model_with("<composite type='cable' count='100000000 1 1' size='1'/>"),
        model_with(asset="<hfield name='h' nrow='100000' ncol='100000' size='1 1 1 1'/>"),
        model_with(
            asset="<texture name='t' builtin='flat' type='2d' width='99999' height='99999'/>"
        ),
        model_with(head="<size memory='1000G'/>"),
        model_with(head="<size nuserdata='2000000000'/>"),
        model_with(head="<custom><numeric name='n' size='2000000000'/></custom>"),
        model_with(head="<actuator><motor joint='j' nsample='2000000000'/></actuator>"),
    ],
)
def test_excessive_sizes_are_refused_before_expansion(tmp_path: Path, text: str) -> None:
    said = refusal(tmp_path, text, LimitError)
    assert said.startswith(f"{tmp_path}/model.xml:1: ")


def test_a_huge_image_is_refused_by_its_header(tmp_path: Path) -> None:
    head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 60_000, 60_000)
    (tmp_path / "bomb.png").write_bytes(head + bytes(40))
    text = model_with(asset="<texture name='t' type='2d' file='bomb.png'/>")
    assert "got '60000 x 60000' pixels" in refusal(tmp_path, text, LimitError)


def test_an_stl_with_fewer_triangles_than_stated_is_refused(tmp_path: Path) -> None:
    (tmp_path / "m.stl").write_bytes(bytes(80) + struct.pack("<I", 4_000_000_000) + bytes(50))
    said = refusal(tmp_path, model_with(asset="<mesh file='m.stl'/>"))
    assert "not a whole binary STL" in said


@pytest.mark.parametrize(
    "text", ["<mujoco", "", "<!DOCTYPE a [<!ENTITY b 'c'>]><mujoco>&b;</mujoco>"]
)
def test_malformed_xml_and_document_types_are_refused(tmp_path: Path, text: str) -> None:
    refusal(tmp_path, text, FormatError)


def test_mujoco_errors_are_reported_with_file_and_line(
    tmp_path: Path,
) -> None:
    written(tmp_path, "<mujoco>\n\n<body name='x'><joint/></body></mujoco>", "part.xml")
    said = refusal(tmp_path, "<mujoco><worldbody>\n<include file='part.xml'/></worldbody></mujoco>")
    assert said.startswith(f"{tmp_path}/part.xml:3: MuJoCo refuses the model: mass and inertia")
    said = refusal(
        tmp_path, "<mujoco>\n<worldbody>\n<geom size='1' sise='2'/></worldbody></mujoco>"
    )
    assert said.startswith(f"{tmp_path}/model.xml:3: MuJoCo refuses the model: Schema violation")


def test_unknown_names_are_refused_with_similar_names(tmp_path: Path) -> None:
    realization = load(written(tmp_path, PENDULUM))
    assert realization.joints == ("swing",)
    assert realization.actuators == ("servo",)
    for ask in (realization.joint_dof_index, realization.joint_qpos_index):
        with pytest.raises(TwinError, match=r"no joint 'swng' \(expected perhaps 'swing'\)"):
            ask("swng")
    with pytest.raises(TwinError, match=r"no actuator 'swing'"):
        realization.actuator_index("swing")
    with pytest.raises(TwinError, match=r"no frame 'tp' \(expected perhaps 'tip'\)"):
        realization.frame_index("tp")


def test_the_pose_of_a_frame_equals_the_closed_form(tmp_path: Path) -> None:
    realization = load(written(tmp_path, PENDULUM))
    data = mujoco.MjData(realization.model)
    data.qpos[:] = realization.qpos({"swing": 0.3})
    mujoco.mj_kinematics(realization.model, data)
    pose = realization.frame_pose(data, "tip")
    s, c = np.sin(0.3), np.cos(0.3)
    expected = [[c, 0, s, -0.2 * s], [0, 1, 0, 0], [-s, 0, c, -0.2 * c], [0, 0, 0, 1]]
    np.testing.assert_allclose(pose, expected, atol=1e-15)
    with pytest.raises(TwinError, match="not a value of joint 'swing'"):
        realization.qpos({"swing": float("nan")})
    with pytest.raises(TwinError, match="one finite number"):
        realization.qpos({"swing": np.zeros(2)})
