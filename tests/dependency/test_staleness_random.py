"""A short run of the staleness benchmark: no golden that exceeds its tolerance counts as fresh."""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Callable
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
def test_no_golden_affected_by_a_random_edit_is_called_fresh(benchmark: ModuleType) -> None:
    tally = benchmark.run(24, seed=7, precision=False)
    assert tally.edits == 24
    assert tally.goldens > 200
    assert tally.misses == []
    assert 0 < tally.stale < tally.goldens


@pytest.mark.filterwarnings("ignore")
def test_the_benchmark_detects_a_dependency_map_without_inertia(
    benchmark: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The benchmark must be able to fail."""
    for name in ("carried", "dynamics", "contact", "everything"):
        monkeypatch.setattr(Structure, name, without_inertia(getattr(Structure, name)))
    monkeypatch.setattr(benchmark, "EDITS", [(1.0, heavier)])
    assert benchmark.run(6, seed=3, precision=False).misses


def without_inertia(
    parts: Callable[..., frozenset[str]],
) -> Callable[..., frozenset[str]]:
    """The ids that a method of a structure returns, without those of inertia and joints."""

    def fewer(self: Structure, *names: object) -> frozenset[str]:
        return frozenset(i for i in parts(self, *names) if not re.search("/(inertia|joint):", i))

    return fewer


def heavier(root: etree._Element, rng: np.random.Generator) -> str:
    for element in root.iter("inertial"):
        element.set("mass", str(2 * float(element.get("mass", "1"))))
    for element in root.iter("joint"):
        element.set("damping", "3")
    return "heavier, more damped"
