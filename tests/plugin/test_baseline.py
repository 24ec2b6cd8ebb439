"""The last signed release as the baseline: one that does not hold proves nothing."""

from __future__ import annotations

import shutil
from pathlib import Path


def test_a_damaged_release_proves_nothing_and_is_said_loudly(released) -> None:
    path = released.root / "releases" / "0001" / "results.json"
    path.write_bytes(path.read_bytes().replace(b"passed", b"pasted", 1))
    result = released.run()
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["release 1 does not hold: *results.json*"])


def test_a_foreign_release_proves_nothing(released) -> None:
    for key in (released.root / "keys").glob("*.pub"):
        key.unlink()
    result = released.run()
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["release 1 does not hold: *"])


def test_a_damaged_release_still_says_which_goldens_there_were(released) -> None:
    (released.root / "releases" / "0001" / "results.json").write_text("{}")
    (released.root / "golden/fk/home.yaml").unlink()
    result = released.run("--twin-release")
    result.stdout.fnmatch_lines(["  golden/fk/home: no spec: *"])
    assert released.releases == ["0001"]


def test_the_cache_of_a_copied_twin_proves_nothing(released, pytester, monkeypatch) -> None:
    released.run("--twin-why")
    copy: Path = pytester.path / "copy"
    shutil.copytree(released.root, copy)
    model = copy / "arm.xml"
    model.write_text(model.read_text().replace('mass="0.6"', 'mass="0.7"'))
    monkeypatch.chdir(copy)
    result = released.run("--twin-why")
    result.stdout.fnmatch_lines(["         mujoco/inertia:fore: mass 0.6 -> 0.7 kg"])
