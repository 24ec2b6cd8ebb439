"""Thresholds of the diagnosis are fields of settings objects, each with its unit and its reason."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import pkgutil
import re
from pathlib import Path
from typing import Any

import pytest

import pytest_twin.diagnosis

HOME = Path(pytest_twin.diagnosis.__file__).parent


def settings() -> list[Any]:
    """Every settings object of the diagnosis."""
    modules = [
        importlib.import_module(info.name)
        for info in pkgutil.walk_packages(pytest_twin.diagnosis.__path__, "pytest_twin.diagnosis.")
        if info.name.endswith("settings")
    ]
    return [
        value
        for module in modules
        for value in vars(module).values()
        if type(value).__module__ == module.__name__ and dataclasses.is_dataclass(value)
        if not isinstance(value, type)
    ]


@pytest.mark.parametrize("owner", settings(), ids=lambda owner: type(owner).__name__)
def test_every_field_of_a_settings_object_is_described(owner: Any) -> None:
    described = re.findall(r"^ {4,8}(\w+(?:, \w+)*):", type(owner).__doc__ or "", re.MULTILINE)
    named = {name for entry in described for name in entry.split(", ")}
    assert {field.name for field in dataclasses.fields(owner)} - named == set()


@pytest.mark.parametrize("owner", settings(), ids=lambda owner: type(owner).__name__)
def test_a_settings_object_is_not_changed_by_accident(owner: Any) -> None:
    field = dataclasses.fields(owner)[0].name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(owner, field, 1.0)


def test_no_default_of_a_parameter_is_a_setting() -> None:
    """Such a default is read once, when the module is loaded, and not from the settings later."""
    found = []
    for path in sorted(HOME.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef):
                defaults = [d for d in (*node.args.defaults, *node.args.kw_defaults) if d]
                found += [
                    f"{path.name}:{default.lineno}"
                    for default in defaults
                    if isinstance(default, ast.Attribute)
                    and isinstance(default.value, ast.Name)
                    and default.value.id.isupper()
                ]
    assert found == []
