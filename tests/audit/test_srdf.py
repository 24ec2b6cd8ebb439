"""Audit of an SRDF against its URDF: names, values and collision pairs used by a planner."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from audited import CLEAN, changed, line_of, robots, write_clean

from pytest_twin.asset.urdf_elements import ENTRIES
from pytest_twin.audit.read import read
from pytest_twin.audit.srdf.audit_srdf import audit_srdf, check
from pytest_twin.audit.srdf.document import Srdf
from pytest_twin.audit.srdf.elements import ELEMENTS
from pytest_twin.audit.srdf.files import srdfs_of
from pytest_twin.cli import main
from pytest_twin.errors import TwinError
from pytest_twin.realization import urdf

pytestmark = pytest.mark.usefixtures("commands_in_process")

SRDF = """<?xml version="1.0"?>
<robot name="clean">
  <virtual_joint name="fix" type="fixed" parent_frame="map" child_link="world"/>
  <group name="arm">
    <chain base_link="base" tip_link="tcp"/>
  </group>
  <group name="hand">
    <joint name="grip"/>
    <joint name="thumb_slide"/>
  </group>
  <group name="all">
    <group name="arm"/>
    <group name="hand"/>
  </group>
  <group_state name="ready" group="arm">
    <joint name="shoulder" value="-0.5"/>
    <joint name="elbow" value="1.2"/>
  </group_state>
  <group_state name="open" group="hand">
    <joint name="grip" value="0.02"/>
  </group_state>
  <end_effector name="gripper" parent_link="tcp" group="hand" parent_group="arm"/>
  <disable_collisions link1="base" link2="upper" reason="Adjacent"/>
  <disable_collisions link1="upper" link2="lower" reason="Adjacent"/>
  <disable_collisions link1="lower" link2="finger" reason="Adjacent"/>
  <disable_collisions link1="lower" link2="thumb" reason="Adjacent"/>
