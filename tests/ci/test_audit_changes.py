"""``audit-changes``, the GitHub Action and the pre-commit hook, on a robot description package."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from lxml import etree

from pytest_twin import cli
from pytest_twin.formats.schema import load_schema

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "robot_description"
SARIF = json.loads((Path(__file__).parent / "sarif-schema-2.1.0.json").read_text())
# The commands of this environment, also where it is not activated.
ENVIRONMENT = os.environ | {
    "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
}
in_process = pytest.mark.usefixtures("commands_in_process")


def git(folder: Path, *words: str) -> None:
    settings = ("-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false")
    subprocess.run(["git", "-C", str(folder), *settings, *words], check=True, capture_output=True)


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout of the example with a second robot in xacro, whose mass comes from a part."""
    folder = tmp_path / "checkout"
    shutil.copytree(EXAMPLE, folder)
    arm = (folder / "urdf" / "arm.urdf").read_text()
    (folder / "urdf" / "other.urdf").write_text(arm.replace('name="arm"', 'name="other"'))
    git(folder, "init", "-q", "-b", "main")
    git(folder, "add", ".")
    git(folder, "commit", "-qm", "first")
    monkeypatch.chdir(folder)
    return folder


def break_arm(folder: Path) -> int:
    """Make a mass negative; return its line."""
    arm = folder / "urdf" / "arm.urdf"
    arm.write_text(arm.read_text().replace('<mass value="2"/>', '<mass value="-2"/>'))
    return 1 + arm.read_text().split('value="-2"')[0].count("\n")


def results(folder: Path) -> tuple[dict[str, Any], etree._Element]:
    document = json.loads((folder / "a.sarif").read_text())
    jsonschema.Draft4Validator(SARIF).validate(document)
    return document["runs"][0], etree.parse(folder / "a.xml").getroot()


def check(*options: str) -> int:
    return cli.main(["audit-changes", "--sarif", "a.sarif", "--junit", "a.xml", *options])


