"""Every command that reads a model accepts the usual ROS package layout without an option."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import trimesh

from pytest_twin.cli import main
from pytest_twin.twin import load_twin

pytestmark = pytest.mark.usefixtures("commands_in_process")

INERTIAL = (
    '<inertial><mass value="1"/>'
    '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
)
URDF = f"""<robot name="arm">
  <link name="base">{INERTIAL}<collision><geometry>
    <mesh filename="{{mesh}}"/>
  </geometry></collision></link>
  <link name="arm">{INERTIAL}</link>
  <joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="5" velocity="2"/></joint>
</robot>
"""


def box() -> bytes:
    content = trimesh.creation.box((0.1, 0.1, 0.1)).export(file_type="stl")
    assert isinstance(content, bytes)
    return content


def robot(folder: Path, mesh: str = "../meshes/a.stl") -> Path:
    (folder / "urdf").mkdir(parents=True)
    (folder / "meshes").mkdir()
    (folder / "meshes/a.stl").write_bytes(box())
    path = folder / "urdf/arm.urdf"
    path.write_text(URDF.format(mesh=mesh))
    return path


@pytest.mark.parametrize("mesh", ["../meshes/a.stl", "package://arm_description/meshes/a.stl"])
def test_audit_realize_and_init_find_and_report_the_root(
    tmp_path: Path, mesh: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = robot(tmp_path / "ws/arm_description", mesh)
    root = tmp_path / "ws/arm_description"
    assert main(["audit", str(path), "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out.count(f"root of the model: {root} (") == 1
    facts = json.loads((tmp_path / "arm.urdf.audit.json").read_text())["facts"]
    assert facts["root"]["folder"] == str(root)
    assert main(["realize", str(path), "--out", str(tmp_path / "made")]) == 0
    assert capsys.readouterr().out.count(f"root of the model: {root} (") == 1
    assert main(["init", str(path), "--out", str(tmp_path / "twin")]) == 0
    assert capsys.readouterr().out.count(f"root of the model: {root} (") == 1
    twin = load_twin(tmp_path / "twin/twin.yaml")
    assert twin.roots == {"arm_description": tmp_path / "twin/asset/arm_description"}


def test_init_accepts_a_source_stored_by_intake(tmp_path: Path) -> None:
    robot(tmp_path / "arm_description", "package://arm_description/meshes/a.stl")
    out = tmp_path / "kept"
    assert main(["intake", str(tmp_path / "arm_description"), "--out", str(out)]) == 0
    assert main(["init", str(out / "source/urdf/arm.urdf"), "--out", str(tmp_path / "twin")]) == 0
    assert load_twin(tmp_path / "twin/twin.yaml").roots["arm_description"].is_dir()


def test_audit_realize_and_init_accept_the_root_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = robot(tmp_path / "arm", "../../shared/a.stl")
    (tmp_path / "arm/.git").mkdir()
    shared = tmp_path / "shared"
    shared.mkdir()
    (shared / "a.stl").write_bytes(box())
    assert main(["realize", str(path), "--out", str(tmp_path / "no")]) == 2
    assert f"--root {shared}" in capsys.readouterr().err
    for words in (["audit", "--out", str(tmp_path)], ["realize", "--out", str(tmp_path / "made")]):
        assert main([words[0], str(path), *words[1:], "--root", str(shared)]) == 0
    assert main(["init", str(path), "--out", str(tmp_path / "t"), "--root", str(shared)]) == 0
    assert main(["audit", str(path), "--root", str(tmp_path / "none")]) == 2
    assert "--root: no such folder" in capsys.readouterr().err
