"""Ranges, budgets and fitted models that a twin uses become stale with what they were made from."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from recorded_cell import changed, edit, states, write_cell, write_identification

from pytest_twin.budget.budget_of_twin import budget_of_file
from pytest_twin.errors import SpecError
from pytest_twin.ranges.ranges_of_twin import ranges_of_file
from pytest_twin.realization import load
from pytest_twin.realization.record_inputs import basis_json, result_basis, unfitted
from pytest_twin.records.basis import Uses
from pytest_twin.twin import load_twin

MASS = "inertia:fore: mass 0.6 -> 0.642 kg"


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cell with ``ranges.json`` and ``budget.json``, which its twin names."""
    root = write_cell(tmp_path_factory.mktemp("template"))
    with (root / "twin.yaml").open("a") as stream:
        stream.write(
            "ranges: {tolerance: [{parameter: fore.mass, relative: 0.1}]}\n"
            "budget: {poses: [{elbow: 0.3}], tolerance: {position: 0.002}}\n"
        )
    twin = load_twin(root / "twin.yaml")
    realization = load(twin.first_realization.file, twin=twin)
    for name in ("ranges", "budget"):
        (root / name).mkdir()
        document = {"schema": 1, "basis": result_basis(realization, name, root / name)}
        (root / name / f"{name}.json").write_text(json.dumps(document))
    edit(root / "twin.yaml", "ranges: {", "ranges: {file: ranges/ranges.json, ")
    edit(root / "twin.yaml", "budget: {", "budget: {file: budget/budget.json, ")
    return root


@pytest.fixture
def cell(template: Path, tmp_path: Path) -> Path:
    shutil.copytree(template, tmp_path / "cell")
    return tmp_path / "cell"


RANGES, BUDGET = "ranges/ranges.json", "budget/budget.json"


@pytest.mark.parametrize(
    ("file", "old", "new", "stale"),
    [
        ("arm.xml", 'mass="0.6"', 'mass="0.642"', {"identified", RANGES, BUDGET}),
        ("arm.xml", 'mass="3"', 'mass="4"', {RANGES, BUDGET}),
        ("twin.yaml", "mass: 1.0", "mass: 1.1", {RANGES, BUDGET}),
        ("twin.yaml", "relative: 0.1", "relative: 0.2", {RANGES}),
        ("twin.yaml", "elbow: 0.3", "elbow: 0.4", {BUDGET}),
        ("identified/identification.json", '"mass": 1.3', '"mass": 1.4', {RANGES, BUDGET}),
        ("arm.xml", 'rgba="0.2', 'rgba="0.9', set()),
        ("twin.yaml", "name: cell", "# a comment\nname: cell", set()),
    ],
)
def test_ranges_and_budgets_are_stale_after_a_change_of_the_twin(
    cell: Path, file: str, old: str, new: str, stale: set[str]
) -> None:
    assert changed(cell) == {}
    edit(cell / file, old, new)
    assert set(changed(cell)) == stale


def test_the_owner_states_that_a_change_does_not_touch_the_ranges(cell: Path) -> None:
    edit(cell / "arm.xml", 'mass="3"', 'mass="4"')
    (change,) = states(cell)[RANGES].touching
    statement = (
        f"unaffected: [{{part: '{change.part}', digest: {change.digest[:12]}, "
        "reason: the table is not randomized, owner: A. Engineer}]"
    )
    edit(cell / "twin.yaml", f"file: {RANGES}", f"file: {RANGES}, {statement}")
    assert set(changed(cell)) == {BUDGET}


@pytest.mark.parametrize("compute", [budget_of_file, ranges_of_file])
def test_nothing_is_computed_from_a_stale_record(cell: Path, compute) -> None:
    edit(cell / "arm.xml", 'mass="0.6"', 'mass="0.642"')
    with pytest.raises(SpecError, match=r"record .identified. is stale: .* mass 0\.6 -> 0\.642 kg"):
        compute(str(cell / "twin.yaml"))


def write_diagnosis(cell: Path) -> None:
    """Write the folder of a diagnosis of the cell, whose model has a changed friction."""
    twin = load_twin(cell / "twin.yaml")
    source = unfitted(load(twin.first_realization.file, twin=twin))
    folder = cell / "diagnosis"
    (folder / "realization").mkdir(parents=True)
    model = (cell / "arm.xml").read_text().replace('frictionloss="0.1"', 'frictionloss="0.4"')
    (folder / "realization" / "model.xml").write_text(model)
    (folder / "realization" / "effects.json").write_text("{}")
    uses = Uses(joints=("shoulder", "elbow"))
    basis = basis_json(source, uses, twin, folder, {}, has_twin=True)
    (folder / "diagnosis.json").write_text(json.dumps({"schema": 1, "basis": basis}))


def test_a_model_that_a_diagnosis_wrote_is_stale_after_a_change_of_its_source(cell: Path) -> None:
    write_diagnosis(cell)
    edit(cell / "twin.yaml", "model: arm.xml", "model: diagnosis")
    assert "diagnosis/diagnosis.json" not in changed(cell)
    edit(cell / "arm.xml", 'mass="0.6"', 'mass="0.642"')
    assert changed(cell)["diagnosis/diagnosis.json"] == [MASS]
    state = states(cell)["diagnosis/diagnosis.json"]
    structure = load(cell / "diagnosis/realization/model.xml").structure
    assert state.overridden(structure) == structure.part_ids
    assert f"{cell}/twin.yaml:2: model: record 'diagnosis/diagnosis.json' is stale" in str(
        state.as_error(load_twin(cell / "twin.yaml"))
    )


def test_a_diagnosis_without_its_inputs_says_that_changes_are_not_known(cell: Path) -> None:
    write_diagnosis(cell)
    (cell / "diagnosis" / "diagnosis.json").write_text('{"schema": 1}')
    edit(cell / "twin.yaml", "model: arm.xml", "model: diagnosis")
    (note,) = states(cell)["diagnosis/diagnosis.json"].notes
    assert "whether they changed is not known; pytest-twin diagnose again states them" in note


def test_a_model_that_an_identification_wrote_is_stale_with_its_listed_record(cell: Path) -> None:
    write_identification(cell, "second")
    shutil.copytree(cell / "second", cell / "third")
    folder = cell / "third" / "realization"
    folder.mkdir()
    shutil.copy(cell / "arm.xml", folder / "model.xml")
    (folder / "effects.json").write_text("{}")
    edit(cell / "twin.yaml", "identified/", "third/")
    edit(cell / "twin.yaml", "model: arm.xml", "model: third")
    assert states(cell)["second"].models == ("mujoco",)
    assert "third/identification.json" not in states(cell)
    edit(cell / "arm.xml", 'mass="0.6"', 'mass="0.642"')
    assert changed(cell)["second"] == [MASS]
