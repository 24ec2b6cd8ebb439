"""twin.yaml: permitted fields, their meaning, and errors."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pytest_twin.errors import TwinError
from pytest_twin.twin import Affects, Edit, Payload, find_twin, load_twin, schema

MODEL = "<mujoco/>"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "arm"
    root.mkdir()
    (root / "model.xml").write_text(MODEL)
    return root


def write(folder: Path, text: str) -> Path:
    path = folder / "twin.yaml"
    path.write_text(text)
    return path


def refused(folder: Path, text: str) -> str:
    with pytest.raises(TwinError) as caught:
        load_twin(write(folder, text))
    return str(caught.value).replace(str(folder), "")


def test_a_twin_file_needs_only_a_model(folder: Path) -> None:
    twin = load_twin(write(folder, "model: model.xml\n"))
    assert twin.name == "arm"
    assert twin.root == folder
    assert [ref.file for ref in twin.realizations.values()] == [folder / "model.xml"]
    assert list(twin.realizations) == ["mujoco"]
    assert twin.topics == {"state": "/joint_states", "command": "/joint_commands"}
    assert twin.release.valid_days == 90
    assert twin.files == (folder / "twin.yaml", folder / "model.xml")


FULL = """\
# yaml-language-server: $schema=twin.schema.json
schema: 1
name: demo
model: model.xml
realizations:
  urdf: {file: robot.urdf, simulator: mujoco}
source: [asset/robot.step]
edited: {robot.urdf: {reason: axis turned, owner: A. Engineer}}
roots: {shared: ../shared}
topics: {state: /js}
controllers:
  kp100: {servo: {kp: 0.239, forcerange: [-1, 1]}}
payloads:
  kg05: {link6: {mass: 0.5, com: [0, 0, 0.05], inertia: [1, 2, 3]}}
calibration:
  id: cal-7
  base: {position: [0, 0, 0.1], quaternion: [2.0e-4, 0, 0, 1]}
  joints: {elbow: {offset: 0.02, sign: -1}, wrist: {offset: 0.1}}
