"""A short run of the mutation benchmark, and the size of mutations in tolerances."""

from __future__ import annotations

import copy
import importlib.util
import math
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from lxml import etree

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "mutations.py"
ARM = """<robot name="arm"><link name="base"/>
  <link name="upper"><inertial><origin xyz="0 0 0.1"/><mass value="2"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.3"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="2" effort="40" velocity="3"/></joint></robot>"""


@pytest.fixture(scope="module")
def mutations() -> ModuleType:
    spec = importlib.util.spec_from_file_location("mutations", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["mutations"] = module
    spec.loader.exec_module(module)
    return module


def test_every_fault_above_tolerance_is_detected(
    mutations: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    # USD and meshes of real robots are slow; only the full benchmark includes them.
    monkeypatch.setattr(
        mutations, "TARGETS", {k: v for k, v in mutations.TARGETS.items() if k != "USD"}
    )
    monkeypatch.setattr(mutations, "real_robots", list)
    tally = mutations.run(32, 5)
    assert tally.mutations == 32
    assert tally.missed == []
    assert tally.alarms == []
    assert tally.above.total() > 20
    assert tally.below.total() > 0


def test_the_benchmark_counts_missed_faults_without_properties(
    mutations: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mutations, "PROPERTIES", {})
    monkeypatch.setattr(mutations, "TARGETS", {"Pinocchio": (mutations.pinocchio_form, 1.0)})
    monkeypatch.setattr(mutations, "real_robots", list)
    # Drawing configurations still needs a MuJoCo form.
    monkeypatch.setattr(mutations, "text_form", mutations.mujoco_form)
    tally = mutations.run(16, 5)
    assert len(tally.missed) > 8


@pytest.mark.parametrize(
    ("xpath", "key", "value", "target", "least", "most"),
    [
        # 1 mm is 1000 times the position tolerance, 1 nm one thousandth of it.
        (".//joint/origin", "xyz", "0 0 0.301", "Pinocchio", 999, 1001),
        (".//joint/origin", "xyz", "0 0 0.300000001", "Pinocchio", 0, 0.0011),
        # The tolerance of a link's centre of mass is 1 um where the form has links.
        (".//inertial/origin", "xyz", "0 0 0.1002", "MuJoCo", 199, 2100),
        # 1 % of the mass; its tolerance is one millionth.
        (".//mass", "value", "2.02", "Pinocchio", 9990, 10010),
        (".//limit", "effort", "41", "MuJoCo", 24999, 25001),
        # MuJoCo has no velocity limits, so a change has no effect there.
        (".//limit", "velocity", "0", "MuJoCo", 0, 0),
        (".//limit", "velocity", "0", "Pinocchio", 999_999, 1_000_001),
        # The tolerance for USD is ten times larger.
        (".//joint/origin", "xyz", "0 0 0.301", "USD", 99, 101),
        (".//axis", "xyz", "0 -1 0", "MuJoCo", 1e5, math.inf),
        (".//joint", "type", "continuous", "USD", math.inf, math.inf),
    ],
)
def test_the_size_of_a_mutation_is_given_in_tolerances(
    mutations: ModuleType,
    xpath: str,
    key: str,
    value: str,
    target: str,
    least: float,
    most: float,
) -> None:
    right = etree.fromstring(ARM)
    wrong = copy.deepcopy(right)
    wrong.find(xpath).set(key, value)
    found = mutations.effect(right, wrong, target, np.random.default_rng(1))
    assert least <= found <= most


def test_every_kind_of_fault_can_be_injected(mutations: ModuleType) -> None:
    rng = np.random.default_rng(3)
    able = set()
    for robot in mutations.random_robots(20, 2):
        for kind, (edit, _) in mutations.FAULTS.items():
            root = etree.fromstring(robot.urdf)
            before = etree.tostring(root)
            if edit(root, rng) is not None and etree.tostring(root) != before:
                able.add(kind)
    assert able == set(mutations.FAULTS)
