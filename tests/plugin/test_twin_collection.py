"""Collection of golden specs by pytest: ids, markers, errors and import cost."""

from __future__ import annotations

import sys

import pytest


def test_each_golden_and_realization_is_one_test_item(twin) -> None:
    twin.edit(
        "twin.yaml", "model: arm.xml", "model: arm.xml\nrealizations: {copy: {file: arm.xml}}"
    )
    twin.edit("golden/fk/home.yaml", "kind: fk", "kind: fk\nrealizations: [mujoco, copy]")
    result = twin.run("--collect-only", "-q")
    result.stdout.fnmatch_lines(
        [
            "golden/fk/home.yaml::home[[]mujoco[]]",
            "golden/fk/home.yaml::home[[]copy[]]",
            "golden/mass/arm.yaml::arm[[]mujoco[]]",
        ]
    )
    assert result.ret == 0


@pytest.mark.parametrize(
    ("arguments", "chosen"),
    [
        (("-m", "fk"), "home"),
        (("-m", "mass_properties"), "arm"),
        (("-m", "critical and not fk"), "arm"),
        (("-k", "home"), "home"),
        (("-k", "mass_properties"), "arm"),
        (("-k", "mujoco and arm and not home"), "arm"),
    ],
)
def test_goldens_can_be_selected_by_kind_and_criticality(twin, arguments, chosen) -> None:
    result = twin.run("--collect-only", "-q", "--strict-markers", *arguments)
    result.stdout.fnmatch_lines([f"golden/*/{chosen}.yaml::{chosen}[[]mujoco[]]"])
    result.stdout.fnmatch_lines(["1/2 tests collected (1 deselected)*"])


def test_kinds_and_criticalities_are_listed_as_markers(twin) -> None:
    result = twin.run("--markers")
    result.stdout.fnmatch_lines_random(
        ["@pytest.mark.critical: *", "@pytest.mark.advisory: *", "@pytest.mark.fk: *"]
    )


def test_collection_imports_no_simulator(twin) -> None:
    twin.write(
        "conftest.py",
        "import sys\n"
        "def pytest_collection_finish():\n"
        "    heavy = {'mujoco', 'pinocchio', 'coal', 'scipy', 'matplotlib', 'cryptography'}\n"
        "    print('HEAVY', sorted(heavy & set(sys.modules)))\n",
    )
    result = twin.run_apart("--collect-only", "-s")
    result.stdout.fnmatch_lines(["*2 tests collected*"])
    assert "HEAVY []" in result.stdout.str()


def test_in_a_project_without_a_twin_only_the_plugin_module_is_imported(
    pytester: pytest.Pytester,
) -> None:
    pytester.makepyfile(
        "import sys\n"
        "def test_nothing():\n"
        "    ours = {name for name in sys.modules if name.startswith('pytest_twin')}\n"
        "    assert ours <= {'pytest_twin', 'pytest_twin.errors', 'pytest_twin.plugin',\n"
        "                    'pytest_twin.record_spec',\n"
        "                    'pytest_twin.session', 'pytest_twin.session.options',\n"
        "                    'pytest_twin.session.release_fixture',\n"
        "                    'pytest_twin.session.result_folders', 'pytest_twin.systems'}, ours\n"
        "    assert 'numpy' not in sys.modules\n"
    )
    (pytester.path / "golden").mkdir()
    (pytester.path / "golden" / "settings.yaml").write_text("a: 1\n")
    result = pytester.run(sys.executable, "-m", "pytest", "-q")
    result.stdout.fnmatch_lines(["1 passed*"])


def test_invalid_specs_are_reported_in_one_line_each_and_the_others_are_collected(twin) -> None:
    twin.write("golden/a.yaml", "schema: 1\nkind: fk\n  bad indent: [\n")
    twin.write("golden/b.yaml", "schema: 1\nkind: teleport\n")
    result = twin.run("--collect-only")
    result.stdout.fnmatch_lines(["*GoldenItem home[[]mujoco[]]*", "*2 tests collected, 2 errors*"])
    errors = [line for line in result.outlines if "golden/b.yaml:2" in line]
    assert errors
    assert errors[0].startswith(f"{twin.root}/golden/b.yaml:2: kind: unknown kind (got 'teleport'")
    assert any(line.startswith(f"{twin.root}/golden/a.yaml:3") for line in result.outlines)
    assert "Traceback" not in result.stdout.str()
    assert "plugin.py" not in result.stdout.str()


def test_an_invalid_twin_file_is_reported_at_its_goldens(twin) -> None:
    twin.write("twin.yaml", "model: missing.xml\n")
    result = twin.run("--collect-only")
    result.stdout.fnmatch_lines([f"{twin.root}/twin.yaml:1: *", "*no tests collected, 1 error*"])
    assert result.ret == pytest.ExitCode.INTERRUPTED


def test_only_specs_in_a_twins_golden_folder_are_collected(twin) -> None:
    twin.write("golden/calibration.yaml", "id: c1\n")
    twin.edit("twin.yaml", "tcp: tcp", "tcp: tcp\ncalibration: {file: golden/calibration.yaml}")
    twin.write("settings.yaml", "a: 1\n")
    twin.write("releases/0001/files/golden/fk/home.yaml", "nonsense")
    twin.write("releases/0001/files/test_copy.py", "def test_copy(): assert False")
    result = twin.run("--collect-only", "-q")
    result.stdout.fnmatch_lines(["2 tests collected*"])


def test_goldens_run_with_import_mode_importlib_and_without_cache(recorded) -> None:
    result = recorded.run("--import-mode=importlib", "-p", "no:cacheprovider")
    result.assert_outcomes(passed=2)
