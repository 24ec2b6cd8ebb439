"""Each inserted fault is found at its line, and the robot without faults has none."""

from __future__ import annotations

from pathlib import Path

import pytest
from audited import CLEAN, box_stl, changed, findings_of, line_of, only, write_clean


def test_a_robot_without_faults_has_only_unknown_properties(tmp_path: Path) -> None:
    rows = findings_of(write_clean(tmp_path))
    bad = [row for row in rows if row["severity"] in ("critical", "warning")]
    assert bad == []
    # A URDF does not state the meaning of commands or the force model of a mimic.
    unknown = {row["code"] for row in rows if row["severity"] == "unknown"}
    assert unknown >= {
        "commands.unknown",
        "coupling.mimic_force",
        "joints.sign_unknown",
        "joints.zero_unknown",
        "controllers.unknown",
        "transmissions.unknown",
    }
    assert all(row["settle"] for row in rows if row["severity"] == "unknown")


def test_massless_frames_are_not_a_fault(tmp_path: Path) -> None:
    rows = findings_of(write_clean(tmp_path))
    assert not [row for row in rows if "tcp" in row["element"] or "world" in row["element"]]


ELBOW_LIMIT = '<limit lower="-2" upper="2" velocity="2" effort="20"/>'
UPPER_INERTIA = '<inertia ixx="0.0012" iyy="0.0156" izz="0.0156" ixy="0" ixz="0" iyz="0"/>'
UPPER_INERTIAL = f"""    <inertial>
      <origin xyz="0.15 0 0"/>
      <mass value="2"/>
      {UPPER_INERTIA}
    </inertial>
"""
THUMB_MIMIC = '<mimic joint="grip" multiplier="1"/>'

