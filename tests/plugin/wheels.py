"""Small Python packages, built as wheels and installed into a folder."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path


def wheel(
    folder: Path, name: str, version: str, code: str, entry_points: str | None = None
) -> Path:
    """Build a pure Python wheel with one module."""
    info = f"{name}-{version}.dist-info"
    files = {
        f"{name}.py": code,
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n",
        f"{info}/WHEEL": (
            "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        ),
    }
    if entry_points is not None:
        files[f"{info}/entry_points.txt"] = entry_points
    files[f"{info}/RECORD"] = "".join(f"{path},,\n" for path in [*files, f"{info}/RECORD"])
    path = folder / f"{name}-{version}-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for member, text in files.items():
            archive.writestr(member, text)
    return path


def pip_install(wheels: list[Path], target: Path) -> None:
    """Install or upgrade wheels in a folder with pip."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    command += ["--disable-pip-version-check", "--no-warn-conflicts", "--upgrade"]
    subprocess.run([*command, "--target", str(target), *map(str, wheels)], check=True, timeout=120)


def unpack(path: Path, target: Path) -> None:
    """Install a pure Python wheel by unpacking it, without pip."""
    with zipfile.ZipFile(path) as archive:
        archive.extractall(target)


KIND = '''\
"""How far a dropped box sinks: a kind of golden in one file."""

from pytest_twin.checks import Check, Measure, Observation


class BoxRest(Check):
    kind = "box_rest"
    libraries = ("boxphysics",)
    tolerances = {"height": "m"}
    required_tolerances = frozenset({"height"})
    schema = {
        "stimulus": {
            "type": "object",
            "properties": {"drop": {"type": "number", "minimum": 0}},
            "required": ["drop"],
            "additionalProperties": False,
        }
    }

    def depends(self, golden, structure):
        return structure.contact()

    def observe(self, golden, realization, progress):
        import boxphysics

        progress(1.0)
        height = boxphysics.rest_height(realization.model, golden.stimulus["drop"])
        return Observation({"height": height})

    def compare(self, golden, observation, stored):
        if golden.expected is None:
            return []
        found, expected = observation.values["height"], golden.expected["height"]
        bound = golden.tolerance["height"].value
        error = abs(found - expected)
        return [Measure("height", "box", found, expected, error, bound, "m")]
'''

ENTRY_POINTS = "[pytest_twin.checks]\nbox_rest = box_rest:BoxRest\n"

# Two versions of a library: the second one changes the resting height of boxes.
PHYSICS = {
    "1.0": "def rest_height(model, drop):\n    return 0.1000 + 0.0 * model.nbody\n",
    "1.1": "def rest_height(model, drop):\n    return 0.0987 + 0.0 * model.nbody\n",
}

SPEC = """\
schema: 1
kind: box_rest
title: A box at rest on another
stimulus: {drop: 0.02}
tolerance: {height: 0.1 mm}
"""
