"""Every URDF element of the table is converted, reported or listed as a loss as stated there."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path

import pytest
from audited import box_stl, findings_of
from lxml import etree

from pytest_twin.asset.realize import realize
from pytest_twin.asset.urdf_elements import APPLIED, CARRIED, ENTRIES, NAMES, TEXT, Entry, by_path
from pytest_twin.errors import ModelError

BASE = """<robot name="table">
  <link name="base"/>
  <link name="arm">
    <inertial><origin xyz="0 0 0" rpy="0 0 0"/><mass value="1"/>
      <inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
    {shapes}
  </link>
  <joint name="j" type="revolute"><parent link="base"/><child link="arm"/>
    <origin xyz="0 0 0" rpy="0 0 0"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="10" velocity="2"/><dynamics damping="0" friction="0"/>
  </joint>
  <link name="tip"><inertial><mass value="1"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="f" type="revolute"><parent link="arm"/><child link="tip"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="10" velocity="2"/>{mimic}
  </joint>
</robot>
"""
PLAIN = {
    "box": '<box size="0.5 0.5 0.5"/>',
    "cylinder": '<cylinder radius="0.5" length="0.5"/>',
    "capsule": '<capsule radius="0.5" length="0.5"/>',
    "sphere": '<sphere radius="0.5"/>',
    "mesh": '<mesh filename="other.stl" scale="1 1 1"/>',
}


def base(entry: Entry) -> etree._Element:
    """A robot in which the entry's element has another value or is absent."""
    shape = next((tag for tag in PLAIN if entry.path.endswith(f"geometry/{tag}")), "box")
    paint = '<material name="m"><color rgba="1 1 1 1"/></material>'
    shapes = "".join(
        f"<{role}><origin/><geometry>{PLAIN[shape]}</geometry>"
        f"{paint if role == 'visual' and entry.path != 'material/color' else ''}</{role}>"
        for role in ("visual", "collision")
    )
    mimic = '<mimic joint="j" multiplier="1" offset="0"/>' if "mimic" in entry.path else ""
    root = etree.fromstring(BASE.format(shapes=shapes, mimic=mimic))
    if entry.path == "material/color":
        root.insert(0, etree.fromstring('<material name="p"><color rgba="1 1 1 1"/></material>'))
        etree.SubElement(root.find("link[@name='arm']/visual"), "material").set("name", "p")
    return root


def insert_sample(root: etree._Element, entry: Entry) -> None:
    """Insert the entry's sample value into a robot; missing parent elements are created."""
    owner = "f" if "mimic" in entry.path else "j"
    at = root
    for tag in filter(None, entry.path.removesuffix("/**").removesuffix("/*").split("/")):
        found = {
            "link": "link[@name='arm']",
            "joint": f"joint[@name='{owner}']" if at is root else "joint",
        }.get(tag, tag)
        below = at.find(found)
        if below is None:
            below = etree.SubElement(at, tag)
            if tag == "param":
                below.set("name", "min")
        at = below
    if entry.attribute == TEXT:
        at.text = entry.sample
    elif entry.attribute is not None:
        at.set(entry.attribute, entry.sample)


def write(folder: Path, root: etree._Element) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "part.stl").write_bytes(box_stl((0.2, 0.05, 0.05)))
    (folder / "other.stl").write_bytes(box_stl((0.4, 0.3, 0.2)))
    path = folder / "table.urdf"
    path.write_bytes(etree.tostring(root))
    return path


def named(entries: Iterable[Entry]) -> list[object]:
    return [pytest.param(entry, id=entry.label) for entry in entries]


def realized(path: Path, out: Path) -> Path:
    out.mkdir()
    realize(str(path), str(out))
    return out


@pytest.mark.parametrize(
    "entry",
    # With two joints there is only one joint to mimic, so that value cannot be changed.
    named(e for e in ENTRIES if e.goes is CARRIED and e.label != "joint/mimic@joint"),
)
def test_a_converted_value_changes_the_mjcf(tmp_path: Path, entry: Entry) -> None:
    root = base(entry)
    before = realized(write(tmp_path / "a", root), tmp_path / "before")
    insert_sample(root, entry)
    after = realized(write(tmp_path / "b", root), tmp_path / "after")
    texts = [(folder / "table.xml").read_text() for folder in (before, after)]
    meshes = [
        [f.read_bytes() for f in sorted(folder.glob("meshes/*"))] for folder in (before, after)
    ]
    assert texts[0] != texts[1] or meshes[0] != meshes[1]


