"""Goldens that re-check an accepted calibration on its held-out observations."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from test_calibrate_command import written

from pytest_twin.calibration.exports import export_files
from pytest_twin.calibration.run import calibrate_file
from pytest_twin.checks import check_of
from pytest_twin.checks.base import Measure, NothingToProposeError
from pytest_twin.checks.files import find_file
from pytest_twin.errors import SpecError, TwinError
from pytest_twin.formats.digest import file_sha256
from pytest_twin.gate.parts import installed_version
from pytest_twin.gate.plan import Plan, Task
from pytest_twin.gate.specs import load_golden
from pytest_twin.gate.why import why_lines
from pytest_twin.golden import Golden
from pytest_twin.realization import load
from pytest_twin.staleness import Baseline, Model, Stock, Surroundings, staleness, take_stock
from pytest_twin.twin import Twin, load_twin

PAGE = Path(__file__).resolve().parents[2] / "docs" / "kinds" / "calibration.md"
SPEC = """\
schema: 1
kind: calibration
target:
  record: cell_hand_eye
  plan: calibration.yaml
  observations: observations.csv
  flange: fr3_link8
tolerance: {position: 2 mm, orientation: 3.5 mrad}
"""
FK = """\
schema: 1
kind: fk
target: {frames: [fr3_link8]}
stimulus: {poses: [reference]}
tolerance: {position: 1 um, orientation: 1e-6 rad}
"""
LINK = 'xyz="0.0 -0.316'


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A twin with an accepted calibration whose joint 4 is off by 20 mrad."""
    root = tmp_path_factory.mktemp("cell")
    written(root)
    document = calibrate_file(str(root / "calibration.yaml"))
    assert document["verdict"] == "accepted"
    (root / "record.json").write_text(json.dumps(document))
    # Another record of the same observations; its zeros are not taken over.
    (root / "second.json").write_text(json.dumps(document | {"calibration": "second"}))
    (root / "twin.yaml").write_text(
        "model: fr3.urdf\ncalibrations: [{file: record.json}, {file: second.json, use: []}]\n"
    )
    (root / "golden").mkdir()
    (root / "golden" / "hand_eye.yaml").write_text(SPEC)
    (root / "golden" / "second.yaml").write_text(SPEC.replace("cell_hand_eye", "second"))
    (root / "golden" / "fk.yaml").write_text(FK)
    return root


@pytest.fixture
def cell(calibrated: Path, tmp_path: Path) -> Path:
    root = tmp_path / "cell"
    shutil.copytree(calibrated, root)
    return root


def measured(root: Path) -> list[Measure]:
    twin = load_twin(root / "twin.yaml")
    golden = load_golden(root / "golden" / "hand_eye.yaml", twin)
    check = check_of("calibration")
    realization = load(root / "fr3.urdf", twin=twin)
    return check.compare(golden, check.observe(golden, realization, lambda fraction: None), None)


def replaced(root: Path, file: str, old: str, new: str) -> None:
    text = (root / file).read_text()
    assert old in text
    (root / file).write_text(text.replace(old, new, 1))


def test_the_robot_that_was_calibrated_passes_with_the_errors_of_the_record(cell: Path) -> None:
    found = {m.name: m for m in measured(cell)}
    assert all(m.passed for m in found.values())
    for m in found.values():
        assert m.against == "record"
        assert m.error == pytest.approx(m.golden, rel=1e-3)
    assert found["position"].subject.startswith("cell_hand_eye on 10 held-out observations (worst")


def test_a_moved_link_fails(cell: Path) -> None:
    replaced(cell, "fr3.urdf", LINK, 'xyz="0.0 -0.336')
    position = next(m for m in measured(cell) if m.name == "position")
    assert not position.passed
    assert position.error > 0.003


def test_a_twin_without_the_zeros_fails(cell: Path) -> None:
    replaced(cell, "twin.yaml", "{file: record.json}", "{file: record.json, use: []}")
    assert not all(m.passed for m in measured(cell))


