"""The package takes only names from MuJoCo that the oldest supported version has."""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import mujoco
import pytest
from engine_names import FILE, NEWEST, names

import pytest_twin

PACKAGE = Path(pytest_twin.__file__).parent
# They ask what the installed version offers.
SEAM = {"realization/engine.py"}
# Files that users run beside another simulator.
WRITTEN = "ranges/written/"
# Attributes of newer MuJoCo classes whose names also occur elsewhere, so that the scan cannot tell
# them apart. The package reads those of MuJoCo in engine.py only.
SHARED = {"surfacevel", "type", "texture", "scale", "meshname", "section", "scaling", "name",
          "value", "expanded", "models", "jac", "error", "step", "state"}  # fmt: skip


@cache
def uses() -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Place and dotted name of what comes from ``mujoco``; place and name of each attribute."""
    chains, attributes = [], []
    for path in PACKAGE.rglob("*.py"):
        file = path.relative_to(PACKAGE).as_posix()
        if file in SEAM or file.startswith(WRITTEN):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] == "mujoco":
                module = str(node.module).split(".")[1:]
                chains.append((f"{file}:{node.lineno}", ".".join([*module, node.names[0].name])))
            if isinstance(node, ast.Attribute):
                place = f"{file}:{node.lineno}"
                attributes.append((place, node.attr))
                parts: list[str] = []
                while isinstance(node, ast.Attribute):
                    parts.append(node.attr)
                    node = node.value
                if isinstance(node, ast.Name) and node.id == "mujoco":
                    chains.append((place, ".".join(reversed(parts))))
    return chains, attributes


def prefixes(name: str) -> Iterator[str]:
    """The dotted name and all its beginnings."""
    parts = name.split(".")
    return (".".join(parts[: end + 1]) for end in range(len(parts)))


def lacking() -> dict[str, list[str]]:
    return json.loads(FILE.read_text())


@pytest.mark.parametrize("version", lacking())
def test_no_module_but_the_seam_names_what_an_older_mujoco_lacks(version: str) -> None:
    absent = set(lacking()[version])
    assert [(place, name) for place, name in uses()[0] if absent & set(prefixes(name))] == []


@pytest.mark.parametrize("version", lacking())
def test_no_module_but_the_seam_reads_a_field_that_an_older_mujoco_lacks(version: str) -> None:
    """An attribute of any object counts, because its class is not in the text."""
    members = [name for name in lacking()[version] if name[0].isupper() and "." in name]
    fields = {name.split(".")[1] for name in members} - SHARED
    assert [(place, name) for place, name in uses()[1] if name in fields] == []


def test_every_name_from_mujoco_exists_in_the_installed_version() -> None:
    installed = names() | {"__version__"}
    chains = [(place, name) for place, name in uses()[0] if name.split(".")[0] not in installed]
    enums = [(place, name) for place, name in uses()[0] if name.startswith("mjt") and "." in name]
    assert chains == []
    assert [(p, n) for p, n in enums if ".".join(n.split(".")[:2]) not in installed] == []


@pytest.mark.skipif(mujoco.__version__ != NEWEST, reason=f"the list is made with {NEWEST}")
def test_the_list_of_lacking_names_is_that_of_the_newest_version() -> None:
    listed = {name for absent in lacking().values() for name in absent}
    assert sorted(listed - names()) == []
