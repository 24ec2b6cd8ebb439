"""Inertias compared with the inertias that sets of point masses can have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from audited import box_stl, changed, findings_of, only, write_clean
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pytest_twin.audit import inertia
from pytest_twin.audit.asset import Asset, Body, Edge, Joint, Shape
from pytest_twin.audit.finding import Finding, Place
from pytest_twin.audit.geometry import Geometry

HERE = Place(Path("robot.urdf"), 1)
COORDINATE = st.floats(-1, 1, allow_nan=False, allow_subnormal=False)
POINTS = st.lists(
    st.tuples(st.floats(0.01, 5), COORDINATE, COORDINATE, COORDINATE), min_size=4, max_size=8
)


def _moving(mass: float, com: NDArray[np.float64], tensor: NDArray[np.float64]) -> Asset:
    asset = Asset("urdf", HERE.path, "robot")
    asset.bodies = [Body("base", HERE), Body("arm", HERE, mass, com, tensor, inertial=HERE)]
    asset.edges = [Edge("j", HERE, "base", "arm", np.zeros(3), np.eye(3))]
    asset.joints = [Joint("j", HERE, "hinge", "arm", np.array([0.0, 0.0, 1.0]))]
    return asset


def _critical(asset: Asset) -> list[Finding]:
    found = inertia.check(asset, Geometry(asset))
    return [finding for finding in found if finding.severity == "critical"]


def _of_points(
    points: list[tuple[float, float, float, float]],
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    masses = np.array([point[0] for point in points])
    places = np.array([point[1:] for point in points])
    com = masses @ places / masses.sum()
    arms = places - com
    second = np.einsum("i,ij,ik->jk", masses, arms, arms)
    return float(masses.sum()), com, np.trace(second) * np.eye(3) - second


@settings(max_examples=40, deadline=None)
@given(POINTS)
def test_the_inertia_of_any_set_of_point_masses_is_accepted(
    points: list[tuple[float, float, float, float]],
) -> None:
    mass, com, tensor = _of_points(points)
    moments = np.linalg.eigvalsh(tensor)
    # Points on one line have no inertia about it: this limit case is skipped.
    if moments[0] <= max(1e-6 * moments[2], 1e-9):
        return
    assert _critical(_moving(mass, com, tensor)) == []


@settings(max_examples=40, deadline=None)
@given(POINTS, st.floats(1.001, 5))
def test_a_moment_above_the_sum_of_the_others_is_critical(
    points: list[tuple[float, float, float, float]], factor: float
) -> None:
    mass, com, tensor = _of_points(points)
    moments, axes = np.linalg.eigh(tensor)
    if moments[0] <= max(1e-6 * moments[2], 1e-9):
        return
    moments[2] = factor * (moments[0] + moments[1])
    found = _critical(_moving(mass, com, axes @ np.diag(moments) @ axes.T))
    assert [finding.code for finding in found] == ["inertia.triangle"]


@pytest.mark.parametrize(
    "moments", [(1, 0.1, 0.1), (0.1, 1, 0.1), (0.1, 0.1, 1)], ids=["x", "y", "z"]
)
def test_an_inertia_with_positive_moments_may_violate_the_triangle_inequality(
    moments: tuple[float, float, float],
) -> None:
    found = _critical(_moving(1.0, np.zeros(3), np.diag(moments)))
    assert [finding.code for finding in found] == ["inertia.triangle"]
    # The smallest eigenvalue of the pseudo-inertia matrix is tr(I)/2 - 1.
    assert "eigenvalue -0.4 kg*m^2" in found[0].title


def test_rounded_moments_of_a_disc_are_only_an_info() -> None:
    # The largest moment of a disc is the sum of the others; here it is rounded up.
    found = list(
        inertia.check(
            asset := _moving(1.0, np.zeros(3), np.diag([0.25, 0.25, 0.500001])), Geometry(asset)
        )
    )
    assert [(finding.code, finding.severity) for finding in found] == [
        ("inertia.triangle_rounded", "info")
    ]


def test_a_massless_link_is_critical_only_if_it_moves(tmp_path: Path) -> None:
    frame = (
        '  <link name="probe"/>\n  <joint name="probe_mount" type="{}">\n'
        '    <parent link="tcp"/><child link="probe"/><axis xyz="0 0 1"/>\n  </joint>\n</robot>'
    )
    fixed = findings_of(write_clean(tmp_path, changed(("</robot>", frame.format("fixed")))))
    assert only(fixed, "inertia.moving_without") == []
    turning = findings_of(write_clean(tmp_path, changed(("</robot>", frame.format("continuous")))))
    assert [row["severity"] for row in only(turning, "inertia.moving_without")] == ["critical"]


def test_a_massless_link_may_get_its_inertia_from_a_fixed_child(tmp_path: Path) -> None:
    text = changed(
        ('<link name="upper">\n', '<link name="upper"/>\n  <link name="upper_body">\n'),
        ('<parent link="upper"/>', '<parent link="upper_body"/>'),
        (
            "</robot>",
            '  <joint name="glue" type="fixed"><parent link="upper"/><child link="upper_body"/>'
            "</joint>\n</robot>",
        ),
    )
    assert only(findings_of(write_clean(tmp_path, text)), "inertia.moving_without") == []


def test_mass_properties_of_solids_equal_the_closed_forms() -> None:
    asset = Asset("urdf", HERE.path, "robot")
    asset.bodies = [Body("b", HERE)]
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    asset.shapes = [
        Shape(HERE, "b", "collision", "box", np.array([1.0, 0, 0]), turn, (0.3, 0.2, 0.1)),
        Shape(HERE, "b", "visual", "cylinder", np.zeros(3), np.eye(3), (0.1, 0.4)),
    ]
    geometry = Geometry(asset)
    box = geometry.body("b", "collision")
    assert box is not None
    assert box.volume == pytest.approx(0.006)
    assert box.centroid == pytest.approx([1, 0, 0])
    # The box is rotated by 90 degrees: x and y are swapped.
    expected = np.array([0.3**2 + 0.1**2, 0.2**2 + 0.1**2, 0.2**2 + 0.3**2]) / 12
    assert np.diag(box.inertia) == pytest.approx(expected)
    cylinder = geometry.body("b", "visual")
    assert cylinder is not None
    assert cylinder.volume == pytest.approx(np.pi * 0.01 * 0.4, rel=0.005)
    assert cylinder.inertia[2, 2] == pytest.approx(0.1**2 / 2, rel=0.01)


def test_an_extremely_small_mass_is_a_finding_of_density(tmp_path: Path) -> None:
    rows = findings_of(
        write_clean(tmp_path, changed(('<mass value="2"/>', '<mass value="1e-308"/>')))
    )
    assert [row["element"] for row in only(rows, "inertia.density")] == ["link 'upper'"]


def test_two_adjacent_boxes_have_the_inertia_of_one_bar() -> None:
    asset = Asset("urdf", HERE.path, "robot")
    asset.bodies = [Body("b", HERE)]
    asset.shapes = [
        Shape(HERE, "b", "collision", "box", np.array([x, 0, 0]), np.eye(3), (0.2, 0.1, 0.1))
        for x in (-0.1, 0.1)
    ]
    bar = Geometry(asset).body("b")
    assert bar is not None
    assert bar.volume == pytest.approx(0.004)
    assert np.diag(bar.inertia) == pytest.approx(np.array([0.02, 0.17, 0.17]) / 12)


def test_a_convex_mesh_is_not_reported_as_non_convex(tmp_path: Path) -> None:
    path = write_clean(tmp_path)
    (tmp_path / "bar.stl").write_bytes(box_stl((0.2, 0.05, 0.05)))
    rows = findings_of(path)
    assert not only(rows, "meshes.not_convex")


@pytest.mark.parametrize(
    "text",
    [
        '<robot name="r"><link name="base"><visual><geometry><box size="1 1 1"/></geometry>'
        '</visual></link><link name="lidar"/><joint name="j" type="fixed"><parent link="base"/>'
        '<child link="lidar"/></joint></robot>',
        '<mujoco model="r"><worldbody><body name="base"><geom size=".1" mass="0" contype="0" '
        'conaffinity="0"/></body></worldbody></mujoco>',
    ],
    ids=["urdf", "mjcf"],
)
def test_a_robot_of_visual_shapes_alone_is_critical(text: str, tmp_path: Path) -> None:
    path = tmp_path / ("r.urdf" if text.startswith("<robot") else "r.xml")
    path.write_text(text)
    (row,) = only(findings_of(path), "inertia.no_mass_at_all")
    assert (row["severity"], row["element"], row["value"]) == ("critical", "robot 'r'", 0.0)
