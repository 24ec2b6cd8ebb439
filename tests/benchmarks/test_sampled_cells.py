"""The plant of sampled cells: mechanics, friction laws, servos, and a complete case."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from scipy.integrate import solve_ivp

pytest.importorskip("numba", reason="the plant is compiled: pip install 'pytest-twin[benchmarks]'")
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "concealed"))

import case_parts
import cell_cases
import cell_friction
import cell_kernel
import cell_plant
import logger
import pinocchio as pin
import robots
import setpoints
from cell import Background, Cell, draw_background, draw_cell, ideal
from plant import Hidden


def _cell(between: str = "held", law: str = "set_valued") -> Cell:
    drawn = draw_cell(
        robots.draw(np.random.default_rng(0), 1, "position"), np.random.default_rng(0)
    )
    held = replace(drawn, between=between, command_period=0.01)
    return replace(ideal(held, cell_plant.STEP), friction=law)


def _pendulum(**changed: Any) -> robots.Robot:
    """One hinge without servo and, unless changed, without friction."""
    robot = robots.draw(np.random.default_rng(5), 1, "position", hinges=True)
    free = {"damping": 0.0, "friction": 0.0, "kp": 0.0, "kv": 0.0, **changed}
    return replace(robot, joints=(replace(robot.joints[0], **free),))


@pytest.mark.parametrize("joints", [1, 3, 6])
def test_mass_matrix_and_bias_forces_equal_pinocchio(joints: int) -> None:
    robot = robots.draw(np.random.default_rng(joints), joints, "position", hinges=True)
    rng = np.random.default_rng(1)
    q, v = rng.uniform(-1, 1, joints), rng.uniform(-2, 2, joints)
    mass, bias = np.empty((joints, joints)), np.empty(joints)
    gravity = np.array([0.3, -0.2, -9.81])
    cell_kernel.rigid_terms(
        cell_plant.link_rows(robot), cell_plant.body_rows(robot, Hidden()), gravity, q, v, mass,
        bias, cell_kernel.scratch(joints),
    )  # fmt: skip
    model = robots.pinocchio_model(robot, {}, (0.0, 0.0), gravity)
    data = model.createData()
    upper = np.triu(pin.crba(model, data, q))
    assert mass == pytest.approx(upper + np.triu(upper, 1).T, abs=1e-12)
    assert bias == pytest.approx(pin.nonLinearEffects(model, data, q, v), abs=1e-12)


def test_the_sampled_plant_matches_the_equation_of_a_pendulum(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    robot = _pendulum()
    monkeypatch.setattr(cell_kernel, "SETTLE", 0.0)
    j = robot.joints[0]
    reference = np.full((1000, 1, 1), 0.7)
    state = np.zeros((4, 1, 1), cell_kernel.STATE)
    state["q"] = state["theta"] = 0.7
    before = cell_plant.Run(*(np.zeros((0, 1, 1)) for _ in range(4)), reference, reference, state)
    motion = cell_plant.simulate(
        robot, _cell(), Hidden(), Background(), reference[:250], again=before
    )
    inertia = j.inertia[1] + j.mass * (j.center[0] ** 2 + j.center[2] ** 2) + j.armature

    def swing(_: float, y: Any) -> list[float]:
        lever = j.center[0] * np.cos(y[0]) + j.center[2] * np.sin(y[0])
        return [y[1], j.mass * 9.81 * lever / inertia]

    time = np.arange(len(motion.position)) * cell_plant.RECORD
    exact = solve_ivp(swing, (0.0, 0.25), [0.7, 0.0], t_eval=time, rtol=1e-10, atol=1e-12)
    assert np.ptp(exact.y[0]) > 0.05
    assert motion.position[:, 0, 0] == pytest.approx(exact.y[0], abs=2e-4)


@pytest.mark.parametrize("law", [0, 1, 2])
@pytest.mark.parametrize("speed", [-0.4, 0.02])
def test_dynamic_friction_laws_reach_the_coulomb_level_when_sliding(law: int, speed: float) -> None:
    z, slip = np.zeros(cell_friction.ELEMENTS), np.zeros(cell_friction.ELEMENTS)
    for _ in range(20_000):
        effort = cell_friction.friction_effort(law, 1.5, 2e-4, 0.05, speed, 5e-5, z, slip)
    assert effort == pytest.approx(1.5 * np.sign(speed), rel=1e-3)


def test_maxwell_slip_stiffness_drops_as_elements_start_to_slide() -> None:
    z, slip = np.zeros(cell_friction.ELEMENTS), np.zeros(cell_friction.ELEMENTS)
    efforts = [
        cell_friction.friction_effort(2, 1.0, 1e-3, 0.05, 0.1, 5e-5, z, slip) for _ in range(600)
    ]
    stiffness = np.diff(efforts) / (0.1 * 5e-5)
    each = cell_friction.SHARES / cell_friction.YIELDS / 1e-3  # N*m/rad of the elements
    for stretched, sticking in ((0, 4), (100, 3), (400, 1)):  # after 0, 0.5 and 2 yield distances
        assert stiffness[stretched] == pytest.approx(each[4 - sticking :].sum(), rel=1e-6)


@pytest.mark.parametrize("law", cell_friction.LAWS)
def test_every_friction_law_holds_a_joint_below_its_level(law: str) -> None:
    j = _pendulum().joints[0]
    weight = j.mass * 9.81 * np.hypot(j.center[0], j.center[2])
    level = 0.5 * weight
    for angle, stays in ((0.2, True), (1.2, False)):
        robot = _pendulum(friction=level)
        still = np.full((500, 1, 1), angle)
        motion = cell_plant.simulate(robot, _cell(law=law), Hidden(), Background(), still)
        moved = abs(motion.position[-1, 0, 0] - angle)
        assert bool(moved < 2e-3) is stays


@pytest.mark.parametrize(
    ("between", "expected"), [("held", 0.0), ("interpolated", 0.5), ("ramped", -0.5)]
)
def test_the_setpoint_between_commands_is_held_interpolated_or_ramped(
    between: str, expected: float
) -> None:
    sent = np.arange(100.0)[:, None]  # one unit a millisecond
    code = ("held", "interpolated", "ramped").index(between)
    value = cell_kernel.asked(sent, 0, 0.025, code, 10, 1e-3)
    assert (value - 20.0) / 10.0 == pytest.approx(expected)


def test_a_longer_servo_period_increases_the_overshoot() -> None:
    robot = robots.draw(np.random.default_rng(2), 1, "position", hinges=True)
    stepped = np.full((1500, 1, 1), 0.1)
    stepped[:300] = 0.0
    over = []
    for period in (2.5e-4, 4e-3):
        cell = replace(_cell(), servo_period=period, computing=1.0, slope_cutoff=100.0)
        motion = cell_plant.simulate(robot, cell, Hidden(), Background(), stepped)
        over.append(motion.position[:, 0, 0].max())
    assert over[1] > over[0] + 1e-4


def test_background_differences_have_realistic_sizes() -> None:
    robot = robots.draw(np.random.default_rng(1), 2, "position")
    background = draw_background(robot, np.random.default_rng(3))
    for values in background.effects["inertial_parameters"].values():
        assert 0.01 <= abs(values["relative_error"]) <= 0.03
    for i, values in background.effects["viscous_friction"].items():
        assert 0.05 <= abs(values["coefficient"]) / robot.joints[i].damping <= 0.1
    assert np.abs(background.centers).max() <= 1e-3
    half = background.scaled(0.5)
    assert half.effects["base_tilt"][-1]["roll"] == pytest.approx(
        0.5 * background.effects["base_tilt"][-1]["roll"]
    )


def test_resizing_keeps_contact_stiffness_positive() -> None:
    hidden = Hidden({"contact_stiffness": {-1: {"relative_error": -0.7}},
                     "rate_limit": {0: {"rate": 0.4}}})  # fmt: skip
    larger = case_parts.resized(hidden, 2.0).effects
    assert larger["contact_stiffness"][-1]["relative_error"] == -0.9
    assert larger["rate_limit"][0]["rate"] == 0.2  # a larger effect is a lower limit


def test_any_twenty_seeds_have_the_planned_kinds() -> None:
    kinds = [cell_cases.kind_of(seed) for seed in range(7, 27)]
    assert {k: kinds.count(k) for k in set(kinds)} == {
        "none": 4, "one": 11, "two": 2, "three": 1, "outside": 2
    }  # fmt: skip


def test_a_seed_generates_the_same_case_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cell_cases, "SECONDS", (2.5,))
    seed = next(s for s in range(20) if cell_cases.kind_of(s) == "one")
    name = cell_cases.make(seed, tmp_path / "cases", tmp_path / "truth", joints=1)
    cell_cases.make(seed, tmp_path / "again", tmp_path / "truth2", joints=1)
    first = (tmp_path / "truth" / f"{name}.json").read_bytes()
    assert first == (tmp_path / "truth2" / f"{name}.json").read_bytes()
    truth = json.loads(first)
    assert len(truth["effects"]) == 1
    assert truth["stands_out"]["factor"] > 0.0
    assert {"inertial_parameters", "control_period"} <= {b["effect"] for b in truth["background"]}
    recordings = sorted((tmp_path / "cases" / name / "recordings").glob("*.mcap"))
    assert len(recordings) == 5
    with recordings[0].open("rb") as file:
        topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    assert topics == {"/joint_commands", "/joint_states"}


def test_setpoints_of_every_kind_start_at_the_centre_and_move() -> None:
    robot = robots.draw(np.random.default_rng(1), 2, "position", hinges=True)
    for kind in setpoints.KINDS:
        out = setpoints.setpoint(robot, kind, np.full(2, 0.3), 6.0, np.random.default_rng(4))
        assert out.shape == (6000, 2)
        assert np.abs(out[0] - 0.3).max() < 0.01
        assert np.ptp(out) > 0.1


@pytest.mark.parametrize("late_share", [0.0, 0.02])
def test_the_logger_adds_no_unintended_clock_drift(late_share: float) -> None:
    """Clock drift is only injected on purpose; stamps always increase."""
    rng = np.random.default_rng(3)
    drawn = replace(
        logger.draw_logger(rng), rate=1000.0, jitter=2e-4, latency=0.0, late_share=late_share,
        late_by=8e-3, drop_share=0.0, hole=0.0,
    )  # fmt: skip
    rows = np.zeros((10_001, 1))
    traces = logger.Traces(1e-3, rows, rows, rows, rows, 0.01, rows[:1000])
    stamps, taken = logger.stamped(traces, Hidden(), drawn, False, rng)
    assert (np.diff(stamps) > 0.0).all()
    drift = np.polyfit(taken, stamps - taken, 1)[0]
    assert abs(drift) < 2e-5
