"""A record whose inputs changed: its goldens are stale, and no release is signed."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from pytest_twin import cli
from pytest_twin.commands import fresh, verify
from pytest_twin.commands import stamp as stamp_command
from pytest_twin.formats.mcap import write_recording
from pytest_twin.realization import load
from pytest_twin.realization.record_inputs import basis_json
from pytest_twin.records.basis import Uses
from pytest_twin.twin import load_twin

sys.path.append(str(Path(__file__).parents[1]))

from in_process import InProcess

pytestmark = pytest.mark.usefixtures("gate_in_process")


@pytest.fixture
def fitted(released, monkeypatch: pytest.MonkeyPatch):
    """The released twin with a record of an identification, in release 0002."""
    for command in (fresh, verify, stamp_command):
        if hasattr(command, "Sandbox"):
            monkeypatch.setattr(command, "Sandbox", InProcess)
    root = released.root
    twin = load_twin(root / "twin.yaml")
    uses = Uses(joints=("shoulder", "elbow"))
    source = load(twin.first_realization.file, twin=twin)
    folder = root / "identified"
    folder.mkdir()
    record = {
        "schema": 1,
        "identification": "identified",
        "verdict": "accepted",
        "stages": [],
        "parameters": {},
        "covariance": {"names": [], "matrix": []},
        "held_out": {},
        "trials": {"fit": [], "held_out": []},
        "fit": {"body": {"fore": {"mass": 0.7}}},
        "basis": basis_json(source, uses, twin, folder, {}, has_twin=True),
    }
    (folder / "identification.json").write_text(json.dumps(record))
    released.edit(
        "twin.yaml", "tcp: tcp\n", "tcp: tcp\nfit:\n- {file: identified/identification.json}\n"
    )
    assert released.run("--twin-update").ret == 0
    assert released.run("--twin-release").ret == 0
    assert released.releases == ["0001", "0002"]
    return released


def run(twin, capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    status = cli.main([*arguments])
    return status, capsys.readouterr().out


def test_a_masked_change_is_reported_everywhere_and_blocks_the_release(
    fitted, capsys: pytest.CaptureFixture[str]
) -> None:
    data = fitted.root.parent / "data.mcap"
    write_recording(data, [], {"role": "fit"})
    assert cli.main(["stamp", str(data), "--release", str(fitted.root)]) == 0
    fitted.edit("arm.xml", "<worldbody>", "<worldbody><!-- a comment -->")
    assert "release 0002 still holds" in fitted.run("--twin-release").stdout.str()

    fitted.edit("arm.xml", 'mass="0.6"', 'mass="0.642"')
    change = "inertia:fore: mass 0.6 -> 0.642 kg"
    stale = f"record 'identified' is stale: its inputs changed: {change} (expected"
    why = fitted.run("--twin-why").stdout.str()
    assert "1 stale, 1 fresh" in why
    assert f"identified, made with {change}" in why
    plain = fitted.run()
    assert plain.ret == 0
    assert plain.stdout.str().count(stale) == 1
    refused = fitted.run("--twin-release")
    assert refused.ret == 1
    assert "no release:" in refused.stdout.str()
    assert stale in refused.stdout.str()
    assert fitted.releases == ["0001", "0002"]
    capsys.readouterr()
    status, output = run(fitted, capsys, "fresh", str(data), "--twin", str(fitted.root))
    assert status == 1
    assert f"matters: basis:identified: {change}" in output
    status, output = run(fitted, capsys, "verify", str(fitted.root))
    assert status == 1
    assert stale in output
    # The release itself is as it was signed.
    assert run(fitted, capsys, "verify", str(fitted.root / "releases" / "0002"))[0] == 0


def test_the_statement_of_the_owner_is_released(fitted, capsys: pytest.CaptureFixture[str]) -> None:
    fitted.edit("arm.xml", 'mass="0.6"', 'mass="0.642"')
    line = next(line for line in fitted.run().stdout.str().splitlines() if "unaffected: [" in line)
    statement = line[line.index("unaffected: [") : -1].replace("WHY", "a label of 42 g")
    fitted.edit("twin.yaml", "identification.json}", f"identification.json, {statement}}}")
    run_again = fitted.run("--twin-release")
    assert run_again.ret == 0
    assert "release 0003 signed" in run_again.stdout.str()
    assert "release 0003 still holds" in fitted.run("--twin-release").stdout.str()
    assert cli.main(["verify", str(fitted.root)]) == 0