def test_a_record_with_geometry_passes_on_the_calibrated_urdf_alone(tmp_path: Path) -> None:
    plan = (
        "estimate: [joint_zeros, geometry, base_world, hand_eye]\ncamera: {mount: hand}\n"
        "hold_out: {fraction: 0.33, seed: 1}\naccept: {translation: 0.002, rotation: 0.0035}\n"
    )
    written(tmp_path, plan=plan)
    document = calibrate_file(str(tmp_path / "calibration.yaml"))
    nominal = (tmp_path / "fr3.urdf").read_text()
    texts = export_files(str(tmp_path / "calibration.yaml"), document, str(tmp_path))
    (tmp_path / "record.json").write_text(json.dumps(document))
    (tmp_path / "golden").mkdir()
    (tmp_path / "golden" / "hand_eye.yaml").write_text(SPEC)
    # The exported file has the zeros in its origins.
    (tmp_path / "twin.yaml").write_text(
        "model: fr3.urdf\ncalibrations: [{file: record.json, use: []}]\n"
    )
    (tmp_path / "fr3.urdf").write_text(texts["calibrated.urdf"])
    assert [m.error for m in measured(tmp_path)] == pytest.approx(
        [m.golden for m in measured(tmp_path)], rel=1e-3
    )
    (tmp_path / "fr3.urdf").write_text(nominal)
    assert not all(m.passed for m in measured(tmp_path))


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("golden/hand_eye.yaml", "record: cell", "record: sell", "did you mean 'cell_hand_eye'"),
        ("golden/hand_eye.yaml", "fr3_link8", "fr3_link7", "not the flange of the plan"),
        (
            "calibration.yaml",
            "seed: 1",
            "seed: 2",
            "target.plan: not a file that cell_hand_eye was made from",
        ),
        ("observations.csv", "id,", "id,", ""),
    ],
)
def test_what_is_not_the_records_is_refused(
    cell: Path, file: str, old: str, new: str, words: str
) -> None:
    replaced(cell, file, old, new)
    if not words:
        with (cell / file).open("a") as stream:
            stream.write("\n")
        words = "target.observations: not a file that cell_hand_eye was made from"
    with pytest.raises(SpecError) as caught:
        measured(cell)
    assert words in str(caught.value)
    assert caught.value.line is not None


def test_a_record_without_a_needed_transform_is_refused(cell: Path) -> None:
    document = json.loads((cell / "record.json").read_text())
    del document["records"]["hand_eye"]
    (cell / "record.json").write_text(json.dumps(document))
    with pytest.raises(SpecError, match="no transform of the camera on the flange"):
        measured(cell)


def test_a_record_without_held_out_observations_is_refused(cell: Path) -> None:
    document = json.loads((cell / "record.json").read_text())
    del document["held_out"]["ids"]
    (cell / "record.json").write_text(json.dumps(document))
    with pytest.raises(SpecError, match="the calibration held no observation out"):
        measured(cell)


def test_nothing_is_proposed_without_a_calibration(cell: Path) -> None:
    with pytest.raises(NothingToProposeError, match=r"docs/kinds/calibration\.md"):
        check_of("calibration").first(load(cell / "fr3.urdf"))


def test_the_documented_example_loads(cell: Path) -> None:
    path = cell / "golden" / "hand_eye.yaml"
    path.write_text(PAGE.read_text().split("```yaml\n")[1].split("```")[0])
    assert load_golden(path, load_twin(cell / "twin.yaml")).kind == "calibration"


# -- what makes it stale


def stock(root: Path) -> Stock:
    twin = load_twin(root / "twin.yaml")
    goldens = [load_golden(path, twin) for path in sorted((root / "golden").iterdir())]
    realization = load(root / "fr3.urdf", twin=twin)
    models = {"mujoco": Model(realization.parts, realization.structure)}
    return take_stock(twin, goldens, models, _surroundings(twin))


def _surroundings(twin: Twin) -> Surroundings:
    def digest(golden: Golden | None, reference: str) -> str | None:
        try:
            return file_sha256(
                Path(reference) if golden is None else find_file(golden, "", reference, twin)
            )
        except TwinError:
            return None

    return Surroundings(check_of, installed_version, digest)


