"""What only a simulation model states: gravity, drives, springs, keyframes; each fault is found."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from audited import findings_of

ARM = """<mujoco model="arm">
<compiler angle="radian" autolimits="true"/>
<option gravity="0 0 -9.81" timestep="0.002"/>
<default><joint damping="0.5" frictionloss="0.2" armature="0.05"/></default>
<worldbody>
  <body name="base">
    <inertial mass="4" pos="0 0 .05" diaginertia=".018 .018 .027"/>
    <geom type="box" size=".1 .1 .05" pos="0 0 .05"/>
    <body name="upper" pos="0 0 .15">
      <joint name="shoulder" axis="0 1 0" range="-1.5 1.5"/>
      <inertial mass="2" pos=".15 0 0" diaginertia=".0012 .0156 .0156"/>
      <geom type="box" size=".15 .03 .03" pos=".15 0 0"/>
      <body name="lower" pos=".32 0 0">
        <joint name="elbow" axis="0 1 0" range="-2 2"/>
        <inertial mass="1.3" pos=".1 0 0" diaginertia=".00052 .0046 .0046"/>
        <geom type="box" size=".1 .025 .025" pos=".1 0 0"/>
        <site name="tcp" pos=".2 0 0"/>
      </body>
    </body>
  </body>
</worldbody>
<actuator>
  <position name="s" joint="shoulder" kp="200" kv="10" ctrlrange="-1.5 1.5" forcerange="-50 50"/>
  <motor name="e" joint="elbow" gear="20" ctrlrange="-1 1"/>
</actuator>
<keyframe><key name="home" qpos="0.3 -0.5"/></keyframe>
</mujoco>"""


def faults(folder: Path, *edits: tuple[str, str]) -> dict[str, dict[str, Any]]:
    """Code -> the last critical finding or warning of the arm with these edits."""
    text = ARM
    for old, new in edits:
        assert old in text, old
        text = text.replace(old, new, 1)
    path = folder / "arm.xml"
    path.write_text(text)
    rows = findings_of(path)
    return {row["code"]: row for row in rows if row["severity"] in ("critical", "warning")}


def test_the_arm_without_faults_has_none(tmp_path: Path) -> None:
    assert faults(tmp_path) == {}


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        pytest.param("-9.81", "9.81", "frames.gravity", id="gravity upwards"),
        pytest.param("0 0 -9.81", "0 -9.81 0", "frames.gravity", id="gravity along y"),
        pytest.param("0 0 -9.81", "0 0 -9810", "frames.gravity", id="gravity in mm"),
        pytest.param("0 0 -9.81", "0 0 0", "frames.gravity", id="no gravity"),
        pytest.param(
            "<option ",
            '<option><flag gravity="disable"/></option><option ',
            "frames.gravity",
            id="gravity disabled",
        ),
        pytest.param(
            "<option ",
            '<option><flag contact="disable"/></option><option ',
            "meshes.masked",
            id="contact disabled",
        ),
        pytest.param('"0.002"', '"0.1"', "controllers.time_step", id="large step"),
        pytest.param(
            'ctrlrange="-1.5 1.5"', 'ctrlrange="-90 90"', "commands.range", id="commands in degrees"
        ),
        pytest.param(
            'ctrlrange="-1.5 1.5"', 'ctrlrange="3 4"', "commands.range", id="commands elsewhere"
        ),
        pytest.param(
            'joint="shoulder"', 'joint="shoulder" gear="100"', "commands.range", id="servo's gear"
        ),
        pytest.param('kp="200"', 'kp="-200"', "commands.unstable", id="stiffness reversed"),
        pytest.param('"-50 50"', '"-.05 .05"', "joints.effort_too_small", id="force in kN*m"),
        pytest.param('"-50 50"', '"-50000 50000"', "joints.effort_units", id="force in N*mm"),
        pytest.param('gear="20"', 'gear="20000"', "joints.effort_units", id="motor's gear"),
        pytest.param('gear="20"', 'gear="0.02"', "joints.effort_too_small", id="inverse gear"),
        pytest.param('armature="0.05"', 'armature="50"', "joints.armature_units", id="armature"),
        pytest.param(
            'frictionloss="0.2"', 'frictionloss="60"', "joints.friction_above_effort", id="friction"
        ),
        pytest.param('damping="0.5"', 'damping="1e4"', "joints.damping_above_effort", id="damping"),
        pytest.param(
            'name="shoulder" axis',
            'name="shoulder" stiffness="10" springref="90" axis',
            "joints.spring_above_effort",
            id="spring reference in degrees",
        ),
        pytest.param('qpos="0.3 -0.5"', 'qpos="30 -50"', "joints.key_outside", id="key in degrees"),
        pytest.param(
            'range="-2 2"', 'range="-2 2" limited="false"', "joints.idle_range", id="range unused"
        ),
        pytest.param(
            'angle="radian"',
            'angle="radian" inertiafromgeom="true"',
            "inertia.replaced",
            id="inertia from shapes",
        ),
        pytest.param('pos=".32 0 0"', 'pos="32 0 0"', "frames.gap", id="position in cm"),
    ],
)
def test_each_fault_is_found(tmp_path: Path, old: str, new: str, code: str) -> None:
    found = faults(tmp_path, (old, new))
    assert code in found
    assert found[code]["severity"] == ("critical" if code == "commands.unstable" else "warning")


def test_a_compensated_arm_needs_no_effort_to_hold_itself(tmp_path: Path) -> None:
    weak = ('"-50 50"', '"-5 5"')
    assert "joints.effort_too_small" in faults(tmp_path, weak)
    compensated = [
        ('<body name="upper"', '<body name="upper" gravcomp="1"'),
        ('<body name="lower"', '<body name="lower" gravcomp="1"'),
    ]
    assert faults(tmp_path, weak, *compensated) == {}
