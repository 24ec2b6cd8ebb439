"""Weights of windows under effort commands in which dry friction reverses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_noise_floor import TICK, mjcf, prepared
from two_pendulums import START_NS

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.build_problem import notes_on_low_weights
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.hypothesis import EMPTY
from pytest_twin.formats.mcap import JointSeries, read_recording, write_recording
from pytest_twin.trial import Trial, make_trial

DRY, DAMPING, INERTIA, WEIGHT = 0.3, 0.1, 0.002 + 0.04 + 0.01, 9.81 * 0.2
FINE, NOISE = 1e-5, 5e-5
MOTOR = '<motor name="j" joint="j"/>'


def pendulum_with_friction(friction: float) -> str:
    """MJCF of the pendulum with dry friction in N*m, whose constraint hardly creeps."""
    stiff = 'solreffriction="0.004 1" solimpfriction="0.99 0.999 0.001"'
    given = f'damping="{DAMPING}" frictionloss="{friction}" {stiff}'
    return mjcf(MOTOR).replace(f'damping="{DAMPING}"', given)


def simulate_dahl_friction(command: FloatArray, distance: float) -> tuple[FloatArray, FloatArray]:
    """Stamps in s and positions in rad of a pendulum with the dry friction of Dahl (1968).

    After a reversal, the friction reaches its level over about ``distance`` in rad.
    """
    q = v = z = 0.0
    each = round(TICK / FINE)
    seen = []
    for k in range(len(command) * each):
        if k % each == each // 2:
            seen.append((k * FINE, q))
        z += FINE * (v - abs(v) * z / distance)
        friction = DRY * z / distance + DAMPING * v
        v += FINE * (command[k // each] - friction - WEIGHT * np.sin(q)) / INERTIA
        q += FINE * v
    time, position = np.array(seen).T
    return time, position


def recorded(folder: Path, friction: float, distance: float) -> Trial:
    """Record a pendulum with presliding ``distance``; its model has dry friction ``friction``."""
    sent = TICK * np.arange(400)
    command = 0.9 * np.sin(2 * np.pi * 0.8 * sent) + 0.5 * np.sin(2 * np.pi * 1.7 * sent)
    time, position = simulate_dahl_friction(command, distance)
    position += NOISE * np.random.default_rng(0).standard_normal(len(position))
    (folder / "model.xml").write_text(pendulum_with_friction(friction))

    def series(topic: str, at: FloatArray, **fields: FloatArray) -> JointSeries:
        stamps = START_NS + np.rint(at * 1e9).astype(np.int64)
        given = {n: fields[n][:, None] if n in fields else None for n in
                 ("position", "velocity", "effort")}  # fmt: skip
        return JointSeries(topic, ("j",), stamps, stamps, **given)

    both = [
        series("/joint_commands", sent, effort=command),
        series("/joint_states", time, position=position),
    ]
    write_recording(folder / "a.mcap", both, {})
    return make_trial(read_recording(folder / "a.mcap"))


def test_small_presliding_is_no_mismatch(tmp_path: Path) -> None:
    problem = prepared(tmp_path, recorded(tmp_path, DRY, 2e-4)).problem
    everywhere = problem.all_segments
    (unweighted,), (weighted,) = (
        f([EMPTY], everywhere) for f in (problem.errors, problem.residuals)
    )
    floors = [np.sqrt(np.mean((r[:, 0] / problem.floor[0]) ** 2)) for r in (unweighted, weighted)]
    assert floors[0] > 2.0 * VERDICT.at_floor, "the unweighted error must be above the noise floor"
    assert floors[1] < VERDICT.at_floor
    assert problem.floor[0] < 3.0 * NOISE, "the noise floor must stay near the sensor noise"
    weights = np.array(list(problem.position_weights.values()))[:, 0]
    assert np.mean(weights**2) == pytest.approx(1.0)
    (line,) = notes_on_low_weights(problem)
    assert line.startswith(f"joint 'j': {(weights < 0.5 * weights.max()).sum()} of {len(weights)}")


def test_dry_friction_that_the_model_lacks_keeps_its_full_weight(tmp_path: Path) -> None:
    problem = prepared(tmp_path, recorded(tmp_path, 0.0, 2e-4)).problem
    assert problem.position_weights == {}
    assert notes_on_low_weights(problem) == []
    (left,) = problem.residuals([EMPTY], problem.all_segments)
    assert np.sqrt(np.mean(left[:, 0] ** 2)) > 30.0 * problem.floor[0]


def test_large_presliding_leaves_a_residual_above_the_noise_floor(tmp_path: Path) -> None:
    problem = prepared(tmp_path, recorded(tmp_path, DRY, 5e-3)).problem
    (left,) = problem.residuals([EMPTY], problem.all_segments)
    assert np.sqrt(np.mean(left[:, 0] ** 2)) > 2.0 * VERDICT.at_floor * problem.floor[0]
