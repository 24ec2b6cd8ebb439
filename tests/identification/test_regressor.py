"""The regressor agrees with MuJoCo's inverse dynamics, base parameters with the textbook."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from arms import needed_effort
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_twin.errors import SpecError
from pytest_twin.estimation.covariance import predicted_covariance
from pytest_twin.identification.regressor.base_parameters import (
    COEFFICIENT_TOLERANCE,
    RANK_TOLERANCE,
    base_of,
    structural_base,
)
from pytest_twin.identification.regressor.columns import SharedMotor
from pytest_twin.identification.regressor.regressor import Regressor
from pytest_twin.realization import Realization, load
from pytest_twin.strategies import robots

TWO_LINKS = """<mujoco model="two_links">
  <worldbody>
    <body name="upper">
      <inertial pos="0.3 0.01 0" mass="4" diaginertia="0.02 0.1 0.1"/>
      <joint name="shoulder" axis="0 1 0" armature="0.4" damping="0.7" frictionloss="0.3" ref="20"/>
      <body name="lower" pos="0.5 0 0">
        <inertial pos="0.2 0 0.02" mass="2" diaginertia="0.01 0.05 0.05"/>
        <joint name="elbow" axis="0 1 0" armature="0.1" damping="0.2" frictionloss="0.1"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""


def model_of(text: str, folder: Path) -> Realization:
    path = folder / "model.xml"
    path.write_text(text)
    return load(path)


def motion(joints: int, samples: int = 40, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-2.0, 2.0, (3, samples, joints))


def check_effort(realization: Realization) -> None:
    regressor = Regressor(realization, realization.joints)
    q, v, a = motion(len(realization.joints))
    dry = np.array([c.kind == "coulomb_friction" for c in regressor.columns])
    ours = regressor.matrix(q, v, a) @ np.where(dry, 0.0, regressor.prior)
    # MuJoCo models dry friction as a constraint.
    theirs = needed_effort(realization.model, q, v, a, dry=False)
    np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-7 * np.abs(theirs).max())


def test_efforts_of_two_links_agree_with_mujoco(tmp_path):
    check_effort(model_of(TWO_LINKS, tmp_path))


@given(robot=robots(links=(2, 5), mimics=False, meshes=False))
@settings(max_examples=15, deadline=None)
def test_efforts_of_random_robots_agree_with_mujoco(robot, tmp_path_factory):
    folder = tmp_path_factory.mktemp("robot")
    for form in ("urdf", "mjcf"):
        check_effort(load(robot.write(folder, form)))


def check_derivatives(regressor: Regressor, parameters: np.ndarray) -> None:
    """Derivatives by the motion agree with central differences of the regressor's efforts."""
    state = motion(len(regressor.joints), samples=10)
    step = 1e-5
    for which, found in enumerate(regressor.derivatives(*state, parameters)):
        for joint in range(len(regressor.joints)):
            ends = []
            for side in (step, -step):
                moved = state.copy()
                moved[which, :, joint] += side
                ends.append(regressor.matrix(*moved) @ parameters)
            expected = (ends[0] - ends[1]) / (2.0 * step)
            near = 1e-6 * max(1.0, np.abs(ends).max())
            np.testing.assert_allclose(found[:, :, joint], expected, rtol=1e-6, atol=near)


@given(robot=robots(links=(2, 5), mimics=False, meshes=False), seed=st.integers(0, 99))
@settings(max_examples=15, deadline=None)
def test_derivatives_of_efforts_agree_with_differences(robot, seed, tmp_path_factory):
    realization = load(robot.write(tmp_path_factory.mktemp("robot"), "mjcf"))
    regressor = Regressor(realization, realization.joints)
    # Values of base parameters, with zero for all others: links without mass, no real bodies.
    base = structural_base(regressor)
    parameters = np.zeros(len(regressor.columns))
    random = np.random.default_rng(seed).normal(size=len(base))
    parameters[base.independent] = base.values(regressor.prior) + 0.1 * random
    check_derivatives(regressor, parameters)


def test_derivatives_of_links_whose_masses_cancel_are_finite(tmp_path):
    """Base parameters are no real bodies: the mass of a subtree may be zero."""
    regressor = Regressor(model_of(TWO_LINKS, tmp_path), ["shoulder", "elbow"])
    parameters = regressor.prior.copy()
    masses = [at for at, c in enumerate(regressor.columns) if c.kind == "m"]
    parameters[masses] = 1.5, -1.5
    check_derivatives(regressor, parameters)


def test_derivatives_count_shared_motors_and_currents(tmp_path):
    regressor = Regressor(
        model_of(TWO_LINKS, tmp_path), ["shoulder", "elbow"],
        [SharedMotor("elbow", "shoulder", -1.0)], unscaled=["shoulder"],
    )  # fmt: skip
    parameters = regressor.prior + np.random.default_rng(3).normal(size=len(regressor.columns))
    check_derivatives(regressor, parameters)


def test_dry_friction_opposes_the_motion(tmp_path):
    regressor = Regressor(model_of(TWO_LINKS, tmp_path), ["shoulder", "elbow"])
    at = [c.name for c in regressor.columns].index("elbow.coulomb_friction")
    v = np.array([[1.0, 0.2], [1.0, -0.2], [1.0, 0.0]])
    column = regressor.matrix(np.zeros((3, 2)), v, np.zeros((3, 2)))[:, :, at]
    np.testing.assert_array_equal(column, [[0, 1], [0, -1], [0, 0]])
    assert regressor.prior[at] == 0.1


