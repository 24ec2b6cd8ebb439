"""Known faults of real robot descriptions are found."""

from __future__ import annotations

from pathlib import Path

import pytest
from audited import findings_of, only, robots

from pytest_twin.audit.read import read
from pytest_twin.errors import ModelError


def _find(name: str) -> Path:
    return next(robots().glob(f"*/*/{name}"))


def test_the_ur3_file_without_links_is_refused() -> None:
    with pytest.raises(ModelError, match=r"ur3\.urdf:6: robot: a robot without links"):
        read(_find("ur3.urdf"))


@pytest.mark.parametrize("side", ["left", "right"])
def test_four_links_of_each_allegro_hand_violate_the_triangle_inequality(side: str) -> None:
    rows = only(findings_of(_find(f"allegro_{side}_hand.urdf")), "inertia.triangle")
    assert sorted(row["element"] for row in rows) == [
        "link 'link_11.0'",
        "link 'link_15.0'",
        "link 'link_3.0'",
        "link 'link_7.0'",
    ]
    assert {row["severity"] for row in rows} == {"critical"}


def test_the_anymal_c_cameras_violate_the_triangle_inequality() -> None:
    path = robots() / "anymal_c_simple_description/urdf/anymal.urdf"
    rows = findings_of(path)
    broken = only(rows, "inertia.triangle")
    assert [row["element"] for row in broken] == [
        f"link 'depth_camera_{side}_camera'" for side in ("front", "rear", "left", "right")
    ]
    assert broken[0]["line"] == 200
    # All six inertia entries of the hatch are equal, which is the inertia of a line.
    assert [row["element"] for row in only(rows, "inertia.zero_moment")] == ["link 'hatch'"]


def test_two_links_of_pr2_violate_the_triangle_inequality() -> None:
    rows = findings_of(_find("pr2.urdf"))
    assert [row["element"] for row in only(rows, "inertia.triangle")] == [
        "link 'sensor_mount_link'",
        "link 'double_stereo_link'",
    ]


def test_romeo_has_a_negative_moment_of_inertia() -> None:
    rows = only(findings_of(_find("romeo_laas_small.urdf")), "inertia.negative_moment")
    body = next(row for row in rows if row["element"] == "link 'body'")
    assert body["value"] == pytest.approx(-0.021, abs=5e-4)
    assert body["unit"] == "kg*m^2"


def test_the_finger_robot_has_a_zero_moment_of_inertia() -> None:
    rows = only(findings_of(_find("finger_edu.urdf")), "inertia.zero_moment")
    assert [(row["element"], row["severity"]) for row in rows] == [
        ("link 'finger_lower_link'", "critical")
    ]


def test_missing_mimicked_joints_are_found_in_the_psyonic_hand() -> None:
    rows = only(findings_of(_find("alex_psyonic_hands.urdf")), "coupling.mimic_master")
    assert len(rows) == 8
    assert rows[0]["value"] == "index_q1"


def test_massless_links_of_multi_axis_joints_are_only_a_warning() -> None:
    human = only(findings_of(_find("human.urdf")), "inertia.moving_without")
    assert {row["severity"] for row in human} == {"warning"}
    assert all("virtual" in row["element"] for row in human)
    romeo = only(findings_of(_find("romeo.urdf")), "inertia.moving_without")
    assert {row["severity"] for row in romeo} == {"critical"}


@pytest.mark.parametrize("name", ["panda.urdf", "go2.urdf", "solo12.urdf", "ur5_robot.urdf"])
def test_widely_used_robots_have_no_critical_finding(name: str) -> None:
    rows = findings_of(_find(name))
    assert [row for row in rows if row["severity"] == "critical"] == []
    # Massless frames are not a fault.
    assert only(rows, "inertia.moving_without") == []
