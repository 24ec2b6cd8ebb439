"""Simulation of a USD stage by Newton, compared with the same robot in MuJoCo."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from model_texts import ARM, written

from pytest_twin.errors import ModelError, SpecError
from pytest_twin.realization import Realization, load, simulate, usd

needs_newton = pytest.mark.skipif(
    importlib.util.find_spec("newton") is None or importlib.util.find_spec("pxr") is None,
    reason="needs the extra newton: pip install 'pytest-twin[newton]'",
)
FRICTIONLESS = ARM.replace('friction="0.2"', "")


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The arm without dry friction as a USD stage."""
    folder = tmp_path_factory.mktemp("stage")
    usd.convert(written(folder, FRICTIONLESS, "arm.urdf"), folder / "arm.usda")
    return folder / "arm.usda"


@pytest.fixture(scope="module")
def both(stage: Path) -> tuple[Realization, Realization]:
    """The arm in MuJoCo and in Newton."""
    return load(stage.with_suffix(".urdf")), load(stage, simulator="newton")


def simulated_fall(realization: Realization, seconds: float = 0.15) -> simulate.SimulatedMotion:
    """A fall under gravity with a time step of 1 ms, without contacts and joint limits."""
    model = simulate.prepare_model(realization, contact=False)
    model.opt.timestep = 0.001
    data = simulate.initial_state(model, realization, np.array([0.4, 0.1]))
    return simulate.run(realization, model, data, simulate.steps_in(model, seconds))


@needs_newton
def test_forward_kinematics_agrees_with_mujoco(both: tuple[Realization, Realization]) -> None:
    frames = ("base", "upper", "lower", "tool")
    mujoco, newton = (
        simulate.forward_kinematics(one)(np.array([0.7, 0.2]), frames) for one in both
    )
    for frame in frames:
        np.testing.assert_allclose(newton[frame], mujoco[frame], atol=2e-6)


@needs_newton
def test_the_motion_of_a_falling_arm_agrees_with_mujoco(
    both: tuple[Realization, Realization],
) -> None:
    mujoco, newton = (simulated_fall(one) for one in both)
    motion = np.ptp(mujoco.qpos, axis=0)
    assert (motion > 0.01).all()
    assert (np.abs(newton.qpos - mujoco.qpos).max(axis=0) < 0.01 * motion).all()


@needs_newton
def test_the_energy_of_a_falling_arm_has_no_numerical_drift(
    both: tuple[Realization, Realization],
) -> None:
    run = simulated_fall(both[1])
    assert abs(run.constraint_work[-1]) < 1e-3 * np.ptp(run.energy)


@needs_newton
def test_a_locked_joint_does_not_move(both: tuple[Realization, Realization]) -> None:
    newton = both[1]
    model = simulate.prepare_model(newton, contact=False, locked=["elbow"])
    data = simulate.initial_state(model, newton, np.array([0.4, 0.1]))
    run = simulate.run(newton, model, data, simulate.steps_in(model, 0.3))
    shoulder, elbow = np.ptp(run.qpos, axis=0)
    assert shoulder > 0.1
    assert elbow < 1e-4


@needs_newton
def test_a_simulation_with_contacts_is_refused(both: tuple[Realization, Realization]) -> None:
    newton = both[1]
    model = simulate.prepare_model(newton)
    data = simulate.initial_state(model, newton, np.zeros(2))
    with pytest.raises(SpecError, match="stepped without contacts"):
        simulate.run(newton, model, data, 1)


@needs_newton
def test_dry_friction_that_newton_leaves_out_is_noted(tmp_path: Path) -> None:
    usd.convert(written(tmp_path, ARM, "arm.urdf"), tmp_path / "arm.usda")
    (note,) = load(tmp_path / "arm.usda", simulator="newton").notes
    assert note.endswith("has no dry friction; the model states them for 1 of 2")


def test_mujoco_does_not_step_a_stage(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="MuJoCo does not step USD"):
        load(written(tmp_path, "#usda 1.0", "arm.usda"))


def test_without_the_extra_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pytest_twin.realization import newton

    monkeypatch.setattr(newton.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(newton.NewtonMissingError, match=r"pip install 'pytest-twin\[newton\]'"):
        load(written(tmp_path, "#usda 1.0", "arm.usda"), simulator="newton")
