"""The last signed release is the baseline; an invalid release proves no golden."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("gate_in_process")


def test_with_a_damaged_release_all_goldens_run_and_a_warning_is_printed(released) -> None:
    path = released.root / "releases" / "0001" / "results.json"
    path.write_bytes(path.read_bytes().replace(b"passed", b"pasted", 1))
    result = released.run()
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["release 1 does not hold: *results.json*"])


def test_with_a_release_of_an_untrusted_key_all_goldens_run(released) -> None:
    for key in (released.root / "keys").glob("*.pub"):
        key.unlink()
    result = released.run()
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["release 1 does not hold: *"])


def test_a_damaged_release_still_lists_the_goldens_that_must_exist(released) -> None:
    (released.root / "releases" / "0001" / "results.json").write_text("{}")
    (released.root / "golden/fk/home.yaml").unlink()
    result = released.run("--twin-release")
    result.stdout.fnmatch_lines(["  golden/fk/home: no spec: *"])
    assert released.releases == ["0001"]


def test_the_cache_of_a_copied_twin_is_not_trusted(released, pytester, monkeypatch) -> None:
    released.run("--twin-why")
    copy: Path = pytester.path / "copy"
    shutil.copytree(released.root, copy)
    model = copy / "arm.xml"
    model.write_text(model.read_text().replace('mass="0.6"', 'mass="0.7"'))
    monkeypatch.chdir(copy)
    result = released.run("--twin-why")
    result.stdout.fnmatch_lines(["         mujoco/inertia:fore: mass 0.6 -> 0.7 kg"])
