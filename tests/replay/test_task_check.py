"""Goldens of kind task: outputs of a user's function, and its errors."""

from __future__ import annotations

from pathlib import Path

import pytest
from replay_trials import ARM

from pytest_twin.checks import check_of
from pytest_twin.errors import SpecError, TwinError
from pytest_twin.gate.specs import load_golden
from pytest_twin.golden import Golden
from pytest_twin.outcome import Measure
from pytest_twin.realization import Realization, load
from pytest_twin.twin import load_twin

CODE = """\
import helper
import numpy as np

def reach(realization, shoulder=0.0, tip="tool"):
    import mujoco
    data = mujoco.MjData(realization.model)
    data.qpos[:] = realization.qpos({"shoulder": shoulder})
    mujoco.mj_kinematics(realization.model, data)
    pose = realization.frame_pose(data, tip)
    return {"height": pose[2, 3], "position": pose[:3, 3], "count": helper.COUNT}
"""
GOLDEN = """\
schema: 1
kind: task
target:
  function: tasks/reach.py:reach
  files: [tasks/helper.py]
  outputs:
    height: {unit: m, tolerance: 1 mm}
    position: {unit: m, tolerance: 2 mm}
    count: {unit: '1', tolerance: '0'}
stimulus: {shoulder: 0.5}
"""


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    (tmp_path / "tasks").mkdir()
    (tmp_path / "golden").mkdir()
    (tmp_path / "twin.yaml").write_text("name: arm\nmodel: arm.xml\n")
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "tasks" / "reach.py").write_text(CODE)
    (tmp_path / "tasks" / "helper.py").write_text("COUNT = 3\n")
    (tmp_path / "golden" / "reach.yaml").write_text(GOLDEN)
    return tmp_path


def load_task(arm: Path, **replaced: str) -> tuple[Golden, Realization]:
    path = arm / "golden" / "reach.yaml"
    for old, new in replaced.items():
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))
    twin = load_twin(arm / "twin.yaml")
    return load_golden(path, twin), load(arm / "arm.xml", twin=twin)


def compare_with(arm: Path, expected: dict[str, object]) -> list[Measure]:
    from dataclasses import replace

    golden, realization = load_task(arm)
    check = check_of("task")
    observation = check.observe(golden, realization, lambda _: None)
    return check.compare(replace(golden, expected=expected), observation, None)


def test_declared_outputs_are_compared_with_recorded_values(arm: Path) -> None:
    golden, realization = load_task(arm)
    observation = check_of("task").observe(golden, realization, lambda _: None)
    # A straight arm of 0.55 m, 1 m above the floor, rotated down by 0.5 rad.
    assert observation.values["height"] == pytest.approx(1 - 0.55 * 0.479425539)
    measures = compare_with(arm, {"height": 0.7363, "position": [0.4826, 0.0, 0.74], "count": 3})
    verdicts = [(m.name, m.subject, m.passed) for m in measures]
    assert verdicts == [
        ("height", "reach", True),
        ("position", "reach[0]", True),
        ("position", "reach[1]", True),
        ("position", "reach[2]", False),
        ("count", "reach", True),
    ]


def test_a_task_depends_on_the_whole_model_and_its_files(arm: Path) -> None:
    golden, realization = load_task(arm)
    parts = set(check_of("task").depends(golden, realization.structure))
    assert realization.structure.part_ids <= parts
    assert {"file:tasks/reach.py", "file:tasks/helper.py"} <= parts


def test_a_changed_imported_module_is_loaded_again(arm: Path) -> None:
    compare_with(arm, {"height": 0.7363, "position": [0.4826, 0.0, 0.7363], "count": 3})
    (arm / "tasks" / "helper.py").write_text("COUNT = 4  # was 3\n")
    measures = compare_with(arm, {"height": 0.7363, "position": [0.4826, 0.0, 0.7363], "count": 3})
    assert [m.measured for m in measures if m.name == "count"] == [4.0]


def test_a_module_that_the_golden_does_not_declare_is_refused(arm: Path) -> None:
    golden, realization = load_task(arm, **{"  files: [tasks/helper.py]\n": ""})
    # Not even where the function would go on without the module.
    text = (arm / "tasks" / "reach.py").read_text()
    (arm / "tasks" / "reach.py").write_text(
        text.replace("import helper\n", "try:\n    import helper\nexcept ImportError:\n    pass\n")
    )
    with pytest.raises(SpecError) as refusal:
        check_of("task").observe(golden, realization, lambda _: None)
    assert str(refusal.value) == (
        f"{golden.path}:3: target.files: the function imports 'helper', a module that the golden "
        f"does not declare (got '{arm / 'tasks' / 'helper.py'}'; expected every module of the twin "
        "that the function imports)"
    )


@pytest.mark.parametrize("name", ["json.py", "numpy.py", "yaml/__init__.py"])
def test_a_declared_module_with_the_name_of_an_installed_one_is_refused(
    arm: Path, name: str
) -> None:
    (arm / "tasks" / name).parent.mkdir(exist_ok=True)
    (arm / "tasks" / name).write_text("COUNT = 3\n")
    golden, realization = load_task(
        arm, **{"files: [tasks/helper.py]": f"files: [tasks/helper.py, tasks/{name}]"}
    )
    with pytest.raises(SpecError, match="a module with the name of an installed one"):
        check_of("task").observe(golden, realization, lambda _: None)


