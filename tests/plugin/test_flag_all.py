"""--twin-all: runs what the last release still proves too."""

from __future__ import annotations


def test_everything_runs(released) -> None:
    released.run("--twin-all").assert_outcomes(passed=2)


def test_everything_runs_and_is_signed_again(released) -> None:
    released.write("pytest.ini", "[pytest]\ntwin_all = true\n")
    result = released.run("--twin-release")
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["release 0002 signed: *"])