fit: {file: fit.yaml}
parts:
  firmware: {id: '3.10', affects: {kinds: [step], goldens: [golden/*], joints: [elbow]}}
  table: {file: table.txt}
  room: {value: 22.5}
tcp: tip
retired: {golden/old: superseded}
release: {valid_days: 30}
"""


@pytest.fixture
def full(folder: Path) -> Path:
    (folder / "asset").mkdir()
    (folder.parent / "shared").mkdir()
    for name in ("asset/robot.step", "robot.urdf", "table.txt"):
        (folder / name).write_text("x")
    (folder / "fit.yaml").write_text(
        "id: fit-3\njoint:\n  elbow: {damping: [0.1, 0.2]}\noption: {timestep: 0.001}\n"
    )
    return folder


def test_every_field_of_the_twin_file_is_read(full: Path) -> None:
    twin = load_twin(write(full, FULL))
    assert list(twin.realizations) == ["mujoco", "urdf"]
    assert twin.source == (full / "asset/robot.step",)
    assert twin.edited == {full / "robot.urdf": Edit("axis turned", "A. Engineer")}
    assert twin.roots == {"shared": full.parent / "shared"}
    assert twin.topics == {"state": "/js", "command": "/joint_commands"}
    assert twin.controllers == {"kp100": {"servo": {"kp": 0.239, "forcerange": (-1.0, 1.0)}}}
    assert twin.payloads == {"kg05": {"link6": Payload(0.5, (0, 0, 0.05), (1, 2, 3, 0, 0, 0))}}
    assert twin.calibration is not None
    assert twin.calibration.id == "cal-7"
    assert twin.calibration.joints["elbow"].sign == -1
    assert twin.calibration.joints["wrist"].sign == 1
    assert twin.calibration.transform_world_to_base is not None
    assert sum(q * q for q in twin.calibration.transform_world_to_base.quaternion) == pytest.approx(
        1.0, abs=1e-15
    )
    assert twin.fit is not None
    assert twin.fit.patches["joint"] == {"elbow": {"damping": (0.1, 0.2)}}
    assert twin.fit.option == {"timestep": 0.001}
    assert twin.fit.lines["joint.elbow.damping"] == 3
    assert twin.fit.path == full / "fit.yaml"
    assert twin.parts["firmware"].id == "3.10"
    assert twin.parts["firmware"].affects == Affects(("step",), ("golden/*",), ("elbow",))
    assert twin.parts["room"].value == 22.5
    assert twin.parts["table"].affects is None
    assert {full / "fit.yaml", full / "table.txt", full / "robot.urdf"} <= set(twin.files)
    assert str(twin.error("controllers.kp100.servo", "no")).endswith(
        "twin.yaml:12: controllers.kp100.servo: no"
    )


def test_roots_given_as_a_list_are_named_after_their_folders(full: Path) -> None:
    twin = load_twin(write(full, "model: model.xml\nroots: [../shared]\n"))
    assert twin.roots == {"shared": full.parent / "shared"}


REFUSED = [
    ("name: x\n", r"^/twin.yaml:1.*model"),
    ("model: model.xml\nmodle: y\n", r"^/twin.yaml:2: modle: .*"),
    ("model: gone.xml\n", r"^/twin.yaml:1: .*no such file .*'gone.xml'"),
    ("model: model.txt\n", r"^/twin.yaml:1: model: not a kind of model.*expected MJCF"),
    ("model: ../arm2/model.xml\n", r"^/twin.yaml:1: .*leaves the declared roots"),
    ("model: model.xml\nrelease: {valid_days: 0}\n", r"^/twin.yaml:2: release.valid_days: .*0"),
    (
        "model: model.xml\npayloads:\n  a:\n    hand: {com: [0, 0, 0]}\n",
        r"^/twin.yaml:4: payloads.a.hand.*mass",
    ),
    (
        "model: model.xml\npayloads:\n  a: {hand: {mass: -1}}\n",
        r"^/twin.yaml:3: payloads.a.hand.mass: .*got -1",
    ),
    (
        "model: model.xml\ncontrollers: {a: {servo: {kpp: 1}}}\n",
        r"^/twin.yaml:2: controllers.a.servo.*kpp",
    ),
    (
        "model: model.xml\nparts:\n  firmware: {id: 3, affects: {kind: [step]}}\n",
        r"^/twin.yaml:3: parts.firmware.affects.kind: ",
    ),
    ("model: model.xml\nparts:\n  firmware: {affects: {kinds: [step]}}\n", r"^/twin.yaml:3: parts"),
    (
        "model: model.xml\ncalibration: {id: a, base: {quaternion: [1, 1, 0, 0]}}\n",
        r"^/twin.yaml:2: calibration.base.quaternion: not a rotation \(got 'length 1.41421'",
    ),
    (
        "model: model.xml\ncalibration: {id: a, joints: {j: {sign: 0}}}\n",
        r"^/twin.yaml:2: calibration.joints.j.sign: ",
    ),
    (
        "model: model.xml\nrealizations: {mujoco: {file: model.xml}}\n",
        r"^/twin.yaml:2: realizations.mujoco: 'model:' is already",
    ),
    ("model: model.xml\nroots: [nowhere]\n", r"^/twin.yaml:2: roots.0: no such folder"),
    ("model: model.xml\nfit: {file: fit2.yaml}\n", r"^/fit2.yaml:2: joint.elbow.*stifness"),
    ("model: model.xml\nmodel: model.xml\n", r"^/twin.yaml:2:"),
    ('model: model.xml\nroots: ["a\\0"]\n', r"^/twin.yaml:2: roots"),
    ("model: no\n", r"^/twin.yaml:1: model: .*'no'"),
    ("[]\n", r"^/twin.yaml:1"),
    ("", r"^/twin.yaml:1"),
]


@pytest.mark.parametrize(("text", "words"), REFUSED)
def test_an_invalid_twin_file_is_refused_with_file_line_and_field(
    folder: Path, text: str, words: str
) -> None:
    (folder / "model.txt").write_text("x")
    (folder / "fit2.yaml").write_text("id: a\njoint: {elbow: {stifness: 1}}\n")
    message = refused(folder, text)
    assert re.search(words, message), message
    assert "\n" not in message


def test_a_symbolic_link_out_of_the_folder_is_refused(folder: Path) -> None:
    (folder.parent / "outside.xml").write_text(MODEL)
    (folder / "linked.xml").symlink_to(folder.parent / "outside.xml")
    assert "leaves the declared roots" in refused(folder, "model: linked.xml\n")


def test_the_twin_file_is_searched_in_parent_folders(folder: Path) -> None:
    path = write(folder, "model: model.xml\n")
    deep = folder / "golden" / "fk"
    deep.mkdir(parents=True)
    assert find_twin(deep) == path
    assert find_twin(folder) == path
    assert find_twin(folder.parent) is None


def test_the_twin_schema_is_valid_and_describes_every_field() -> None:
    jsonschema.Draft202012Validator.check_schema(schema())

    def undescribed(node: Any, where: str) -> list[str]:
        found = []
        for key, value in node.get("properties", {}).items():
            at = f"{where}.{key}"
            if "description" not in value and "$ref" not in value:
                found.append(at)
            found += undescribed(value, at)
        return found

    everything = [undescribed(schema(), "")]
    everything += [undescribed(node, name) for name, node in schema()["$defs"].items()]
    assert [path for found in everything for path in found] == []


def test_the_twin_file_of_the_xl330_recordings_is_read() -> None:
    beside = Path(__file__).resolve().parents[2] / "shared" / "recordings"
    path = Path(os.environ.get("TWIN_RECORDINGS", beside)) / "xl330" / "twin.yaml"
    if not path.is_file():
        pytest.skip(f"no recordings at {path}: set TWIN_RECORDINGS")
    twin = load_twin(path)
    assert twin.controllers["kp400"] == {"servo": {"kp": 0.957}}


json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-5, 5) | st.text("ab/.*", max_size=4),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(
                ["id", "file", "joints", "affects", "mass", "kp", "position", "a", "kinds"]
            ),
            inner,
            max_size=3,
        )
    ),
    max_leaves=8,
)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.dictionaries(st.sampled_from(sorted(schema()["properties"])), json_values, max_size=4))
def test_arbitrary_twin_files_are_read_or_raise_a_typed_error(
    folder: Path, data: dict[str, Any]
) -> None:
    path = write(folder, json.dumps({**data, "model": "model.xml"}))
    try:
        found: object = load_twin(path).realizations["mujoco"]
    except TwinError as error:
        found = error.line
    assert found is not None