def test_names_of_installed_modules_beside_a_function_change_nothing(arm: Path) -> None:
    for name in ("json.py", "numpy.py", "token.py"):
        (arm / "tasks" / name).write_text("raise SystemExit(9)\n")
    measures = compare_with(arm, {"height": 0.7363, "position": [0.4826, 0.0, 0.7363], "count": 3})
    assert all(measure.passed for measure in measures)


def test_only_the_declared_modules_of_a_package_are_imported(arm: Path) -> None:
    package = arm / "tasks" / "parts"
    package.mkdir()
    (package / "count.py").write_text("COUNT = 3\n")
    (package / "other.py").write_text("COUNT = 4\n")
    path = arm / "tasks" / "reach.py"
    path.write_text(CODE.replace("import helper", "import parts.count as helper"))
    declared = {"tasks/helper.py": "tasks/parts/count.py"}
    golden, realization = load_task(arm, **declared)
    observation = check_of("task").observe(golden, realization, lambda _: None)
    assert observation.values["count"] == 3
    path.write_text(CODE.replace("import helper", "import parts.other as helper"))
    with pytest.raises(SpecError, match=r"imports 'parts\.other', a module that the golden does"):
        check_of("task").observe(golden, realization, lambda _: None)


def test_an_installed_function_depends_on_its_distribution(arm: Path) -> None:
    golden, realization = load_task(arm, **{"tasks/reach.py:reach": "numpy.linalg:norm"})
    assert "library:numpy" in check_of("task").depends(golden, realization.structure)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("pose[2, 3]", "float('nan')", "target.outputs.height: the function returned a number "
         "that is not finite (got 'nan'; expected a finite number)"),
        ("pose[2, 3]", "[0.0, float('inf')]", "target.outputs.height[1]: the function returned a "
         "number that is not finite (got 'inf'; expected a finite number)"),
        ("pose[2, 3]", "'high'", "target.outputs.height: the function did not return a number "
         "(got 'str'; expected a number or a list of numbers)"),
        ("pose[2, 3]", "True", "target.outputs.height: the function did not return a number "
         "(got 'bool'; expected a number or a list of numbers)"),
        ('"height": pose[2, 3], ', "", "target.outputs: outputs that the function did not return "
         "(got 'height'; expected count, height, position)"),
        ('"count"', '"width": 1.0, "count"', "target.outputs: outputs that the spec does not "
         "declare (got 'width'; expected count, height, position)"),
        ('{"height"', '3.0 or {"height"', "target.outputs: the function did not return a mapping "
         "(got 'float'; expected count, height, position)"),
        ("def reach(realization, shoulder", "def reach(realization, elbow", "stimulus: the "
         "function cannot be called with these arguments: reach() got "
         "an unexpected keyword argument 'shoulder' "
         "(expected function(realization, **stimulus))"),
        ("def reach", "def grasp", "target.function: no function of this name in tasks/reach.py "
         "(got 'reach'; expected a function that this module defines)"),
        ("def reach", "def def reach", "reach.py:4: not valid Python: invalid syntax"),
    ],
)  # fmt: skip
def test_an_invalid_function_or_output_is_refused_with_the_reason(
    arm: Path, old: str, new: str, words: str
) -> None:
    assert old in CODE
    (arm / "tasks" / "reach.py").write_text(CODE.replace(old, new))
    golden, realization = load_task(arm)
    with pytest.raises(SpecError) as refusal:
        check_of("task").observe(golden, realization, lambda _: None)
    assert str(refusal.value).endswith(words)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("tasks/reach.py:reach", "tasks/none.py:reach", "target.function: no such file"),
        ("tasks/reach.py:reach", "../reach.py:reach", "target.function: no such file"),
        (
            "tasks/reach.py:reach",
            "no_such_module:reach",
            "target.function: no installed distribution brings this module",
        ),
        ("tasks/reach.py:reach", "tasks/reach.py", "target.function"),
        ("tolerance: 1 mm", "tolerance: 1 deg", "target.outputs.height.tolerance"),
    ],
)
def test_an_invalid_task_spec_is_refused(arm: Path, old: str, new: str, words: str) -> None:
    def run() -> None:
        golden, realization = load_task(arm, **{old: new})
        check = check_of("task")
        check.compare(golden, check.observe(golden, realization, lambda _: None), None)

    with pytest.raises(TwinError) as refusal:
        run()
    assert words in str(refusal.value)


def test_an_output_with_another_length_than_recorded_is_refused(arm: Path) -> None:
    with pytest.raises(
        SpecError, match=r"another length than the recorded one \(got 3; expected 2"
    ):
        compare_with(arm, {"height": 0.7, "position": [0.1, 0.2], "count": 3})


def test_a_task_golden_without_recorded_values_is_refused(arm: Path) -> None:
    with pytest.raises(SpecError, match="no recorded value of output 'height'"):
        compare_with(arm, {})
