"""--twin-update is the only run that writes goldens."""

from __future__ import annotations

import hashlib

import pytest

from pytest_twin.formats.yaml import load

pytestmark = pytest.mark.usefixtures("gate_in_process")


def test_update_records_values_trace_and_provenance(twin) -> None:
    twin.write(
        "golden/settle.yaml",
        "schema: 1\nkind: settling  # mine\nstimulus: {duration: 0.5 s}\n"
        "tolerance: {angle: 1 mrad, settling_time: 10 ms, energy_growth: 1 J,"
        " penetration: 1 mm}\n",
    )
    result = twin.run("--twin-update", "-k", "settle")
    result.stdout.fnmatch_lines(
        ["golden/settle: recorded for the first time (golden/settle.trace.csv, *"]
    )
    text = (twin.root / "golden/settle.yaml").read_text()
    assert text.startswith("schema: 1\nkind: settling  # mine\n")
    data = load(twin.root / "golden/settle.yaml").data
    trace = (twin.root / "golden" / data["trace"]["file"]).read_bytes()
    assert data["trace"]["sha256"] == hashlib.sha256(trace).hexdigest()
    assert trace.startswith(b"time [s],")
    assert data["provenance"]["realization"] == "mujoco"
    assert data["provenance"]["simulator"].startswith("mujoco ")
    assert {"check", "simulator", "mujoco/inertia"} <= data["provenance"]["parts"].keys()
    assert "expected" not in load(twin.root / "golden/fk/home.yaml").data
    assert twin.run("-k", "settle").ret == 0


def test_update_prints_changed_values_and_the_next_release_runs_them(released) -> None:
    released.edit("arm.xml", 'mass="0.6"', 'mass="0.7"')
    result = released.run("--twin-update")
    result.stdout.fnmatch_lines(
        [
            "golden/fk/home: unchanged",
            "golden/mass/arm: recorded afresh (golden/mass/arm.yaml)",
            "  mass of robot: 1.8 kg -> 1.9 kg (tolerance 0.001 kg)",
            "  mass: 1.8 -> 1.9",
            "1 recorded, 1 unchanged",
        ]
    )
    result = released.run("--twin-release")
    result.assert_outcomes(passed=1, deselected=1)
    result.stdout.fnmatch_lines(["release 0002 signed: *"])


def test_update_does_not_write_unchanged_goldens(recorded) -> None:
    before = {path: path.read_bytes() for path in recorded.root.rglob("*.yaml")}
    recorded.run("--twin-update").stdout.fnmatch_lines(["0 recorded, 2 unchanged"])
    assert {path: path.read_bytes() for path in recorded.root.rglob("*.yaml")} == before
    assert recorded.releases == []


def test_a_non_deterministic_task_is_recorded_and_fails_in_the_next_run(recorded) -> None:
    recorded.task("wild", "import random\nreturn {'reach': random.random()}")
    assert recorded.run("--twin-update", "-k", "wild").ret == 0
    assert recorded.run("-k", "wild").ret == pytest.ExitCode.TESTS_FAILED


def test_a_golden_that_cannot_run_is_not_recorded(twin) -> None:
    twin.edit("golden/fk/home.yaml", "frames: [tcp]", "frames: [tpc]")
    before = (twin.root / "golden/fk/home.yaml").read_text()
    result = twin.run("--twin-update", "-k", "home")
    result.stdout.fnmatch_lines(["*home.yaml:5: target.frames.0: no frame of this name *"])
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    assert (twin.root / "golden/fk/home.yaml").read_text() == before


@pytest.mark.parametrize("value", ["1", "true", "yes"])
def test_update_is_refused_in_ci(recorded, monkeypatch, value) -> None:
    monkeypatch.setenv("CI", value)
    result = recorded.run("--twin-update")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["ERROR: --twin-update refuses to run in CI *"])


def test_no_other_run_writes_a_golden(released) -> None:
    released.edit("arm.xml", 'mass="0.6"', 'mass="0.7"')
    before = {
        path: path.read_bytes() for path in (released.root / "golden").rglob("*") if path.is_file()
    }
    for arguments in (("--twin-release", "--twin-all"), ("--twin-why",)):
        released.run(*arguments)
    after = {
        path: path.read_bytes() for path in (released.root / "golden").rglob("*") if path.is_file()
    }
    assert after == before
