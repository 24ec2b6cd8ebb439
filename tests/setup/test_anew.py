"""``init`` on a twin proposes the goldens that fit its present model and drives."""

from __future__ import annotations

import json
import re
from pathlib import Path

import jsonschema
import pytest

from pytest_twin.cli import main
from pytest_twin.formats.schema import load_schema

pytestmark = pytest.mark.usefixtures("commands_in_process")

LINK = """<link name='{name}'><inertial><origin xyz='0 0 .1'/><mass value='1'/>
<inertia ixx='.004' iyy='.004' izz='.001' ixy='0' ixz='0' iyz='0'/></inertial></link>"""
ARM = f"""<robot name='arm'><link name='base'/>{LINK.format(name="upper")}{LINK.format(name="fore")}
<joint name='shoulder' type='revolute'><parent link='base'/><child link='upper'/>
<axis xyz='0 1 0'/><limit lower='-1' upper='1' velocity='2' effort='20'/>
<dynamics damping='.5'/></joint>
<joint name='elbow' type='revolute'><parent link='upper'/><child link='fore'/>
<origin xyz='0 0 .3'/><axis xyz='0 1 0'/><limit lower='-1' upper='1' velocity='2' effort='10'/>
<dynamics damping='.5'/></joint></robot>"""
MASSLESS = re.sub("<inertial>.*?</inertial>", "", ARM, flags=re.DOTALL)


def test_goldens_that_no_longer_fit_the_drives_are_proposed_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "arm.urdf").write_text(ARM)
    assert main(["init", str(tmp_path / "arm.urdf"), "--out", str(tmp_path)]) == 0
    golden = tmp_path / "golden"
    mine = golden / "fk/frames.yaml"
    mine.write_text(mine.read_text().replace("kind: fk", "kind: fk  # checked by hand"))
    twin_file = tmp_path / "twin.yaml"
    servos = "fit: {id: servos, actuator: {shoulder: {kp: 80, kv: 4}, elbow: {kp: 40, kv: 2}}}\n"
    twin_file.write_text(f"{twin_file.read_text()}{servos}")
    capsys.readouterr()
    assert main(["init", str(twin_file)]) == 0
    said = capsys.readouterr().out
    for name in ("step/shoulder", "step/elbow"):
        assert "command: position" in (golden / f"{name}.yaml").read_text()
        assert f"proposed: golden/{name}\n" in said
    assert "checked by hand" in mine.read_text()
    assert "FAILS" not in said
    # A second call finds nothing to replace.
    assert main(["init", str(twin_file), "--json", "-"]) == 0
    fields = json.loads(capsys.readouterr().out)
    jsonschema.validate(fields, load_schema("results/init.schema.json"))
    assert fields["goldens"] == []
    assert fields["replaced"] == fields["cannot_be_compared"] == {}


def test_a_twin_takes_no_recordings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "twin.yaml").write_text("model: arm.urdf\n")
    assert main(["init", str(tmp_path / "twin.yaml"), "moves.mcap"]) == 2
    assert "takes no recording" in capsys.readouterr().err


def test_the_audit_of_a_robot_without_masses_fails_and_the_twin_lists_its_findings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bare.urdf").write_text(MASSLESS)
    assert main(["init", str(tmp_path / "bare.urdf"), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "FAILS now: golden/asset/audit: bare.urdf: 2 critical findings" in said
    assert not (tmp_path / "golden/mass_properties").exists()
    text = (tmp_path / "twin.yaml").read_text()
    assert "# accepted_findings:" in text
    assert "inertia.moving_without:link 'upper'" in text
