"""Search for the files that a model references, restricted to the model's root folder."""

from __future__ import annotations

from pathlib import Path

import pytest
from test_mjcf_loading import binary_stl

from pytest_twin.errors import PathError, TwinError
from pytest_twin.formats.declared_inputs import DeclaredInputs, declaring
from pytest_twin.formats.paths import Roots
from pytest_twin.realization import load
from pytest_twin.realization.files.locate import ModelFolders, locate
from pytest_twin.realization.files.packages import Packages

URDF = """<robot name="arm">
{head}
  <link name="base"><collision><geometry>
    <mesh filename="{mesh}"/>
  </geometry></collision></link>
</robot>
"""


@pytest.fixture(autouse=True)
def _no_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH"):
        monkeypatch.delenv(name, raising=False)


def urdf(folder: Path, mesh: str, head: str = "") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "arm.urdf"
    path.write_text(URDF.format(mesh=mesh, head=head))
    return path


def stl(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(binary_stl())
    return path


def loaded(path: Path, **named: object) -> ModelFolders:
    with declaring(DeclaredInputs(**named)):  # type: ignore[arg-type]
        realization = load(path)
    assert realization.model.nmesh == 1
    located = realization.source.located
    assert located is not None
    return located


def test_meshes_in_the_usual_ros_layout_are_found_without_options(tmp_path: Path) -> None:
    stl(tmp_path / "ws/arm/meshes/a.stl")
    path = urdf(tmp_path / "ws/arm/urdf", "../meshes/a.stl")
    located = loaded(path)
    assert located.root is not None
    assert located.root.folder == tmp_path / "ws/arm"
    assert load(path).notes[0] == (
        f"root of the model: {tmp_path}/ws/arm "
        "(the nearest folder with all files that it refers to)"
    )


def test_a_package_without_manifest_is_found_by_the_name_of_a_parent_folder(tmp_path: Path) -> None:
    stl(tmp_path / "arm_description/meshes/a.stl")
    path = urdf(tmp_path / "arm_description/urdf", "package://arm_description/meshes/a.stl")
    located = loaded(path)
    package = located.packages.found["arm_description"]
    assert package.folder == tmp_path / "arm_description"
    assert package.by == "the name of a folder above the file"


def test_a_package_in_a_sibling_folder_is_found_by_its_name(tmp_path: Path) -> None:
    stl(tmp_path / "ws/meshes_of_arm/a.stl")
    path = urdf(tmp_path / "ws/arm/urdf", "package://meshes_of_arm/a.stl")
    package = loaded(path).packages.found["meshes_of_arm"]
    assert package.folder == tmp_path / "ws/meshes_of_arm"
    assert package.by == "the name of a folder beside one above the file"


def test_a_package_is_found_by_the_name_in_its_manifest(tmp_path: Path) -> None:
    # The folder name of a GitHub archive.
    folder = tmp_path / "arm_description-1.2"
    stl(folder / "meshes/a.stl")
    (folder / "package.xml").write_text("<package><name>arm_description</name></package>")
    path = urdf(folder / "urdf", "package://arm_description/meshes/a.stl")
    located = loaded(path)
    assert located.packages.found["arm_description"].by == "the name in package.xml"
    assert located.root is not None
    assert located.root.folder == folder


def test_a_renamed_package_without_manifest_is_found_by_its_contents(tmp_path: Path) -> None:
    stl(tmp_path / "arm-main/meshes/a.stl")
    path = urdf(tmp_path / "arm-main/urdf", "package://arm_description/meshes/a.stl")
    located = loaded(path)
    assert located.packages.found["arm_description"].folder == tmp_path / "arm-main"
    assert located.root is not None
    assert located.root.folder == tmp_path / "arm-main"
    assert located.root.why == "the nearest folder with all files that it refers to"


def test_ros_environment_variables_are_searched_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stl(tmp_path / "opt/share/arm/a.stl")
    stl(tmp_path / "old/arm/a.stl")
    path = urdf(tmp_path / "ws/src", "package://arm/a.stl")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "old"))
    assert loaded(path).packages.found["arm"].by == "ROS_PACKAGE_PATH"
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "opt"))
    package = loaded(path).packages.found["arm"]
    assert (package.folder, package.by) == (tmp_path / "opt/share/arm", "AMENT_PREFIX_PATH")
    stl(tmp_path / "ws/src/arm/a.stl")
    assert loaded(path).packages.found["arm"].folder == tmp_path / "ws/src/arm"


def test_a_package_given_on_the_command_line_has_priority(tmp_path: Path) -> None:
    stl(tmp_path / "ws/arm/a.stl")
    stl(tmp_path / "mine/a.stl")
    path = urdf(tmp_path / "ws/arm/urdf", "package://arm/a.stl")
    package = loaded(path, packages={"arm": tmp_path / "mine"}).packages.found["arm"]
    assert (package.folder, package.by) == (tmp_path / "mine", "--package")


def test_of_two_folders_with_the_package_name_the_one_with_the_file_is_used(tmp_path: Path) -> None:
    stl(tmp_path / "arm/meshes/a.stl")
    path = urdf(tmp_path / "arm/python/arm/urdf", "package://arm/meshes/a.stl")
    assert loaded(path).packages.found["arm"].folder == tmp_path / "arm"


def test_a_missing_package_is_refused_with_all_searched_places(
    tmp_path: Path,
) -> None:
    path = urdf(tmp_path / "ws/urdf", "package://nowhere/a.stl")
    with pytest.raises(PathError) as caught:
        load(path)
    words = str(caught.value)
    assert words.startswith(f"{path}:4: mesh.filename: package 'nowhere' is not found")
    assert "--package nowhere=FOLDER" in words
    for place in (tmp_path / "ws/urdf", tmp_path / "ws"):
        assert f"{place} and its folders" in words
    assert "AMENT_PREFIX_PATH (not set), ROS_PACKAGE_PATH (not set)" in words


