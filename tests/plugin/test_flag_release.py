"""--twin-release: signed results, carried-over results and all reasons for refusal."""

from __future__ import annotations

import json
import shutil

import pytest

from pytest_twin.gate.specs import UNWRITTEN
from pytest_twin.session.selection import selected_by

pytestmark = pytest.mark.usefixtures("gate_in_process")

SETTLE = """\
schema: 1
kind: settling
stimulus: {duration: 0.1 s}
tolerance: {angle: 1 mrad, settling_time: 1 s, energy_growth: 1 J, penetration: 1 mm}
"""


def _results(twin, number: str) -> dict[str, dict[str, object]]:
    results = json.loads((twin.root / "releases" / number / "results.json").read_text())
    return {entry["outcome"]["golden"]: entry for entry in results["goldens"]}


def test_passed_goldens_are_signed_and_an_unchanged_twin_keeps_its_release(recorded) -> None:
    result = recorded.run("--twin-release")
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["twin arm: 2 stale, 0 still proven", "release 0001 signed: *"])
    assert recorded.releases == ["0001"]
    result = recorded.run("--twin-release")
    result.stdout.fnmatch_lines(["2 still proven by release 0001", "release 0001 still holds"])
    assert result.ret == 0
    assert recorded.releases == ["0001"]


def test_a_plain_run_skips_goldens_that_the_release_proves(released) -> None:
    result = released.run()
    result.assert_outcomes(deselected=2)
    result.stdout.fnmatch_lines(["2 still proven by release 0001"])
    assert result.ret == 0


def test_unaffected_results_are_carried_over_with_the_number_of_their_release(released) -> None:
    released.edit("golden/mass/arm.yaml", "mass: 1 g", "mass: 2 g")
    result = released.run("--twin-release")
    result.assert_outcomes(passed=1, deselected=1)
    result.stdout.fnmatch_lines(["1 still proven by release 0001", "release 0002 signed: *"])
    results = _results(released, "0002")
    assert results["golden/fk/home"]["release"] == 1
    assert results["golden/mass/arm"]["release"] == 2
    reasons = results["golden/mass/arm"]["outcome"]["reasons"]
    assert [reason["part"] for reason in reasons] == ["spec:golden/mass/arm"]


def test_comments_and_colours_make_no_golden_stale(released) -> None:
    released.edit("arm.xml", "<worldbody>", "<!-- hello -->\n  <worldbody>")
    released.edit("arm.xml", 'size="0.02"', 'size="0.02" rgba="1 0 0 1"')
    released.edit("golden/fk/home.yaml", "schema: 1", "# hello\nschema: 1")
    released.run("--twin-release").stdout.fnmatch_lines(["release 0001 still holds"])


def test_an_ini_option_enables_the_release(released) -> None:
    released.write("pytest.ini", "[pytest]\ntwin_release = true\n")
    released.run().stdout.fnmatch_lines(["release 0001 still holds"])
    released.run("-o", "twin_release=false").stdout.no_fnmatch_line("*still holds*")


def test_release_and_update_exclude_each_other(recorded) -> None:
    result = recorded.run("--twin-release", "--twin-update")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["ERROR: --twin-release and --twin-update exclude each other: *"])


def test_a_release_without_a_twin_is_a_usage_error(pytester) -> None:
    result = pytester.runpytest_inprocess("--twin-release")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["ERROR: no twin.yaml at, above or below *"])


def assert_release_refused(twin, *words: str, arguments: tuple[str, ...] = ()) -> None:
    """Check that a release is refused for each of ``words`` and that none is signed."""
    before = twin.releases
    result = twin.run("--twin-release", *arguments)
    text = result.stdout.str()
    assert "no release:" in text
    for word in words:
        assert f"  {word}" in text.partition("no release:")[2]
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    assert twin.releases == before


def test_a_critical_failure_refuses_the_release(recorded) -> None:
    recorded.edit("arm.xml", 'mass="0.6"', 'mass="0.7"')
    assert_release_refused(recorded, "golden/mass/arm@mujoco: a critical golden failed")


