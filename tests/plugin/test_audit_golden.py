"""The audit in the gate: it blocks a release, is added by an update, and a release states gaps."""

from __future__ import annotations

import json

import pytest

from pytest_twin.cli import main
from pytest_twin.outcome import Outcome

pytestmark = pytest.mark.usefixtures("gate_in_process")

AUDITED = "name: arm\nmodel: arm.xml\ntcp: tcp\n"
SETTLE = """\
schema: 1
kind: settling
stimulus: {duration: 0.1 s}
tolerance: {angle: 1 mrad, settling_time: 1 s, energy_growth: 1 J, penetration: 1 mm}
"""
NOT_AUDITED = (
    "not audited: no golden of kind asset checks the model's file; pytest --twin-update adds one "
    "for a URDF, MJCF or USD file"
)
THIN = "thin: * goldens, and none compares motion over time with a record (*settling*)"


def summary_of(result: pytest.RunResult) -> list[str]:
    """Lines below the heading of the twin."""
    lines = result.outlines
    (at,) = (i for i, line in enumerate(lines) if line.strip("= ") == "twin arm")
    return lines[at + 1 :]


def test_an_update_adds_the_audit_and_the_release_states_what_is_assumed(recorded) -> None:
    first = summary_of(recorded.run("--twin-release"))
    assert first[0] == NOT_AUDITED
    assert first[1].startswith("thin: 2 goldens, and none compares motion over time")
    recorded.write("twin.yaml", AUDITED)
    recorded.run("--twin-update", "golden/fk")
    assert not (recorded.root / "golden/asset").exists()
    recorded.write("golden/settle.yaml", SETTLE)
    result = recorded.run("--twin-update")
    result.stdout.fnmatch_lines(["*golden/asset/audit.yaml: a new golden, which audits the model"])
    result = recorded.run("--twin-release")
    result.stdout.fnmatch_lines(
        [
            "assumed: no rotor inertia is stated for 2 joints (shoulder, elbow): they have none",
            "release 0002 signed: *",
        ]
    )
    result.stdout.no_fnmatch_line("*audited*")
    result.stdout.no_fnmatch_line("thin: *")
    text = (recorded.root / "releases/0002/results.json").read_text()
    outcomes = [Outcome.from_json(entry["outcome"]) for entry in json.loads(text)["goldens"]]
    (audit,) = (outcome for outcome in outcomes if outcome.kind == "asset")
    assert audit.notes[0].startswith("no rotor inertia")
    page = (recorded.root / "releases/0002/report.html").read_text()
    assert "no rotor inertia is stated for 2 joints" in page


def test_a_release_with_gaps_states_them_in_verify_and_in_the_report(
    released, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert main(["verify", "."]) == 0
    first, *rest = capsys.readouterr().out.splitlines()
    assert first == "holds: release 1 of 'arm', not audited, no motion tested"
    assert f"  {NOT_AUDITED}" in rest
    page = (released.root / "releases/0001/report.html").read_text()
    assert "not audited; no motion tested; 2 ran" in page


def test_a_critical_finding_blocks_the_release_until_it_is_accepted_or_corrected(recorded) -> None:
    recorded.write("twin.yaml", AUDITED)
    recorded.edit("arm.xml", '<compiler angle="radian"/>', "")
    recorded.run("--twin-update")
    result = recorded.run("--twin-release")
    result.stdout.fnmatch_lines(
        ["*1 critical finding that nobody accepts, such as joints.range_radians:joint 'shoulder'*"]
    )
    result.stdout.fnmatch_lines(["  golden/asset/audit@mujoco: a critical golden failed"])
    result.stdout.no_fnmatch_line("*advisory only*")
    assert recorded.releases == []
    recorded.write(
        "twin.yaml",
        AUDITED
        + "accepted_findings:\n"
        + "  - findings: [\"joints.range_radians:joint 'shoulder'\"]\n"
        + "    reason: a test\n    owner: A. Nowak\n",
    )
    recorded.run("--twin-release").stdout.fnmatch_lines(["release 0001 signed: *"])
    recorded.write("twin.yaml", AUDITED)
    result = recorded.run("--twin-release")
    result.stdout.fnmatch_lines(["*accepted:findings*"])
    assert recorded.releases == ["0001"]
    recorded.edit("golden/asset/audit.yaml", "kind: asset", "kind: asset\ncriticality: advisory")
    result = recorded.run("--twin-release")
    result.stdout.fnmatch_lines(["critical findings, advisory only: arm.xml: 1 critical finding*"])
    assert recorded.releases == ["0001", "0002"]


def test_an_element_that_no_simulator_compiles_makes_only_the_audit_stale(recorded) -> None:
    recorded.write("twin.yaml", AUDITED)
    recorded.run("--twin-update")
    recorded.run("--twin-release")
    recorded.edit("arm.xml", "<worldbody>", "<!-- hello -->\n  <worldbody>")
    recorded.edit("arm.xml", 'size="0.02"', 'rgba="1 0 0 1" size="0.02"')
    recorded.run("--twin-why").stdout.fnmatch_lines(["0 stale, 3 fresh"])
    recorded.edit("arm.xml", "</mujoco>", "<custom/></mujoco>")
    result = recorded.run("--twin-why")
    result.stdout.fnmatch_lines(
        ["stale  golden/asset/audit@mujoco", "*mujoco/elements*", "1 stale, 2 fresh"]
    )


@pytest.mark.parametrize("result", ["diagnosis.json", "identification.json"])
def test_the_fitted_model_of_a_result_in_the_twins_folder_is_no_twin(released, result: str) -> None:
    released.write(f"found/{result}", "{}")
    released.write("found/realization/model.xml", (released.root / "arm.xml").read_text())
    released.write("found/realization/twin.yaml", "name: other_twin\nmodel: model.xml\n")
    run = released.run("--twin-release")
    run.stdout.fnmatch_lines(["release 0001 still holds"])
    run.stdout.no_fnmatch_line("*other_twin*")
    assert run.ret == 0
