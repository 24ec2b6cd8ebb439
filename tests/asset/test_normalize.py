"""The normalized asset: it is self-contained and explicit, and every change is logged."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from asset_robots import ALLEGRO, ARM, CORNERS, write_arm

from pytest_twin.asset.normalize import Normalized, normalize
from pytest_twin.errors import PathError, SpecError
from pytest_twin.realization import inertia, urdf


def normalized(source: Path, folder: Path, accept: tuple[str, ...] = ()) -> Normalized:
    folder.mkdir()
    return normalize(source, folder, accept=accept)


def file_digests(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file()
    }


def sorted_vertices(path: Path) -> np.ndarray:
    points = np.asarray(trimesh.load(path, process=False, force="mesh").vertices)
    return points[np.lexsort(points.T)]


def test_meshes_are_copied_and_scaled_to_metres(tmp_path: Path) -> None:
    found = normalized(write_arm(tmp_path), tmp_path / "out")
    text = found.urdf.read_text()
    assert "package://" not in text
    assert "scale" not in text
    meshes = sorted(path.name for path in (tmp_path / "out/meshes").iterdir())
    assert meshes == ["part.obj", "part_2.obj"]
    wanted = CORNERS[np.lexsort(CORNERS.T)]
    # One was STL in millimetres with a scale, the other COLLADA in centimetres.
    for name in meshes:
        assert sorted_vertices(tmp_path / "out/meshes" / name) == pytest.approx(wanted, abs=1e-8)


def test_every_change_is_logged_with_place_old_and_new_value_and_reason(tmp_path: Path) -> None:
    source = write_arm(tmp_path)
    found = normalized(source, tmp_path / "out")
    lines = source.read_text().splitlines()
    by_where = {change.where: change for change in found.changes}
    axis = by_where["joint 'lift'/axis.xyz"]
    assert (axis.file, axis.before) == ("arm.urdf", "0 2 1")
    assert 'xyz="0 2 1"' in lines[axis.line - 1]
    assert [float(word) for word in axis.after.split()] == pytest.approx(
        [0, 0.8944, 0.4472], abs=1e-4
    )
    assert axis.why == "the axis was not a unit vector"
    mesh = next(c for c in found.changes if c.after == "meshes/part.obj")
    assert mesh.before == "package://arm_description/meshes/part.stl"
    assert "scale 0.001 0.001 0.001 is applied to its vertices, in metres" in mesh.why
    other = next(c for c in found.changes if c.after == "meshes/part_2.obj")
    assert "its unit is applied to its vertices; its materials are omitted" in other.why
    assert "its up axis is Y_UP" in other.why


def test_values_without_a_log_entry_are_unchanged(tmp_path: Path) -> None:
    source = write_arm(tmp_path)
    before, after = urdf.read(source), urdf.read(normalized(source, tmp_path / "out").urdf)
    assert list(before.links) == list(after.links)
    for name, link in before.links.items():
        held = after.links[name]
        assert (link.mass, link.com.tolist(), link.inertia.tolist()) == (
            held.mass,
            held.com.tolist(),
            held.inertia.tolist(),
        )
    for name, joint in before.joints.items():
        held = after.joints[name]
        assert joint.axis == pytest.approx(held.axis, abs=1e-15)
        for field in ("type", "parent", "child", "limits", "velocity", "effort", "damping"):
            assert getattr(joint, field) == getattr(held, field)


def test_normalization_is_reproducible_and_does_not_change_the_source(tmp_path: Path) -> None:
    source = write_arm(tmp_path)
    package = source.parents[1]
    before = file_digests(package)
    normalized(source, tmp_path / "one")
    normalized(source, tmp_path / "two")
    assert file_digests(tmp_path / "one") == file_digests(tmp_path / "two")
    assert file_digests(package) == before


def test_an_impossible_inertia_is_kept_and_flagged(tmp_path: Path) -> None:
    found = normalized(ALLEGRO, tmp_path / "out")
    flags = {flag.patch: flag for flag in found.flags}
    assert sorted(flags) == [f"inertia-repair:link_{n}.0" for n in (11, 15, 3, 7)]
    assert all(flag.critical for flag in found.flags)
    lines = ALLEGRO.read_text().splitlines()
    assert all("ixx" in lines[flag.line - 1] for flag in found.flags)
    link = urdf.read(found.urdf).links["link_3.0"]
    assert (link.inertia == urdf.read(ALLEGRO).links["link_3.0"].inertia).all()


def test_only_the_accepted_inertia_repair_is_applied(tmp_path: Path) -> None:
    patch = "inertia-repair:link_3.0"
    found = normalized(ALLEGRO, tmp_path / "out", (patch,))
    assert len(found.flags) == 3
    log = [change for change in found.changes if change.patch]
    assert [change.patch for change in log] == [patch]
    assert (
        "the largest is kept, the other two grow until the triangle inequality holds" in log[0].why
    )
    before, after = urdf.read(ALLEGRO), urdf.read(found.urdf)
    assert inertia.violation(after.links["link_3.0"].inertia) == 0.0
    assert np.linalg.eigvalsh(after.links["link_3.0"].inertia).max() == pytest.approx(
        np.linalg.eigvalsh(before.links["link_3.0"].inertia).max(), rel=1e-6
    )
    assert (after.links["link_7.0"].inertia == before.links["link_7.0"].inertia).all()


def test_an_unnecessary_patch_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="this asset does not need that patch") as caught:
        normalized(write_arm(tmp_path), tmp_path / "out", ("inertia-repair:upper",))
    assert caught.value.expected == "no --accept"


def test_a_missing_visual_mesh_is_logged_and_a_missing_collision_mesh_refused(
    tmp_path: Path,
) -> None:
    source = write_arm(tmp_path)
    (source.parents[1] / "meshes/part.dae").unlink()
    found = normalized(source, tmp_path / "out")
    gone = next(change for change in found.changes if change.after is None)
    assert gone.before == "mesh package://arm_description/meshes/part.dae"
    assert gone.why == "no such file; the visual mesh is omitted"
    (source.parents[1] / "meshes/part.stl").unlink()
    with pytest.raises(PathError, match="no such file") as caught:
        normalized(source, tmp_path / "again")
    assert (
        caught.value.line
        == ARM.splitlines().index(next(line for line in ARM.splitlines() if "part.stl" in line)) + 1
    )


@pytest.mark.parametrize("reference", ["../../../secret.stl", "/etc/passwd", "file:///etc/passwd"])
def test_a_mesh_outside_the_roots_is_refused(tmp_path: Path, reference: str) -> None:
    (tmp_path / "secret.stl").write_bytes(b"")
    text = ARM.replace("package://arm_description/meshes/part.stl", reference)
    source = write_arm(tmp_path, text)
    with pytest.raises(PathError, match="path leaves the declared roots"):
        normalized(source, tmp_path / "out")
