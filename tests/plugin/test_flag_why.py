"""--twin-why reports which goldens are stale and why, and runs none."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.usefixtures("gate_in_process")


def test_why_names_the_changed_part_with_old_and_new_value(released) -> None:
    released.edit("arm.xml", 'mass="0.6"', 'mass="0.7"')
    released.write("test_a.py", "def test_b(): assert False")
    result = released.run("--twin-why")
    result.stdout.fnmatch_lines(
        [
            "*twin arm: fresh or stale, and why*",
            "fresh  golden/fk/home@mujoco  proven in release 0001",
            "stale  golden/mass/arm@mujoco",
            "         mujoco/inertia:fore: mass 0.6 -> 0.7 kg",
            "1 stale, 1 fresh",
        ]
    )
    result.assert_outcomes(deselected=3)
    assert result.ret == pytest.ExitCode.OK


def test_without_a_release_all_goldens_are_stale(recorded) -> None:
    recorded.write("pytest.ini", "[pytest]\ntwin_why = true\n")
    result = recorded.run()
    result.stdout.fnmatch_lines(["stale  golden/fk/home@mujoco", "         no release yet"])


def test_why_lists_missing_goldens_and_orphaned_traces(released) -> None:
    (released.root / "golden/fk/home.yaml").unlink()
    released.write("golden/old.trace.csv", "time [s]\n0\n")
    result = released.run("--twin-why")
    result.stdout.fnmatch_lines(["missing  golden/fk/home", "orphaned trace  golden/old.trace.csv"])
