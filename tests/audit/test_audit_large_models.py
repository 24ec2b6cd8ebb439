"""Audits of large scenes, deep chains and rarely used MJCF elements."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from audited import findings_of, only, write_clean

from pytest_twin.asset.realize import realize
from pytest_twin.audit import render, self_collision
from pytest_twin.audit.audit_file import audit_file
from pytest_twin.audit.broad_phase import near_pairs
from pytest_twin.audit.geometry import Geometry
from pytest_twin.audit.read import read
from pytest_twin.errors import LimitError, ModelError, PathError

LINE_OBJ = "v 0 0 0\nv 2 0 0\nv 1 0 0\nv 3 0 0\nl 1 3 2\nl 2 4\n"


def write(folder: Path, text: str, name: str = "model.xml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def spheres(count: int, offset: str = "1 0 0") -> str:
    return (
        f'<mujoco><worldbody><replicate count="{count}" offset="{offset}"><body><joint/>'
        '<geom size=".1"/></body></replicate></worldbody></mujoco>'
    )


def chain(count: int, kind: str = "fixed") -> str:
    joints = "".join(
        f'<link name="l{i}"/><joint name="j{i}" type="{kind}"><parent link="l{i - 1}"/>'
        f'<child link="l{i}"/></joint>'
        for i in range(1, count)
    )
    return f'<robot name="chain"><link name="l0"/>{joints}</robot>'


def test_a_keyframe_of_an_unnamed_joint_is_read(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        '<mujoco><worldbody><body name="b"><joint/><geom size=".1"/></body></worldbody>'
        '<keyframe><key name="k" qpos="0.3"/></keyframe></mujoco>',
    )
    assert read(path).poses == {"k": {"joint 0": 0.3}}
    assert findings_of(path)


def test_a_flexcomp_from_a_file_is_read_as_mujoco_compiles_it(tmp_path: Path) -> None:
    (tmp_path / "line.obj").write_text(LINE_OBJ)
    path = write(
        tmp_path,
        '<mujoco><worldbody><flexcomp name="line" type="mesh" file="line.obj" dim="1" '
        'radius="0.1"/></worldbody></mujoco>',
    )
    asset = read(path)
    assert len(asset.bodies) == 5, "expected the world and one body for each vertex"
    assert path.parent / "line.obj" in asset.files


@pytest.mark.parametrize("with_file", [True, False])
def test_two_meshes_with_the_same_file_name_are_a_finding_with_line(
    tmp_path: Path, with_file: bool
) -> None:
    if with_file:
        (tmp_path / "cube.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 3 4\n")
    path = write(
        tmp_path,
        '<mujoco>\n  <asset>\n    <mesh file="cube.obj"/>\n    <mesh file="cube.obj"/>\n'
        '  </asset>\n  <worldbody><geom type="mesh" mesh="cube"/></worldbody>\n</mujoco>\n',
    )
    (found,) = only(findings_of(path), "tree.duplicate_name")
    assert (found["severity"], found["element"], found["line"]) == ("critical", "mesh 'cube'", 4)
    assert "line 3" in found["expected"]


def test_an_mjcf_with_a_missing_mesh_is_refused(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        '<mujoco><asset><mesh file="cube.obj"/></asset>'
        '<worldbody><geom type="mesh" mesh="cube"/></worldbody></mujoco>',
    )
    with pytest.raises(PathError, match="no such file"):
        read(path)


def test_a_duplicate_body_is_reported_even_if_a_mesh_is_missing(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        '<mujoco><asset><mesh file="cube.obj"/></asset><worldbody><body name="a"/>\n'
        '<body name="a"/></worldbody></mujoco>',
    )
    assert [row["element"] for row in only(findings_of(path), "tree.duplicate_name")] == [
        "body 'a'"
    ]


@pytest.mark.usefixtures("rendered_figures")
def test_three_thousand_spheres_are_audited_in_bounded_time(tmp_path: Path) -> None:
    start = time.process_time()
    found = audit_file(str(write(tmp_path, spheres(3000))))
    # CPU time, s: 11 as measured; over 75 without limits on pairs and triangles.
    assert time.process_time() - start < 30
    assert found["facts"]["bodies"] == 3001
    assert found["renders"]


def test_a_dense_heap_of_shapes_is_measured_partly_and_reported_so(tmp_path: Path) -> None:
    asset = read(write(tmp_path, spheres(60, "0.01 0 0")))
    (result,), findings = self_collision.measure(asset, Geometry(asset), {})
    assert result.checked_pairs < (result.pairs or 0)
    (unknown,) = [f for f in findings if f.code == "meshes.distances_unknown"]
    assert unknown.severity == "unknown"
    assert f"{result.pairs} pairs of shapes may be near each other" in unknown.title


def test_too_many_near_pairs_are_reported_as_unknown_distances(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asset = read(write(tmp_path, spheres(60, "0.01 0 0")))
    monkeypatch.setattr(self_collision, "near_pairs", lambda *args: near_pairs(*args, most=100))
    results, findings = self_collision.measure(asset, Geometry(asset), {})
    assert results[0].pairs is None
    assert [f.code for f in findings] == ["meshes.distances_unknown"]
    assert "more than 1000000 pairs" in findings[0].title


def test_the_broad_phase_finds_the_same_pairs_as_a_full_search() -> None:
    generator = np.random.default_rng(5)
    centres = generator.uniform(0, 4, (120, 3))
    radii = 10 ** generator.uniform(-3, 0, 120)
    at, other = np.triu_indices(120, 1)
    gaps = np.linalg.norm(centres[at] - centres[other], axis=1) - radii[at] - radii[other]
    expected = {(int(a), int(b)) for a, b, g in zip(at, other, gaps, strict=True) if g < 0.05}
    found = near_pairs(centres, radii, 0.05)
    assert found is not None
    assert {(int(a), int(b)) for a, b in found} == expected
    assert len(found) == len(expected)


def test_the_broad_phase_of_zero_or_one_shape_has_no_pair() -> None:
    for count in (0, 1):
        found = near_pairs(np.zeros((count, 3)), np.ones(count), 0.05)
        assert found is not None
        assert found.shape == (0, 2)


@pytest.mark.parametrize("count", [100, 3000, pytest.param(5000, marks=pytest.mark.nightly)])
def test_a_picture_of_many_shapes_has_a_bounded_number_of_triangles(
    tmp_path: Path, count: int
) -> None:
    asset = read(write(tmp_path, spheres(count)))
    corners, _ = render.drawn_triangles(asset, asset.shapes, {}, ())
    assert corners is not None
    assert 10_000 < len(corners) <= 40_000
    # The extent is unchanged: the spheres reach from -0.1 m to count - 0.9 m.
    if count <= 3000:
        assert np.ptp(corners[..., 0]) == pytest.approx(count - 0.8, abs=0.1)


def test_a_distant_body_is_a_warning_in_a_scene_and_critical_in_a_robot(tmp_path: Path) -> None:
    scene = write(tmp_path, spheres(102))
    assert {row["severity"] for row in only(findings_of(scene), "joints.origin_far")} == {"warning"}
    robot = chain(3).replace('<child link="l2"/>', '<child link="l2"/><origin xyz="101 0 0"/>')
    path = write_clean(tmp_path, robot)
    assert {row["severity"] for row in only(findings_of(path), "joints.origin_far")} == {"critical"}


def test_a_chain_too_deep_to_convert_is_refused_with_file_and_limit(tmp_path: Path) -> None:
    path = write(tmp_path, chain(251), "chain.urdf")
    out = tmp_path / "out"
    out.mkdir()
    words = r"chain\.urdf:1: .*too many links one below the other .*251 links.*at most 250"
    with pytest.raises(LimitError, match=words):
        realize(str(path), str(out))
    assert findings_of(path), "the audit needs no compilation and should report findings"


def test_a_chain_too_deep_to_audit_is_refused_early(tmp_path: Path) -> None:
    path = write(tmp_path, chain(20_000), "chain.urdf")
    start = time.process_time()
    with pytest.raises(LimitError, match=r"chain\.urdf:1: .*20000 links.*at most 10000"):
        read(path)
    assert time.process_time() - start < 20


def test_a_too_deep_mjcf_is_refused_with_its_file(tmp_path: Path) -> None:
    deep = "<body>" * 400 + "</body>" * 400
    path = write(tmp_path, f"<mujoco><worldbody>{deep}</worldbody></mujoco>")
    with pytest.raises((LimitError, ModelError), match=r"model\.xml"):
        read(path)
