"""Two commands lead from a robot file to a signed release, for several robots."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest
import yaml
from typed import run, run_apart

from pytest_twin.errors import SpecError
from pytest_twin.twin import load_twin

pytestmark = pytest.mark.usefixtures("commands_in_process")

ROBOTS = {
    "panda": "panda_description/urdf/panda.urdf",
    "allegro": "allegro_hand_description/urdf/allegro_right_hand.urdf",
    "solo12": "solo_description/robots/solo12.urdf",
}
WITH_CRITICAL_FINDINGS = {"allegro"}
EVERY_ROBOT = {"asset", "fk", "joint_direction", "limits", "mass_properties", "settling"}
DEMO = Path(__file__).resolve().parents[2] / "golden"


def find_robots() -> Path:
    for entry in sys.path:
        folder = Path(entry) / "cmeel.prefix/share/example-robot-data/robots"
        if folder.is_dir():
            return folder
    pytest.fail("the package example-robot-data is not installed; it is in the extra 'test'")


def accept_proposed_findings(twin_file: Path) -> None:
    """Take the # off the lines that init proposes for critical findings, and fill in two."""
    lines = twin_file.read_text().splitlines()
    start = lines.index("# accepted_findings:")
    stop = next(i for i, line in enumerate(lines) if line.startswith("#     owner:")) + 1
    lines[start:stop] = [line.removeprefix("# ").rstrip() for line in lines[start:stop]]
    twin_file.write_text("\n".join(lines) + "\n")
    with pytest.raises(SpecError, match="reason"):
        load_twin(twin_file)
    lines[stop - 2 : stop] = ["    reason: a test", "    owner: A. Nowak"]
    twin_file.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    "name", ["panda", "allegro", pytest.param("solo12", marks=pytest.mark.nightly)]
)
def test_init_and_release_work_for_a_urdf(name: str, tmp_path: Path) -> None:
    """All commands for the first robot are processes, as a person starts them."""
    typed = run_apart if name == "panda" else run
    twin = tmp_path / "twin"
    made = typed("pytest-twin", "init", str(find_robots() / ROBOTS[name]), "--out", str(twin),
                 cwd=tmp_path, state=tmp_path)  # fmt: skip
    assert made.returncode == 0, made.stdout + made.stderr
    assert ("FAILS now: golden/asset/audit" in made.stdout) == (name in WITH_CRITICAL_FINDINGS)
    assert made.stdout.count("FAILS") == int(name in WITH_CRITICAL_FINDINGS)
    assert {path.name for path in (twin / "golden").iterdir()} >= EVERY_ROBOT
    if name in WITH_CRITICAL_FINDINGS:
        refused = run("pytest", "--twin-release", cwd=twin, state=tmp_path)
        assert "no release:" in refused.stdout
        accept_proposed_findings(twin / "twin.yaml")
    released = run("pytest", "--twin-release", cwd=twin, state=tmp_path)
    assert released.returncode == 0, released.stdout[-4000:]
    assert "release 0001 signed" in released.stdout
    verified = typed("pytest-twin", "verify", "releases/0001", cwd=twin, state=tmp_path)
    assert verified.returncode == 0, verified.stdout + verified.stderr
    again = run("pytest", "--twin-release", cwd=twin, state=tmp_path)
    assert again.returncode == 0, again.stdout[-4000:]
    assert "release 0001 still holds" in again.stdout


def test_repairs_of_impossible_inertias_are_written_and_noted(tmp_path: Path) -> None:
    made = run("pytest-twin", "init", str(find_robots() / ROBOTS["allegro"]), cwd=tmp_path,
               state=tmp_path)  # fmt: skip
    assert made.returncode == 0, made.stdout + made.stderr
    twin = yaml.safe_load((tmp_path / "twin.yaml").read_text())
    assert sorted(twin["fit"]["body"]) == ["link_11.0", "link_15.0", "link_3.0", "link_7.0"]
    for link in twin["fit"]["body"]:
        assert any(link in line for line in made.stdout.splitlines() if line.startswith("note"))


