"""``authority:`` in twin.yaml: what is recorded, and what is told of the other realizations."""

from __future__ import annotations

import pytest

from pytest_twin.errors import SpecError
from pytest_twin.twin import load_twin

BOTH = "authority: [{realization: light, kinds: [mass_properties]}]\n"


@pytest.fixture
def two(recorded):
    """The arm, and a lighter one by 0.1 g, on which the golden of the mass runs too."""
    recorded.write(
        "light.xml", (recorded.root / "arm.xml").read_text().replace('mass="0.6"', 'mass="0.5999"')
    )
    recorded.edit("twin.yaml", "tcp: tcp\n", "tcp: tcp\nrealizations: {light: {file: light.xml}}\n")
    recorded.edit(
        "golden/mass/arm.yaml",
        "kind: mass_properties",
        "kind: mass_properties\nrealizations: [mujoco, light]",
    )
    return recorded


def test_differences_are_told_and_the_authoritative_one_is_recorded(two) -> None:
    result = two.run("--twin-release")
    result.stdout.fnmatch_lines(
        [
            "golden/mass/arm: light (mujoco) against mujoco (mujoco), which is authoritative: "
            "* apart, * % of the tolerance (largest of *)",
            "release 0001 signed: *",
        ]
    )
    two.edit("twin.yaml", "tcp: tcp\n", f"tcp: tcp\n{BOTH}")
    result = two.run("--twin-release")
    assert result.ret != 0
    result.stdout.fnmatch_lines(["*recorded on 'mujoco', and 'light' is authoritative for it*"])
    assert two.run("--twin-update").ret == 0
    assert "realization: light" in (two.root / "golden" / "mass" / "arm.yaml").read_text()
    assert "realization: mujoco" in (two.root / "golden" / "fk" / "home.yaml").read_text()
    result = two.run("--twin-release")
    result.stdout.fnmatch_lines(["golden/mass/arm: mujoco (mujoco) against light (mujoco)*"])


def test_a_rule_without_its_realization_is_one_line(two) -> None:
    two.edit("twin.yaml", "tcp: tcp\n", f"tcp: tcp\n{BOTH.replace('light', 'usd')}")
    with pytest.raises(SpecError, match=r"no such realization .*expected mujoco, light"):
        load_twin(two.root / "twin.yaml")


def test_a_golden_that_leaves_the_authority_out_is_refused(two) -> None:
    two.edit("twin.yaml", "tcp: tcp\n", f"tcp: tcp\n{BOTH}")
    two.edit("golden/mass/arm.yaml", "[mujoco, light]", "[mujoco]")
    result = two.run()
    result.stdout.fnmatch_lines(["*does not run on 'light', which is authoritative for it*"])
