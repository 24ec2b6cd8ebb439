"""A short run of the benchmark: no golden moves past its tolerance and is called fresh."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from lxml import etree

from pytest_twin.dependency import Structure


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    path = Path(__file__).resolve().parents[2] / "benchmarks" / "staleness.py"
    spec = importlib.util.spec_from_file_location("benchmark_staleness", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.filterwarnings("ignore")
def test_no_random_edit_is_missed(benchmark: ModuleType) -> None:
    tally = benchmark.run(24, seed=7, precision=False)
    assert tally.edits == 24
    assert tally.goldens > 200
    assert tally.misses == []
    assert 0 < tally.stale < tally.goldens


@pytest.mark.filterwarnings("ignore")
def test_a_map_that_forgets_inertia_is_found_out(
    benchmark: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The proof itself can fail."""
    whole = Structure._layer

    def forgetful(self: Structure, layer: str, names: object) -> set[str]:
        return set() if layer in ("inertia", "joint") else whole(self, layer, names)  # type: ignore[arg-type]

    monkeypatch.setattr(Structure, "_layer", forgetful)
    monkeypatch.setattr(benchmark, "EDITS", [(1.0, heavier)])
    assert benchmark.run(6, seed=3, precision=False).misses


def heavier(root: etree._Element, rng: np.random.Generator) -> str:
    for element in root.iter("inertial"):
        element.set("mass", str(2 * float(element.get("mass", "1"))))
    for element in root.iter("joint"):
        element.set("damping", "3")
    return "heavier, more damped"