def test_a_never_recorded_golden_refuses_the_release(twin) -> None:
    assert_release_refused(twin, "golden/fk/home: never recorded: run pytest --twin-update")
    twin.run().stdout.fnmatch_lines(["*golden/fk/home@mujoco: never recorded: run pytest --twin-*"])


REPLAY = """\
schema: 1
kind: replay
target: {recording: rest.csv}
tolerance: {angle_rms: TOLERANCE}
"""


def test_a_replay_golden_is_compared_and_released_without_an_update(recorded) -> None:
    rows = [f"{0.01 * k:.2f},0,0,0,0\n" for k in range(20)]
    columns = ",".join(f"{j}.{c}" for j in ("shoulder", "elbow") for c in ("position", "command"))
    recorded.write("rest.csv", f"time,{columns}\n{''.join(rows)}")
    spec = "golden/replay/rest.yaml"
    recorded.write(spec, REPLAY.replace("TOLERANCE", f"'{UNWRITTEN} 1 rad>'"))
    assert_release_refused(recorded, "golden/replay/rest@mujoco: could not be compared: ")
    recorded.write(spec, REPLAY.replace("TOLERANCE", "0.001 mrad"))
    assert_release_refused(recorded, "golden/replay/rest@mujoco: a critical golden failed")
    recorded.write(spec, REPLAY.replace("TOLERANCE", "1 rad"))
    recorded.run("--twin-release").stdout.fnmatch_lines(["release 0001 signed: *"])
    assert "golden/replay/rest" in _results(recorded, "0001")
    # A change of the model makes it stale, as one of a recorded golden.
    recorded.edit("arm.xml", 'kp="40"', 'kp="41"')
    recorded.run("--twin-why").stdout.fnmatch_lines(["stale  golden/replay/rest@mujoco"])


def test_a_trace_without_a_spec_refuses_the_release(released) -> None:
    released.write("golden/old.trace.csv", "time [s]\n0\n")
    assert_release_refused(released, "golden/old.trace.csv: no spec refers to this trace")


def test_a_missing_golden_refuses_the_release_until_it_is_retired(released) -> None:
    (released.root / "golden/fk/home.yaml").unlink()
    assert_release_refused(
        released, "golden/fk/home: no spec: restore it, or give a reason under 'retired:'"
    )
    released.edit(
        "twin.yaml", "retired:\n", "retired:\n  golden/fk/home: replaced by a better one\n"
    )
    released.run("--twin-release").stdout.fnmatch_lines(["release 0002 signed: *"])
    assert list(_results(released, "0002")) == ["golden/mass/arm"]


def test_a_twin_without_goldens_refuses_the_release(released) -> None:
    shutil.rmtree(released.root / "golden")
    assert_release_refused(
        released, "golden/fk/home: no spec", "golden/mass/arm: no spec", "no golden"
    )


def test_a_non_finite_advisory_result_refuses_the_release(recorded) -> None:
    recorded.task("odd", "return {'reach': 1.0}", criticality="advisory")
    assert recorded.run("--twin-update", "-k", "odd").ret == 0
    recorded.write("odd.py", "def run(realization):\n    return {'reach': float('nan')}\n")
    assert_release_refused(recorded, "golden/task/odd@mujoco: could not be compared: ")


def test_a_failing_ordinary_test_refuses_the_release(released) -> None:
    released.write("test_a.py", "def test_b(): assert False")
    assert_release_refused(released, "test_a.py::test_b: an ordinary test failed in the same run")


def test_an_invalid_spec_refuses_the_release(released) -> None:
    released.write("golden/b.yaml", "schema: 1\nkind: teleport\n")
    result = released.run("--twin-release", "--continue-on-collection-errors")
    result.stdout.fnmatch_lines(["no release:", "  could not be collected: *b.yaml:2: kind: *"])
    assert result.ret != 0
    assert released.releases == ["0001"]


