"""A link with the mirrored shape of another and not its mirrored inertia is reported."""

from __future__ import annotations

from pathlib import Path

import pytest
from audited import findings_of, only, robots

LEFT = ("0.02 0.03 -0.1", 'ixy="0.002" ixz="-0.0002" iyz="0.0012"')
"""Centre of mass, m, and products of inertia, kg*m^2, of the left leg."""
MIRRORED = ("0.02 -0.03 -0.1", 'ixy="-0.002" ixz="-0.0002" iyz="-0.0012"')


def codes(folder: Path, right: tuple[str, str], *, right_shape: float = -0.03) -> list[str]:
    """Codes of the warnings about a robot with two legs.

    Args:
        right: centre of mass and products of inertia of the right leg.
        right_shape: y of the middle of its shape, m.
    """

    def leg(name: str, y: float, middle: float, com: str, products: str) -> str:
        shape = f'<origin xyz="0.01 {middle} -0.1"/><geometry><box size="0.1 0.16 0.3"/></geometry>'
        return f"""<link name="{name}"><inertial><origin xyz="{com}"/><mass value="1.2"/>
  <inertia ixx="0.0115" iyy="0.01" izz="0.008" {products}/></inertial>
  <visual>{shape}</visual><collision>{shape}</collision></link>
  <joint name="{name}_joint" type="revolute"><origin xyz="0 {y} 0"/><parent link="base"/>
  <child link="{name}"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="30" velocity="5"/>
  </joint>"""

    path = folder / "legs.urdf"
    path.write_text(
        '<robot name="legs"><link name="world"/><link name="base"><collision><geometry>'
        '<box size="0.3 0.16 0.1"/></geometry></collision></link><joint name="mount" type="fixed">'
        '<parent link="world"/><child link="base"/></joint>'
        + leg("left", 0.12, 0.03, *LEFT)
        + leg("right", -0.12, right_shape, *right)
        + "</robot>"
    )
    rows = findings_of(path)
    return [row["code"] for row in rows if row["severity"] in ("critical", "warning")]


def test_a_mirrored_link_has_no_finding(tmp_path: Path) -> None:
    assert codes(tmp_path, MIRRORED) == []


def test_the_same_part_on_both_sides_has_no_finding(tmp_path: Path) -> None:
    assert codes(tmp_path, LEFT, right_shape=0.03) == []


@pytest.mark.parametrize(
    "right",
    [
        pytest.param(LEFT, id="all numbers copied"),
        pytest.param((LEFT[0], MIRRORED[1]), id="centre of mass copied"),
        pytest.param((MIRRORED[0], LEFT[1]), id="products copied"),
        pytest.param(("-0.02 -0.03 -0.1", MIRRORED[1]), id="another sign"),
    ],
)
def test_an_inertia_that_is_not_mirrored_is_a_warning(
    tmp_path: Path, right: tuple[str, str]
) -> None:
    assert codes(tmp_path, right) == ["inertia.not_mirrored"]


def test_two_links_of_the_left_arm_of_talos_have_the_centres_of_mass_of_the_right() -> None:
    rows = findings_of(next(robots().glob("*/*/talos_reduced.urdf")))
    found = [row["element"] for row in only(rows, "inertia.not_mirrored") if row["unit"] == "m"]
    assert found == ["link 'arm_left_3_link'", "link 'arm_left_4_link'"]
