"""Goldens that test an accepted calibration on its held-out observations."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from test_calibrate_command import write_cell

from pytest_twin.calibration.calibrate import calibrate_file
from pytest_twin.calibration.exports import export_files
from pytest_twin.checks import check_of
from pytest_twin.checks.base import Measure, NothingToProposeError
from pytest_twin.checks.files import find_file
from pytest_twin.errors import SpecError, TwinError
from pytest_twin.formats.digest import file_sha256
from pytest_twin.gate.distributions import installed_version
from pytest_twin.gate.plan import Plan, Task
from pytest_twin.gate.plan_lines import why_lines
from pytest_twin.gate.specs import load_golden
from pytest_twin.golden import Golden
from pytest_twin.realization import load
from pytest_twin.realization.record_inputs import states_of_records
from pytest_twin.staleness import Baseline, DependencyMap, Lookups, Model, dependency_map, staleness
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
    """A twin with an accepted calibration of a robot whose joint 4 has a zero error of 20 mrad."""
    root = tmp_path_factory.mktemp("cell")
    write_cell(root)
    document = calibrate_file(str(root / "calibration.yaml"))
    assert document["verdict"] == "accepted"
    (root / "record.json").write_text(json.dumps(document))
    # A second record of the same observations, whose joint zeros the twin does not apply.
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


def measures_of(root: Path) -> list[Measure]:
    twin = load_twin(root / "twin.yaml")
    golden = load_golden(root / "golden" / "hand_eye.yaml", twin)
    check = check_of("calibration")
    realization = load(root / "fr3.urdf", twin=twin)
    return check.compare(golden, check.observe(golden, realization, lambda fraction: None), None)


def replace_text(root: Path, file: str, old: str, new: str) -> None:
    text = (root / file).read_text()
    assert old in text
    (root / file).write_text(text.replace(old, new, 1))


def test_the_golden_passes_for_the_calibrated_robot_with_the_errors_of_the_record(
    cell: Path,
) -> None:
    found = {m.name: m for m in measures_of(cell)}
    assert all(m.passed for m in found.values())
    for m in found.values():
        assert m.against == "record"
        assert m.error == pytest.approx(m.golden, rel=1e-3)
    assert found["position"].subject.startswith("cell_hand_eye on 10 held-out observations (worst")


def test_the_golden_fails_for_a_displaced_link(cell: Path) -> None:
    replace_text(cell, "fr3.urdf", LINK, 'xyz="0.0 -0.336')
    position = next(m for m in measures_of(cell) if m.name == "position")
    assert not position.passed
    assert position.error > 0.003


def test_the_golden_fails_without_the_joint_zeros(cell: Path) -> None:
    replace_text(cell, "twin.yaml", "{file: record.json}", "{file: record.json, use: []}")
    assert not all(m.passed for m in measures_of(cell))


def test_the_golden_of_a_record_with_geometry_passes_only_for_the_calibrated_urdf(
    tmp_path: Path,
) -> None:
    plan = (
        "estimate: [joint_zeros, geometry, base_world, hand_eye]\ncamera: {mount: hand}\n"
        "hold_out: {fraction: 0.33, seed: 1}\naccept: {translation: 0.002, rotation: 0.0035}\n"
    )
    write_cell(tmp_path, plan=plan)
    document = calibrate_file(str(tmp_path / "calibration.yaml"))
    nominal = (tmp_path / "fr3.urdf").read_text()
    texts = export_files(str(tmp_path / "calibration.yaml"), document, str(tmp_path))
    (tmp_path / "record.json").write_text(json.dumps(document))
    (tmp_path / "golden").mkdir()
    (tmp_path / "golden" / "hand_eye.yaml").write_text(SPEC)
    # The exported file includes the joint zeros in its joint origins.
    (tmp_path / "twin.yaml").write_text(
        "model: fr3.urdf\ncalibrations: [{file: record.json, use: []}]\n"
    )
    (tmp_path / "fr3.urdf").write_text(texts["calibrated.urdf"])
    assert [m.error for m in measures_of(tmp_path)] == pytest.approx(
        [m.golden for m in measures_of(tmp_path)], rel=1e-3
    )
    (tmp_path / "fr3.urdf").write_text(nominal)
    assert not all(m.passed for m in measures_of(tmp_path))


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
def test_files_and_names_that_do_not_belong_to_the_record_are_refused(
    cell: Path, file: str, old: str, new: str, words: str
) -> None:
    replace_text(cell, file, old, new)
    if not words:
        with (cell / file).open("a") as stream:
            stream.write("\n")
        words = "target.observations: not a file that cell_hand_eye was made from"
    with pytest.raises(SpecError) as caught:
        measures_of(cell)
    assert words in str(caught.value)
    assert caught.value.line is not None


def test_a_record_without_a_needed_transform_is_refused(cell: Path) -> None:
    document = json.loads((cell / "record.json").read_text())
    del document["records"]["hand_eye"]
    (cell / "record.json").write_text(json.dumps(document))
    with pytest.raises(SpecError, match="no transform of the camera on the flange"):
        measures_of(cell)


def test_a_record_without_held_out_observations_is_refused(cell: Path) -> None:
    document = json.loads((cell / "record.json").read_text())
    del document["held_out"]["ids"]
    (cell / "record.json").write_text(json.dumps(document))
    with pytest.raises(SpecError, match="the calibration has no held-out observations"):
        measures_of(cell)


def test_nothing_is_proposed_without_a_calibration(cell: Path) -> None:
    with pytest.raises(NothingToProposeError, match=r"docs/kinds/calibration\.md"):
        check_of("calibration").first(load(cell / "fr3.urdf"))


def test_the_documented_example_loads(cell: Path) -> None:
    path = cell / "golden" / "hand_eye.yaml"
    path.write_text(PAGE.read_text().split("```yaml\n")[1].split("```")[0])
    assert load_golden(path, load_twin(cell / "twin.yaml")).kind == "calibration"


# -- goldens that become stale


def dependency_map_of(root: Path) -> DependencyMap:
    twin = load_twin(root / "twin.yaml")
    goldens = [load_golden(path, twin) for path in sorted((root / "golden").iterdir())]
    realization = load(root / "fr3.urdf", twin=twin)
    models = {"mujoco": Model(realization.parts, realization.structure)}
    return dependency_map(twin, goldens, models, _surroundings(twin))


def _surroundings(twin: Twin) -> Lookups:
    def digest(golden: Golden | None, reference: str) -> str | None:
        try:
            return file_sha256(
                Path(reference) if golden is None else find_file(golden, "", reference, twin)
            )
        except TwinError:
            return None

    return Lookups(check_of, installed_version, digest)


def change_mount(root: Path) -> None:
    document = json.loads((root / "record.json").read_text())
    document["records"]["hand_eye"]["transform"]["xyz"][0] += 0.01
    (root / "record.json").write_text(json.dumps(document))


def change_zero(root: Path) -> None:
    document = json.loads((root / "record.json").read_text())
    document["records"]["joint_zeros"]["values"]["fr3_joint4"]["value"] += 0.01
    (root / "record.json").write_text(json.dumps(document))


def change_note(root: Path) -> None:
    document = json.loads((root / "record.json").read_text())
    document["notes"] = ["checked on Monday"]
    (root / "record.json").write_text(json.dumps(document))


def change_link(root: Path) -> None:
    replace_text(root, "fr3.urdf", LINK, 'xyz="0.0 -0.336')


def add_data(root: Path) -> None:
    with (root / "observations.csv").open("a") as stream:
        stream.write("\n")


CHANGES: list[tuple[Callable[[Path], None], set[str], str]] = [
    (change_mount, {"hand_eye"}, "record:cell_hand_eye: transforms.hand_eye.position"),
    (change_zero, {"hand_eye", "second"}, "calibration:fr3_joint4: offset"),
    (change_note, set(), ""),
    (change_link, {"hand_eye", "second", "fk"}, "mujoco/kinematics:"),
    (add_data, {"hand_eye", "second"}, "file:observations.csv: sha256"),
]


@pytest.mark.parametrize(
    ("change", "stale", "words"), CHANGES, ids=[change[0].__name__ for change in CHANGES]
)
def test_a_change_makes_only_the_dependent_goldens_stale(
    cell: Path, change: Callable[[Path], None], stale: set[str], words: str
) -> None:
    before = dependency_map_of(cell)
    release = Baseline(1, before.parts, dict.fromkeys(before.depends_on, True), before.depends_on)
    change(cell)
    reasons = staleness(dependency_map_of(cell), release)
    found = {key.split("/")[1].split("@")[0]: why for key, why in reasons.items() if why}
    assert found.keys() == stale
    assert not words or any(str(reason).startswith(words) for reason in found["hand_eye"])


# -- stale and unchecked records


def record_lines(root: Path, change: Callable[[Path], None]) -> list[str]:
    """Lines of ``--twin-why`` about records after a change to a released twin."""
    before = dependency_map_of(root)
    release = Baseline(1, before.parts, dict.fromkeys(before.depends_on, True), before.depends_on)
    change(root)
    now = dependency_map_of(root)
    twin = load_twin(root / "twin.yaml")
    tasks = {}
    for path in sorted((root / "golden").iterdir()):
        golden = load_golden(path, twin)
        key = f"{golden.id}@mujoco"
        reasons = staleness(now, release)[key]
        tasks[key] = Task(golden, "mujoco", tuple(now.depends_on[key]), reasons, None)
    return [
        line
        for line in why_lines(Plan(tasks, now.parts))
        if line.startswith(("stale  record", "unchecked"))
    ]


def test_a_record_is_stale_after_a_change_of_the_robot_it_was_measured_with(cell: Path) -> None:
    def stale_records() -> list[str]:
        states = states_of_records(load_twin(cell / "twin.yaml"))
        return [state.record.id for state in states if state.touching]

    assert stale_records() == []
    change_link(cell)
    assert stale_records() == ["cell_hand_eye", "second"]


def test_a_record_without_a_golden_is_reported(cell: Path) -> None:
    (cell / "golden" / "second.yaml").unlink()
    assert record_lines(cell, change_note) == [
        "unchecked  record:second  no golden of kind calibration re-checks it"
    ]


def test_a_superseded_record_needs_no_golden(cell: Path) -> None:
    (cell / "golden" / "hand_eye.yaml").unlink()
    replace_text(cell, "twin.yaml", "use: []", "supersedes: [cell_hand_eye]")
    assert record_lines(cell, change_note) == []
