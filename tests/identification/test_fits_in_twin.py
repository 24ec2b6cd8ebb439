"""Use of identification records in a twin, and goldens that test them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from arms import (
    JOINTS,
    REAL,
    TRUE,
    simulated_effort,
    true_arm,
    write_mcap,
    write_model,
    write_recording,
)

from pytest_twin.checks import check_of
from pytest_twin.checks.base import Measure, NothingToProposeError
from pytest_twin.checks.files import find_file
from pytest_twin.errors import SpecError, TwinError
from pytest_twin.formats.digest import file_sha256
from pytest_twin.gate.distributions import installed_version
from pytest_twin.gate.specs import load_golden
from pytest_twin.identification.identify_files import identify_files
from pytest_twin.realization import load
from pytest_twin.realization.record_inputs import states_of_records
from pytest_twin.report.identification import encoder_rows, render, signal_rows
from pytest_twin.staleness import Baseline, DependencyMap, Lookups, Model, dependency_map, staleness
from pytest_twin.twin import load_twin

SPEC = """\
schema: 1
kind: identification
target: {record: october, recordings: [check.csv]}
tolerance: {effort: 3 %, torque: 0.2 N*m}
"""
FK = """\
schema: 1
kind: fk
target: {frames: [lower]}
stimulus: {poses: [reference]}
tolerance: {position: 1 um, orientation: 1e-6 rad}
"""


@pytest.fixture(scope="module")
def identified(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("cell")
    write_model(root)
    robot = true_arm(root)
    for name, seed in (("one", 1), ("two", 2), ("check", 3)):
        write_recording(root / f"{name}.csv", *simulated_effort(robot, seed))
    (root / "out").mkdir()
    document = identify_files(
        {
            "model": str(root / "model.xml"),
            "recordings": [str(root / "one.csv"), str(root / "two.csv")],
            "held_out": [str(root / "check.csv")],
            "out": str(root / "out"),
            "name": "october",
        }
    )
    (root / "record.json").write_text(json.dumps(document))
    (root / "twin.yaml").write_text("model: model.xml\nfit: [{file: record.json}]\n")
    (root / "golden").mkdir()
    (root / "golden" / "effort.yaml").write_text(SPEC)
    (root / "golden" / "fk.yaml").write_text(FK)
    return root


@pytest.fixture
def cell(identified: Path, tmp_path: Path) -> Path:
    shutil.copytree(identified, tmp_path / "cell")
    return tmp_path / "cell"


def measures_of(root: Path) -> list[Measure]:
    twin = load_twin(root / "twin.yaml")
    golden = load_golden(root / "golden" / "effort.yaml", twin)
    check = check_of("identification")
    robot = load(root / "model.xml", twin=twin)
    return check.compare(golden, check.observe(golden, robot, lambda fraction: None), None)


def dependency_map_of(root: Path) -> DependencyMap:
    twin = load_twin(root / "twin.yaml")
    goldens = [load_golden(path, twin) for path in sorted((root / "golden").glob("*.yaml"))]
    robot = load(root / "model.xml", twin=twin)

    def digest(golden, reference: str) -> str:
        found = root / reference if golden is None else find_file(golden, "target", reference, twin)
        return file_sha256(found)

    lookups = Lookups(check_of, installed_version, digest)
    return dependency_map(twin, goldens, {"mujoco": Model(robot.parts, robot.structure)}, lookups)


def stale_goldens(before: DependencyMap, after: DependencyMap) -> set[str]:
    passed = dict.fromkeys(before.depends_on, True)
    release = Baseline(1, before.parts, passed, before.depends_on)
    return {key for key, why in staleness(after, release).items() if why}


def test_the_twin_has_the_identified_parameters(cell: Path) -> None:
    twin = load_twin(cell / "twin.yaml")
    assert twin.fit is not None
    assert twin.fit.id == "october"
    record = twin.fits[0].record
    assert len(record.covariance) == len(record.covariance_names) == len(record.values)
    model = load(cell / "model.xml", twin=twin).model
    assert model.dof_damping == pytest.approx([1.5, 0.6], abs=0.1)
    assert cell / "record.json" in twin.files


def test_the_fit_can_be_a_single_table(cell: Path) -> None:
    (cell / "twin.yaml").write_text(
        "model: model.xml\nfit: {id: by-hand, joint: {elbow: {damping: 0.9}}}\n"
    )
    twin = load_twin(cell / "twin.yaml")
    assert twin.fit is not None
    assert twin.fit.id == "by-hand"
    assert not twin.fits


def test_a_later_fit_overrides_an_earlier_one(cell: Path) -> None:
    (cell / "twin.yaml").write_text(
        "model: model.xml\nfit:\n  - {file: record.json}\n"
        "  - {id: by-hand, joint: {elbow: {damping: 0.9}}}\n"
    )
    twin = load_twin(cell / "twin.yaml")
    assert twin.fit is not None
    assert twin.fit.id == "october+by-hand"
    model = load(cell / "model.xml", twin=twin).model
    assert model.dof_damping[1] == 0.9
    assert model.dof_damping[0] == pytest.approx(1.5, abs=0.1)


def test_a_superseded_record_is_not_applied(cell: Path) -> None:
    (cell / "twin.yaml").write_text(
        "model: model.xml\nfit:\n  - {file: record.json}\n"
        "  - {id: by-hand, joint: {elbow: {damping: 0.9}}}\n"
        "  - {file: second.json, supersedes: [october]}\n"
    )
    document = json.loads((cell / "record.json").read_text())
    second = document | {"identification": "november", "fit": {"joint": {"elbow": {"armature": 1}}}}
    (cell / "second.json").write_text(json.dumps(second))
    model = load(cell / "model.xml", twin=load_twin(cell / "twin.yaml")).model
    assert model.dof_damping.tolist() == [0.0, 0.9]
    assert model.dof_armature[1] == 1.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"verdict": "improved"}, "an identification that is not accepted (got 'improved'"),
        ({"covariance": {"names": ["a"], "matrix": []}}, "unusable: covariance"),
        ({"fit": {"option": {}}}, "unusable: fit"),
        (
            {"fit": {"joint": {"elbow": {"damping": "x"}}}},
            "fit.joint.elbow.damping: a field is missing or unusable (got 'x'; expected a number",
        ),
        ({"schema": 2}, "a field is missing or unusable: 'schema'"),
    ],
)
def test_an_invalid_record_is_refused(cell: Path, change: dict[str, object], words: str) -> None:
    document = json.loads((cell / "record.json").read_text())
    (cell / "record.json").write_text(json.dumps(document | change))
    with pytest.raises(TwinError) as error:
        load_twin(cell / "twin.yaml")
    assert words in str(error.value)
    assert "record.json" in str(error.value) or "twin.yaml:2" in str(error.value)


def test_the_golden_passes_for_the_identified_robot(cell: Path) -> None:
    found = measures_of(cell)
    assert {m.name for m in found} == {"effort", "torque"}
    assert all(m.passed for m in found)
    assert [m.subject for m in found if m.name == "effort"] == [
        f"{joint}, effort predicted by october" for joint in JOINTS
    ]
    for m in found:
        if m.name == "effort":
            assert m.error == pytest.approx(m.golden, rel=0.1)


def test_the_golden_fails_if_a_fitted_value_is_overridden(cell: Path) -> None:
    (cell / "twin.yaml").write_text(
        "model: model.xml\nfit: [{file: record.json}, {id: less, joint: {elbow: {damping: 0}}}]\n"
    )
    assert not all(m.passed for m in measures_of(cell))


def test_a_golden_with_a_recording_used_for_fitting_is_refused(cell: Path) -> None:
    spec = cell / "golden" / "effort.yaml"
    spec.write_text(spec.read_text().replace("check.csv", "one.csv"))
    with pytest.raises(SpecError, match="a recording that october was fitted on"):
        measures_of(cell)


def test_a_golden_with_a_changed_recording_is_refused(cell: Path) -> None:
    (cell / "check.csv").write_text((cell / "check.csv").read_text() + "\n")
    with pytest.raises(SpecError, match="not a file that october was made from"):
        measures_of(cell)


def test_a_changed_record_makes_only_the_goldens_stale_that_depend_on_it(cell: Path) -> None:
    before = dependency_map_of(cell)
    document = json.loads((cell / "record.json").read_text())
    document["fit"]["joint"]["elbow"]["damping"] += 0.01
    (cell / "record.json").write_text(json.dumps(document))
    assert stale_goldens(before, dependency_map_of(cell)) == {"golden/effort@mujoco"}
    document["parameters"]["elbow.viscous_friction"]["value"] += 0.01
    (cell / "record.json").write_text(json.dumps(document))
    assert stale_goldens(before, dependency_map_of(cell)) == {"golden/effort@mujoco"}


def write_twin_with_errors(folder: Path, bias: float, late: float, payload: str) -> Path:
    """Write a twin with a golden and an accepted record of an encoder bias and an effort delay."""
    write_model(folder)
    (folder / "twin.yaml").write_text(
        "model: model.xml\npayloads: {kg3: {lower: {mass: 3, com: [0.4, 0, 0.1]}}}\n"
    )
    twin = load_twin(folder / "twin.yaml")
    (folder / "real.xml").write_text(TRUE.format(**REAL))
    robot = load(folder / "real.xml", twin=twin)
    for name, seed in (("one", 1), ("two", 2), ("check", 3)):
        time, q, effort = simulated_effort(robot.variant(payload=payload), seed)
        acted = [np.interp(time - late, time, column) for column in effort.T]
        write_mcap(
            folder / f"{name}.mcap", time, q + np.array([bias, 0.0]), np.array(acted).T, payload
        )
    (folder / "out").mkdir()
    document = identify_files(
        {
            "model": str(folder / "twin.yaml"),
            "recordings": [str(folder / "one.mcap"), str(folder / "two.mcap")],
            "held_out": [str(folder / "check.mcap")],
            "out": str(folder / "out"),
            "name": "october",
        }
    )
    (folder / "record.json").write_text(json.dumps(document))
    text = (folder / "twin.yaml").read_text()
    (folder / "twin.yaml").write_text(text + "fit: [{file: record.json}]\n")
    (folder / "golden").mkdir()
    spec = SPEC.replace("check.csv", "check.mcap")
    (folder / "golden" / "effort.yaml").write_text(spec)
    return folder


@pytest.fixture(scope="module")
def twin_with_errors(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_twin_with_errors(tmp_path_factory.mktemp("twin_with_errors"), 0.08, 0.012, "kg3")


def test_a_golden_applies_delay_payload_and_encoder_correction_of_its_record(
    twin_with_errors: Path,
) -> None:
    document = json.loads((twin_with_errors / "record.json").read_text())
    assert document["parameters"]["robot.effort_delay"]["value"] == pytest.approx(0.012, abs=0.003)
    found = [m for m in measures_of(twin_with_errors) if m.name == "effort"]
    assert found
    for one in found:
        assert one.passed
        # An uncorrected delay of 12 ms would cause a difference of 0.01 to 0.04.
        assert one.error == pytest.approx(one.golden, abs=0.002)


def test_the_twin_has_the_identified_encoder_correction(twin_with_errors: Path) -> None:
    twin = load_twin(twin_with_errors / "twin.yaml")
    assert twin.calibration is not None
    assert twin.calibrated is None
    assert twin.calibration.id == "october"
    assert twin.calibration.joints["shoulder"].offset == pytest.approx(-0.08, abs=0.015)
    written = load_twin(twin_with_errors / "out" / "realization" / "twin.yaml")
    assert written.calibration is not None
    assert written.calibration.joints == twin.calibration.joints


def test_a_calibration_replaces_an_identified_encoder_correction(
    twin_with_errors: Path, tmp_path: Path
) -> None:
    shutil.copytree(twin_with_errors, tmp_path / "cell")
    path = tmp_path / "cell" / "twin.yaml"
    path.write_text(
        path.read_text() + "calibration: {id: laser, joints: {shoulder: {offset: -0.07}}}\n"
    )
    twin = load_twin(path)
    assert twin.calibration is not None
    assert twin.calibration.id == "laser"
    assert twin.calibration.joints["shoulder"].offset == -0.07


def test_a_golden_depends_on_the_identified_encoder_correction(twin_with_errors: Path) -> None:
    assert "calibration:shoulder" in dependency_map_of(twin_with_errors).parts
    assert (
        "calibration:shoulder"
        in dependency_map_of(twin_with_errors).depends_on["golden/effort@mujoco"]
    )


def test_a_second_record_keeps_the_encoder_correction_of_the_first_one(
    twin_with_errors: Path, tmp_path: Path
) -> None:
    """An identification of the corrected twin finds no further encoder error."""
    shutil.copytree(twin_with_errors, tmp_path / "cell")
    cell = tmp_path / "cell"
    (cell / "again").mkdir()
    document = identify_files(
        {
            "model": str(cell / "twin.yaml"),
            "recordings": [str(cell / "one.mcap"), str(cell / "two.mcap")],
            "held_out": [str(cell / "check.mcap")],
            "out": str(cell / "again"),
            "name": "november",
        }
    )
    (encoder,) = (one for one in document["stages"] if one["stage"] == "encoder")
    assert encoder["state"] == "not_observable"
    first = json.loads((cell / "record.json").read_text())
    assert document["encoders"] == first["encoders"]
    (cell / "second.json").write_text(json.dumps(document))
    text = (cell / "twin.yaml").read_text()
    (cell / "twin.yaml").write_text(
        text.replace(
            "[{file: record.json}]",
            "[{file: record.json}, {file: second.json, supersedes: [october]}]",
        )
    )
    twin = load_twin(cell / "twin.yaml")
    assert twin.calibration is not None
    assert twin.calibration.id == "november"
    assert twin.calibration.joints == load_twin(twin_with_errors / "twin.yaml").calibration.joints


def test_without_an_identification_no_golden_is_proposed(cell: Path) -> None:
    with pytest.raises(NothingToProposeError, match="it needs an accepted identification"):
        check_of("identification").first(load(cell / "model.xml"))


def test_the_page_shows_signals_and_encoders(twin_with_errors: Path) -> None:
    document = json.loads((twin_with_errors / "record.json").read_text())
    shoulder = document["signals"]["shoulder"]
    shoulder["effort"] |= {"quantity": "current", "constant": 0.09, "filter": "low-pass, 200 Hz"}
    rows = signal_rows(document)
    assert rows[0]["effort"] == (
        "current, output side of the gear, constant 0.09, filter: low-pass, 200 Hz"
    )
    assert rows[0]["rate"] == pytest.approx(200.0)
    (encoder,) = (row for row in encoder_rows(document) if row["joint"] == "shoulder")
    assert encoder["before"] == "sign +1, scale 1, offset +0"
    assert encoder["after"].startswith("sign +1, scale 1, offset -0.07")
    page = render(document)
    assert "filter: low-pass, 200 Hz" in page
    assert encoder["found"] in page


def test_a_record_is_stale_until_it_is_fitted_again_from_the_model_alone(cell: Path) -> None:
    def stale() -> list[str]:
        states = states_of_records(load_twin(cell / "twin.yaml"))
        return [str(reason) for state in states for reason in state.reasons]

    assert stale() == []
    text = (cell / "model.xml").read_text()
    (cell / "model.xml").write_text(text.replace('mass="3.5"', 'mass="3.745"'))
    assert stale() == ["october, made with inertia:upper: mass 3.5 -> 3.745 kg"]
    documents = []
    for model in ("model.xml", "twin.yaml"):
        out = cell / f"from_{model}"
        out.mkdir()
        request = {
            "model": str(cell / model),
            "recordings": [str(cell / "one.csv"), str(cell / "two.csv")],
            "held_out": [str(cell / "check.csv")],
            "out": str(out),
            "folder": str(cell),
            "name": "october",
        }
        documents.append(identify_files(request))
    # The record in the twin is left out, so that its values are not the prior of the new ones.
    assert documents[0]["fit"] == documents[1]["fit"]
    (cell / "record.json").write_text(json.dumps(documents[1]))
    assert stale() == []