def test_gazebo_model_uris_are_resolved_like_package_uris(tmp_path: Path) -> None:
    stl(tmp_path / "models/arm/meshes/a.stl")
    path = urdf(tmp_path / "models/arm", "model://arm/meshes/a.stl")
    assert loaded(path).packages.found["arm"].folder == tmp_path / "models/arm"


def test_a_reference_outside_the_root_is_refused_with_the_option_that_permits_it(
    tmp_path: Path,
) -> None:
    (tmp_path / "arm/.git").mkdir(parents=True)
    stl(tmp_path / "shared/a.stl")
    path = urdf(tmp_path / "arm/urdf", "../../shared/a.stl")
    with pytest.raises(PathError) as caught:
        load(path)
    assert "path leaves the declared roots" in str(caught.value)
    assert f"--root {tmp_path}/shared on the command line" in str(caught.value)
    assert f"'roots: [{tmp_path}/shared]' in twin.yaml" in str(caught.value)
    loaded(path, roots=(tmp_path / "shared",))


def test_a_model_in_downloads_cannot_reference_private_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "home/ann"
    monkeypatch.setenv("HOME", str(home))
    stl(home / "secret.stl")
    stl(home / "Downloads/secret.stl")
    for folder, mesh in (
        ("Downloads", "../secret.stl"),
        ("Downloads/arm", "../secret.stl"),
        ("Downloads/arm", f"file://{home}/secret.stl"),
        ("Downloads/arm", "package://Downloads/secret.stl"),
        ("Downloads/arm", "package://arm/../secret.stl"),
        ("Downloads/arm/urdf", "package://ann/secret.stl"),
    ):
        with pytest.raises(TwinError):
            load(urdf(home / folder, mesh))


def test_symbolic_links_out_of_the_root_are_refused(tmp_path: Path) -> None:
    secret = stl(tmp_path / "secret/a.stl")
    (tmp_path / "arm/meshes").mkdir(parents=True)
    (tmp_path / "arm/meshes/a.stl").symlink_to(secret)
    with pytest.raises(PathError, match="leaves the declared roots"):
        load(urdf(tmp_path / "arm/urdf", "../meshes/a.stl"))
    (tmp_path / "arm/linked").symlink_to(tmp_path / "secret")
    with pytest.raises(PathError, match="package 'linked' is not found"):
        load(urdf(tmp_path / "arm/urdf", "package://linked/a.stl"))


MJCF = """<mujoco>{compiler}{include}
  <asset><mesh name="m" file="a.stl"/></asset>
  <worldbody><body><geom type="mesh" mesh="m"/></body></worldbody>
</mujoco>
"""


@pytest.mark.parametrize("key", ["meshdir", "assetdir"])
def test_an_mjcf_may_reference_meshes_in_folders_above_and_beside_it(
    tmp_path: Path, key: str
) -> None:
    stl(tmp_path / "hand/stls/left/a.stl")
    folder = tmp_path / "hand/xml/left"
    folder.mkdir(parents=True)
    path = folder / "hand.xml"
    path.write_text(MJCF.format(compiler=f'<compiler {key}="../../stls/left"/>', include=""))
    located = loaded(path)
    assert located.root is not None
    assert located.root.folder == tmp_path / "hand"


def test_references_of_included_files_widen_the_root_too(tmp_path: Path) -> None:
    stl(tmp_path / "robots/assets/a.stl")
    for name in ("robots/shared", "robots/hand"):
        (tmp_path / name).mkdir()
    (tmp_path / "robots/shared/common.xml").write_text(
        '<mujoco><compiler meshdir="../assets"/></mujoco>'
    )
    path = tmp_path / "robots/hand/hand.xml"
    path.write_text(MJCF.format(compiler="", include='<include file="../shared/common.xml"/>'))
    assert loaded(path).root == locate(path).root
    (tmp_path / "robots/hand/.git").mkdir()
    with pytest.raises(PathError, match="leaves the declared roots"):
        load(path)


def test_an_include_through_a_link_does_not_widen_the_root(tmp_path: Path) -> None:
    (tmp_path / "robots/hand").mkdir(parents=True)
    (tmp_path / "robots/secret.xml").write_text("<mujoco/>")
    (tmp_path / "robots/hand/link.xml").symlink_to("../secret.xml")
    path = tmp_path / "robots/hand/hand.xml"
    path.write_text(MJCF.format(compiler="", include='<include file="link.xml"/>'))
    with pytest.raises(PathError, match="leaves the declared roots"):
        load(path)


def test_declared_roots_replace_the_search_for_a_root(tmp_path: Path) -> None:
    stl(tmp_path / "arm/meshes/a.stl")
    path = urdf(tmp_path / "arm/urdf", "../meshes/a.stl")
    with pytest.raises(PathError):
        load(path, roots=Roots(path.parent))
    assert load(path, roots=Roots(path.parent, (tmp_path / "arm",))).model.nmesh == 1
    named = urdf(tmp_path / "arm/urdf", "package://arm/meshes/a.stl")
    assert load(named, roots=Roots(path.parent, (tmp_path / "arm",))).model.nmesh == 1


def test_a_package_is_found_in_a_workspace_with_many_folders(tmp_path: Path) -> None:
    for index in range(50):
        (tmp_path / f"p{index}").mkdir()
        (tmp_path / f"p{index}/package.xml").write_text(f"<package><name>n{index}</name></package>")
    found = Packages(above=[tmp_path]).find("n31", "a.stl")
    assert found is not None
    assert found.folder == tmp_path / "p31"
