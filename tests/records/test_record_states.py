"""Records of a twin become stale if an input that they used changes, though they override it."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest
from recorded_cell import changed, edit, states, write_calibration, write_cell, write_identification

from pytest_twin import cli
from pytest_twin.formats.digest import file_sha256
from pytest_twin.realization import load
from pytest_twin.realization.record_inputs import replaced_parts, states_of_records
from pytest_twin.records.state import unknown_statements, with_records
from pytest_twin.staleness import DependencyMap, Model, staleness
from pytest_twin.twin import load_twin

sys.path.append(str(Path(__file__).parents[1] / "dependency"))

from dependency_map_of import dependency_map_of, proven


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_cell(tmp_path_factory.mktemp("template"))


@pytest.fixture
def cell(template: Path, tmp_path: Path) -> Path:
    shutil.copytree(template, tmp_path / "cell")
    return tmp_path / "cell"


def test_records_of_an_unchanged_cell_are_fresh(cell: Path) -> None:
    assert set(states(cell)) == {"identified", "zeros"}
    assert changed(cell) == {}


@pytest.mark.parametrize(
    ("file", "old", "new", "expected"),
    [
        # A mass, a gain and a friction that the record overrides.
        (
            "arm.xml", 'mass="0.6"', 'mass="0.642"',
            {"identified": ["inertia:fore: mass 0.6 -> 0.642 kg"]},
        ),
        (
            "arm.xml", 'kp="20"', 'kp="25"',
            {"identified": [f"actuator:elbow: {name} {old} -> {new}" for name, old, new in (
                ("biasprm", [0, -20, *8 * [0]], [0, -25, *8 * [0]]),
                ("gainprm", [20, *9 * [0]], [25, *9 * [0]]),
            )]},
        ),
        (
            "twin.yaml", "kp: 55", "kp: 56",
            {"identified": ["fit:gains: actuator.shoulder.kp 55 -> 56"]},
        ),
        (
            "arm.xml", 'damping="0.2"', 'damping="0.25"',
            {"identified": ["joint:elbow: damping 0.2 -> 0.25 N*m*s/rad"]},
        ),
        # Geometry is used by both.
        (
            "arm.xml", 'name="fore" pos="0.3 0 0"', 'name="fore" pos="0.31 0 0"',
            {"identified": ["kinematics:fore: position [0.3, 0, 0] -> [0.31, 0, 0] m"],
             "zeros": ["kinematics:fore: position [0.3, 0, 0] -> [0.31, 0, 0] m"]},
        ),
        # The conditions of its recordings, and no others.
        (
            "twin.yaml", "mass: 0.5", "mass: 0.55",
            {"identified": ["payload:kg05: fore.mass 0.5 -> 0.55 kg"]},
        ),
        ("twin.yaml", "kp: 10}", "kp: 11}", {"identified": ["controller:soft: elbow.kp 10 -> 11"]}),
        ("twin.yaml", "mass: 1.0", "mass: 1.1", {}),
        ("twin.yaml", "kp: 80", "kp: 81", {}),
        # A stated encoder beneath a calibration.
        (
            "twin.yaml", "offset: 0.01", "offset: 0.02",
            {"identified": ["calibration:elbow: offset 0.01 -> 0.02 rad or m"],
             "zeros": ["calibration:elbow: offset 0.01 -> 0.02 rad or m"]},
        ),
        # Texts, looks, and what moves apart from the robot.
        ("arm.xml", "<worldbody>", "<!-- the cell --><worldbody>", {}),
        ("arm.xml", 'mass="0.6"', 'mass="0.600"', {}),
        ("arm.xml", 'rgba="0.2', 'rgba="0.9', {}),
        ("arm.xml", 'size="0.03 0.03 0.03"', 'size="0.05 0.05 0.05"', {}),
        ("arm.xml", 'mass="3"', 'mass="4"', {}),
        ("twin.yaml", "name: cell", "# the second cell\nname: cell", {}),
        ("plan.yaml", "flange: tcp", "flange: tcp  # of the gripper", {}),
        ("observations.csv", "0.10,0.20", "0.1, 0.2", {}),
    ],
)  # fmt: skip
def test_a_record_is_stale_exactly_if_an_input_that_it_used_changed(
    cell: Path, file: str, old: str, new: str, expected: dict[str, list[str]]
) -> None:
    edit(cell / file, old, new)
    assert changed(cell) == expected


@pytest.mark.parametrize(
    ("file", "old", "new", "record"),
    [
        ("observations.csv", "0.40", "0.41", "zeros"),
        ("plan.yaml", "estimate: [joint_zeros]", "estimate: [joint_zeros, tcp]", "zeros"),
        ("one.csv", "0.2", "0.3", "identified"),
    ],
)
def test_changed_data_make_the_record_stale(
    cell: Path, file: str, old: str, new: str, record: str
) -> None:
    edit(cell / file, old, new)
    assert list(changed(cell)) == [record]
    assert changed(cell)[record][0].startswith(f"file:{file}: content ")


def test_a_record_that_is_made_again_is_fresh(cell: Path) -> None:
    edit(cell / "arm.xml", 'mass="0.6"', 'mass="0.642"')
    write_identification(cell)
    assert changed(cell) == {}
    edit(cell / "arm.xml", 'mass="0.642"', 'mass="0.6"')
    assert list(changed(cell)) == ["identified"]


def test_the_owner_accepts_one_change_and_not_the_next(cell: Path) -> None:
    edit(cell / "arm.xml", 'mass="0.6"', 'mass="0.642"')
    twin = load_twin(cell / "twin.yaml")
    state = states(cell)["identified"]
    line = str(state.as_error(twin))
    (change,) = state.touching
    assert line == (
        f"{cell}/twin.yaml:13: fit.1: record 'identified' is stale: its inputs changed: "
        "inertia:fore: mass 0.6 -> 0.642 kg (expected pytest-twin identify again, or if it does "
        f"not touch the record, here unaffected: [{{part: 'inertia:fore', "
        f'digest: {change.digest[:12]}, reason: "WHY", owner: "WHO"}}])'
    )
    statement = line[line.index("unaffected:") : -1].replace("WHY", "a label, 42 g")
    statement = statement.replace("WHO", "A. Engineer")
    edit(cell / "twin.yaml", "identification.json}", f"identification.json, {statement}}}")
    assert changed(cell) == {}
    edit(cell / "arm.xml", 'mass="0.642"', 'mass="0.65"')
    assert list(changed(cell)) == ["identified"]


def test_a_statement_about_something_that_the_record_did_not_use_is_an_error(cell: Path) -> None:
    stated = "unaffected: [{part: 'inertia:fox', digest: 0123456789ab, reason: r, owner: o}]"
    edit(cell / "twin.yaml", "identification.json}", f"identification.json, {stated}}}")
    (problem,) = unknown_statements(list(states(cell).values()), load_twin(cell / "twin.yaml"))
    assert "fit.1.unaffected.0.part: no input of record 'identified' (got 'inertia:fox'" in str(
        problem
    )


def test_a_later_record_does_not_hide_a_change_beneath_the_one_that_it_supersedes(
    cell: Path,
) -> None:
    write_identification(cell, "second")
    listed = "- {file: second/identification.json, supersedes: [identified]}\n"
    edit(cell / "twin.yaml", "calibrations:", listed + "calibrations:")
    assert changed(cell) == {}
    edit(cell / "arm.xml", 'mass="0.6"', 'mass="0.642"')
    assert changed(cell) == {"second": ["inertia:fore: mass 0.6 -> 0.642 kg"]}


def test_an_earlier_record_may_be_removed_if_the_later_one_has_all_of_its_values(
    cell: Path,
) -> None:
    write_identification(cell, "second")
    edit(cell / "twin.yaml", "identified/", "second/")
    assert changed(cell) == {}


def test_an_earlier_record_that_was_fitted_again_makes_a_later_one_stale(cell: Path) -> None:
    write_identification(cell, "second")
    listed = "- {file: second/identification.json}\n"
    edit(cell / "twin.yaml", "calibrations:", listed + "calibrations:")
    path = cell / "identified" / "identification.json"
    path.write_text(path.read_text().replace("0.33", "0.34"))
    assert changed(cell) == {"second": ["fitted:identified: joint.elbow.damping 0.33 -> 0.34"]}


def test_a_record_of_an_earlier_version_falls_back_on_the_digest_of_its_files(cell: Path) -> None:
    path = cell / "identified" / "identification.json"
    document = json.loads(path.read_text())
    del document["basis"]
    document["inputs"] = {
        name: {"sha256": file_sha256(cell / name)} for name in ("arm.xml", "twin.yaml")
    }
    path.write_text(json.dumps(document))
    assert changed(cell) == {}
    assert "an earlier version made it" in states(cell)["identified"].notes[0]
    edit(cell / "arm.xml", "<worldbody>", "<!-- a comment --><worldbody>")
    (line,) = changed(cell)["identified"]
    assert line.startswith("file:arm.xml: content ")


def test_a_record_that_was_moved_finds_its_model_by_name(cell: Path) -> None:
    (cell / "records" / "2026").mkdir(parents=True)
    (cell / "identified" / "identification.json").rename(cell / "records/2026/october.json")
    edit(cell / "twin.yaml", "identified/identification.json", "records/2026/october.json")
    assert changed(cell) == {}
    edit(cell / "arm.xml", 'mass="0.6"', 'mass="0.642"')
    assert list(changed(cell)) == ["identified"]


def test_a_record_of_a_model_that_the_twin_lacks_says_so(cell: Path) -> None:
    shutil.copy(cell / "arm.xml", cell / "other.xml")
    edit(cell / "twin.yaml", "model: arm.xml", "model: other.xml")
    # The original is still there: it is compared.
    edit(cell / "arm.xml", 'mass="0.6"', 'mass="0.642"')
    assert "identified" in changed(cell)
    (cell / "arm.xml").unlink()
    assert "identified" not in changed(cell)
    assert states(cell)["identified"].notes == (
        "record 'identified' was made with ../arm.xml, which this twin does not have: whether "
        "that model changed is not known",
    )


@pytest.mark.usefixtures("commands_in_process")
def test_a_prediction_with_a_stale_record_has_a_note(
    cell: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    header = "time,shoulder.position,elbow.position,shoulder.command,elbow.command\n"
    rows = "".join(f"{0.01 * i:.2f},0,0,0.1,0.1\n" for i in range(100))
    (cell / "motion.csv").write_text(header + rows)
    edit(cell / "arm.xml", 'mass="0.6"', 'mass="0.642"')
    arguments = [str(cell / "motion.csv"), "--out", str(cell / "predicted.mcap")]
    assert cli.main(["replay", str(cell / "twin.yaml"), *arguments]) == 0
    assert "record 'identified' is stale: its inputs changed: inertia:fore: mass" in (
        capsys.readouterr().out
    )


def reasons_of_goldens(root: Path, released: DependencyMap) -> list[str]:
    found = staleness(dependencies_of(root), proven(released))
    return [str(reason) for why in found.values() for reason in why]


def dependencies_of(root: Path) -> DependencyMap:
    twin = load_twin(root / "twin.yaml")
    models = {}
    for name, reference in twin.realizations.items():
        robot = load(reference.file, twin=twin, name=name)
        models[name] = Model(robot.parts, robot.structure, replaced_parts(robot))
    return with_records(dependency_map_of(root), states_of_records(twin), models)


def test_values_that_a_fit_replaces_make_the_goldens_of_every_realization_stale(
    cell: Path,
) -> None:
    """The record was made with one realization, and replaces the values of another too."""
    shutil.copy(cell / "arm.xml", cell / "second.xml")
    edit(cell / "twin.yaml", "model: arm.xml", "realizations: {a: {file: arm.xml}, "
         "b: {file: second.xml}}")  # fmt: skip
    (cell / "golden").mkdir()
    (cell / "golden" / "mass.yaml").write_text(
        "schema: 1\nkind: mass_properties\nrealizations: [a, b]\nstimulus: {poses: [reference]}\n"
        "tolerance: {mass: 1 g, center_of_mass: 1 mm}\n"
    )
    released = dependencies_of(cell)
    assert reasons_of_goldens(cell, released) == []
    edit(cell / "second.xml", 'mass="0.6"', 'mass="0.642"')
    assert reasons_of_goldens(cell, released) == ["b/source/inertia:fore: mass 0.6 -> 0.642 kg"]


def test_a_stated_zero_beneath_a_calibration_makes_its_goldens_stale(cell: Path) -> None:
    """The plan named the URDF alone, so that the record itself knows of no stated zero."""
    edit(cell / "plan.yaml", "robot: twin.yaml", "robot: arm.xml")
    write_calibration(cell)
    edit(
        cell / "twin.yaml",
        "joints: {elbow: {sign: -1,",
        "joints: {shoulder: {offset: 0.1}, elbow: {",
    )
    (cell / "golden").mkdir()
    (cell / "golden" / "replay.yaml").write_text(
        "schema: 1\nkind: replay\ntarget: {recording: one.csv}\ntolerance: {angle_rms: 1 mrad}\n"
    )
    released = dependencies_of(cell)
    edit(cell / "twin.yaml", "offset: 0.1", "offset: 0.2")
    assert "zeros" not in changed(cell)
    assert "basis:zeros: overrides.shoulder.offset 0.1 -> 0.2 rad or m" in reasons_of_goldens(
        cell, released
    )
