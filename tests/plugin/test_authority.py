"""``authority:`` in twin.yaml selects the realization whose values are recorded."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pytest_twin.errors import SpecError
from pytest_twin.twin import load_twin

pytestmark = pytest.mark.usefixtures("gate_in_process")

WARP_CACHE = Path(os.environ.get("WARP_CACHE_PATH") or Path.home() / ".cache/warp")
BOTH = "authority: [{realization: light, kinds: [mass_properties]}]\n"

FLAT = """<robot name="flat"><link name="base"/>
  <link name="lever"><inertial><origin xyz="0.1 0 0"/><mass value="0.5"/>
    <inertia ixx="0.001" iyy="0.002" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hinge" type="revolute"><parent link="base"/><child link="lever"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="5" velocity="5"/></joint>
</robot>
"""
STEP = """schema: 1
kind: step
realizations: [mujoco, stage]
target: {joint: hinge}
stimulus: {amplitude: 0.2 rad, duration: 0.5 s, contact: false}
tolerance: {rise_time: 5 ms, angle: 5 mrad}
"""


@pytest.fixture
def two_realizations(recorded):
    """A twin with a second realization that is 0.1 g lighter; the mass golden runs on both."""
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


def test_differences_are_reported_and_the_authoritative_values_are_recorded(
    two_realizations,
) -> None:
    result = two_realizations.run("--twin-release")
    result.stdout.fnmatch_lines(
        [
            "golden/mass/arm: light (mujoco) against mujoco (mujoco), which is authoritative: "
            "* apart, * % of the tolerance (largest of *)",
            "release 0001 signed: *",
        ]
    )
    two_realizations.edit("twin.yaml", "tcp: tcp\n", f"tcp: tcp\n{BOTH}")
    result = two_realizations.run("--twin-release")
    assert result.ret != 0
    result.stdout.fnmatch_lines(["*recorded on 'mujoco', and 'light' is authoritative for it*"])
    assert two_realizations.run("--twin-update").ret == 0
    assert (
        "realization: light" in (two_realizations.root / "golden" / "mass" / "arm.yaml").read_text()
    )
    assert (
        "realization: mujoco" in (two_realizations.root / "golden" / "fk" / "home.yaml").read_text()
    )
    result = two_realizations.run("--twin-release")
    result.stdout.fnmatch_lines(["golden/mass/arm: mujoco (mujoco) against light (mujoco)*"])


def test_an_authority_rule_for_an_unknown_realization_is_refused(two_realizations) -> None:
    two_realizations.edit("twin.yaml", "tcp: tcp\n", f"tcp: tcp\n{BOTH.replace('light', 'usd')}")
    with pytest.raises(SpecError, match=r"no such realization .*expected mujoco, light"):
        load_twin(two_realizations.root / "twin.yaml")


def test_a_golden_must_run_on_its_authoritative_realization(two_realizations) -> None:
    two_realizations.edit("twin.yaml", "tcp: tcp\n", f"tcp: tcp\n{BOTH}")
    two_realizations.edit("golden/mass/arm.yaml", "[mujoco, light]", "[mujoco]")
    result = two_realizations.run()
    result.stdout.fnmatch_lines(["*does not run on 'light', which is authoritative for it*"])


def test_the_difference_between_newton_and_mujoco_is_reported_for_a_usd_stage(
    twin, monkeypatch: pytest.MonkeyPatch
) -> None:
    warp = pytest.importorskip("newton") and pytest.importorskip("warp")
    # The home folder of these tests is empty, so Warp would compile its kernels for a minute.
    monkeypatch.setenv("WARP_CACHE_PATH", str(WARP_CACHE / warp.__version__))
    from pytest_twin.realization import usd

    twin.write("flat.urdf", FLAT)
    usd.convert(twin.root / "flat.urdf", twin.root / "flat.usda")
    twin.write(
        "twin.yaml",
        "name: arm\nrealizations:\n  mujoco: {file: flat.urdf}\n"
        "  stage: {file: flat.usda, simulator: newton}\n"
        "fit: {id: gains, actuator: {hinge: {kp: 5, kv: 0.5}}}\n",
    )
    for old in ("fk/home", "mass/arm"):
        (twin.root / f"golden/{old}.yaml").unlink()
    twin.write("golden/step.yaml", STEP)
    assert twin.run("--twin-update").ret == 0
    result = twin.run()
    result.stdout.fnmatch_lines(
        ["golden/step: stage (newton) against mujoco (mujoco), which is authoritative: * apart, *"]
    )
    assert result.ret == 0


def test_a_kind_that_newton_does_not_compute_is_refused_in_one_line(two_realizations) -> None:
    two_realizations.write("flat.usda", "#usda 1.0")
    two_realizations.edit("twin.yaml", "light.xml", "flat.usda, simulator: newton")
    result = two_realizations.run()
    result.stdout.fnmatch_lines(["*a golden of kind mass_properties is not computed on newton*"])
