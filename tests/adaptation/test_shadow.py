"""Command ``shadow``: a candidate is compared with a release, promoted and released."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from in_process import InProcess
from plants import model, record

from pytest_twin import cli
from pytest_twin.adaptation import faults, shadow
from pytest_twin.adaptation.guard import Guard
from pytest_twin.commands import shadow as command
from pytest_twin.effects.unnamed_law import KNOTS
from pytest_twin.formats.schema import load_schema
from pytest_twin.gate.promotion import unpromoted_lines
from pytest_twin.twin import load_twin

FK = """\
schema: 1
kind: fk
target: {frames: [arm]}
stimulus: {poses: [reference]}
tolerance: {position: 0.1 mm, orientation: 0.1 mrad}
"""
TWIN = "name: pendulum\nmodel: model.xml\nshadow: {metrics: {position_rms: 0.5}}\n"
RESIDUAL = """\
residual:
  id: spring-1
  kind: KIND
  file: FILE
  hold_off: 0.05
  joints: {a: {bound: 0.6, position: [-1.5, 1.5], velocity: [-8, 8], jump: 1.5}}
"""
STIFFNESS = 0.4
"""N*m/rad of a spring that the model lacks."""


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A released twin, a ``home`` folder, and two recordings of a plant with a spring."""
    base = tmp_path_factory.mktemp("shadow")
    twin = base / "twin"
    (twin / "golden" / "fk").mkdir(parents=True)
    (base / "home").mkdir()
    (twin / "twin.yaml").write_text(TWIN)
    (twin / "model.xml").write_text(model())
    (twin / "golden" / "fk" / "home.yaml").write_text(FK)
    with pytest.MonkeyPatch.context() as patch:
        set_user(patch, base / "home")
        for flag in ("--twin-update", "--twin-release"):
            assert run_gate(twin, flag) == 0
    for number in range(2):
        record(base / f"{number}.mcap", model(), force=lambda q, v: -STIFFNESS * q, phase=number)
    return base


@pytest.fixture
def place(
    template: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> Path:

    # To save time, only the test of the promotion starts a child process.
    if "promoted_then" not in request.node.name:
        monkeypatch.setattr(command, "Sandbox", InProcess)
    shutil.copytree(template, tmp_path / "p")
    set_user(monkeypatch, tmp_path / "p" / "home")
    return tmp_path / "p"


def set_user(patch: pytest.MonkeyPatch, home: Path) -> None:
    for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", "XDG_CACHE_HOME"):
        patch.setenv(name, str(home))


def run_gate(twin: Path, flag: str) -> int:
    words = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-q", flag]
    return subprocess.run(words, cwd=twin, capture_output=True, check=False, timeout=100).returncode


def onnx_spring(path: Path, stiffness: float = STIFFNESS) -> None:
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    from onnx import TensorProto, helper

    weights = helper.make_tensor("w", TensorProto.FLOAT, [3, 1], [-stiffness, 0.0, 0.0])
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["x", "w"], ["y"])],
        "spring",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 1])],
        [weights],
    )
    opset = [helper.make_opsetid("", 17)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), path)


def table_spring(path: Path) -> None:
    """A table of the spring's torque over position, as a diagnosis writes it."""
    knots = np.linspace(-1.5, 1.5, KNOTS)
    table = {
        "variable": "position",
        "knots": knots.tolist(),
        "values": (-STIFFNESS * knots).tolist(),
        "range": [-1.5, 1.5],
    }
    effects = [{"effect": "unnamed_law", "joint": "a", "table": table}]
    path.write_text(json.dumps({"schema": 1, "joints": ["a"], "effects": effects}))


def run_shadow(place: Path, status: int, *more: str) -> dict:
    out = place / "out.json"
    recordings = [str(place / f"{n}.mcap") for n in range(2)]
    twin = str(place / "twin")
    words = ["shadow", str(place / "twin" / "releases" / "0001"), twin, *recordings]
    assert cli.main([*words, "--json", str(out), *more]) == status
    document = json.loads(out.read_text())
    jsonschema.validate(document, load_schema("results/shadow.schema.json"))
    return document


def declare_residual(place: Path, kind: str, file: str) -> None:
    text = RESIDUAL.replace("KIND", kind).replace("FILE", file)
    (place / "twin" / "twin.yaml").write_text(TWIN + text)


@pytest.mark.parametrize("kind", ["onnx", "unnamed_laws"])
def test_a_residual_with_the_missing_spring_is_better_and_passes_the_fault_tests(
    kind: str, place: Path
) -> None:
    name = "spring.onnx" if kind == "onnx" else "laws.json"
    (onnx_spring if kind == "onnx" else table_spring)(place / "twin" / name)
    declare_residual(place, kind, name)
    document = run_shadow(place, 0)
    by_name = {one["metric"]: one for one in document["metrics"]}
    assert by_name["position_rms"]["change"] < -0.9
    assert [fault["holds"] for fault in document["faults"]] == [True] * 6
    assert all(fault["largest_force"][0] <= 0.6 for fault in document["faults"])
    assert document["acting"]["share"] > 0.8


