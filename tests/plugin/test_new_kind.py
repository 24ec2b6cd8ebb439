"""A kind of golden from another package: one module and one entry point."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from wheels import ENTRY_POINTS, KIND, PHYSICS, SPEC, pip_install, wheel


@pytest.fixture(scope="module")
def installed_kind(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which pip installed a package with a new kind and its library."""
    folder = tmp_path_factory.mktemp("kind")
    packages = [
        wheel(folder, "box_rest", "0.3", KIND, ENTRY_POINTS),
        wheel(folder, "boxphysics", "1.0", PHYSICS["1.0"]),
    ]
    pip_install(packages, folder / "site")
    return folder / "site"


@pytest.fixture
def with_kind(installed_kind, recorded, monkeypatch):
    """A recorded twin in an environment with the installed new kind."""
    site = shutil.copytree(installed_kind, recorded.pytester.path / "site")
    monkeypatch.setenv("PYTHONPATH", str(site))
    recorded.write("golden/box.yaml", SPEC)
    return recorded


def test_an_installed_kind_is_collected_validated_recorded_and_run(with_kind) -> None:
    result = with_kind.run_apart("--collect-only", "-q", "--strict-markers", "-m", "box_rest")
    result.stdout.fnmatch_lines(["golden/box.yaml::box[[]mujoco[]]"])
    with_kind.edit("golden/box.yaml", "drop: 0.02", "drop: -1")
    result = with_kind.run_apart("--collect-only", "-q")
    result.stdout.fnmatch_lines(["*/golden/box.yaml:4: stimulus.drop: *-1*"])
    with_kind.edit("golden/box.yaml", "drop: -1", "drop: 0.02")
    assert with_kind.run_apart("--twin-update", "-k", "box").ret == 0
    with_kind.run_apart("--twin-release").assert_outcomes(passed=3)
    assert with_kind.releases == ["0001"]


LOADED = "(got 'box_rest'; expected box_rest:BoxRest to import; repair or uninstall the package)"
UNUSABLE = "kind: package 'box_rest' 0.3 defines an invalid check: its"


@pytest.mark.parametrize(
    ("code", "problem"),
    [
        (
            "import no_such_module",
            "kind: package 'box_rest' 0.3 cannot be loaded: ModuleNotFoundError: "
            f"No module named 'no_such_module' {LOADED}",
        ),
        (
            "raise SystemExit(3)",
            f"kind: package 'box_rest' 0.3 cannot be loaded: SystemExit: 3 {LOADED}",
        ),
        (
            "raise BaseException",
            f"kind: package 'box_rest' 0.3 cannot be loaded: BaseException {LOADED}",
        ),
        (
            "import pytest; pytest.skip('no', allow_module_level=True)",
            f"kind: package 'box_rest' 0.3 cannot be loaded: Skipped: no {LOADED}",
        ),
        (
            "class BoxRest: pass",
            f"{UNUSABLE} class (got 'BoxRest'; expected a subclass of pytest_twin.checks.Check)",
        ),
        (
            KIND.replace('kind = "box_rest"', 'kind = "box"'),
            f"{UNUSABLE} kind (got 'box'; expected 'box_rest', as the entry point says)",
        ),
        (
            KIND.replace('{"height": "m"}', "None"),
            f"{UNUSABLE} tolerances (got 'NoneType'; expected a mapping from names to SI units)",
        ),
        (
            KIND.replace('frozenset({"height"})', 'frozenset({"box_depth"})'),
            f"{UNUSABLE} required_tolerances (got 'box_depth'; expected names in tolerances)",
        ),
    ],
)
def test_an_unusable_kind_package_is_reported_in_one_line_with_its_name(
    with_kind, code: str, problem: str
) -> None:
    (with_kind.pytester.path / "site" / "box_rest.py").write_text(f"{code}\n")
    result = with_kind.run_apart("-k", "no_test_has_this_name")
    assert f"{with_kind.root}/golden/box.yaml:2: {problem}" in result.stdout.str()
    assert result.ret == pytest.ExitCode.INTERRUPTED
    for trace in ("Traceback", "INTERNALERROR"):
        assert trace not in result.stdout.str() + result.stderr.str()


def test_a_keyboard_interrupt_during_package_loading_interrupts_the_run(with_kind) -> None:
    (with_kind.pytester.path / "site" / "box_rest.py").write_text("raise KeyboardInterrupt\n")
    result = with_kind.run_apart("--collect-only")
    assert result.ret == pytest.ExitCode.INTERRUPTED
    assert "cannot be loaded" not in result.stdout.str()


def test_a_kind_defined_by_two_packages_is_refused(with_kind) -> None:
    folder = with_kind.pytester.path
    pip_install([wheel(folder, "boxes", "1.0", KIND, ENTRY_POINTS)], folder / "site")
    result = with_kind.run_apart("--collect-only")
    result.stdout.fnmatch_lines(
        [
            "*/golden/box.yaml:2: kind: package 'box*' * and package 'box*' * both provide this "
            "kind (got 'box_rest'; expected one of them; uninstall the other)"
        ]
    )


def test_a_library_upgrade_makes_only_its_golden_stale_until_it_is_updated(with_kind) -> None:
    assert with_kind.run_apart("--twin-update", "-k", "box").ret == 0
    assert with_kind.run_apart("--twin-release").ret == 0

    # A library upgrade changes the resting height of boxes.
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

    # CI runs only the stale golden; the failure names the dependency and the numbers.
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

    # An engineer accepts the new number, updates the golden and releases.
    result = with_kind.run_apart("--twin-update", "-k", "box")
    result.stdout.fnmatch_lines(
        ["  height of box: 0.1 m -> 0.0987 m (tolerance 0.0001 m)", "  height: 0.1 -> 0.0987"]
    )
    result = with_kind.run_apart("--twin-release")
    result.assert_outcomes(passed=1, deselected=2)
    assert with_kind.releases == ["0001", "0002"]


def test_a_kind_whose_dependencies_fail_refuses_the_release_naming_its_golden(with_kind) -> None:
    assert with_kind.run_apart("--twin-update", "-k", "box").ret == 0
    path = with_kind.pytester.path / "site" / "box_rest.py"
    path.write_text(path.read_text().replace("structure.contact()", "structure.no_such_thing()"))
    result = with_kind.run_apart("--twin-release")
    result.assert_outcomes(passed=3)
    result.stdout.fnmatch_lines(
        ["  golden/box: its dependencies cannot be determined: AttributeError: *no_such_thing*"]
    )
    assert with_kind.releases == []
