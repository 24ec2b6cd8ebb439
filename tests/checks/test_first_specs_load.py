"""Specs written by people and by ``init`` are valid under the shipped schema."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from check_robots import ARM

from pytest_twin.checks import check_of
from pytest_twin.errors import SpecError
from pytest_twin.gate.specs import load_golden
from pytest_twin.realization import load
from pytest_twin.twin import Twin, load_twin

KINDS = ["fk", "joint_direction", "limits", "mass_properties", "collision_distance"]
DOCS = Path(__file__).resolve().parents[2] / "docs" / "kinds"


@pytest.fixture
def twin(tmp_path: Path) -> Twin:
    (tmp_path / "robot.xml").write_text(ARM)
    (tmp_path / "twin.yaml").write_text("schema: 1\nname: arm\nmodel: robot.xml\n")
    (tmp_path / "golden").mkdir()
    return load_twin(tmp_path / "twin.yaml")


def write(twin: Twin, text: str) -> Path:
    path = twin.root / "golden" / "spec.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("kind", KINDS)
def test_proposed_specs_load_and_pass(twin: Twin, kind: str) -> None:
    realization = load(twin.root / "robot.xml", twin=twin)
    specs = check_of(kind).first(realization)
    assert specs
    for spec in specs:
        body: dict[str, Any] = {"schema": 1, "kind": kind} | dict(spec)
        name = body.pop("name")
        assert name == Path(name).name
        golden = load_golden(write(twin, yaml.safe_dump(body)), twin)
        assert golden.kind == kind
        measures = check_of(kind).compare(
            golden, check_of(kind).observe(golden, realization, lambda fraction: None), None
        )
        assert measures
        assert all(measure.passed for measure in measures)


@pytest.mark.parametrize("kind", KINDS)
def test_the_documented_example_of_a_kind_loads_and_passes(twin: Twin, kind: str) -> None:
    page = (DOCS / f"{kind}.md").read_text()
    example = page.split("```yaml\n")[1].split("```")[0]
    golden = load_golden(write(twin, example), twin)
    realization = load(twin.root / "robot.xml", twin=twin)
    check = check_of(kind)
    measures = check.compare(
        golden, check.observe(golden, realization, lambda fraction: None), None
    )
    assert measures
    assert all(measure.passed for measure in measures)
    for name in check.tolerances:
        assert f"`{name}`" in page


@pytest.mark.parametrize(
    ("kind", "target", "stimulus", "words"),
    [
        ("fk", "{frames: []}", "{poses: [home]}", "target.frames"),
        ("fk", "{frames: [tcp]}", "{poses: [{seed: -1, count: 3}]}", "stimulus.poses.0"),
        ("joint_direction", "{joints: {lift: {frame: a}}}", "{}", "target.joints.lift"),
        ("limits", "{joints: {lift: {hard: [1]}}}", "{}", "target.joints.lift.hard"),
        (
            "collision_distance",
            "{pairs: [], disabled: [{pair: [a, b], reason: ' '}]}",
            "{poses: [home]}",
            "target.disabled.0.reason",
        ),
    ],
)
def test_an_invalid_target_or_stimulus_is_refused_at_its_field(
    twin: Twin, kind: str, target: str, stimulus: str, words: str
) -> None:
    tolerance = {
        "fk": "{position: 1 mm, orientation: 1 deg}",
        "joint_direction": "{direction: 1 deg}",
        "limits": "{angle: 1 deg}",
        "collision_distance": "{distance: 1 mm}",
    }[kind]
    text = (
        f"schema: 1\nkind: {kind}\ntarget: {target}\nstimulus: {stimulus}\ntolerance: {tolerance}\n"
    )
    with pytest.raises(SpecError) as caught:
        load_golden(write(twin, text), twin)
    assert words in str(caught.value)
    assert caught.value.line is not None
