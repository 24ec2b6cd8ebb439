"""Drake and Bullet as plants of blind cases: closed-form mechanics and a complete case."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

pytest.importorskip("numba", reason="servos are compiled: pip install 'pytest-twin[benchmarks]'")
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "concealed"))

import cell_plant
import engine_cases
import engine_plant
import robots
from cell import Background, Cell, draw_cell, ideal
from plant import Hidden

MODULES = {"drake": "pydrake", "bullet": "pybullet"}
ENGINES = [
    pytest.param(
        engine,
        marks=pytest.mark.skipif(
            find_spec(MODULES[engine]) is None,
            reason=f"needs {MODULES[engine]}: pip install 'pytest-twin[engines]'",
        ),
    )
    for engine in engine_plant.ENGINES
]


def _cell(between: str = "held") -> Cell:
    robot = robots.draw(np.random.default_rng(0), 1, "position")
    drawn = replace(draw_cell(robot, np.random.default_rng(0)), command_period=0.01)
    return replace(ideal(drawn, 1e-3), between=between)


def _hinge(**changed: Any) -> robots.Robot:
    """One hinge without servo, rotor inertia and, unless changed, friction."""
    robot = robots.draw(np.random.default_rng(5), 1, "position", hinges=True)
    free = {"damping": 0.0, "friction": 0.0, "kp": 0.0, "kv": 0.0, "armature": 0.0, **changed}
    return replace(robot, joints=(replace(robot.joints[0], **free),))


@pytest.mark.parametrize("engine", ENGINES)
def test_each_engine_matches_the_equation_of_a_pendulum(
    engine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine_plant, "SETTLE", 0.0)
    robot = _hinge()
    j = robot.joints[0]
    still = np.full((1000, 1, 1), 0.7)
    motion = engine_plant.simulate(engine, robot, _cell(), Hidden(), Background(), still)
    inertia = j.inertia[1] + j.mass * (j.center[0] ** 2 + j.center[2] ** 2)

    def swing(_: float, y: Any) -> list[float]:
        lever = j.center[0] * np.cos(y[0]) + j.center[2] * np.sin(y[0])
        return [y[1], j.mass * 9.81 * lever / inertia]

    time = np.arange(len(motion.position)) * motion.period
    exact = solve_ivp(swing, (0.0, 1.0), [0.7, 0.0], t_eval=time, rtol=1e-10, atol=1e-12)
    assert np.ptp(exact.y[0]) > 1.0
    assert motion.position[:, 0, 0] == pytest.approx(exact.y[0], abs=0.02)


@pytest.mark.parametrize("engine", ENGINES)
def test_each_engine_holds_a_joint_below_the_dry_friction_level(engine: str) -> None:
    j = _hinge().joints[0]
    weight = j.mass * 9.81 * np.hypot(j.center[0], j.center[2])
    for angle, stays in ((0.2, True), (1.2, False)):
        robot = _hinge(friction=0.5 * weight)
        still = np.full((500, 1, 1), angle)
        motion = engine_plant.simulate(engine, robot, _cell(), Hidden(), Background(), still)
        assert bool(abs(motion.position[-1, 0, 0] - angle) < 2e-3) is stays


@pytest.mark.parametrize("engine", ENGINES)
def test_each_engines_contact_force_at_rest_balances_the_weight(engine: str) -> None:
    robot = _hinge(damping=2.0)
    j = robot.joints[0]
    along = robots.link_end(robot)[2]
    contact = robots.Contact(
        normal=(-1.0, 0.0, 0.0), height=-0.5 * along - 0.02, tip=robots.link_end(robot),
        radius=0.02, stiffness=4000.0, damping=200.0, friction=0.0, creep=0.0,
    )  # fmt: skip
    still = np.full((2000, 1, 1), 0.5)
    motion = engine_plant.simulate(
        engine, replace(robot, contact=contact), _cell(), Hidden(), Background(), still
    )
    q = motion.position[-1, 0, 0]
    weight = j.mass * 9.81 * (j.center[0] * np.cos(q) + j.center[2] * np.sin(q))
    depth = along * np.sin(q) + 0.02 + contact.height
    assert contact.stiffness * depth * along * np.cos(q) == pytest.approx(weight, rel=0.03)


@pytest.mark.parametrize("engine", ENGINES)
def test_each_engine_agrees_with_the_plant_of_sampled_cells(engine: str) -> None:
    robot = robots.draw(np.random.default_rng(3), 2, "position", hinges=True)
    robot = replace(robot, joints=tuple(replace(j, armature=0.0) for j in robot.joints))
    t = np.arange(0.0, 2.0, 1e-3)[:, None, None]
    wave = 0.3 * (1 - np.cos(2 * np.pi * t)) * np.array([1.0, -0.7])
    cell = _cell("interpolated")
    hidden = Hidden({"payload": {-1: {"mass": 0.4, "distance": 0.1}},
                     "coulomb_friction": {1: {"coulomb": 0.3}}})  # fmt: skip
    ours = cell_plant.simulate(robot, cell, hidden, Background(), wave)
    theirs = engine_plant.simulate(engine, robot, cell, hidden, Background(), wave)
    every = round(theirs.period / ours.period)
    assert theirs.position == pytest.approx(ours.position[::every], abs=5e-3)
    without = cell_plant.simulate(robot, cell, Hidden(), Background(), wave)
    assert np.abs(without.position - ours.position).max() > 0.01


@pytest.mark.parametrize("engine", ENGINES)
def test_a_prismatic_joint_moves_as_in_the_plant_of_sampled_cells(engine: str) -> None:
    drawn = (robots.draw(np.random.default_rng(seed), 1, "position") for seed in range(20))
    robot = next(r for r in drawn if r.joints[0].slide)
    robot = replace(robot, joints=(replace(robot.joints[0], armature=0.0),))
    t = np.arange(0.0, 1.0, 1e-3)[:, None, None]
    wave = 0.2 * (1 - np.cos(2 * np.pi * t))
    cell = _cell("interpolated")
    ours = cell_plant.simulate(robot, cell, Hidden(), Background(), wave)
    theirs = engine_plant.simulate(engine, robot, cell, Hidden(), Background(), wave)
    every = round(theirs.period / ours.period)
    assert theirs.position == pytest.approx(ours.position[::every], abs=2e-3)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_seed_generates_a_complete_case_for_each_engine(
    engine: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine_cases, "SECONDS", (2.5,))
    monkeypatch.setattr(engine_cases, "TOUCHING", 0.0)
    seed = next(
        s for s in range(40)
        if engine_cases.kind_of(s) == "one" and engine_cases.engine_of(s) == engine
    )  # fmt: skip
    name = engine_cases.make(seed, tmp_path / "cases", tmp_path / "truth", joints=1)
    truth = json.loads((tmp_path / "truth" / f"{name}.json").read_text())
    assert truth["engine"] == engine
    assert len(truth["effects"]) == 1
    assert len(list((tmp_path / "cases" / name / "recordings").glob("*.mcap"))) == 5