def test_an_invalid_spec_is_reported_once(released) -> None:
    released.edit("golden/fk/home.yaml", "kind: fk", "kind: teleport")
    released.write("golden/fk/home.trace.csv", "time [s]\n0\n")
    result = released.run("--twin-release", "--continue-on-collection-errors")
    refusal = result.stdout.str().partition("no release:")[2]
    assert "home.yaml:2: kind: unknown kind (got 'teleport'" in refusal
    assert "missing" not in refusal
    assert "delete it" not in refusal


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("-k", "home"), "-k 'home', 1 deselected"),
        (("golden/fk/home.yaml::home[mujoco]",), "golden/fk/home.yaml::home[mujoco]"),
        (("golden/fk",), "golden/fk"),
    ],
)
def test_a_run_of_a_subset_is_never_released(released, arguments, words) -> None:
    assert_release_refused(
        released,
        f"only a full run is released, and this one selected: {words}",
        arguments=arguments,
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("-m", "fk"), "-m 'fk'"),
        (("--lf",), "--lf"),
        (("--sw",), "--stepwise"),
        (("--deselect", "a.yaml"), "--deselect a.yaml"),
        (("--ignore", "golden/fk"), "--ignore golden/fk"),
        (("--ignore-glob", "*fk*"), "--ignore-glob *fk*"),
    ],
)
def test_options_that_select_a_subset_are_recognized(pytester, arguments, words) -> None:
    assert selected_by(pytester.parseconfigure(*arguments)) == (words,)


def test_an_aborted_run_refuses_the_release(recorded) -> None:
    recorded.write("test_a.py", "def test_b(): assert False\ndef test_c(): pass\n")
    recorded.edit("arm.xml", 'mass="0.6"', 'mass="0.7"')
    assert_release_refused(
        recorded, "the run was stopped: stopping after 1 failures", arguments=("-x",)
    )


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("open('arm.xml', 'a').write('<!-- -->')", "arm.xml"),
        ("open('golden/fk/home.yaml', 'a').write('# \\n')", "golden/fk/home.yaml"),
        ("open('golden/more.yaml', 'w').write('a: 1')", "golden/more.yaml: a new spec"),
    ],
)
def test_a_file_changed_during_the_run_refuses_the_release(recorded, code, words) -> None:
    recorded.write("test_zz.py", f"def test_sabotage():\n    {code}\n")
    assert_release_refused(recorded, f"changed during the run: {recorded.root}/{words}")


def test_a_package_version_changed_during_the_run_refuses_the_release(recorded) -> None:
    recorded.write(
        "test_zz.py",
        "from importlib import metadata\n"
        "true = metadata.version\n"
        "def test_sabotage(monkeypatch_session=None):\n"
        "    metadata.version = lambda name: '9.9' if name == 'pin' else true(name)\n",
    )
    result = recorded.run_apart("--twin-release")
    result.stdout.fnmatch_lines(["  changed during the run: library:pin * -> 9.9"])
    assert recorded.releases == []


def test_two_twins_in_one_run_get_separate_verdicts(released, pytester) -> None:
    shutil.copytree(released.root, pytester.path / "other")
    (pytester.path / "other" / "golden" / "fk" / "home.yaml").unlink()
    result = pytester.runpytest_inprocess(
        "-p", "no:xdist", "--twin-release", str(released.root), str(pytester.path / "other")
    )
    result.stdout.fnmatch_lines(["release 0001 still holds", "*golden/fk/home: no spec: *"])
    assert result.ret == pytest.ExitCode.TESTS_FAILED


def test_an_edited_or_deleted_trace_refuses_the_release(released) -> None:
    released.write("golden/settle.yaml", SETTLE)
    assert released.run("--twin-update", "-k", "settle").ret == 0
    released.run("--twin-release").stdout.fnmatch_lines(["release 0002 signed: *"])
    trace = released.root / "golden/settle.trace.csv"
    text = trace.read_text()
    trace.write_text(text.replace(text.splitlines()[-1], text.splitlines()[-1] + "1"))
    result = released.run("--twin-why")
    result.stdout.fnmatch_lines(
        ["stale  golden/settle@mujoco", "         trace:golden/settle: sha256 * -> *"]
    )
    assert_release_refused(released, f"golden/settle@mujoco: could not be compared: {trace}: ")
    trace.unlink()
    assert_release_refused(
        released, f"golden/settle@mujoco: could not be compared: {trace}: no such file"
    )
