"""Malicious values anywhere in a robot file give findings or a typed error."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from audited import CLEAN, write_clean
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pytest_twin.audit import finding
from pytest_twin.audit.audit_file import audit, report
from pytest_twin.audit.evidence import Evidence
from pytest_twin.audit.geometry import Geometry
from pytest_twin.audit.read import read
from pytest_twin.errors import TwinError

HOSTILE = (
    *("", "nan", "inf", "-1", "0", "1e308", "1e-308", "1 2", "0 0 0", "1e10 1e10 1e10", "x", "1_0"),
    *("world", "upper", "grip", "fixed", "floating", "planar", "../..", "/etc/passwd", "\u202e"),
    *("file:///etc/passwd", "http://host/x", "package://a/b", ".", "robot.urdf", "a" * 300),
)
WITH_MORE = CLEAN.replace(
    "</robot>",
    '<transmission name="t"><type>x</type><joint name="elbow"/><actuator name="m">'
    "<mechanicalReduction>50</mechanicalReduction></actuator></transmission>"
    '<ros2_control name="c" type="system"><joint name="elbow"><command_interface name="position"/>'
    '</joint></ros2_control><gazebo reference="upper"><sensor name="imu" type="imu"/></gazebo>'
    "</robot>",
)
VALUES = [match.span(1) for match in re.finditer(r'="([^"]*)"', WITH_MORE)]
MJCF = """<mujoco model="m">
  <worldbody>
    <body name="a" pos="0 0 1" quat="1 0 0 0">
      <joint name="h" type="hinge" axis="0 0 1" pos="0 0 0" range="-90 90" damping="1"/>
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <geom name="g" type="box" size="0.1 0.1 0.1"/>
      <body name="b" pos="0.5 0 0"><joint name="s" type="slide"/><geom type="sphere" size="0.1"/>
        <site name="tcp" pos="0 0 0"/></body>
    </body>
  </worldbody>
  <equality><joint joint1="s" joint2="h" polycoef="0 1 0 0 0"/></equality>
  <actuator><position joint="h" kp="10" gear="1"/></actuator>
  <keyframe><key name="k" qpos="0 0"/></keyframe>
</mujoco>
"""
MJCF_VALUES = [match.span(1) for match in re.finditer(r'="([^"]*)"', MJCF)]


def _audit(path: Path) -> None:
    try:
        asset = read(path)
    except TwinError:
        return
    geometry = Geometry(asset)
    rows = report(asset, geometry, audit(asset, Evidence(), geometry))["findings"]
    assert all(row["severity"] in finding.SEVERITIES for row in rows)


def _replace_values(text: str, places: list[tuple[int, int]], changes: dict[int, str]) -> str:
    for at in sorted(changes, reverse=True):
        start, end = places[at]
        text = text[:start] + changes[at] + text[end:]
    return text


@settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.dictionaries(
        st.integers(0, len(VALUES) - 1), st.sampled_from(HOSTILE), min_size=1, max_size=4
    )
)
def test_malicious_values_in_a_urdf_give_findings_or_a_typed_error(
    tmp_path: Path, changes: dict[int, str]
) -> None:
    _audit(write_clean(tmp_path, _replace_values(WITH_MORE, VALUES, changes)))


@pytest.mark.filterwarnings("ignore")
@settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.dictionaries(
        st.integers(0, len(MJCF_VALUES) - 1), st.sampled_from(HOSTILE), min_size=1, max_size=3
    )
)
def test_malicious_values_in_an_mjcf_give_findings_or_a_typed_error(
    tmp_path: Path, changes: dict[int, str]
) -> None:
    path = tmp_path / "m.xml"
    path.write_text(_replace_values(MJCF, MJCF_VALUES, changes))
    _audit(path)


@pytest.mark.filterwarnings("ignore")
def test_a_shape_with_infinite_mass_is_a_critical_finding(tmp_path: Path) -> None:
    """The compiler computes the mass from the volume, which overflows."""
    path = tmp_path / "m.xml"
    path.write_text(MJCF.replace('type="sphere" size="0.1"', 'type="sphere" size="1e308"'))
    asset = read(path)
    geometry = Geometry(asset)
    (row,) = [
        row
        for row in report(asset, geometry, audit(asset, Evidence(), geometry))["findings"]
        if "inertia.not_finite" in str(row)
    ]
    assert row["severity"] == "critical"
    assert "link 'b'" in str(row)
    assert "inf" in str(row)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.binary(max_size=400))
def test_arbitrary_mesh_bytes_give_findings_or_a_typed_error(tmp_path: Path, data: bytes) -> None:
    path = write_clean(tmp_path)
    (tmp_path / "bar.stl").write_bytes(b"\0" * 80 + data)
    _audit(path)
