"""A kind of golden from someone else's package: one file and one entry point."""

from __future__ import annotations

import pytest
from wheels import ENTRY_POINTS, KIND, PHYSICS, SPEC, pip_install, wheel


@pytest.fixture
def with_kind(recorded, monkeypatch):
    """A recorded twin in an environment where a foreign kind is installed."""
    folder = recorded.pytester.path
    site = folder / "site"
    pip_install(
        [
            wheel(folder, "box_rest", "0.3", KIND, ENTRY_POINTS),
            wheel(folder, "boxphysics", "1.0", PHYSICS["1.0"]),
        ],
        site,
    )
    monkeypatch.setenv("PYTHONPATH", str(site))
    recorded.write("golden/box.yaml", SPEC)
    return recorded


def test_it_is_collected_validated_recorded_and_run(with_kind) -> None:
    result = with_kind.run_apart("--collect-only", "-q", "--strict-markers", "-m", "box_rest")
    result.stdout.fnmatch_lines(["golden/box.yaml::box[[]mujoco[]]"])
    with_kind.edit("golden/box.yaml", "drop: 0.02", "drop: -1")
    result = with_kind.run_apart("--collect-only", "-q")
    result.stdout.fnmatch_lines(["*/golden/box.yaml:4: stimulus.drop: *-1*"])
    with_kind.edit("golden/box.yaml", "drop: -1", "drop: 0.02")
    assert with_kind.run_apart("--twin-update", "-k", "box").ret == 0
    with_kind.run_apart("--twin-release").assert_outcomes(passed=3)
    assert with_kind.releases == ["0001"]


def test_a_package_that_does_not_load_is_one_line(with_kind) -> None:
    (with_kind.pytester.path / "site" / "box_rest.py").write_text("import no_such_module\n")
    result = with_kind.run_apart("--collect-only")
    result.stdout.fnmatch_lines(
        ["*/golden/box.yaml:2: kind: the package that brings this kind cannot be loaded: *"]
    )
    assert "Traceback" not in result.stdout.str()


def test_dependency_bump_stale_subset_failure_decision_new_release(with_kind) -> None:
    assert with_kind.run_apart("--twin-update", "-k", "box").ret == 0
    assert with_kind.run_apart("--twin-release").ret == 0

    # A library is upgraded, and corrects how boxes rest.
    folder = with_kind.pytester.path
    pip_install([wheel(folder, "boxphysics", "1.1", PHYSICS["1.1"])], folder / "site")
    why = with_kind.run_apart("--twin-why")
    why.stdout.fnmatch_lines(
        [
            "stale  golden/box@mujoco",
            "         library:boxphysics: version 1.0 -> 1.1",
            "fresh  golden/fk/home@mujoco  proven in release 0001",
            "fresh  golden/mass/arm@mujoco  proven in release 0001",
        ]
    )

    # CI runs exactly that one; the failure names the dependency beside the number.
    result = with_kind.run_apart("--twin-release")
    result.assert_outcomes(failed=1, deselected=2)
    result.stdout.fnmatch_lines(
        [
            "  measured     0.0987 m",
            "  golden       0.1 m",
            "  ran because  library:boxphysics: version 1.0 -> 1.1",
        ]
    )
    assert result.ret == 1
    assert with_kind.releases == ["0001"]

    # A person looks, decides that the new number is right, and releases.
    result = with_kind.run_apart("--twin-update", "-k", "box")
    result.stdout.fnmatch_lines(
        ["  height of box: 0.1 m -> 0.0987 m (tolerance 0.0001 m)", "  height: 0.1 -> 0.0987"]
    )
    result = with_kind.run_apart("--twin-release")
    result.assert_outcomes(passed=1, deselected=2)
    assert with_kind.releases == ["0001", "0002"]


def test_a_kind_that_cannot_say_what_it_rests_on_costs_its_own_golden_only(with_kind) -> None:
    assert with_kind.run_apart("--twin-update", "-k", "box").ret == 0
    path = with_kind.pytester.path / "site" / "box_rest.py"
    path.write_text(path.read_text().replace("structure.contact()", "structure.no_such_thing()"))
    result = with_kind.run_apart("--twin-release")
    result.assert_outcomes(passed=3)
    result.stdout.fnmatch_lines(
        ["  golden/box: what it rests on cannot be told: AttributeError: *no_such_thing*"]
    )
    assert with_kind.releases == []
