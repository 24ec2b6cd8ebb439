"""The ``<mujoco>`` block of a URDF has the same effect as in MuJoCo."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_mjcf_loading import binary_stl

from pytest_twin.asset.realize import realize
from pytest_twin.audit.audit_file import audit_file
from pytest_twin.errors import ModelError, PathError
from pytest_twin.realization import load

URDF = """<robot name="r"><mujoco>{block}</mujoco>
  <link name="a"><inertial><origin xyz="0 0 .1" rpy="0.3 0 0"/><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="b"><inertial><mass value="0.5"/>
    <inertia ixx="0.001" iyy="0.002" izz="0.0025" ixy="0.0002" ixz="0" iyz="0"/></inertial>{shape}
  </link>
  <joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="2" velocity="1"/></joint>
</robot>
"""


def robot(folder: Path, block: str = "", izz: float = 0.015, shape: str = "") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "r.urdf"
    path.write_text(URDF.format(block=block, izz=izz, shape=shape))
    return path


BALANCE = 'balanceinertia="true" fusestatic="false"'


@pytest.mark.parametrize(
    ("block", "izz"),
    [
        (f"<compiler {BALANCE}/>", 0.05),
        (f"<compiler {BALANCE}/>", 0.015),
        (f'<compiler {BALANCE} boundmass="0.7" boundinertia="0.003"/>', 0.05),
        ('<compiler fusestatic="false" boundmass="0.7"/>', 0.015),
        (f'<compiler {BALANCE} boundinertia="0.0021"/>', 0.05),
        (f'<compiler {BALANCE} discardvisual="true" angle="degree"/>', 0.05),
    ],
)
def test_compiler_options_give_the_same_inertias_as_mujoco(
    tmp_path: Path, block: str, izz: float
) -> None:
    path = robot(tmp_path, block, izz)
    theirs = mujoco.MjModel.from_xml_path(str(path))
    ours = load(path).model
    np.testing.assert_allclose(ours.body_mass, theirs.body_mass, rtol=1e-12)
    moments = np.sort(ours.body_inertia, axis=1)
    np.testing.assert_allclose(moments, np.sort(theirs.body_inertia, axis=1), rtol=1e-9)
    np.testing.assert_allclose(ours.jnt_range, theirs.jnt_range)
    folder = tmp_path / "made"
    folder.mkdir()
    made = realize(str(path), str(folder))
    assert made["critical"] == []
    normalized = mujoco.MjModel.from_xml_path(str(folder / "r.xml"))
    np.testing.assert_allclose(
        np.sort(normalized.body_inertia, axis=1), moments, rtol=1e-9, atol=1e-15
    )
    report = audit_file(str(path))
    assert report["verdict"] == "clean"
    assert report["facts"]["mass"]["value"] == pytest.approx(theirs.body_mass.sum())


def test_an_impossible_inertia_is_refused_without_balanceinertia(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no body can have"):
        load(robot(tmp_path, '<compiler discardvisual="true"/>', 0.05))


def test_corrected_inertias_and_ignored_options_are_noted(tmp_path: Path) -> None:
    notes = load(robot(tmp_path, f"<compiler {BALANCE} settotalmass='3'/>", 0.05)).notes
    assert any("link 'a' has the mass and inertia that <mujoco><compiler>" in n for n in notes)
    assert any("<compiler settotalmass> is not applied" in n for n in notes)


def test_simulation_options_are_the_same_as_in_mujoco(tmp_path: Path) -> None:
    block = '<option timestep="0.01" gravity="0 0 -1"><flag contact="disable"/></option>'
    path = robot(tmp_path, block)
    theirs, ours = mujoco.MjModel.from_xml_path(str(path)), load(path).model
    assert ours.opt.timestep == theirs.opt.timestep == 0.01
    np.testing.assert_array_equal(ours.opt.gravity, theirs.opt.gravity)
    assert ours.opt.disableflags == theirs.opt.disableflags
    for bad in ('timestep="nan"', 'timestep="-1"', 'timestep="x"', 'nonsense="1"'):
        with pytest.raises(ModelError):
            load(robot(tmp_path, f"<option {bad}/>"))


@pytest.mark.parametrize(
    ("compiler", "named", "place"),
    [
        ('meshdir="../meshes"', "deep/a.stl", "meshes/deep/a.stl"),
        ('meshdir="../meshes" strippath="true"', "deep/a.stl", "meshes/a.stl"),
        ('meshdir="../meshes" strippath="false"', "deep/a.stl", "meshes/deep/a.stl"),
        ('assetdir="../meshes"', "a.stl", "meshes/a.stl"),
        ('strippath="true"', "sub/a.stl", "urdf/a.stl"),
    ],
)
def test_mesh_folders_are_resolved_as_in_mujoco(
    tmp_path: Path, compiler: str, named: str, place: str
) -> None:
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / place).write_bytes(binary_stl())
    shape = f'<collision><geometry><mesh filename="{named}"/></geometry></collision>'
    path = robot(tmp_path / "urdf", f"<compiler {compiler}/>", shape=shape)
    assert mujoco.MjModel.from_xml_path(str(path)).nmesh == 1
    assert load(path).model.nmesh == 1
    assert tmp_path / place in load(path).source.files
    assert audit_file(str(path))["verdict"] == "clean"
    folder = tmp_path / "made"
    folder.mkdir()
    assert realize(str(path), str(folder))["critical"] == []
    assert mujoco.MjModel.from_xml_path(str(folder / "r.urdf")).nmesh == 1


def test_a_package_uri_is_resolved_despite_a_mesh_folder_option(tmp_path: Path) -> None:
    (tmp_path / "arm/meshes").mkdir(parents=True)
    (tmp_path / "arm/meshes/a.stl").write_bytes(binary_stl())
    shape = (
        '<collision><geometry><mesh filename="package://arm/meshes/a.stl"/></geometry></collision>'
    )
    block = '<compiler meshdir="elsewhere" discardvisual="true"/>'
    assert load(robot(tmp_path / "arm/urdf", block, shape=shape)).model.nmesh == 1


def test_a_mesh_folder_outside_the_checkout_is_refused(tmp_path: Path) -> None:
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret/a.stl").write_bytes(binary_stl())
    (tmp_path / "arm/.git").mkdir(parents=True)
    shape = '<collision><geometry><mesh filename="a.stl"/></geometry></collision>'
    with pytest.raises(PathError, match="leaves the declared roots"):
        load(robot(tmp_path / "arm", '<compiler meshdir="../secret"/>', shape=shape))
