"""Random URDF attributes: the robot is converted, or an error gives the place."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path

import pytest
from asset_robots import ARM, write_arm
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lxml import etree

from pytest_twin.asset.realize import realize
from pytest_twin.errors import TwinError

VALUES = st.sampled_from(
    [
        "", " ", "0", "-1", "nan", "inf", "1e308", "-1e-320", "1 2", "0 0 0", "1e9 0 0", "x",
        "../../etc", "lift", "base", "upper", "world", "a/b", "a b", "ü", "\u202e", "'\"<&>",
        "package://", "package://arm_description/", "fixed", "floating", "planar", "continuous",
    ]
)  # fmt: skip


@settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_random_attributes_are_converted_or_refused_and_write_no_other_file(
    data: st.DataObject,
) -> None:
    root = etree.fromstring(ARM)
    places = [(node, key) for node in root.iter() for key in node.attrib]
    for _ in range(data.draw(st.integers(1, 3))):
        node, key = data.draw(st.sampled_from(places))
        if data.draw(st.booleans()) or key not in node.attrib:
            node.set(key, data.draw(VALUES))
        else:
            del node.attrib[key]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "out").mkdir()
        urdf = write_arm(folder, etree.tostring(root, encoding="unicode"))
        with contextlib.suppress(TwinError):
            made = realize(str(urdf), str(folder / "out"))
            assert made["states"]["normalized"]["files"]
        outside = {path.name for path in folder.iterdir()}
        assert outside == {"out", "arm_description"}


@pytest.mark.parametrize("scale", ["x", "1 1", "0 1 1", "nan 1 1", ""])
def test_an_invalid_scale_of_a_mesh_is_refused(tmp_path: Path, scale: str) -> None:
    root = etree.fromstring(ARM)
    next(root.iter("mesh")).set("scale", scale)
    urdf = write_arm(tmp_path, etree.tostring(root, encoding="unicode"))
    (tmp_path / "out").mkdir()
    with pytest.raises(TwinError) as refused:
        realize(str(urdf), str(tmp_path / "out"))
    assert "scale" in str(refused.value)