# name, replacements, code, severity, element, text on the line that the finding names
FAULTS = [
    (
        "two links with one name",
        [('<link name="finger">', '<link name="lower">')],
        "tree.duplicate_name",
        "critical",
        "link 'lower'",
        None,
    ),
    (
        "two joints with one name",
        [('<joint name="elbow"', '<joint name="shoulder"')],
        "tree.duplicate_name",
        "critical",
        "joint 'shoulder'",
        None,
    ),
    (
        "names that differ by case",
        [('<link name="tcp"/>', '<link name="tcp"/><link name="TCP"/>')],
        "tree.alike_names",
        "warning",
        "link 'TCP'",
        '<link name="TCP"/>',
    ),
    (
        "an unconnected link",
        [('<link name="tcp"/>', '<link name="tcp"/>\n  <link name="stray"/>')],
        "tree.disconnected",
        "critical",
        "link 'stray'",
        '<link name="stray"/>',
    ),
    (
        "a joint to a missing link",
        [('<child link="finger"/>', '<child link="fingre"/>')],
        "tree.missing_link",
        "critical",
        "joint 'grip'",
        '<joint name="grip"',
    ),
    (
        "a closed chain",
        [
            (
                '  <link name="tcp"/>',
                '  <joint name="closure" type="fixed">\n    <parent link="base"/>'
                '<child link="finger"/></joint>\n  <link name="tcp"/>',
            )
        ],
        "tree.two_parents",
        "critical",
        "joint 'closure'",
        '<joint name="closure"',
    ),
    (
        "a cycle of links",
        [
            (
                '<parent link="base"/>\n    <child link="upper"/>',
                '<parent link="thumb"/>\n    <child link="upper"/>',
            )
        ],
        "tree.loop",
        "critical",
        "link 'upper'",
        '<link name="upper">',
    ),
    (
        "an axis of length 2",
        [('<axis xyz="0 0 1"/>', '<axis xyz="0 0 2"/>')],
        "joints.axis_not_unit",
        "critical",
        "joint 'elbow'",
        '<joint name="elbow"',
    ),
    (
        "a zero axis",
        [('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>')],
        "joints.unreadable",
        "critical",
        "joint 'elbow'",
        '<axis xyz="0 0 0"/>',
    ),
    (
        "no axis",
        [('    <axis xyz="0 0 1"/>\n', "")],
        "joints.axis_left_out",
        "warning",
        "joint 'elbow'",
        '<joint name="elbow"',
    ),
    (
        "a range in degrees",
        [(ELBOW_LIMIT, '<limit lower="-120" upper="120" velocity="2" effort="20"/>')],
        "joints.range_degrees",
        "critical",
        "joint 'elbow'",
        '<joint name="elbow"',
    ),
    (
        "a roll in degrees",
        [('<origin xyz="0.32 0 0" rpy="0 0 0"/>', '<origin xyz="0.32 0 0" rpy="90 0 0"/>')],
        "joints.origin_degrees",
        "critical",
        "joint 'elbow'",
        '<joint name="elbow"',
    ),
    (
        "a right angle rounded to two digits",
        [('<origin xyz="0.32 0 0" rpy="0 0 0"/>', '<origin xyz="0.32 0 0" rpy="1.57 0 0"/>')],
        "joints.origin_rounded",
        "info",
        "joint 'elbow'",
        '<joint name="elbow"',
    ),
    (
        "a speed in degrees per second",
        [(ELBOW_LIMIT, '<limit lower="-2" upper="2" velocity="180" effort="20"/>')],
        "joints.velocity_units",
        "warning",
        "joint 'elbow'",
        '<joint name="elbow"',
    ),
    (
        "lower limit above upper limit",
        [(ELBOW_LIMIT, '<limit lower="2" upper="-2" velocity="2" effort="20"/>')],
        "joints.unreadable",
        "critical",
        "joint 'elbow'",
        '<limit lower="2"',
    ),
    (
        "an empty range",
        [(ELBOW_LIMIT, '<limit lower="0" upper="0" velocity="2" effort="20"/>')],
        "joints.empty_range",
        "warning",
        "joint 'elbow'",
        '<joint name="elbow"',
    ),
    (
        "no range",
        [(ELBOW_LIMIT, '<limit velocity="2" effort="20"/>')],
        "joints.no_range",
        "warning",
        "joint 'elbow'",
        '<joint name="elbow"',
    ),
    (
        "friction above the effort limit",
        [(ELBOW_LIMIT, '<limit lower="-2" upper="2" velocity="2" effort="0.1"/>')],
        "joints.friction_above_effort",
        "warning",
        "joint 'elbow'",
        '<joint name="elbow"',
    ),
    (
        "no effort",
        [(ELBOW_LIMIT, '<limit lower="-2" upper="2" velocity="2"/>')],
        "joints.no_effort",
        "warning",
        "joint 'elbow'",
        '<joint name="elbow"',
    ),
    (
        "a limit that is not a number",
        [('<limit lower="-1.5"', '<limit lower="nan"')],
        "joints.unreadable",
        "critical",
        "joint 'shoulder'",
        '<limit lower="nan"',
    ),
    (
        "an origin in millimetres",
        [('<origin xyz="0.32 0 0" rpy="0 0 0"/>', '<origin xyz="320 0 0" rpy="0 0 0"/>')],
        "joints.origin_far",
        "critical",
        "joint 'elbow'",
        '<joint name="elbow"',
    ),
    (
        "no friction",
        [('effort="20"/>\n    <dynamics damping="0.1" friction="0.2"/>', 'effort="20"/>')],
        "joints.friction_unknown",
        "unknown",
        "joint 'elbow'",
        '<joint name="elbow"',
    ),
    (
        "a mimic of a missing joint",
        [(THUMB_MIMIC, '<mimic joint="gripp" multiplier="1"/>')],
        "coupling.mimic_master",
        "critical",
        "joint 'thumb_slide'",
        '<mimic joint="gripp"',
    ),
    (
        "a mimic of a fixed joint",
        [(THUMB_MIMIC, '<mimic joint="tcp_mount" multiplier="1"/>')],
        "coupling.mimic_master",
        "warning",
        "joint 'thumb_slide'",
        '<mimic joint="tcp_mount"',
    ),
    (
        "a mimic of itself",
        [(THUMB_MIMIC, '<mimic joint="thumb_slide" multiplier="1"/>')],
        "coupling.mimic_loop",
        "critical",
        "joint 'thumb_slide'",
        '<mimic joint="thumb_slide"',
    ),
    (
        "joints that mimic each other",
        [
            (
                'effort="10"/>\n    <dynamics damping="1" friction="0.5"/>\n  </joint>',
                'effort="10"/>\n    <mimic joint="thumb_slide"/>\n  </joint>',
            )
        ],
        "coupling.mimic_loop",
        "critical",
        "joint 'grip'",
        '<mimic joint="thumb_slide"',
    ),
    (
        "a mimic that exceeds its range",
        [(THUMB_MIMIC, '<mimic joint="grip" multiplier="3"/>')],
        "coupling.mimic_range",
        "warning",
        "joint 'thumb_slide'",
        '<mimic joint="grip" multiplier="3"/>',
    ),
    (
        "a mimic with multiplier zero",
        [(THUMB_MIMIC, '<mimic joint="grip" multiplier="0"/>')],
        "coupling.mimic_zero",
        "warning",
        "joint 'thumb_slide'",
        '<mimic joint="grip" multiplier="0"/>',
    ),
    (
        "an impossible inertia",
        [(UPPER_INERTIA, '<inertia ixx="1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>')],
        "inertia.triangle",
        "critical",
        "link 'upper'",
        "<inertial>",
    ),
    (
        "a negative moment",
        [
            (
                UPPER_INERTIA,
                '<inertia ixx="0.0012" iyy="0.0156" izz="0.0156" ixy="0.03" ixz="0" iyz="0"/>',
            )
        ],
        "inertia.negative_moment",
        "critical",
        "link 'upper'",
        "<inertial>",
    ),
    (
        "a zero moment",
        [(UPPER_INERTIA, '<inertia ixx="0" iyy="0.0156" izz="0.0156" ixy="0" ixz="0" iyz="0"/>')],
        "inertia.zero_moment",
        "critical",
        "link 'upper'",
        "<inertial>",
    ),
    (
        "a negative mass",
        [('<mass value="2"/>', '<mass value="-2"/>')],
        "inertia.unreadable",
        "critical",
        "link 'upper'",
        '<mass value="-2"/>',
    ),
    (
        "a moving body without inertia",
        [(UPPER_INERTIAL, "")],
        "inertia.moving_without",
        "critical",
        "link 'upper'",
        '<link name="upper">',
    ),
    (
        "a centre of mass in millimetres",
        [('<origin xyz="0.15 0 0"/>\n      <mass', '<origin xyz="150 0 0"/>\n      <mass')],
        "inertia.com_outside",
        "critical",
        "link 'upper'",
        "<inertial>",
    ),
    (
        "an inertia about the link's origin",
        # The parallel axis term m c^2 = 2 kg * (0.15 m)^2 is added.
        [
            (
                UPPER_INERTIA,
                '<inertia ixx="0.0012" iyy="0.0606" izz="0.0606" ixy="0" ixz="0" iyz="0"/>',
            )
        ],
        "inertia.wrong_origin",
        "warning",
        "link 'upper'",
        "<inertial>",
    ),
    (
        "an inertia in kg*mm^2",
        [(UPPER_INERTIA, '<inertia ixx="1200" iyy="15600" izz="15600" ixy="0" ixz="0" iyz="0"/>')],
        "inertia.too_large",
        "critical",
        "link 'upper'",
        "<inertial>",
    ),
    (
        "an inertia of a much smaller body",
        [
            (
                UPPER_INERTIA,
                '<inertia ixx="1.2e-6" iyy="1.5e-5" izz="1.5e-5" ixy="0" ixz="0" iyz="0"/>',
            )
        ],
        "inertia.too_small",
        "warning",
        "link 'upper'",
        "<inertial>",
    ),
    (
        "a default inertia",
        [
            ('<mass value="2"/>', '<mass value="1"/>'),
            (UPPER_INERTIA, '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'),
        ],
        "inertia.default",
        "warning",
        "link 'upper'",
        "<inertial>",
    ),
    (
        "grams taken for kilograms",
        [('<mass value="2"/>', '<mass value="2000"/>')],
        "inertia.density",
        "warning",
        "link 'upper'",
        "<inertial>",
    ),
    (
        "a copied inertia",
        [
            ('<mass value="1.3"/>', '<mass value="2"/>'),
            (
                '<inertia ixx="0.00052" iyy="0.0046" izz="0.0046" ixy="0" ixz="0" iyz="0"/>',
                UPPER_INERTIA,
            ),
            ('<origin xyz="0.1 0 0"/>\n      <mass', '<origin xyz="0.15 0 0"/>\n      <mass'),
        ],
        "inertia.copied",
        "warning",
        "link 'lower'",
        None,
    ),
    (
        "an inertia in other axes",
        # Rotated by a right angle about y: the bar is then long along z.
        [(UPPER_INERTIA, '<inertia ixx="0.0156" iyy="0.0156" izz="0.0012"/>')],
        "inertia.spread",
        "warning",
        "link 'upper'",
        "<inertial>",
    ),
    (
        "an inertial frame in degrees",
        [
            (
                '<origin xyz="0.15 0 0"/>\n      <mass',
                '<origin xyz="0.15 0 0" rpy="0 90 0"/>\n      <mass',
            )
        ],
        "joints.origin_degrees",
        "critical",
        "inertial of link 'upper'",
        'rpy="0 90 0"',
    ),
    (
        "a small angle in degrees",
        [
            (
                '<collision>\n      <origin xyz="0.02 0 0"/>\n'
                '      <geometry><box size="0.04 0.015 0.015"/>',
                '<collision>\n      <origin xyz="0.02 0 0" rpy="0 5 0"/>\n'
                '      <geometry><box size="0.04 0.015 0.015"/>',
            )
        ],
        "joints.origin_degrees",
        "warning",
        "collision of link 'finger'",
        'rpy="0 5 0"',
    ),
    (
        "a centre of mass left at the origin",
        [('<origin xyz="0.15 0 0"/>\n      <mass', '<origin xyz="0 0 0"/>\n      <mass')],
        "inertia.com_at_origin",
        "warning",
        "link 'upper'",
        "<inertial>",
    ),
    (
        "a link whose mass is that of the part fixed to it",
        [
            (UPPER_INERTIAL, ""),
            (
                "</robot>",
                f'  <link name="rotor">\n{UPPER_INERTIAL}  </link>\n'
                '  <joint name="rotor_mount" type="fixed">'
                '<parent link="upper"/><child link="rotor"/></joint>\n</robot>',
            ),
        ],
        "inertia.shape_without_mass",
        "warning",
        "link 'upper'",
        '<link name="upper">',
    ),
    (
        "a small range in degrees",
        [(ELBOW_LIMIT, '<limit lower="-10" upper="12" velocity="2" effort="20"/>')],
        "joints.range_degrees",
        "warning",
        "joint 'elbow'",
        None,
    ),
    (
        "a small speed in degrees per second",
        [(ELBOW_LIMIT, '<limit lower="-2" upper="2" velocity="60" effort="20"/>')],
        "joints.velocity_units",
        "warning",
        "joint 'elbow'",
        None,
    ),
    (
        "the range of a revolute joint at a prismatic one",
        [
            (
                '<limit lower="0" upper="0.02" velocity="0.1" effort="10"/>\n    '
                '<dynamics damping="1" friction="0.5"/>\n  </joint>\n  <link name="thumb">',
                '<limit lower="-1.57" upper="1.57" velocity="0.1" effort="10"/>\n    '
                '<dynamics damping="1" friction="0.5"/>\n  </joint>\n  <link name="thumb">',
            )
        ],
        "joints.range_millimetres",
        "warning",
        "joint 'grip'",
        None,
    ),
    (
        "an effort in N*mm",
        [(ELBOW_LIMIT, '<limit lower="-2" upper="2" velocity="2" effort="20000"/>')],
        "joints.effort_units",
        "warning",
        "joint 'elbow'",
        None,
    ),
    (
        "an effort in kN*m",
        [('velocity="2" effort="50"', 'velocity="2" effort="0.05"')],
        "joints.effort_too_small",
        "warning",
        "joint 'shoulder'",
        None,
    ),
    (
        "a damping in another unit",
        [
            (
                'effort="50"/>\n    <dynamics damping="0.1" friction="0.2"/>',
                'effort="50"/>\n    <dynamics damping="100" friction="0.2"/>',
            )
        ],
        "joints.damping_above_effort",
        "warning",
        "joint 'shoulder'",
        None,
    ),
    (
        "an origin in centimetres",
        [('<origin xyz="0.32 0 0" rpy="0 0 0"/>', '<origin xyz="32 0 0" rpy="0 0 0"/>')],
        "frames.gap",
        "warning",
        "link 'lower'",
        None,
    ),
    (
        "a collision shape in inches",
        [
            (
                '<collision><origin xyz="0.15 0 0"/><geometry><box size="0.3 0.06 0.06"/>',
                '<collision><origin xyz="0.15 0 0"/><geometry><box size="7.62 1.52 1.52"/>',
            )
        ],
        "meshes.roles_differ",
        "warning",
        "link 'upper'",
        '<link name="upper">',
    ),
    (
        "a collision shape beside the visual one",
        [
            (
                '<collision><origin xyz="0.15 0 0"/><geometry><box size="0.3 0.06 0.06"/>',
                '<collision><origin xyz="0.15 0.1 0"/><geometry><box size="0.3 0.06 0.06"/>',
            )
        ],
        "meshes.roles_differ",
        "warning",
        "link 'upper'",
        '<link name="upper">',
    ),
    (
        "a missing collision mesh",
        [('filename="bar.stl"', 'filename="bra.stl"')],
        "meshes.missing",
        "critical",
        "collision of link 'lower'",
        'filename="bra.stl"',
    ),
    (
        "a missing visual mesh",
        [
            (
                '<visual><origin xyz="0.15 0 0"/><geometry><box size="0.3 0.06 0.06"/>',
                '<visual><origin xyz="0.15 0 0"/><geometry><mesh filename="seen.dae"/>',
            )
        ],
        "meshes.missing",
        "warning",
        "visual of link 'upper'",
        'filename="seen.dae"',
    ),
    (
        "a mesh outside the roots",
        [('filename="bar.stl"', 'filename="../../../../etc/passwd"')],
        "meshes.escapes",
        "critical",
        "collision of link 'lower'",
        "etc/passwd",
    ),
    (
        "a mesh scaled twice",
        [('filename="bar.stl"', 'filename="bar.stl" scale="0.001 0.001 0.001"')],
        "meshes.units",
        "critical",
        "collision of link 'lower'",
        'scale="0.001',
    ),
    (
        "a mesh in millimetres",
        [('filename="bar.stl"', 'filename="bar.stl" scale="1000 1000 1000"')],
        "meshes.units",
        "critical",
        "collision of link 'lower'",
        'scale="1000',
    ),
    (
        "a box of negative size",
        [('<box size="0.04 0.015 0.015"/>', '<box size="0.04 -0.015 0.015"/>')],
        "meshes.no_size",
        "critical",
        "collision of link 'finger'",
        "-0.015",
    ),
    (
        "two shapes in one geometry",
        [('<box size="0.04 0.015 0.015"/>', '<box size="1 1 1"/><sphere radius="1"/>')],
        "meshes.unreadable",
        "critical",
        "collision of link 'finger'",
        None,
    ),
    (
        "a transmission of a missing joint",
        [
            (
                "</robot>",
                '  <transmission name="t"><type>x</type>\n    <joint name="elbw"/>'
                '<actuator name="m"><mechanicalReduction>50</mechanicalReduction></actuator>\n'
                "  </transmission>\n</robot>",
            )
        ],
        "transmissions.missing_joint",
        "critical",
        "transmission 't'",
        '<transmission name="t">',
    ),
    (
        "a gear ratio of zero",
        [
            (
                "</robot>",
                '  <transmission name="t"><type>x</type>\n    <joint name="elbow"/>'
                '<actuator name="m"><mechanicalReduction>0</mechanicalReduction></actuator>\n'
                "  </transmission>\n</robot>",
            )
        ],
        "transmissions.zero_reduction",
        "critical",
        "transmission 't'",
        '<transmission name="t">',
    ),
    (
        "a differential transmission",
        [
            (
                "</robot>",
                '  <transmission name="d">'
                "<type>transmission_interface/DifferentialTransmission</type>"
                '<joint name="elbow"/><joint name="shoulder"/><actuator name="m"/>'
                "</transmission>\n</robot>",
            )
        ],
        "coupling.differential",
        "unknown",
        "transmission 'd'",
        '<transmission name="d">',
    ),
    (
        "a controller of a missing joint",
        [
            (
                "</robot>",
                '  <ros2_control name="c" type="system">\n    <joint name="elbw">'
                '<command_interface name="position"/></joint>\n  </ros2_control>\n</robot>',
            )
        ],
        "controllers.missing_joint",
        "critical",
        "joint 'elbw'",
        '<joint name="elbw">',
    ),
    (
        "soft limits outside the hard limits",
        [
            (
                ELBOW_LIMIT,
                ELBOW_LIMIT
                + '\n    <safety_controller soft_lower_limit="-3" soft_upper_limit="1"/>',
            )
        ],
        "controllers.soft_limits",
        "warning",
        "joint 'elbow'",
        "<safety_controller",
    ),
    (
        "a sensor on a missing link",
        [
            (
                "</robot>",
                '  <gazebo reference="wirst"><sensor name="imu" type="imu"/></gazebo>\n</robot>',
            )
        ],
        "controllers.sensor_bearer",
        "critical",
        "sensor 'imu'",
        "<sensor",
    ),
    (
        "a frame without a name",
        [('<link name="tcp"/>', '<link name="tcp"/><link/>')],
        "tree.unreadable",
        "critical",
        "link",
        "<link/>",
    ),
]


