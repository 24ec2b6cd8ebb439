"""A realization lists every file that was read, so that digests cover all of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from pytest_twin.realization import load


def test_two_mesh_files_with_equal_content_are_both_listed(tmp_path: Path) -> None:
    for name in ("left", "right"):
        trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / f"{name}.stl")
    (tmp_path / "empty.xml").write_text("<mujocoinclude></mujocoinclude>")
    model = tmp_path / "robot.xml"
    model.write_text(
        "<mujoco><asset><mesh file='left.stl'/><mesh file='right.stl'/></asset>"
        "<include file='empty.xml'/><worldbody><body><geom type='mesh' mesh='left'/>"
        "<geom type='mesh' mesh='right'/></body></worldbody></mujoco>"
    )
    realization = load(model)
    assert {path.name for path in realization.source.files} == {
        "robot.xml", "left.stl", "right.stl", "empty.xml",
    }  # fmt: skip
    assert np.isfinite(realization.model.body_mass).all()
