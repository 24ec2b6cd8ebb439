"""The example specs on the documentation pages of dynamic kinds pass on the demo arm."""

from __future__ import annotations

from pathlib import Path

import pytest
from bench_models import failed, measures_on, recorded

from pytest_twin.checks import check_of
from pytest_twin.formats import yaml
from pytest_twin.formats.schema import validate
from pytest_twin.gate.schema import schema_of
from pytest_twin.realization import load

PROJECT = Path(__file__).resolve().parents[2]
ARM = PROJECT / "golden" / "arm.xml"


@pytest.mark.parametrize("kind", ["settling", "step", "frequency_response", "contact"])
def test_the_example_of_a_dynamic_kind_page_passes(kind: str) -> None:
    page = PROJECT / "docs" / "kinds" / f"{kind}.md"
    text = page.read_text().split("```yaml\n")[1].split("```")[0]
    document = yaml.loads(text, page)
    validate(document, schema_of(kind), page)
    check = check_of(kind)
    robot = load(ARM)
    golden, trace = recorded(check, document.data, robot)
    measures = measures_on(check, golden, trace, robot)
    assert failed(measures) == set()
    # All bounded quantities are measured, except resonance where the response has none.
    assert set(golden.tolerance) - set(measures) <= {"resonance", "resonance_peak"}


@pytest.mark.parametrize("kind", ["settling", "step", "frequency_response", "contact"])
def test_the_page_of_a_dynamic_kind_lists_every_tolerance(kind: str) -> None:
    text = (PROJECT / "docs" / "kinds" / f"{kind}.md").read_text()
    for name in check_of(kind).tolerances:
        assert f"`{name}`" in text