@in_process
def test_only_robots_that_changed_are_audited_and_findings_are_at_their_line(
    package: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert check("--since", "HEAD") == 0
    assert "0 robots" in capsys.readouterr().out
    line = break_arm(package)
    assert check("--since", "HEAD", "--annotate", "--json", "a.json") == 1
    said = capsys.readouterr().out
    assert "1 robot, " in said
    assert f"::error file=urdf/arm.urdf,line={line},title=inertia." in said
    run, suite = results(package)
    errors = [one for one in run["results"] if one["level"] == "error"]
    place = errors[0]["locations"][0]["physicalLocation"]
    assert place["artifactLocation"]["uri"] == "urdf/arm.urdf"
    assert place["region"]["startLine"] == line
    assert "link 'upper'" in errors[0]["message"]["text"]
    failures = suite.findall("testcase/failure")
    assert len(failures) == len(errors) == int(suite.get("failures"))
    document = json.loads((package / "a.json").read_text())
    jsonschema.validate(document, load_schema("results/audit-changes.schema.json"))
    assert document["robots"] == ["urdf/arm.urdf"]


@in_process
def test_accepted_findings_are_silent_until_their_value_changes(
    package: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    break_arm(package)
    assert check("--baseline", "accepted.yaml", "--accept") == 0
    assert check("--baseline", "accepted.yaml") == 0
    assert not [one for one in results(package)[0]["results"] if one["level"] == "error"]
    arm = package / "urdf" / "arm.urdf"
    broken = arm.read_text()
    arm.write_text("\n\n" + broken.replace('<?xml version="1.0"?>\n', ""))
    assert check("--baseline", "accepted.yaml") == 0
    arm.write_text(broken.replace('"-2"', '"-3"'))
    assert check("--baseline", "accepted.yaml") == 1
    git(package, "checkout", "-q", "urdf/arm.urdf")
    capsys.readouterr()
    assert check("--baseline", "accepted.yaml") == 0
    assert "accepted, and no longer there: urdf/arm.urdf" in capsys.readouterr().out


@in_process
def test_a_changed_mesh_or_part_affects_the_robots_that_name_it(package: Path) -> None:
    arm = package / "urdf" / "arm.urdf"
    arm.write_text(arm.read_text().replace("<box size=\"0.3 0.06 0.06\"/>",
                                           '<mesh filename="../meshes/bar.stl"/>'))  # fmt: skip
    (package / "meshes").mkdir()
    (package / "meshes" / "bar.stl").write_text("solid nothing\nendsolid\n")
    part = '<mujocoinclude><option timestep="0.001"/></mujocoinclude>'
    (package / "part.xml").write_text(part)
    (package / "scene.xml").write_text(
        '<mujoco><include file="part.xml"/><worldbody><body><joint name="j"/>'
        '<geom size="0.1"/></body></worldbody></mujoco>'
    )
    git(package, "add", ".")
    git(package, "commit", "-qm", "second")
    from pytest_twin.commands.affected_robots import affected

    def names(*changed: str) -> list[str]:
        return [path.name for path in affected(package, [package / one for one in changed])]

    assert names("meshes/bar.stl") == ["arm.urdf"]
    assert names("part.xml") == ["scene.xml"]
    assert names("package.xml", "CMakeLists.txt") == []
    assert [path.name for path in affected(package, None)] == [
        "scene.xml",
        "arm.urdf",
        "other.urdf",
    ]


@in_process
def test_a_robot_that_cannot_be_read_does_not_hide_the_others(
    package: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    break_arm(package)
    (package / "urdf" / "other.urdf").write_text("<robot name='a'>\n<link</robot>")
    assert check("--since", "HEAD") == 2
    run, _ = results(package)
    found = {one["locations"][0]["physicalLocation"]["artifactLocation"]["uri"]
             for one in run["results"] if one["level"] == "error"}  # fmt: skip
    assert found == {"urdf/arm.urdf", "urdf/other.urdf"}
    assert "other.urdf" in capsys.readouterr().err


@in_process
def test_an_unknown_revision_and_a_folder_without_git_are_refused(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    assert check("--since", "nothing") == 2
    assert "git merge-base failed" in capsys.readouterr().err
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert check() == 2


def run_action(folder: Path, **inputs: str) -> subprocess.CompletedProcess[str]:
    """Run the steps of action.yml as GitHub does, in one shell each."""
    action = yaml.safe_load((ROOT / "action.yml").read_text())
    values = {f"inputs.{name}": one["default"] for name, one in action["inputs"].items()}
    values |= {f"inputs.{name}": value for name, value in inputs.items()}
    values |= {"github.action_path": str(ROOT)}

    def expand(text: str) -> str:
        def value(match: re.Match[str]) -> str:
            return next((v for name in match[1].split("||") if (v := values.get(name.strip()))), "")

        return re.sub(r"\$\{\{(.*?)\}\}", value, text)

    for step in action["runs"]["steps"]:
        condition = step.get("if")
        if "run" not in step or (condition and not values[condition.split()[0]]):
            continue
        variables = {name: expand(text) for name, text in step["env"].items()}
        run = subprocess.run(
            ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", expand(step["run"])],
            cwd=folder, env=ENVIRONMENT | variables | {"GITHUB_ACTIONS": "true"},
            capture_output=True, text=True,
        )  # fmt: skip
        if run.returncode:
            break
    return run


def test_the_steps_of_the_action_annotate_the_changed_robot(package: Path) -> None:
    line = break_arm(package)
    run = run_action(package, package="", since="HEAD", results="results")
    assert run.returncode == 1, run.stderr
    assert f"::error file=urdf/arm.urdf,line={line}," in run.stdout
    jsonschema.Draft4Validator(SARIF).validate(
        json.loads((package / "results" / "audit.sarif").read_text())
    )
    assert (package / "results" / "reports" / "urdf" / "arm.urdf.audit.html").is_file()


def test_the_action_runs_the_goldens_of_a_twin_and_fails_with_them(package: Path) -> None:
    """Compared with the signed release that is in the repository, as its cache restores it."""
    twin = shutil.copytree(ROOT / "tests" / "release" / "twin_of_0_1", package / "cell")
    inputs = {"package": "", "since": "HEAD", "results": "results", "twins": "cell"}
    run = run_action(package, **inputs)
    assert run.returncode == 0, run.stdout + run.stderr
    suite = etree.parse(package / "results" / "twin-1.xml").getroot().find("testsuite")
    assert suite is not None
    # None runs where the versions are those of the release.
    assert suite.get("failures") == suite.get("errors") == "0"
    model = twin / "pendulum.xml"
    model.write_text(model.read_text().replace('mass="1"', 'mass="2"'))
    run = run_action(package, **inputs)
    assert run.returncode == 1
    assert "golden/mass_properties/mass_properties" in run.stdout


def test_pre_commit_runs_the_hook_on_the_staged_robot(package: Path) -> None:
    (hook,) = [
        one
        for one in yaml.safe_load((ROOT / ".pre-commit-hooks.yaml").read_text())
        if one["id"] == "pytest-twin-audit"
    ]
    # The environment of this test has the package; pre-commit would install it.
    config = {"repos": [{"repo": "local", "hooks": [{**hook, "language": "system"}]}]}
    (package / ".pre-commit-config.yaml").write_text(yaml.safe_dump(config))
    break_arm(package)
    git(package, "add", ".")
    run = subprocess.run(
        ["pre-commit", "run"], capture_output=True, text=True, cwd=package, env=ENVIRONMENT
    )
    assert run.returncode == 1, run.stdout + run.stderr
    assert "urdf/arm.urdf:" in run.stdout
    assert "other.urdf" not in run.stdout
    assert not list(package.glob("*.audit.*"))


def test_the_package_of_the_example_passes_its_own_tests(tmp_path: Path) -> None:
    folder = shutil.copytree(EXAMPLE, tmp_path / "robot_description")
    run = subprocess.run(
        ["python", "-m", "pytest", "-q", "-p", "no:cacheprovider", "test"], cwd=folder,
        capture_output=True, text=True, env=ENVIRONMENT,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout
    assert "ament_add_pytest_test(audit test" in (folder / "CMakeLists.txt").read_text()