@pytest.fixture(scope="module")
def audited_robot(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[list[dict[str, object]], dict[str, object]]:
    """Findings and loss matrix of a robot with all entries that are not converted."""
    folder = tmp_path_factory.mktemp("table")
    root = base(by_path()["joint/mimic", "multiplier"])
    for entry in ENTRIES:
        if entry.goes is not CARRIED and entry.path not in ("", "link", "joint"):
            insert_sample(root, entry)
    # Any element of Gazebo's own format, for the entry that represents all of them.
    etree.SubElement(root.find("gazebo"), "enable_wind").text = "true"
    path = write(folder / "in", root)
    out = realized(path, folder / "out")
    return findings_of(path), json.loads((out / "loss.json").read_text())


@pytest.mark.parametrize(
    "entry",
    named(e for e in ENTRIES if e.goes.code and e.path not in ("", "link")),
)
def test_an_unconverted_value_is_a_finding(
    audited_robot: tuple[list[dict[str, object]], dict[str, object]], entry: Entry
) -> None:
    element = entry.label.removesuffix("/**").replace("/*", "/enable_wind")
    found = [
        row
        for row in audited_robot[0]
        if row["code"] == entry.goes.code and str(row["element"]).startswith(element)
    ]
    assert found, f"no finding {entry.goes.code} names {element}"
    if entry.attribute is not None:
        assert found[0]["severity"] == ("warning" if entry.is_physical else "info")


@pytest.mark.parametrize(
    "entry", named(e for e in ENTRIES if e.goes.row and e.path not in ("", "link"))
)
def test_an_unconverted_value_has_a_row_in_the_loss_matrix(
    audited_robot: tuple[list[dict[str, object]], dict[str, object]], entry: Entry
) -> None:
    for conversion in audited_robot[1]["conversions"]:  # type: ignore[attr-defined]
        rows = [row for row in conversion["rows"] if row["feature"] == entry.goes.row]
        if conversion["rows"]:
            assert rows, f"the matrix of {conversion['target']} has no row {entry.goes.row}"
            assert rows[0]["verdict"] in ("lost", "changed", "kept")


def test_unknown_attributes_of_robot_and_link_are_findings(tmp_path: Path) -> None:
    root = base(by_path()["joint/axis", "xyz"])
    root.set("version", "1.1")
    root.find("link[@name='arm']").set("type", "laser")
    found = {row["element"] for row in findings_of(write(tmp_path / "a", root))}
    assert {"@version", "link@type"} <= found


def test_an_unconverted_neutral_value_is_not_a_finding(tmp_path: Path) -> None:
    root = base(by_path()["joint/axis", "xyz"])
    offset = by_path()["transmission/joint/offset", TEXT]
    insert_sample(root, offset)
    before = findings_of(write(tmp_path / "a", root))
    for element in root.iter("offset"):
        element.text = "0.0"
    after = findings_of(write(tmp_path / "b", root))
    codes = [
        [r["element"] for r in rows if r["element"] == offset.path] for rows in (before, after)
    ]
    assert codes == [["transmission/joint/offset"], []]


def test_undefined_elements_and_attributes_are_findings_anywhere(tmp_path: Path) -> None:
    root = base(by_path()["joint/axis", "xyz"])
    root.find("joint").set("color", "red")
    etree.SubElement(root.find("joint/limit"), "snap").text = "3"
    etree.SubElement(root, "loop_joint").set("name", "l")
    found = {
        row["element"]
        for row in findings_of(write(tmp_path / "a", root))
        if row["code"] == "controllers.custom_tag"
    }
    assert found == {"joint@color", "joint/limit/snap", "loop_joint"}


def test_the_entries_of_the_table_are_unique_and_have_a_sample() -> None:
    labels = [(entry.path, entry.attribute) for entry in ENTRIES]
    assert len(labels) == len(set(labels))
    for entry in ENTRIES:
        assert entry.sample or entry.attribute is None
        assert re.fullmatch(r"[\w/*]*", entry.path)


@pytest.mark.parametrize("entry", named(e for e in ENTRIES if e.goes is NAMES or e.goes is APPLIED))
def test_names_and_applied_values_are_not_findings(tmp_path: Path, entry: Entry) -> None:
    root = base(by_path()["joint/axis", "xyz"])
    insert_sample(root, entry)
    rows = findings_of(write(tmp_path / "a", root))
    assert entry.label not in {row["element"] for row in rows}


def test_an_srdf_given_as_urdf_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "robot.srdf"
    path.write_text('<robot name="r">\n<group name="all"><link name="a"/></group></robot>')
    with pytest.raises(ModelError, match=r"robot\.srdf:2: .*an SRDF, not a URDF .*--urdf FILE"):
        findings_of(path)
