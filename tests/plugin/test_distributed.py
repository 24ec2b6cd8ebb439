"""With pytest-xdist verdict and release equal those of a run in one process."""

from __future__ import annotations

import json


def _proofs(twin, number: str) -> list[object]:
    results = json.loads((twin.root / "releases" / number / "results.json").read_text())
    for proof in results["goldens"]:
        del proof["at"], proof["outcome"]["seconds"]
    return results["goldens"]


def test_a_distributed_run_signs_the_same_results(recorded, released) -> None:
    """``recorded`` and ``released`` share one folder: the released twin is the recorded one."""
    result = recorded.run_apart("-n", "2", "--twin-release", "--twin-all")
    result.stdout.fnmatch_lines(["release 0002 signed: *"])
    result.assert_outcomes(passed=2)
    one, two = _proofs(released, "0001"), _proofs(released, "0002")
    for proof in (*one, *two):
        proof["release"] = 0
        proof["outcome"]["reasons"] = []
    assert one == two
    result = released.run_apart("-n", "2", "--twin-release")
    result.stdout.fnmatch_lines(["2 still proven by release 0002", "release 0002 still holds"])
    assert result.ret == 0


def test_a_distributed_run_refuses_with_the_same_messages(released) -> None:
    released.edit("arm.xml", 'mass="0.6"', 'mass="0.7"')
    released.write("test_a.py", "def test_b(): assert False")
    alone = released.run_apart("--twin-release", "--junitxml=alone.xml")
    spread = released.run_apart("-n", "2", "--twin-release", "--junitxml=spread.xml")

    def reasons(result) -> list[str]:
        lines = result.outlines
        start = next(i for i, line in enumerate(lines) if line == "no release:")
        return [line for line in lines[start:] if line.startswith("  ")]

    assert reasons(alone) == reasons(spread)
    assert alone.ret == spread.ret == 1
    for result in (alone, spread):
        result.stdout.fnmatch_lines(["  ran because * mujoco/inertia:fore: mass 0.6 -> 0.7 kg"])
        result.stdout.fnmatch_lines(["FAILED golden/mass/arm.yaml::* - gravity_torque of *"])
    message = (released.root / "spread.xml").read_text()
    assert 'message="gravity_torque of shoulder' in message


def test_a_distributed_run_of_a_subset_is_never_released(released) -> None:
    result = released.run_apart("-n", "2", "--twin-release", "-k", "home")
    result.stdout.fnmatch_lines(
        ["  only a full run is released, and this one selected: -k 'home', 1 deselected"]
    )
    assert result.ret == 1


def test_a_distributed_update_records_all_goldens(twin) -> None:
    result = twin.run_apart("-n", "2", "--twin-update")
    result.stdout.fnmatch_lines(["2 recorded, 0 unchanged"])
    assert twin.run().ret == 0


def test_a_distributed_run_supports_why_and_refuses_an_aborted_run(released) -> None:
    released.edit("arm.xml", 'mass="0.6"', 'mass="0.7"')
    result = released.run_apart("-n", "2", "--twin-why")
    result.stdout.fnmatch_lines(["stale  golden/mass/arm@mujoco", "1 stale, 1 fresh"])
    assert result.ret == 0
    result = released.run_apart("-n", "2", "-x", "--twin-release")
    result.stdout.fnmatch_lines(["  the run was stopped: stopping after 1 failures"])
    assert result.ret != 0
    assert released.releases == ["0001"]