@pytest.mark.parametrize(
    ("pairs", "code", "severity", "element", "line"),
    [fault[1:] for fault in FAULTS],
    ids=[fault[0].replace(" ", "_") for fault in FAULTS],
)
def test_each_fault_is_found_with_severity_element_and_line(
    tmp_path: Path,
    pairs: list[tuple[str, str]],
    code: str,
    severity: str,
    element: str,
    line: str | None,
) -> None:
    text = changed(*pairs)
    path = write_clean(tmp_path, text)
    rows = findings_of(path)
    found = only(rows, code)
    assert found, sorted({row["code"] for row in rows})
    row = found[0]
    assert row["severity"] == severity
    assert row["element"] == element
    assert row["file"] == str(path)
    if line is not None:
        assert row["line"] == line_of(text, line)
    assert row["why"]
    assert row["settle"]
    # The robot without faults does not have this finding.
    assert not only(findings_of(write_clean(tmp_path)), code) or code == "coupling.mimic_force"


def test_a_mesh_in_millimetres_is_a_critical_finding(tmp_path: Path) -> None:
    path = write_clean(tmp_path)
    (tmp_path / "bar.stl").write_bytes(box_stl((200.0, 50.0, 50.0)))
    found = only(findings_of(path), "meshes.units")
    assert [row["severity"] for row in found] == ["critical"]
    assert found[0]["value"] == pytest.approx(212.13, rel=1e-3)
    assert "millimetres taken for metres" in found[0]["title"]


def test_an_open_mesh_is_a_finding_with_its_name(tmp_path: Path) -> None:
    path = write_clean(tmp_path)
    (tmp_path / "bar.stl").write_bytes(box_stl((0.2, 0.05, 0.05), leave_out=2))
    assert [row["element"] for row in only(findings_of(path), "meshes.open")] == ["mesh 'bar.stl'"]


def test_the_ids_of_findings_are_unique(tmp_path: Path) -> None:
    rows = findings_of(write_clean(tmp_path, CLEAN.replace("friction=", "frictoin=")))
    ids = [row["id"] for row in rows]
    assert len(set(ids)) == len(ids)