</robot>
"""


def audit_with(folder: Path, *pairs: tuple[str, str], urdf: str = CLEAN) -> list[Mapping[str, Any]]:
    """Findings of the SRDF with each text replaced, together with the clean robot."""
    text = SRDF
    for old, new in pairs:
        assert text.count(old) == 1, (old, text.count(old))
        text = text.replace(old, new)
    robot = write_clean(folder, urdf)
    path = folder / "robot.srdf"
    path.write_text(text)
    found = audit_srdf(str(path), str(robot))
    for row in found["findings"]:
        assert row["file"] == str(path)
        assert row["settle"]
        assert row["why"]
    return list(found["findings"])


def only_finding(rows: list[Mapping[str, Any]], code: str) -> Mapping[str, Any]:
    """The only finding, which must have this code."""
    assert [row["code"] for row in rows] == [code], rows
    return rows[0]


def test_a_consistent_srdf_has_no_finding(tmp_path: Path) -> None:
    assert audit_with(tmp_path) == []


@pytest.mark.parametrize(
    ("old", "new", "code", "value", "near"),
    [
        ('tip_link="tcp"', 'tip_link="tpc"', "planning.unknown_link", "tpc", "'tcp'"),
        ('base_link="base"', 'base_link="bas"', "planning.unknown_link", "bas", "'base'"),
        (
            '<joint name="grip"/>',
            '<joint name="gripp"/>',
            "planning.unknown_joint",
            "gripp",
            "grip",
        ),
        ('<group name="hand"/>', '<group name="hnd"/>', "planning.unknown_group", "hnd", "'hand'"),
        ('name="elbow" value', 'name="Elbow" value', "planning.unknown_joint", "Elbow", "'elbow'"),
        (
            'name="open" group="hand"',
            'name="open" group="x"',
            "planning.unknown_group",
            "x",
            "SRDF",
        ),
        ('parent_link="tcp"', 'parent_link="tool"', "planning.unknown_link", "tool", "robot.urdf"),
        ('parent_group="arm"', 'parent_group="am"', "planning.unknown_group", "am", "'arm'"),
        ('child_link="world"', 'child_link="wrld"', "planning.unknown_link", "wrld", "'world'"),
        ('link2="thumb"', 'link2="thmb"', "planning.unknown_link", "thmb", "'thumb'"),
    ],
)
def test_an_unknown_name_is_critical_and_a_similar_name_is_suggested(
    tmp_path: Path, old: str, new: str, code: str, value: str, near: str
) -> None:
    rows = [
        row for row in audit_with(tmp_path, (old, new)) if row["code"].startswith("planning.unk")
    ]
    row = only_finding(rows, code)
    assert row["severity"] == "critical"
    assert row["value"] == value
    assert near in row["expected"]
    assert row["line"] == line_of(SRDF.replace(old, new), new)


@pytest.mark.parametrize(
    "element",
    [
        '<passive_joint name="x"/>',
        '<joint_property joint_name="x" property_name="weight" value="1"/>',
        '<enable_collisions link1="x" link2="base"/>',
        '<disable_default_collisions link="x"/>',
        '<link_sphere_approximation link="x"><sphere center="0 0 0" radius="1"/>'
        "</link_sphere_approximation>",
    ],
)
def test_names_in_every_kind_of_element_are_checked(tmp_path: Path, element: str) -> None:
    rows = audit_with(tmp_path, ("</robot>", element + "</robot>"))
    assert [row["code"] for row in rows] == [
        "planning.unknown_joint" if "joint" in element else "planning.unknown_link"
    ]


@pytest.mark.parametrize(
    ("value", "severity", "words"),
    [
        ("2.5", "critical", "correct the limit"),
        ("2.0004", "warning", "the digits of the limit"),
        ("-90", "critical", "if the value is in degrees, state -1.5708 rad"),
        ("2.0", None, ""),
    ],
)
def test_a_group_state_outside_the_joint_range_is_a_finding(
    tmp_path: Path, value: str, severity: str | None, words: str
) -> None:
    rows = audit_with(tmp_path, ('value="1.2"', f'value="{value}"'))
    if severity is None:
        assert rows == []
        return
    row = only_finding(rows, "planning.state_range")
    assert row["severity"] == severity
    assert row["value"] == float(value)
    assert row["unit"] == "rad"
    assert row["expected"] == "-2 to 2 rad"
    assert words in row["settle"]


@pytest.mark.parametrize("value", ["fast", "nan", "1 2", ""])
def test_a_group_state_value_that_is_not_one_number_is_critical(tmp_path: Path, value: str) -> None:
    row = only_finding(
        audit_with(tmp_path, ('value="1.2"', f'value="{value}"')), "planning.state_value"
    )
    assert row["severity"] == "critical"
    assert row["expected"] == "a finite number in rad"


def test_a_state_of_a_joint_outside_its_group_is_a_finding(tmp_path: Path) -> None:
    rows = audit_with(tmp_path, ('name="elbow" value="1.2"', 'name="grip" value="0.01"'))
    assert sorted(row["code"] for row in rows) == [
        "planning.state_incomplete",
        "planning.state_joint",
    ]
    assert "'arm' does not contain it" in rows[0]["title"]


def test_a_state_of_a_fixed_joint_is_a_finding(tmp_path: Path) -> None:
    row = only_finding(
        audit_with(
            tmp_path,
            (
                '<joint name="elbow" value="1.2"/>',
                '<joint name="elbow" value="1.2"/><joint name="tcp_mount" value="0"/>',
            ),
        ),
        "planning.state_joint",
    )
    assert row["title"] == "the joint is fixed"


def test_a_state_that_contradicts_a_mimic_is_a_finding(tmp_path: Path) -> None:
    both = '<joint name="grip" value="0.02"/>\n    <joint name="thumb_slide" value="0"/>'
    rows = audit_with(tmp_path, ('<joint name="grip" value="0.02"/>', both))
    row = only_finding(rows, "planning.state_mimic")
    assert row["expected"] == "0.02 m"
    assert row["line"] == line_of(SRDF, 'value="0.02"') + 1


def test_circular_and_empty_groups_are_findings(tmp_path: Path) -> None:
    loop = '<group name="hand">\n    <group name="all"/>'
    rows = audit_with(
        tmp_path,
        ('<group name="hand">', loop),
        ("</robot>", '<group name="none"/></robot>'),
    )
    assert {"planning.circular_group", "planning.empty_group"} <= {row["code"] for row in rows}


def test_a_chain_whose_base_does_not_carry_its_tip_is_a_finding(tmp_path: Path) -> None:
    ends = 'base_link="base" tip_link="tcp"'
    row = only_finding(
        audit_with(tmp_path, (ends, 'base_link="tcp" tip_link="base"'))[:1], "planning.chain"
    )
    assert row["settle"] == "exchange base_link and tip_link"
    row = only_finding(
        audit_with(tmp_path, (ends, 'base_link="finger" tip_link="tcp"'))[:1], "planning.chain"
    )
    assert "does not carry" in row["title"]
    row = only_finding(
        audit_with(tmp_path, (ends, 'base_link="tcp" tip_link="tcp"'))[:1], "planning.chain"
    )
    assert row["severity"] == "critical"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('parent_group="arm"', 'parent_group="hand"', "is its parent_group too"),
        ('parent_link="tcp"', 'parent_link="finger"', "does not contain its parent_link"),
        (
            'parent_link="tcp" group="hand" parent_group="arm"',
            'parent_link="finger" group="hand"',
            "belongs to its own group",
        ),
    ],
)
def test_an_end_effector_with_a_wrong_parent_is_a_finding(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    assert (
        words
        in only_finding(audit_with(tmp_path, (old, new)), "planning.end_effector_parent")["title"]
    )


def test_a_virtual_joint_with_wrong_type_or_frames_is_a_finding(tmp_path: Path) -> None:
    rows = audit_with(
        tmp_path,
        (
            'type="fixed" parent_frame="map" child_link="world"',
            'type="welded" parent_frame="tcp" child_link="upper"',
        ),
    )
    assert {row["code"]: row["expected"] for row in rows} == {
        "planning.virtual_joint_type": "fixed, floating, planar",
        "planning.virtual_joint_child": "'world'",
        "planning.virtual_joint_parent": "a frame outside the robot, such as 'world'",
    }


def test_a_passive_joint_with_a_motor_or_fixed_is_a_finding(tmp_path: Path) -> None:
    drive = (
        '<ros2_control name="s" type="system"><joint name="elbow">'
        '<command_interface name="position"/></joint></ros2_control></robot>'
    )
    passive = '<passive_joint name="elbow"/><passive_joint name="mount"/></robot>'
    rows = audit_with(tmp_path, ("</robot>", passive), urdf=CLEAN.replace("</robot>", drive))
    assert {row["value"]: row["expected"] for row in rows} == {
        "elbow": "a joint without a motor",
        "mount": "a joint that moves",
    }


def test_disabled_pairs_without_effect_are_only_info(tmp_path: Path) -> None:
    rows = audit_with(
        tmp_path,
        (
            "</robot>",
            '<disable_collisions link1="upper" link2="base"/>'
            '<disable_collisions link1="tcp" link2="base"/>'
            '<disable_collisions link1="base" link2="base"/></robot>',
        ),
    )
    assert {row["code"] for row in rows} == {
        "planning.pair_twice",
        "planning.pair_without_shape",
        "planning.pair_of_one",
    }
    assert {row["severity"] for row in rows} == {"info"}


def urdf_with_overlap(*_: object) -> str:
    """The robot with a finger that overlaps the lower arm in every pose."""
    return changed(('<origin xyz="0.23 0 0"/>', '<origin xyz="0.18 0 0"/>'))


def test_a_pair_that_always_collides_must_be_disabled(tmp_path: Path) -> None:
    pair = '  <disable_collisions link1="lower" link2="finger" reason="Adjacent"/>\n'
    rows = audit_with(tmp_path, (pair, ""), urdf=urdf_with_overlap())
    row = only_finding(rows, "planning.always_collides")
    assert row["expected"] == pair.strip().replace("lower", "finger", 1).replace(
        'link2="finger"', 'link2="lower"'
    )
    assert row["value"] < -0.01
    assert audit_with(tmp_path, urdf=urdf_with_overlap()) == []


def test_a_pair_disabled_as_never_colliding_that_collides_is_a_finding(tmp_path: Path) -> None:
    rows = audit_with(
        tmp_path,
        (
            'link1="lower" link2="finger" reason="Adjacent"',
            'link1="lower" link2="finger" reason="Never"',
        ),
        urdf=urdf_with_overlap(),
    )
    row = only_finding(rows, "planning.never_is_wrong")
    assert "'Never'" in row["title"]
    assert "overlap at grip 0 m" in row["title"]
    assert row["line"] == line_of(SRDF, 'link2="finger"')


def test_a_group_state_in_collision_is_a_finding(tmp_path: Path) -> None:
    # The upper arm collides with the post when the shoulder is at -1.2 rad.
    post = (
        '<link name="post"><collision><geometry><box size="0.05 0.05 0.05"/></geometry></collision>'
        '</link><joint name="post_mount" type="fixed"><origin xyz="0.1 0 0.4"/>'
        '<parent link="base"/><child link="post"/></joint></robot>'
    )
    urdf = CLEAN.replace("</robot>", post)
    assert audit_with(tmp_path, urdf=urdf) == []
    rows = audit_with(tmp_path, ('value="-0.5"', 'value="-1.2"'), urdf=urdf)
    assert {(row["code"], row["element"]) for row in rows} == {
        ("planning.state_collides", "group_state 'ready'")
    }
    assert any("'post' and 'upper'" in row["title"] for row in rows)


def test_a_misspelt_element_is_reported_with_the_right_spelling(tmp_path: Path) -> None:
    extra = (
        '<disable_collision link1="base" link2="lower"/><gripper name="g"/>'
        '<end_effector name="e" parent_link="tcp" group="hand" parentgroup="arm"/></robot>'
    )
    rows = [
        row
        for row in audit_with(tmp_path, ("</robot>", extra))
        if row["code"] == "planning.custom_tag"
    ]
    assert [(row["severity"], row["expected"]) for row in rows] == [
        ("warning", "disable_collisions"),
        ("warning", "parent_group"),
        ("info", None),
    ]


def test_rotor_inertia_in_an_srdf_is_a_warning(tmp_path: Path) -> None:
    rotors = '<rotor_params><joint name="elbow" mass="1e-5" gear_ratio="100"/></rotor_params>'
    rows = audit_with(tmp_path, ("</robot>", rotors + "</robot>"))
    row = only_finding(rows, "planning.rotor_inertia")
    assert row["severity"] == "warning"
    assert "gear_ratio=100" in row["value"]


def test_duplicate_and_missing_group_names_are_findings(tmp_path: Path) -> None:
    rows = audit_with(
        tmp_path,
        (
            "</robot>",
            '<group name="arm"><link name="tcp"/></group><group><link name="tcp"/></group></robot>',
        ),
    )
    assert {row["code"] for row in rows} == {"planning.same_name", "planning.missing_attribute"}


def test_the_audit_knows_every_srdf_element_of_the_table() -> None:
    first = ENTRIES.index(next(entry for entry in ENTRIES if entry.path == "group"))
    tops = {entry.path.partition("/")[0] for entry in ENTRIES[first:]}
    assert tops == set(ELEMENTS)


def test_pinocchios_free_flyer_joint_is_a_warning_unless_declared(tmp_path: Path) -> None:
    named = ('<joint name="grip"/>', '<joint name="grip"/><joint name="root_joint"/>')
    row = only_finding(audit_with(tmp_path, named), "planning.unknown_joint")
    assert row["severity"] == "warning"
    assert '<virtual_joint name="root_joint" type="floating"' in row["settle"]
    declared = ('name="fix" type="fixed"', 'name="root_joint" type="floating"')
    assert audit_with(tmp_path, named, declared) == []


# -- search for the URDF of an SRDF


def test_the_urdf_of_an_srdf_is_found_in_the_usual_folders(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for place in ("a_moveit_config/config", "a_description/srdf", "a_description/urdf"):
        (tmp_path / place).mkdir(parents=True)
    urdf = write_clean(tmp_path / "a_description/urdf", name="a.urdf")
    other = CLEAN.replace('name="clean"', 'name="other"')
    write_clean(tmp_path / "a_description/urdf", other, "b.urdf")
    for place in ("a_moveit_config/config/clean.srdf", "a_description/srdf/any.srdf"):
        srdf = tmp_path / place
        srdf.write_text(SRDF)
        assert main(["audit", str(srdf), "--out", str(tmp_path)]) == 0
        said = capsys.readouterr().out
        assert f"URDF: {urdf}" in said
        assert "3 groups, 2 states, 1 end effector, 4 disabled pairs" in said
        page = (tmp_path / f"{srdf.name}.audit.html").read_text()
        assert str(urdf) in page
        report = json.loads((tmp_path / f"{srdf.name}.audit.json").read_text())
        assert report["kind"] == "srdf"
        assert set(report["layers"]) == {"planning"}
    assert [path.name for path in srdfs_of(urdf, "clean")] == ["any.srdf", "clean.srdf"]


def test_the_audit_of_a_urdf_mentions_the_srdf_beside_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    urdf = write_clean(tmp_path)
    (tmp_path / "robot.srdf").write_text(SRDF)
    assert main(["audit", str(urdf), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert f"SRDF beside it, not audited here: pytest-twin audit {tmp_path}/robot.srdf" in said


def test_a_missing_urdf_is_reported_with_the_searched_folders(tmp_path: Path) -> None:
    path = tmp_path / "robot.srdf"
    path.write_text(SRDF)
    with pytest.raises(
        TwinError, match=rf"no URDF of the robot 'clean' in {tmp_path}.*--urdf FILE"
    ):
        audit_srdf(str(path))


def test_several_matching_urdfs_require_a_choice(tmp_path: Path) -> None:
    for name in ("a.urdf", "b.urdf"):
        write_clean(tmp_path, name=name)
    path = tmp_path / "robot.srdf"
    path.write_text(SRDF)
    with pytest.raises(TwinError, match=r"2 URDFs of the robot 'clean' .*a\.urdf, .*--urdf FILE"):
        audit_srdf(str(path))


def test_a_urdf_given_as_srdf_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "robot.srdf"
    path.write_text(CLEAN)
    with pytest.raises(TwinError, match=r"robot\.srdf:2: .*a URDF, not an SRDF"):
        audit_srdf(str(path), str(path))


def test_a_different_robot_name_is_a_warning(tmp_path: Path) -> None:
    row = only_finding(
        audit_with(tmp_path, ('<robot name="clean">', '<robot name="x">')), "planning.robot_name"
    )
    assert row["expected"] == "clean"


def test_the_srdf_of_panda_has_no_finding() -> None:
    found = audit_srdf(str(robots() / "panda_description/srdf/panda.srdf"))
    assert found["findings"] == []
    assert found["facts"]["disabled_pairs"] == 35


def test_an_srdf_with_20000_wrong_pairs_is_audited_within_5_seconds(tmp_path: Path) -> None:
    pairs = "".join(
        f'<disable_collisions link1="left_link_{k}" link2="right_link_{k}"/>\n'
        for k in range(20_000)
    )
    text = SRDF.replace("</robot>", pairs + "</robot>")
    path = tmp_path / "robot.srdf"
    path.write_text(text)
    root = urdf.document(path)
    start = time.process_time()
    found = check(Srdf(root, read(write_clean(tmp_path))))
    assert len(found) == 40_000
    assert time.process_time() - start < 5.0


def test_the_number_of_groups_is_limited(tmp_path: Path) -> None:
    names = [f"g{k}" for k in range(3000)]
    chain = "".join(f'<group name="{a}"><group name="{b}"/></group>' for a, b in pairwise(names))
    path = tmp_path / "robot.srdf"
    path.write_text(SRDF.replace("</robot>", chain + "</robot>"))
    with pytest.raises(TwinError, match=r"robot.srdf:2: .*too many groups .*at most 2000"):
        audit_srdf(str(path), str(write_clean(tmp_path)))
