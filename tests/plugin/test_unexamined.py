"""A release says which changes of the model no result of a golden shows."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("gate_in_process")

AUDITED = "name: arm\nmodel: arm.xml\ntcp: tcp\n"
FALL = """\
schema: 1
kind: contact
target:
  primitive: approach
  pair: [object, fore]
  object: {shape: sphere, size: [0.02], mass: 0.2 kg}
stimulus: {duration: 0.3 s, gravity: false, press: 2 N, others: locked}
tolerance: {onset_time: 5 ms, position: 1 mm}
"""
SLIDE = (
    FALL.replace("approach", "slide")
    .replace(
        "others: locked}",
        "others: locked, slide: {direction: [1, 0, 0], force: 8 N, duration: 0.2 s}}",
    )
    .replace("position", "friction: 2 %, position")
)
SAME = "that may depend on it gave the same results as before"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the first test of this module leaves the released twin for the others."""
    return tmp_path_factory.mktemp("touched") / "twin"


@pytest.fixture
def touched(recorded, store: Path):
    """The recorded twin, whose forearm can be touched and has a golden that does so, released."""
    folder = recorded.pytester.path
    if store.is_dir():
        shutil.copytree(store, folder, dirs_exist_ok=True)
        return recorded
    for old, new in (
        (
            '0.25 0 0" size="0.02" contype="0" conaffinity="0"',
            '0.25 0 0" size="0.02" friction="0.6"',
        ),
        ("</worldbody>", '</worldbody><keyframe><key name="bent" qpos="1 1"/></keyframe>'),
    ):
        recorded.edit("arm.xml", old, new)
    recorded.write("golden/contact/fall.yaml", FALL)
    recorded.write("twin.yaml", AUDITED)
    assert recorded.run("--twin-update").ret == 0
    assert recorded.run("--twin-release").ret == 0
    shutil.copytree(folder, store)
    return recorded


def unexamined(result: pytest.RunResult) -> list[str]:
    return [line for line in result.outlines if line.startswith("unexamined: ")]


def test_a_friction_that_no_golden_shows_is_said_until_a_golden_shows_it(touched) -> None:
    touched.edit("arm.xml", 'friction="0.6"', 'friction="0.9"')
    result = touched.run("--twin-release")
    (line,) = unexamined(result)
    assert line.startswith("unexamined: mujoco/collision:fore: friction [0.6, 0.005, 0.0001] -> ")
    assert line.endswith(SAME)
    assert touched.releases == ["0001", "0002"]
    page = (touched.root / "releases/0002/report.html").read_text()
    assert "1 unexamined change" in page
    touched.write("golden/contact/slide.yaml", SLIDE)
    touched.run("--twin-update", "golden/contact/slide.yaml")
    assert touched.run("--twin-release").ret == 0
    touched.edit("arm.xml", 'friction="0.9"', 'friction="0.8"')
    result = touched.run("--twin-release")
    assert unexamined(result) == []
    result.stdout.fnmatch_lines(["  golden/contact/slide@mujoco: a critical golden failed"])
    touched.run("--twin-update")
    result = touched.run("--twin-release")
    assert unexamined(result) == []
    assert touched.releases[-1] == "0004"


def test_a_change_beside_another_one_is_not_taken_for_shown(touched) -> None:
    touched.edit("arm.xml", 'friction="0.6"', 'friction="0.9"')
    touched.edit("arm.xml", 'pos="0.3 0 0"', 'pos="0.30002 0 0"')
    result = touched.run("--twin-release")
    assert unexamined(result) == []
    result.stdout.fnmatch_lines(
        ["changes of layer collision came together with those of kinematics: no result *"]
    )


def test_a_change_of_a_part_without_golden_is_said(touched) -> None:
    touched.edit("arm.xml", 'qpos="1 1"', 'qpos="1 1.5"')
    result = touched.run("--twin-release")
    (line,) = unexamined(result)
    assert line.startswith("unexamined: mujoco/keyframe:bent: ")
    touched.edit("arm.xml", "<keyframe>", "<!-- a comment --><keyframe>")
    assert unexamined(touched.run("--twin-release")) == []


def test_a_part_on_which_no_golden_depends_is_said_from_the_first_release(touched) -> None:
    touched.write(
        "twin.yaml", f"{AUDITED}payloads:\n  tool: {{fore: {{mass: 0.5, com: [0, 0, 0]}}}}\n"
    )
    result = touched.run("--twin-release")
    result.stdout.fnmatch_lines(
        ["no golden depends on payload:tool: no result would show a change"]
    )
