"""The example specs on the documentation pages of replay and task run on the demo arm."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from pytest_twin.checks import check_of
from pytest_twin.gate.specs import load_golden
from pytest_twin.realization import load
from pytest_twin.twin import load_twin

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("kind", ["replay", "task"])
def test_the_example_on_the_documentation_page_passes(kind: str, tmp_path: Path) -> None:
    page = (ROOT / "docs" / "kinds" / f"{kind}.md").read_text()
    (example,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    shutil.copytree(ROOT / "golden", tmp_path / "arm", ignore=shutil.ignore_patterns(".*"))
    twin = load_twin(tmp_path / "arm" / "twin.yaml")
    path = tmp_path / "arm" / kind / "page.yaml"
    path.write_text(example)
    golden = load_golden(path, twin)
    check = check_of(kind)
    observation = check.observe(
        golden, load(twin.realizations["mujoco"].file, twin=twin), lambda _: None
    )
    expected, trace = check.expect(golden, observation)
    measures = check.compare(replace(golden, expected=expected), observation, trace)
    assert measures
    assert all(measure.passed for measure in measures), measures
    for name in check.tolerances:
        assert f"`{name}`" in page
