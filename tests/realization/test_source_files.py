"""Every file that was read is named: what is not named, no digest guards."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from pytest_twin.realization import load


def test_equal_meshes_under_two_names_are_two_files(tmp_path: Path) -> None:
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
