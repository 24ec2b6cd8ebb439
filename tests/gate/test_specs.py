"""Golden specs: which files are specs, what is read, and errors of invalid specs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pytest_twin.checks import kinds
from pytest_twin.errors import TwinError
from pytest_twin.formats.schema import load_schema
from pytest_twin.gate.gate import Gate
from pytest_twin.gate.runner import Runner
from pytest_twin.gate.schema import golden_schema
from pytest_twin.gate.specs import load_golden, spec_paths, trace_paths
from pytest_twin.twin import Twin, load_twin
from pytest_twin.units import Quantity

SPEC = """\
schema: 1
kind: fk
target: {frames: [tcp]}
stimulus:
  poses: [reference]
tolerance:
  position: 0.5 mm
  orientation: 1 mrad
"""


@pytest.fixture
def twin(tmp_path: Path) -> Twin:
    (tmp_path / "arm.xml").write_text("<mujoco/>")
    (tmp_path / "golden").mkdir()
    (tmp_path / "golden" / "fit.yaml").write_text("id: f1\n")
    (tmp_path / "twin.yaml").write_text(
        "model: arm.xml\nrealizations: {sim2: {file: arm.xml}}\nfit: {file: golden/fit.yaml}\n"
    )
    return load_twin(tmp_path / "twin.yaml")


def write(twin: Twin, name: str, text: str = SPEC) -> Path:
    path = twin.root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_a_valid_spec_is_read_as_a_golden(twin: Twin) -> None:
    path = write(twin, "golden/fk/home.yaml")
    golden = load_golden(path, twin)
    assert golden.id == "golden/fk/home"
    assert golden.kind == "fk"
    assert golden.criticality == "critical"
    assert golden.realizations == ("mujoco",)
    assert golden.tolerance == {
        "position": Quantity(0.5e-3, "m"),
        "orientation": Quantity(1e-3, "rad"),
    }
    assert golden.expected is None
    assert golden.provenance is None
    assert golden.lines["tolerance.position"] == 7


def test_specs_are_yaml_files_below_golden_outside_releases_and_inner_twins(twin: Twin) -> None:
    spec = write(twin, "golden/fk/home.yaml")
    trace = write(twin, "golden/fk/home.trace.csv", "time [s]\n0\n")
    write(twin, "elsewhere/other.yaml")
    write(twin, "releases/0001/files/golden/fk/home.yaml")
    write(twin, "releases/0001/files/golden/fk/home.trace.csv")
    write(twin, ".twin/golden/cached.yaml")
    write(twin, "golden/inner/twin.yaml", "model: ../../arm.xml\n")
    write(twin, "golden/inner/golden/theirs.yaml")
    assert spec_paths(twin) == (spec,)
    assert trace_paths(twin) == (trace,)
    gate = Gate(twin.path, Runner())
    assert gate.is_spec(spec)
    assert not gate.is_spec(trace)
    assert not gate.is_spec(twin.root / "golden" / "fit.yaml")
    assert not gate.is_spec(twin.root / "elsewhere" / "other.yaml")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("kind: fk", "kind: kf", "home.yaml:2: kind: unknown kind (got 'kf'; expected "),
        ("kind: fk", "knd: fk", "home.yaml:1: kind: no golden spec (expected one of "),
        (
            "position: 0.5 mm",
            "position: 0.5 deg",
            "home.yaml:7: tolerance.position: unit 'deg' does not fit (got '0.5 deg'; expected ",
        ),
        (
            "position: 0.5 mm",
            "position: -1 mm",
            "home.yaml:7: tolerance.position: the tolerance is negative",
        ),
        (
            "schema: 1",
            "schema: 1\nrealizations: [isaac]",
            "home.yaml:2: realizations: twin ",
        ),
        ("frames: [tcp]", "frames: tcp", "home.yaml:3: target.frames"),
        ("  orientation: 1 mrad\n", "", "home.yaml:6: tolerance"),
        ("schema: 1", "schema: 1\nschema: 1", "home.yaml:2"),
    ],
)
def test_an_invalid_spec_is_reported_with_line_field_and_expected_value(
    twin: Twin, old: str, new: str, words: str
) -> None:
    path = write(twin, "golden/fk/home.yaml", SPEC.replace(old, new))
    with pytest.raises(TwinError) as caught:
        load_golden(path, twin)
    text = str(caught.value)
    assert words in text
    assert "\n" not in text


def test_the_shipped_schema_matches_the_declarations_of_the_kinds() -> None:
    ours = [kind for kind in kinds() if _is_ours(kind)]
    shipped = load_schema("golden.schema.json")
    assert shipped == json.loads(json.dumps(golden_schema(ours))), (
        "the shipped schema is outdated: run python -m pytest_twin.gate.schema"
    )


def _is_ours(kind: str) -> bool:
    from pytest_twin.checks import check_of

    return type(check_of(kind)).__module__.startswith("pytest_twin.")
