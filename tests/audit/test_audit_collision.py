"""Distances of collision shapes by MuJoCo and coal, and pictures of the robot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from audited import box_stl, changed, findings_of, only, robots, write_clean

from pytest_twin.audit import render, self_collision
from pytest_twin.audit.audit_file import audit_file
from pytest_twin.audit.evidence import Evidence
from pytest_twin.audit.geometry import Geometry
from pytest_twin.audit.read import read

BACK = {"back": {"elbow": 3.1}}


def test_an_overlap_in_a_declared_pose_is_a_warning(tmp_path: Path) -> None:
    # With the elbow at 3.1 rad the lower arm overlaps the upper arm.
    asset = read(write_clean(tmp_path))
    results, findings = self_collision.measure(asset, Geometry(asset), BACK)
    assert [result.name for result in results] == [self_collision.BASE_POSE, "back"]
    assert results[0].overlapping == frozenset()
    found = [finding for finding in findings if finding.code == "meshes.self_collision"]
    assert "links 'finger' and 'upper'" in {finding.element for finding in found}
    assert results[1].overlapping >= {"finger", "upper"}
    assert all(finding.severity == "warning" for finding in found)


def test_the_distance_of_two_boxes_equals_the_closed_form(tmp_path: Path) -> None:
    asset = read(write_clean(tmp_path))
    results, _ = self_collision.measure(asset, Geometry(asset), {})
    near = {(n.first, n.second): n for n in results[0].near}
    # Boxes of 15 and 16 mm width with 30 mm between their centres.
    gap = near["finger", "thumb"]
    assert gap.distance == pytest.approx(0.0145, abs=1e-6)
    assert gap.by_coal == pytest.approx(0.0145, abs=1e-6)


def test_distances_of_hulls_by_coal_agree_with_mujoco() -> None:
    asset = read(next(robots().glob("*/*/panda.urdf")))
    geometry = Geometry(asset)
    results, _ = self_collision.measure(asset, geometry, {})
    by_hulls = self_collision.Hulls(asset, geometry).near("base", results[0].values)
    near = {(n.first, n.second): n.distance for n in results[0].near}
    assert len(near) > 3
    for other in by_hulls.near:
        assert near[other.first, other.second] == pytest.approx(other.distance, abs=1e-4)


def test_the_base_pose_respects_joint_ranges_and_mimic_joints(tmp_path: Path) -> None:
    text = changed(
        ('<limit lower="-2" upper="2"', '<limit lower="0.5" upper="2"'),
        (
            '<mimic joint="grip" multiplier="1"/>',
            '<mimic joint="grip" multiplier="1" offset="0.01"/>',
        ),
    )
    asset = read(write_clean(tmp_path, text))
    base = self_collision.poses(asset, {})[self_collision.BASE_POSE]
    assert base["elbow"] == 0.5
    assert base["thumb_slide"] == 0.01


def test_distances_of_a_model_that_mujoco_refuses_are_computed_by_coal(tmp_path: Path) -> None:
    # A joint that mimics itself is refused by every simulator.
    asset = read(
        write_clean(tmp_path, changed(('<mimic joint="grip"', '<mimic joint="thumb_slide"')))
    )
    results, _ = self_collision.measure(asset, Geometry(asset), {})
    assert results[0].engine == "coal"
    near = {(n.first, n.second): n.distance for n in results[0].near}
    assert near["finger", "thumb"] == pytest.approx(0.0145, abs=1e-6)


def test_a_robot_without_collision_shapes_leaves_distances_unknown(tmp_path: Path) -> None:
    text = "<robot name='r'><link name='a'/></robot>"
    asset = read(write_clean(tmp_path, text))
    results, findings = self_collision.measure(asset, Geometry(asset), {})
    assert results == []
    assert [(f.code, f.severity) for f in findings] == [("meshes.distances_unknown", "unknown")]


@pytest.mark.usefixtures("rendered_figures")
def test_a_picture_shows_overlapping_links_in_red(tmp_path: Path) -> None:
    import matplotlib.image

    asset = read(write_clean(tmp_path))
    pictures = []
    for marked in ((), ("upper",)):
        png = render.views(asset, {}, marked=marked)
        assert png is not None
        path = tmp_path / "shot.png"
        path.write_bytes(png)
        pictures.append(matplotlib.image.imread(path)[..., :3])
    red = [
        int(((p[..., 0] > 0.5) & (p[..., 1] < 0.4) & (p[..., 2] < 0.35)).sum()) for p in pictures
    ]
    assert red[0] == 0
    assert red[1] > 2000


def test_splitting_triangles_keeps_area_and_colour() -> None:
    corners = np.array([[[0.0, 0, 0], [10, 0, 0], [0, 0.1, 0]]])
    pieces, colours = render.split(corners, np.array([[1.0, 0, 0]]), 0.5)
    area = np.linalg.norm(
        np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]), axis=1
    ).sum()
    assert area == pytest.approx(1.0)
    assert len(colours) == len(pieces) > 20


def test_simplified_meshes_keep_their_extent() -> None:
    from pytest_twin.realization.mesh import Triangles

    generator = np.random.default_rng(3)
    vertices = generator.normal(size=(3000, 3))
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    from scipy.spatial import ConvexHull

    ball = Triangles(vertices, ConvexHull(vertices).simplices.astype(np.int32))
    merged, faces = render.coarse(ball.vertices, ball.faces, cells=12)
    assert len(faces) < len(ball.faces) / 3
    assert np.abs(np.linalg.norm(merged, axis=1) - 1).max() < 0.1


def test_empty_evidence_declares_no_pose() -> None:
    assert Evidence().poses == {}


MASKED = """<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <geom type="plane" size="5 5 .1" contype="1" conaffinity="0"/>
    <body name="a" pos="0 0 .5">
      <joint name="j1" axis="0 1 0" range="-1 1"/>
      <geom type="box" size=".1 .1 .1" mass="1" contype="1" conaffinity="0"/>
      <body name="b" pos="0 0 -.35">
        <joint name="j2" axis="1 0 0" range="-1 1"/>
        <geom name="tip" type="box" size=".05 .05 .1" mass="1" contype="1" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(
    ("old", "new", "elements"),
    [
        ("", "", ["robot 'masked'"]),
        ('conaffinity="0"/>\n    <body name="a"', 'conaffinity="1"/>\n    <body name="a"', []),
        ("</worldbody>", '</worldbody><contact><pair geom1="tip" geom2="floor"/></contact>', None),
        ('mass="1" contype="1" conaffinity="0"', 'mass="1" contype="0" conaffinity="0"', []),
    ],
    ids=["no pair", "with the floor", "an explicit pair", "the robot is only drawn"],
)
def test_shapes_whose_masks_exclude_every_pair_are_a_warning(
    tmp_path: Path, old: str, new: str, elements: list[str] | None
) -> None:
    text = MASKED.replace(old, new) if old else MASKED
    path = tmp_path / "masked.xml"
    path.write_text(text.replace('<geom type="plane"', '<geom name="floor" type="plane"'))
    found = only(findings_of(path), "meshes.masked")
    # With the pair of floor and tip, only the shape of a can touch nothing.
    assert [row["element"] for row in found] == (["link 'a'"] if elements is None else elements)
    assert {row["severity"] for row in found} <= {"warning"}