def moved_mount(root: Path) -> None:
    document = json.loads((root / "record.json").read_text())
    document["records"]["hand_eye"]["transform"]["xyz"][0] += 0.01
    (root / "record.json").write_text(json.dumps(document))


def other_zero(root: Path) -> None:
    document = json.loads((root / "record.json").read_text())
    document["records"]["joint_zeros"]["values"]["fr3_joint4"]["value"] += 0.01
    (root / "record.json").write_text(json.dumps(document))


def reworded(root: Path) -> None:
    document = json.loads((root / "record.json").read_text())
    document["notes"] = ["checked on Monday"]
    (root / "record.json").write_text(json.dumps(document))


def other_link(root: Path) -> None:
    replaced(root, "fr3.urdf", LINK, 'xyz="0.0 -0.336')


def more_data(root: Path) -> None:
    with (root / "observations.csv").open("a") as stream:
        stream.write("\n")


CHANGES: list[tuple[Callable[[Path], None], set[str], str]] = [
    (moved_mount, {"hand_eye"}, "record:cell_hand_eye: transforms.hand_eye.position"),
    (other_zero, {"hand_eye", "second"}, "calibration:fr3_joint4: offset"),
    (reworded, set(), ""),
    (other_link, {"hand_eye", "second", "fk"}, "mujoco/kinematics:"),
    (more_data, {"hand_eye", "second"}, "file:observations.csv: sha256"),
]


@pytest.mark.parametrize(
    ("change", "stale", "words"), CHANGES, ids=[change[0].__name__ for change in CHANGES]
)
def test_a_change_makes_exactly_what_rests_on_it_stale(
    cell: Path, change: Callable[[Path], None], stale: set[str], words: str
) -> None:
    before = stock(cell)
    release = Baseline(1, before.parts, dict.fromkeys(before.rests_on, True), before.rests_on)
    change(cell)
    reasons = staleness(stock(cell), release)
    found = {key.split("/")[1].split("@")[0]: why for key, why in reasons.items() if why}
    assert found.keys() == stale
    assert not words or any(str(reason).startswith(words) for reason in found["hand_eye"])


# -- stale and unchecked records in --twin-why


def told(root: Path, change: Callable[[Path], None]) -> list[str]:
    """What ``--twin-why`` says of records after a change to a released twin."""
    before = stock(root)
    release = Baseline(1, before.parts, dict.fromkeys(before.rests_on, True), before.rests_on)
    change(root)
    now = stock(root)
    twin = load_twin(root / "twin.yaml")
    tasks = {}
    for path in sorted((root / "golden").iterdir()):
        golden = load_golden(path, twin)
        key = f"{golden.id}@mujoco"
        reasons = staleness(now, release)[key]
        tasks[key] = Task(golden, "mujoco", tuple(now.rests_on[key]), reasons, None)
    return [
        line
        for line in why_lines(Plan(tasks, now.parts))
        if line.startswith(("stale  record", "unchecked"))
    ]


def test_a_record_is_stale_when_the_robot_that_it_was_measured_with_changes(cell: Path) -> None:
    assert told(cell, other_link) == [
        "stale  record:cell_hand_eye  measured with parts that have changed",
        "stale  record:second  measured with parts that have changed",
    ]


def test_a_new_record_is_not_stale_itself(cell: Path) -> None:
    def new_record(root: Path) -> None:
        moved_mount(root)
        other_zero(root)

    # The zeros of the first are those of the robot, and the second was measured with others.
    assert told(cell, new_record) == ["stale  record:second  measured with parts that have changed"]


def test_a_record_that_no_golden_checks_is_named(cell: Path) -> None:
    (cell / "golden" / "second.yaml").unlink()
    assert told(cell, reworded) == [
        "unchecked  record:second  no golden of kind calibration re-checks it"
    ]


def test_a_superseded_record_needs_no_golden(cell: Path) -> None:
    (cell / "golden" / "hand_eye.yaml").unlink()
    replaced(cell, "twin.yaml", "use: []", "supersedes: [cell_hand_eye]")
    assert told(cell, reworded) == []
