"""The conda recipe has what ``pyproject.toml`` states, and is rendered where that is possible."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[2]
RECIPE = ROOT / "packaging" / "conda" / "recipe.yaml"
OF_CONDA = {
    "mujoco": "mujoco-python", "pin": "pinocchio", "coal": "coal-python", "mcap": "python-mcap",
    "matplotlib": "matplotlib-base",
}  # fmt: skip
"""Name on PyPI -> name on conda-forge, where they differ."""


@pytest.fixture(scope="module")
def project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


@pytest.fixture(scope="module")
def recipe() -> dict[str, Any]:
    return yaml.safe_load(RECIPE.read_text("utf-8"))


def test_the_recipe_requires_what_the_package_requires(
    project: dict[str, Any], recipe: dict[str, Any]
) -> None:
    wanted = set()
    for requirement in project["dependencies"]:
        name, bound = re.fullmatch(r"([A-Za-z0-9-]+)(?:\[.*\])?(>=.*)", requirement).groups()
        wanted.add(f"{OF_CONDA.get(name, name)} {bound}")
    # The extra crypto of securesystemslib; Python has its own line.
    own = {"cryptography", "python >=${{ python_min }}"}
    assert set(recipe["requirements"]["run"]) - own == wanted


def test_the_recipe_has_the_commands_of_the_package(
    project: dict[str, Any], recipe: dict[str, Any]
) -> None:
    commands = [f"{name} = {place}" for name, place in project["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == commands


def test_the_recipe_is_rendered_by_rattler_build() -> None:
    rattler_build = pytest.importorskip("rattler_build")
    variants = rattler_build.VariantConfig({"python_min": ["3.11"], "python": ["3.11.*"]})
    parsed = rattler_build.Stage0Recipe.from_yaml(RECIPE.read_text("utf-8"))
    (variant,) = parsed.render(variants, rattler_build.RenderConfig())
    assert "pytest-twin" in str(variant)