def test_named_states_of_the_srdf_beside_a_urdf_are_measured(tmp_path: Path) -> None:
    path = write_clean(tmp_path)
    (tmp_path / "robot.srdf").write_text(
        '<robot name="clean"><group name="arm"><joint name="elbow"/></group>'
        '<group_state name="folded" group="arm"><joint name="elbow" value="3.1"/></group_state>'
        "</robot>"
    )
    report = audit_file(str(path))
    assert [pose["pose"] for pose in report["poses"]] == [self_collision.BASE_POSE, "arm/folded"]
    found = only(report["findings"], "meshes.self_collision")
    assert any("'arm/folded'" in row["title"] for row in found)
    assert report["verdict"] == "warnings"


def test_a_small_mesh_among_the_meshes_of_a_link_is_no_finding(tmp_path: Path) -> None:
    bar = '<geometry><mesh filename="bar.stl"/></geometry>'
    screw = bar.replace("bar.stl", "screw.stl")
    text = changed((bar, f"{bar}</collision><collision>{screw}"))
    (tmp_path / "screw.stl").write_bytes(box_stl((0.003, 0.003, 0.003)))
    assert only(findings_of(write_clean(tmp_path, text)), "meshes.units") == []
    (tmp_path / "screw.stl").write_bytes(box_stl((2e-4, 5e-5, 5e-5)))
    (found,) = only(findings_of(write_clean(tmp_path, text)), "meshes.units")
    assert "the link's other shape" in found["title"]
