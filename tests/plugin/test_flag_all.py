"""--twin-all also runs goldens that the last release still proves."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.usefixtures("gate_in_process")


def test_all_goldens_run(released) -> None:
    released.run("--twin-all").assert_outcomes(passed=2)


def test_all_goldens_run_and_are_signed_in_a_new_release(released) -> None:
    released.write("pytest.ini", "[pytest]\ntwin_all = true\n")
    result = released.run("--twin-release")
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["release 0002 signed: *"])
