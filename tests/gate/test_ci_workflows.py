"""The CI workflows in the docs are valid YAML and use existing flags."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from pytest_twin.session.options import SWITCHES, VALUES

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.mark.parametrize("name", ["github.yml", "gitlab.yml"])
def test_documented_workflows_use_only_existing_flags(name: str) -> None:
    text = (DOCS / "ci" / name).read_text()
    assert isinstance(yaml.safe_load(text), dict)
    used = set(re.findall(r"--(twin-[a-z]+)", text))
    assert used <= {*SWITCHES, *VALUES}
    assert {"twin-release", "twin-why"} <= used
    assert "python -m pytest --twin-update" not in text


def test_every_flag_is_documented() -> None:
    text = (DOCS / "ci.md").read_text()
    for flag in (*SWITCHES, *VALUES):
        assert f"`--{flag}" in text
