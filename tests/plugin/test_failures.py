"""Messages for people and CI servers about a golden that fails."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest

pytestmark = pytest.mark.usefixtures("gate_in_process")


def _junit(twin) -> dict[str, ElementTree.Element]:
    tree = ElementTree.parse(twin.root / "junit.xml")
    return {case.get("name"): case for case in tree.iter("testcase")}


def test_a_failure_reports_values_margin_cause_spec_line_and_plot(released) -> None:
    released.edit("arm.xml", 'mass="0.6"', 'mass="0.7"')
    result = released.run("--junitxml=junit.xml")
    result.stdout.fnmatch_lines(
        [
            "*golden/mass/arm@mujoco: gravity_torque of shoulder at reference exceeded its*",
            "  worst * gravity_torque of shoulder at reference",
            "  measured * -4.513 N[*]m",
            "  golden * -4.12 N[*]m",
            "  tolerance * 0.001 N[*]m",
            "  margin * -0.391* N[*]m (used *",
            "  ran because * mujoco/inertia:fore: mass 0.6 -> 0.7 kg",
            "  spec * golden/mass/arm.yaml:10",
            "  plot * .twin/plots/golden/mass/arm@mujoco.svg",
            "  FAIL  gravity_torque  elbow at reference *",
        ]
    )
    assert (released.root / ".twin/plots/golden/mass/arm@mujoco.svg").is_file()
    assert "golden/mass/arm.yaml:10" in (released.root / ".twin/report.html").read_text()
    text = result.stdout.str()
    assert ".py:" not in text.partition("FAILURES")[2]
    case = _junit(released)["arm[mujoco]"]
    failure = case.find("failure")
    assert failure is not None
    assert failure.get("message").startswith("gravity_torque of shoulder at reference exceeded")
    assert len(failure.get("message")) < 200
    assert "\n" not in failure.get("message")
    assert "site-packages" not in ElementTree.tostring(case, "unicode")
    properties = {p.get("name"): p.get("value") for p in case.iter("property")}
    assert properties["kind"] == "mass_properties"
    assert properties["stale_because"] == "mujoco/inertia:fore: mass 0.6 -> 0.7 kg"
    assert properties["margin"].startswith("-0.391")
    assert all(len(value) < 120 for value in properties.values())


def test_the_junit_report_points_to_the_line_of_the_exceeded_tolerance(released) -> None:
    released.edit("arm.xml", 'mass="0.6"', 'mass="0.7"')
    released.run("--junitxml=junit.xml", "-o", "junit_family=xunit1")
    case = _junit(released)["arm[mujoco]"]
    assert case.get("file") == "golden/mass/arm.yaml"
    # The line of the exceeded tolerance, counted from 0 as pytest does.
    assert case.get("line") == "9"


def test_an_advisory_failure_is_reported_and_does_not_block_the_release(recorded) -> None:
    recorded.edit("golden/mass/arm.yaml", "criticality: critical", "criticality: advisory")
    recorded.edit("arm.xml", 'mass="0.6"', 'mass="0.7"')
    result = recorded.run("--twin-release", "--junitxml=junit.xml")
    assert result.ret == 0
    result.stdout.fnmatch_lines(
        [
            "golden/mass/arm.yaml a *",
            "*advisory, blocks nothing*",
            "golden/mass/arm@mujoco: gravity_torque of shoulder at reference exceeded its *",
            "release 0001 signed: *",
            "*1 passed, 1 advisory*",
        ]
    )
    again = recorded.run("--twin-release")
    again.stdout.fnmatch_lines(["*1 advisory*"])
    again.stdout.fnmatch_lines(["release 0001 still holds"])
    skipped = _junit(recorded)["arm[mujoco]"].find("skipped")
    assert skipped is not None
    assert skipped.get("message").startswith("advisory: gravity_torque")


def test_goldens_of_an_invalid_model_fail_with_the_models_error(released) -> None:
    released.edit("arm.xml", 'mass="0.6"', 'mass="-0.6"')
    result = released.run()
    result.assert_outcomes(failed=2)
    assert result.stdout.str().count("arm.xml:10: inertial.mass: negative") >= 2
    result.stdout.fnmatch_lines(["  ran because  mujoco/model: cannot be read"])


def test_last_failed_runs_only_the_failed_goldens(released) -> None:
    released.edit("arm.xml", 'mass="0.6"', 'mass="0.7"')
    released.edit("golden/fk/home.yaml", "position: 0.1 mm", "position: 0.2 mm")
    released.run().assert_outcomes(passed=1, failed=1)
    released.run("--lf").assert_outcomes(failed=1)