def test_a_residual_is_promoted_then_released_and_later_changes_are_reported(place: Path) -> None:
    twin = place / "twin"
    onnx_spring(twin / "spring.onnx")
    declare_residual(place, "onnx", "spring.onnx")
    asset = (twin / "model.xml").read_bytes()
    (problem,) = unpromoted_lines(load_twin(twin / "twin.yaml"))
    assert "residual 'spring-1': no valid record of a shadow run" in problem
    assert run_gate(twin, "--twin-release") != 0
    run_shadow(place, 0, "--promote")
    assert run_gate(twin, "--twin-release") == 0
    assert (twin / "releases" / "0002" / "files" / "spring.onnx").is_file()
    assert (twin / "releases" / "0002" / "files" / "shadow" / "spring-1.json").is_file()
    assert (twin / "model.xml").read_bytes() == asset
    onnx_spring(twin / "spring.onnx", 0.3)
    (problem,) = unpromoted_lines(load_twin(twin / "twin.yaml"))
    assert "residual 'spring-1' has changed since its shadow run" in problem
    assert cli.main(["rollback", "--twin", str(twin)]) == 0
    released = twin / "releases" / "0002" / "files"
    for name in ("spring.onnx", "twin.yaml", "shadow/spring-1.json"):
        assert (twin / name).read_bytes() == (released / name).read_bytes()


def test_a_residual_with_the_wrong_sign_is_rejected_and_not_promoted(place: Path) -> None:
    onnx_spring(place / "twin" / "spring.onnx", -0.4)
    declare_residual(place, "onnx", "spring.onnx")
    document = run_shadow(place, 1, "--promote")
    by_name = {one["metric"]: one for one in document["metrics"]}
    assert not by_name["position_rms"]["met"]
    assert not by_name["position_max"]["met"]
    assert not (place / "twin" / "shadow").exists()


class OpenGuard(Guard):
    """A guard that blocks no force."""

    def force(self, now, sample):
        if sample is None or not np.isfinite(sample.velocity).all():
            return np.array([0.1])
        return self.law(sample.position, sample.velocity, sample.command)[0]


def test_without_a_guard_the_tests_of_all_faults_fail(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(faults, "Guard", OpenGuard)
    monkeypatch.setattr(shadow, "Guard", OpenGuard)
    table_spring(place / "twin" / "laws.json")
    declare_residual(place, "unnamed_laws", "laws.json")
    base = place / "twin" / "twin.yaml"
    document = shadow.shadow(str(base), str(base), [str(place / "0.mcap")])
    assert [fault["fault"] for fault in document["faults"] if fault["holds"]] == []


UPDATE = """
update:
  id: friction-1
  rule: recursive_least_squares
  window: 0.5
  parameters:
    JOINT.viscous_friction: {lower: 0.0, upper: 0.4}
    JOINT.torque_constant: {lower: -0.5, upper: 0.5}
"""


def test_the_values_of_an_update_have_units(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "twin" / "twin.yaml").write_text(TWIN + UPDATE.replace("JOINT", "a"))
    twin, data = str(place / "twin"), str(place / "0.mcap")
    cli.main(["shadow", str(place / "twin/releases/0001"), twin, data])
    lines = capsys.readouterr().out.splitlines()
    assert all(line.endswith(" rad") for line in lines if line.startswith("    all: "))
    (friction,) = (line for line in lines if line.startswith("  a.viscous_friction: 0.05 -> "))
    assert friction.endswith(" N*m*s/rad")
    assert any(line.startswith("  a.torque_constant: 0 -> ") for line in lines)


def test_an_update_that_rests_on_its_bound_is_not_promoted(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The damping of the plant is outside the bounds; the update predicts better all the same."""
    update = UPDATE.replace("JOINT", "a").replace("upper: 0.4", "upper: 0.06")
    update = "\n".join(line for line in update.splitlines() if "torque_constant" not in line)
    (place / "twin" / "twin.yaml").write_text(TWIN + update + "\n")
    twin, data = str(place / "twin"), str(place / "0.mcap")
    assert cli.main(["shadow", str(place / "twin/releases/0001"), twin, data, "--promote"]) == 1
    output = capsys.readouterr().out
    assert "NOT MET: a.viscous_friction stays at its bound of 0.06" in output
    assert "promoted" not in output


def test_an_update_of_an_unknown_joint_is_refused_with_its_place(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = place / "twin" / "twin.yaml"
    file.write_text(TWIN + UPDATE.replace("JOINT", "aa"))
    words = [
        "shadow",
        str(place / "twin/releases/0001"),
        str(place / "twin"),
        str(place / "0.mcap"),
    ]
    assert cli.main(words) == 2
    error = capsys.readouterr().err
    assert f"{file}:" in error
    assert "update.parameters.aa.viscous_friction: no such joint (got 'aa'" in error
    assert "expected perhaps 'a')" in error


def test_an_invalid_candidate_or_release_is_refused_with_a_reason(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = place / "twin"
    release, data = str(twin / "releases" / "0001"), str(place / "0.mcap")
    assert cli.main(["shadow", release, str(twin), data, "--promote"]) == 2
    assert "nothing to promote" in capsys.readouterr().err
    (twin / "laws.json").write_text("{}")
    declare_residual(place, "unnamed_laws", "laws.json")
    assert cli.main(["shadow", release, str(twin), data]) == 2
    assert "no tables of a diagnosis" in capsys.readouterr().err
    (twin / "releases" / "0001" / "release.dsse.json").unlink()
    assert cli.main(["shadow", release, str(twin), data]) == 2
    assert "does not hold" in capsys.readouterr().err