def test_base_parameters_of_two_links_agree_with_the_textbook(tmp_path):
    """Khalil and Dombre (2002), ch. 9, for two parallel joint axes."""
    regressor = Regressor(model_of(TWO_LINKS, tmp_path), ["shoulder", "elbow"])
    base = structural_base(regressor)
    assert base.expressions == (
        "Iyy1 + Ia1 + 0.25*m2",
        "mx1 + 0.5*m2",
        "mz1",
        "fv1", "fs1", "off1",
        "Iyy2",
        "mx2",
        "mz2",
        "Ia2",
        "fv2", "fs2", "off2",
    )  # fmt: skip
    own = dict(zip(base.expressions, base.values(regressor.prior), strict=True))
    assert own["mx1 + 0.5*m2"] == pytest.approx(4 * 0.3 + 2 * 0.5)
    assert own["Iyy2"] == pytest.approx(0.05 + 2 * (0.2**2 + 0.02**2))
    assert base.words[1] == (
        "first moment along x of the link of 'shoulder' + 0.5*mass of the link of 'elbow'"
    )
    assert base.names[0] == "shoulder.Iyy"
    assert base.units[:4] == ("kg*m^2", "kg*m", "kg*m", "N*m*s/rad")


@given(robot=robots(links=(2, 6), mimics=False, meshes=False))
@settings(max_examples=10, deadline=None)
def test_base_parameters_predict_the_same_effort_as_all_parameters(robot, tmp_path_factory):
    realization = load(robot.write(tmp_path_factory.mktemp("robot")))
    regressor = Regressor(realization, realization.joints)
    matrix = regressor.matrix(*motion(len(realization.joints), 60, seed=5))
    of_motion = base_of(matrix, regressor.columns)
    ours = of_motion.matrix(matrix) @ of_motion.values(regressor.prior)
    whole = matrix @ regressor.prior
    # Columns that only the rounding of an exporter distinguishes are one; each may leave its share,
    # and that of the coefficients that count as rounding.
    share = RANK_TOLERANCE + len(of_motion) * COEFFICIENT_TOLERANCE
    left = share * np.linalg.norm(matrix, axis=(0, 1)) @ np.abs(regressor.prior)
    assert np.linalg.norm(ours - whole) <= left
    base = structural_base(regressor)
    reduced = base.matrix(matrix).reshape(-1, len(base))
    assert np.linalg.matrix_rank(reduced / np.linalg.norm(reduced, axis=0)) == len(base)


def test_a_motion_of_one_joint_determines_fewer_base_parameters(tmp_path):
    regressor = Regressor(model_of(TWO_LINKS, tmp_path), ["shoulder", "elbow"])
    q, v, a = motion(2)
    for moved in (q, v, a):
        moved[:, 1] = 0.0
    found = base_of(regressor.matrix(q, v, a), regressor.columns)
    assert "fv2" not in found.expressions
    assert "fv1" in found.expressions
    assert len(found) < len(structural_base(regressor))


def test_a_shared_motor_couples_two_joints(tmp_path):
    shared = SharedMotor("elbow", "shoulder")
    regressor = Regressor(model_of(TWO_LINKS, tmp_path), ["shoulder", "elbow"], [shared])
    names = [c.symbol for c in regressor.columns]
    q, v, a = motion(2, samples=1)
    matrix = regressor.matrix(q, v, a)[0]
    np.testing.assert_allclose(matrix[:, names.index("Iam2")], a[0, ::-1])
    np.testing.assert_allclose(matrix[:, names.index("fvm2")], v[0, ::-1])
    np.testing.assert_allclose(matrix[:, names.index("fsm2")], np.sign(v.sum()) * np.ones(2))
    words = "a shared motor turns joint 'wrist', which is not among the identified"
    with pytest.raises(SpecError, match=words):
        Regressor(model_of(TWO_LINKS, tmp_path), ["elbow"], [SharedMotor("elbow", "wrist")])


def test_predicted_deviations_agree_with_repeated_fits(tmp_path):
    regressor = Regressor(model_of(TWO_LINKS, tmp_path), ["shoulder", "elbow"])
    base = structural_base(regressor)
    matrix = base.matrix(regressor.matrix(*motion(2, 100)))
    std = np.array([0.5, 0.1])
    predicted = predicted_covariance(matrix, std)
    assert not predicted.undetermined.any()
    weighted = (matrix / std[:, None]).reshape(-1, len(base))
    noise = np.random.default_rng(3).standard_normal((len(weighted), 4000))
    repeated = np.linalg.lstsq(weighted, noise, rcond=None)[0]
    np.testing.assert_allclose(repeated.std(axis=1), predicted.std, rtol=0.05)


def test_parameters_without_motion_are_undetermined(tmp_path):
    regressor = Regressor(model_of(TWO_LINKS, tmp_path), ["shoulder", "elbow"])
    base = structural_base(regressor)
    q, v, a = motion(2)
    v[:, 0] = a[:, 0] = 0.0
    predicted = predicted_covariance(base.matrix(regressor.matrix(q, v, a)), np.ones(2))
    open_ = dict(zip(base.expressions, predicted.undetermined, strict=True))
    assert open_["fv1"]
    assert open_["Iyy1 + Ia1 + 0.25*m2"]
    assert not open_["fv2"]
    assert np.isinf(predicted.std[base.expressions.index("fv1")])


def test_a_rounded_right_angle_leaves_friction_its_own_name(tmp_path):
    """An exporter writes 1.5708 rad: the angle is off by 7e-6 rad."""
    text = TWO_LINKS.replace('<body name="upper">', '<body name="upper" euler="90 0 0">')
    text = text.replace('pos="0.5 0 0">', 'pos="0.5 0 0" euler="90.0004 0 0">')
    base = structural_base(Regressor(model_of(text, tmp_path), ["shoulder", "elbow"]))
    assert {"fv1", "fs1", "Ixx2 - Izz2", "fv2", "fs2"} <= set(base.expressions)
