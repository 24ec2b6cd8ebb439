"""The audit as a golden: critical findings fail it unless the twin accepts each by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from pytest_twin.checks.asset import AssetAudit, audit_spec
from pytest_twin.checks.assumed_values import assumed_values
from pytest_twin.checks.mass_properties import MassProperties
from pytest_twin.errors import SpecError
from pytest_twin.gate.specs import load_golden
from pytest_twin.outcome import Measure, Outcome
from pytest_twin.realization import Realization, load
from pytest_twin.report.failure import failure_text
from pytest_twin.staleness import twin_parts
from pytest_twin.twin import Twin, load_twin

CHECK = AssetAudit()
LINK = (
    "<link name='{name}'>{mass}"
    "<collision><geometry><box size='.1 .1 .2'/></geometry></collision></link>"
)
MASS = """<inertial><mass value='2'/>
<inertia ixx='.008' iyy='.008' izz='.004' ixy='0' ixz='0' iyz='0'/></inertial>"""
JOINT = """<joint name='{name}' type='revolute'><parent link='{parent}'/><child link='{child}'/>
<origin xyz='0 0 .3'/><axis xyz='0 1 0'/><limit lower='-1' upper='1' velocity='2'
effort='{effort}'/></joint>"""
FINDING = "inertia.moving_without:link 'upper'"


def twin_of(folder: Path, *, mass: str = "", more: str = "", effort: float = 10.0) -> Twin:
    """A twin of a URDF arm with two links; the upper one has the given ``<inertial>``."""
    (folder / "arm.urdf").write_text(
        "<robot name='arm'>\n<link name='base'/>\n"
        + LINK.format(name="upper", mass=mass)
        + "\n"
        + LINK.format(name="fore", mass=MASS)
        + "\n"
        + JOINT.format(name="shoulder", parent="base", child="upper", effort=effort)
        + JOINT.format(name="elbow", parent="upper", child="fore", effort=effort)
        + "</robot>"
    )
    (folder / "twin.yaml").write_text(f"model: arm.urdf\n{more}")
    (folder / "golden").mkdir(exist_ok=True)
    (folder / "golden/audit.yaml").write_text("schema: 1\nkind: asset\n")
    return load_twin(folder / "twin.yaml")


def realization_of(twin: Twin) -> Realization:
    return load(twin.first_realization.file, twin=twin)


def audited(twin: Twin) -> list[Measure]:
    golden = load_golden(twin.root / "golden/audit.yaml", twin)
    observation = CHECK.observe(golden, realization_of(twin), lambda done: None)
    assert CHECK.expect(golden, observation) == ({}, None)
    return CHECK.compare(golden, observation, None)


def test_a_file_without_critical_findings_passes(tmp_path: Path) -> None:
    (summary,) = audited(twin_of(tmp_path, mass=MASS))
    assert summary.passed
    assert summary.subject == (
        "arm.urdf: no critical finding; warnings and values that nobody states: "
        "pytest-twin audit arm.urdf"
    )


def test_each_critical_finding_fails_with_its_name_and_line(tmp_path: Path) -> None:
    summary, finding = audited(twin_of(tmp_path))
    assert not summary.passed
    assert not finding.passed
    assert finding.subject == (
        f"{FINDING}: joint 'shoulder' moves it, and it has no mass (arm.urdf:3)"
    )
    outcome = Outcome("golden/audit", "asset", "mujoco", "critical", "failed", (summary, finding))
    text = failure_text(outcome, location="golden/audit.yaml:2")
    assert "1 critical finding that nobody accepts" in text.splitlines()[0]
    assert "accepted_findings:" in text
    assert "tolerance" not in text


def test_a_finding_that_is_accepted_by_name_passes_with_reason_and_owner(tmp_path: Path) -> None:
    accepted = f"""accepted_findings:
  - findings: ["{FINDING}"]
    reason: the data sheet states no mass of the upper arm
    owner: A. Nowak