def test_a_robot_file_inside_the_folder_is_not_copied(tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text(
        "<mujoco><worldbody><body name='link'><joint name='hinge' axis='0 1 0' range='-90 90'/>"
        "<geom type='capsule' fromto='0 0 0 0 0 .3' size='.02'/></body></worldbody>"
        "<actuator><position name='hinge' joint='hinge' kp='50' kv='2'/></actuator></mujoco>"
    )
    made = run("pytest-twin", "init", "robot.xml", cwd=tmp_path, state=tmp_path)
    assert made.returncode == 0, made.stdout + made.stderr
    assert yaml.safe_load((tmp_path / "twin.yaml").read_text())["model"] == "robot.xml"
    assert not (tmp_path / "asset").exists()
    again = run("pytest-twin", "init", "robot.xml", cwd=tmp_path, state=tmp_path)
    assert again.returncode == 2
    assert again.stderr == (
        f"pytest-twin init: {tmp_path}/twin.yaml: a twin exists already (expected a new folder)\n"
    )


def test_every_spec_refers_to_an_existing_schema_file(tmp_path: Path) -> None:
    made = run("pytest-twin", "init", str(DEMO / "arm.xml"), cwd=tmp_path, state=tmp_path)
    assert made.returncode == 0, made.stdout + made.stderr
    files = [tmp_path / "twin.yaml", *(tmp_path / "golden").rglob("*.yaml")]
    assert len(files) > 5
    for path in files:
        head = path.read_text().splitlines()[0]
        assert head.startswith("# yaml-language-server: $schema=")
        assert (path.parent / head.partition("=")[2]).resolve().is_file()


@pytest.mark.parametrize("name", ["nothing.urdf", "notes.txt"])
def test_a_missing_or_wrong_file_is_refused_with_one_line(name: str, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("a robot, one day")
    made = run("pytest-twin", "init", name, cwd=tmp_path, state=tmp_path)
    assert made.returncode == 2
    assert made.stderr == (
        f"pytest-twin init: {name}: no robot file "
        "(expected a URDF (.urdf), an MJCF (.xml) or a xacro file (.xacro))\n"
    )
    assert not (tmp_path / "twin.yaml").exists()


def test_after_an_invalid_robot_file_no_other_file_is_left(tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text("<robot name='r'><link name='a'/><link name='a'/></robot>")
    made = run("pytest-twin", "init", "robot.urdf", cwd=tmp_path, state=tmp_path)
    assert made.returncode == 2
    assert "robot.urdf:1" in made.stderr
    assert len(made.stderr.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir() if path.suffix != ".urdf"] == []


def test_the_demo_twin_can_be_released(tmp_path: Path) -> None:
    twin = tmp_path / "golden"
    shutil.copytree(
        DEMO,
        twin,
        ignore=shutil.ignore_patterns("releases", "keys", ".twin", "__pycache__", "make"),
    )
    released = run("pytest", "--twin-release", "golden", cwd=tmp_path, state=tmp_path)
    assert released.returncode == 0, released.stdout[-4000:]
    assert "release 0001 signed" in released.stdout
    kinds = {path.parent.name for path in twin.glob("*/*.yaml")}
    assert kinds == {
        "asset", "collision_distance", "contact", "fk", "frequency_response", "joint_direction",
        "limits", "mass_properties", "replay", "settling", "step", "task",
    }  # fmt: skip


def test_joints_with_equal_motors_are_proposed_as_a_type(tmp_path: Path) -> None:
    links = "".join(
        f'<body name="{joint}"><joint name="{joint}" armature="{armature}" range="-1 1"/>'
        '<geom size=".1" mass="1"/></body>'
        for joint, armature in {"pan": 0.1, "lift": 0.1, "turn": 0.2}.items()
    )
    motors = "".join(f'<motor joint="{j}" ctrlrange="-3 3"/>' for j in ("pan", "lift", "turn"))
    robot = tmp_path / "robot.xml"
    robot.write_text(
        f'<mujoco><compiler angle="radian"/><worldbody>{links}</worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )
    made = run("pytest-twin", "init", str(robot), "--out", "twin", cwd=tmp_path, state=tmp_path)
    assert made.returncode == 0, made.stdout + made.stderr
    twin = tmp_path / "twin" / "twin.yaml"
    assert load_twin(twin).motors == {}
    lines = twin.read_text().splitlines()
    at = lines.index("# motors:")
    lines[at : at + 2] = [line.removeprefix("# ") for line in lines[at : at + 2]]
    twin.write_text("\n".join(lines) + "\n")
    assert load_twin(twin).motors == {"type_1": ("pan", "lift")}
