"""D-optimal Fourier series from each solver: within the limits, and equally informative."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from approved_arms import approved_for_arm, loaded, write_twin
from in_process import InProcess

from pytest_twin import cli
from pytest_twin.errors import SpecError
from pytest_twin.excitation.approved_limits import ApprovedLimits
from pytest_twin.excitation.d_optimal import Design
from pytest_twin.excitation.excite import excite
from pytest_twin.excitation.minimizers import SOLVERS, minimizer
from pytest_twin.excitation.noise import noise_of
from pytest_twin.excitation.read_limits import read_approved
from pytest_twin.formats.schema import load_schema
from pytest_twin.identification.regressor.base_parameters import structural_base
from pytest_twin.identification.regressor.regressor import Regressor

pytestmark = pytest.mark.usefixtures("commands_in_process")


def designs(twin: Path) -> tuple[ApprovedLimits, int, dict[str, Design]]:
    """The approved limits, the number of base parameters, and the design problem per solver."""
    realization, read = loaded(twin)
    approved = read_approved(realization, read)
    regressor = Regressor(realization, approved.names)
    base = structural_base(regressor)
    std = noise_of(realization, approved).effort
    return (
        approved,
        len(base),
        {
            solver: Design(approved, regressor, base, std, minimize=minimizer(solver))
            for solver in SOLVERS
        },
    )


def test_motions_from_ipopt_keep_the_limits_and_are_as_informative_as_those_from_scipy(
    tmp_path: Path,
) -> None:
    pytest.importorskip("casadi")
    twin = write_twin(tmp_path, approved_for_arm(mechanisms=["inertia"]))
    approved, parameters, found = designs(twin)
    lower, upper = approved.room
    log_det = {}
    for solver, design in found.items():
        optimum = design.optimum(seed=1, starts=2)
        drawn = design.drawn(optimum.coefficients)
        assert np.all(drawn.position >= lower - 1e-9)
        assert np.all(drawn.position <= upper + 1e-9)
        assert np.all(np.abs(drawn.velocity) <= approved.speed * (1.0 + 1e-9))
        assert np.all(np.abs(drawn.acceleration) <= approved.acceleration * (1.0 + 1e-9))
        assert optimum.log_det > max(design.log_det(design.random(seed)) for seed in range(20))
        log_det[solver] = optimum.log_det
    # D-efficiency: the n-th root of the determinant, where n is the number of parameters.
    gained = log_det["ipopt"] - log_det["scipy"]
    assert math.exp(gained / parameters) >= 0.95


def test_the_command_uses_the_given_solver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("casadi")
    monkeypatch.setattr("pytest_twin.commands.excite.Sandbox", InProcess)
    small = approved_for_arm(
        mechanisms=["inertia"],
        duration=3.0,
        rate=20.0,
        task_band=[0.5, 2.0],
        workspace=[],
        clearance="none",
    )
    twin, out = write_twin(tmp_path, small), tmp_path / "out"
    # Three seconds are too short for all parameters: status 1.
    assert cli.main(["excite", str(twin), "--out", str(out), "--solver", "ipopt"]) == 1
    document = json.loads((out / "excitation.json").read_text())
    jsonschema.validate(document, load_schema("results/excite.schema.json"))
    assert document["solver"] == "ipopt"
    motion = next(one for one in document["trajectories"] if one["name"] == "fourier_held_out")
    reached = {
        solver: design.optimum(motion["seed"], starts=1).log_det
        for solver, design in designs(twin)[2].items()
    }
    assert motion["settings"]["log_det"] == pytest.approx(reached["ipopt"], rel=1e-9)
    assert motion["settings"]["log_det"] != pytest.approx(reached["scipy"], rel=1e-9)


def test_ipopt_raises_errors_of_the_objective() -> None:
    pytest.importorskip("casadi")

    def objective(free: np.ndarray) -> tuple[float, np.ndarray]:
        if free[0] < 1.0:
            raise ValueError("below 1")
        return float(free @ free), 2.0 * free

    with pytest.raises(ValueError, match="below 1"):
        minimizer("ipopt")(objective, np.array([3.0, 1.0]), 50, 1e-9)


def test_ipopt_finds_the_minimum_of_the_rosenbrock_function() -> None:
    pytest.importorskip("casadi")

    def rosenbrock(free: np.ndarray) -> tuple[float, np.ndarray]:
        x, y = free
        value = (1.0 - x) ** 2 + 100.0 * (y - x * x) ** 2
        slope = [-2.0 * (1.0 - x) - 400.0 * x * (y - x * x), 200.0 * (y - x * x)]
        return float(value), np.array(slope)

    found = minimizer("ipopt")(rosenbrock, np.array([-1.2, 1.0]), 200, 1e-14)
    assert found == pytest.approx([1.0, 1.0], abs=1e-4)


def test_without_casadi_the_error_gives_the_command_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "casadi", None)
    monkeypatch.delitem(sys.modules, "pytest_twin.excitation.ipopt", raising=False)
    path = write_twin(tmp_path, approved_for_arm(mechanisms=["inertia"]))
    with pytest.raises(SpecError) as caught:
        excite(*loaded(path), solver="ipopt")
    message = str(caught.value)
    assert "casadi, which contains IPOPT, is not installed" in message
    assert "pip install 'pytest-twin[ipopt]'" in message
