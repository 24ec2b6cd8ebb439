"""Rigid-body terms along a trajectory."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from test_first_order import ARM, problem_of

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.measured_trajectory import measured_trajectory
from pytest_twin.diagnosis.first_order.rigid_terms import rigid_terms
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects import catalogue
from pytest_twin.effects.batch_models import BatchModels, PreparedBatch
from pytest_twin.estimation.hypothesis import EMPTY, Term, effect_values

UPPER_ARM = 0.3
"""Distance from the shoulder to the elbow, m."""


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of("position", {})


def planar_arm(q: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 2, 2) mass matrix and (n, 2) bias of the arm from Lagrange's equations.

    A positive angle about y turns the x axis of a link downward.

    Args:
        q, v: (n, 2) joint positions in rad and velocities in rad/s.
    """
    model = mujoco.MjModel.from_xml_string(ARM)
    mass, centre = model.body_mass[1:], model.body_ipos[1:, 0]
    inertia = model.body_inertia[1:, 0]
    g = -model.opt.gravity[2]
    offset = mass[1] * UPPER_ARM * centre[1]
    inner = inertia[1] + mass[1] * centre[1] ** 2
    matrix = np.empty((len(q), 2, 2))
    matrix[:, 1, 1] = inner
    matrix[:, 0, 1] = matrix[:, 1, 0] = inner + offset * np.cos(q[:, 1])
    matrix[:, 0, 0] = (
        inertia[0] + mass[0] * centre[0] ** 2 + mass[1] * UPPER_ARM**2
        + inner + 2 * offset * np.cos(q[:, 1])
    )  # fmt: skip
    matrix += np.diag(model.dof_armature)
    coriolis = offset * np.sin(q[:, 1])
    elbow = -mass[1] * centre[1] * g * np.cos(q.sum(axis=1))
    shoulder = -(mass[0] * centre[0] + mass[1] * UPPER_ARM) * g * np.cos(q[:, 0]) + elbow
    bias = np.stack([
        shoulder - coriolis * v[:, 1] * (2 * v[:, 0] + v[:, 1]), elbow + coriolis * v[:, 0] ** 2,
    ], axis=1)  # fmt: skip
    return matrix, bias


def test_mass_matrix_and_bias_of_a_planar_arm_equal_the_closed_form(problem: Problem) -> None:
    motion = measured_trajectory(problem, EMPTY, problem.fit)
    found = rigid_terms(problem.simulator, motion)[0]
    q, v, a = (x[0, found.at] for x in (motion.position, motion.velocity, motion.acceleration))
    mass, bias = planar_arm(q, v)
    effort = bias + np.einsum("nij,nj->ni", mass, a)
    assert np.ptp(q[:, 1]) > 0.2
    assert found.mass[0] == pytest.approx(mass, rel=1e-6)
    assert found.bias[0] == pytest.approx(bias, abs=1e-6 * np.abs(bias).max())
    assert found.effort[0] == pytest.approx(effort, abs=1e-6 * np.abs(effort).max())


def test_each_payload_is_written_into_a_model_once_for_all_samples(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    motion = measured_trajectory(problem, EMPTY, problem.fit)
    payloads = [
        EMPTY.with_term(Term("payload", -1), np.array([mass, 1.0, 0.0, 0.0, 0.0]))
        for mass in np.linspace(0.1, 1.0, 100)
    ]
    values = effect_values(payloads, len(problem.joints), problem.scales)
    effects = [(catalogue()[e], v) for e, v in values.items()]
    written: list[int] = []
    write = BatchModels.prepare

    def counted(self: BatchModels, rows: Any, *args: Any, **named: Any) -> PreparedBatch:
        written.append(len(rows))
        return write(self, rows, *args, **named)

    monkeypatch.setattr(BatchModels, "prepare", counted)
    found = rigid_terms(problem.simulator, motion, effects, len(payloads))
    assert len(found[0].at) > 100
    assert written == [len(payloads)]
    efforts = np.array([f.effort for f in found])
    assert np.abs(np.diff(efforts, axis=0)).max(axis=(1, 2, 3)).all()