"""
    twin = twin_of(tmp_path, more=accepted)
    summary, finding = audited(twin)
    assert summary.passed
    assert "no critical finding besides 1 that the twin accepts" in summary.subject
    assert finding.passed
    assert finding.subject.endswith(
        "accepted by A. Nowak: the data sheet states no mass of the upper arm"
    )
    parts = twin_parts(twin, lambda file: None)
    assert parts["accepted:findings"].content[FINDING]["owner"] == "A. Nowak"


def test_another_finding_than_the_accepted_one_fails(tmp_path: Path) -> None:
    other = FINDING.replace("upper", "fore")
    accepted = f'accepted_findings:\n  - {{findings: ["{other}"], reason: old, owner: A. Nowak}}\n'
    summary, _ = audited(twin_of(tmp_path, more=accepted))
    assert not summary.passed


@pytest.mark.parametrize("left_out", ["reason", "owner", "findings"])
def test_an_acceptance_without_name_reason_or_owner_is_refused(
    left_out: str, tmp_path: Path
) -> None:
    entry = {"findings": f'["{FINDING}"]', "reason": "known", "owner": "A. Nowak"}
    del entry[left_out]
    words = ", ".join(f"{key}: {value}" for key, value in entry.items())
    with pytest.raises(SpecError, match=left_out):
        twin_of(tmp_path, more=f"accepted_findings:\n  - {{{words}}}\n")


def test_the_audit_covers_every_realization_whose_file_it_reads(tmp_path: Path) -> None:
    twin = twin_of(tmp_path, more="realizations: {copy: {file: arm.urdf}}\n")
    spec = audit_spec(twin)
    assert spec is not None
    assert spec["realizations"] == ["mujoco", "copy"]


def test_values_that_nothing_states_are_listed(tmp_path: Path) -> None:
    lines = assumed_values(realization_of(twin_of(tmp_path)))
    assert lines == (
        "no mass is stated for 1 link (upper): the simulator takes 1e-12 kg",
        "no friction and no damping is stated for 2 joints (shoulder, elbow): they have none",
        "no rotor inertia is stated for 2 joints (shoulder, elbow): they have none",
        "no gains are stated: the drives take torques or forces, and nothing holds a pose",
        "2 of 2 collision shapes have MuJoCo's default contact friction, 1",
    )
    assert assumed_values(realization_of(twin_of(tmp_path, effort=0.0)))[3] == (
        "no drive is stated: nothing moves or holds a joint"
    )


def test_masses_that_mujoco_computes_or_raises_are_listed(tmp_path: Path) -> None:
    path = tmp_path / "m.xml"
    path.write_text(
        """<mujoco><compiler boundmass="0.5"/><worldbody>
        <body name="a"><joint name="j" damping="1" armature="0.1"/>
        <geom type="box" size=".1 .1 .1" friction="0.8"/></body>
        <body name="b"><geom type="box" size=".1 .1 .1" mass="2" friction="0.8"/></body>
        <body name="c"><geom type="sphere" size=".01" mass=".01" friction="0.8"/></body>
        </worldbody><actuator><position name="j" joint="j" kp="1"/></actuator></mujoco>"""
    )
    assert assumed_values(load(path)) == (
        "boundmass raises the mass of 1 link (c) to 0.5 kg",
        "no mass is stated for 1 link (a): the simulator computes mass and inertia from the shapes "
        "with 1000 kg/m^3",
    )


def test_no_golden_records_a_mass_that_the_robot_does_not_state(tmp_path: Path) -> None:
    twin = twin_of(tmp_path)
    path = tmp_path / "golden/mass.yaml"
    path.write_text(
        "schema: 1\nkind: mass_properties\ntarget: {bodies: [upper]}\n"
        "stimulus: {poses: [reference]}\ntolerance: {mass: 1 g, center_of_mass: 1 mm}\n"
    )
    golden, loaded = load_golden(path, twin), realization_of(twin)
    with pytest.raises(SpecError, match=r"target.bodies.0: upper has no mass \(got 1e-12 kg"):
        MassProperties().observe(golden, loaded, lambda done: None)
    loaded.model.body_mass[:] = 1e-12
    with pytest.raises(SpecError, match=r"target: the robot has no mass"):
        MassProperties().observe(golden, loaded, lambda done: None)
