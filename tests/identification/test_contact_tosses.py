"""Identification of contact parameters from tosses of an object, and their use in a twin."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from pytest_twin.errors import ModelError, RecordingError
from pytest_twin.formats.pose_track import PoseTrack
from pytest_twin.identification.contact.loss import errors_of, losses, whole_toss
from pytest_twin.identification.contact.parameters import (
    DAMPING,
    FRICTION,
    OFFSET,
    STIFFNESS,
    contact_model,
    direct_solref,
)
from pytest_twin.identification.contact.tosses import Toss, in_model_units
from pytest_twin.identification.contact.uncertainty import Surface, bootstrap_minimum, is_as_good
from pytest_twin.identification.identify_files import identify_files
from pytest_twin.metrics.pose_track import rotation_errors
from pytest_twin.realization import load
from pytest_twin.realization.free_body import free_body
from pytest_twin.report import identification
from pytest_twin.twin import load_twin

CUBE = """<mujoco model="cube">
  <option timestep="0.002"/>
  <worldbody>
    <geom name="table" type="plane" size="5 5 0.1"/>
    <body name="cube" pos="0 0 0.2"><freejoint/>
      <geom name="faces" type="box" size="0.05 0.05 0.05" mass="0.37"/>
    </body>
  </worldbody>
</mujoco>"""
GRAVITY = np.array([0.0, 0.0, -9.81])
TRUE = {FRICTION: 0.25, STIFFNESS: 9000.0, DAMPING: 150.0, OFFSET: 0.0015}
RATE = 150.0


@pytest.fixture(scope="module")
def model_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cube") / "cube.xml"
    path.write_text(CUBE)
    return path


def simulated_toss(model: mujoco.MjModel, seed: int, samples: int = 60) -> np.ndarray:
    """Positions and velocities (samples, 13) of a simulated toss, with a very small time step."""
    rng = np.random.default_rng(seed)
    fine = mujoco.MjModel.from_xml_string(CUBE) if model is None else model
    fine.opt.timestep = 1.0 / RATE / 32.0
    data = mujoco.MjData(fine)
    data.qpos[:3] = [*rng.uniform(-0.1, 0.1, 2), 0.15]
    turn = rng.normal(size=4)
    data.qpos[3:7] = turn / np.linalg.norm(turn)
    data.qvel[:] = [*rng.uniform(-1.0, 1.0, 2), 0.0, *rng.uniform(-5.0, 5.0, 3)]
    rows = []
    for _ in range(samples):
        rows.append(np.concatenate([data.qpos, data.qvel]))
        for _ in range(32):
            mujoco.mj_step(fine, data)
    return np.array(rows)


def tosses_of(model_path: Path, seeds: range) -> list[np.ndarray]:
    contact = contact_of(model_path)
    return [simulated_toss(contact.at(TRUE), seed) for seed in seeds]


def contact_of(model_path: Path):  # type: ignore[no-untyped-def]
    realization = load(model_path)
    return contact_model(realization, free_body(realization))


def as_toss(table: np.ndarray, name: str) -> Toss:
    time = np.arange(len(table)) / RATE
    return Toss(name, Path("sim.npz"), time, table[:, :7], table[:, 7:])


def test_the_true_parameters_have_the_smallest_prediction_error(model_path: Path) -> None:
    contact = contact_of(model_path)
    rows = [whole_toss(as_toss(t, "t")) for t in tosses_of(model_path, range(20, 26))]
    models = [contact.at({**TRUE, **change}) for change in ({}, {FRICTION: 0.6}, {OFFSET: -0.004})]
    best, slippery, small = (
        losses(e, contact.size).mean() for e in errors_of(models, contact.body, rows)
    )
    assert best < 0.5 * slippery
    assert best < 0.5 * small


def test_missing_units_of_length_and_time_are_estimated_from_free_fall(model_path: Path) -> None:
    unit, rate = 0.0524, 148.0
    tracks = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        time = np.arange(20) / rate
        v0 = np.array([2.0, -1.0, 0.5])
        position = np.outer(time, v0) + 0.5 * np.outer(time**2, GRAVITY)
        old = v0 + np.outer(time - 0.5 / rate, GRAVITY)
        noise = 1e-4 * rng.normal(size=position.shape)
        turn = np.tile([1.0, 0.0, 0.0, 0.0], (20, 1))
        tracks.append(PoseTrack(
            str(seed), Path("t.npz"), np.arange(20.0), (position + noise) / unit, turn,
            old / unit, np.zeros((20, 3)), has_times=False,
        ))  # fmt: skip
    found, units = in_model_units(tracks, GRAVITY)
    assert units.length == pytest.approx(unit, rel=0.01)
    assert 1.0 / units.period == pytest.approx(rate, rel=0.01)
    assert units.lag == pytest.approx(0.5 / rate, rel=0.1)
    assert found[0].twist[0, :3] == pytest.approx([2.0, -1.0, 0.5], abs=0.02)
    assert any("--length-unit" in note for note in units.notes)


def test_without_free_fall_the_units_cannot_be_estimated() -> None:
    still = PoseTrack(
        "0", Path("t.npz"), np.arange(20.0), np.zeros((20, 3)), np.tile([1.0, 0, 0, 0], (20, 1)),
        np.ones((20, 3)), np.zeros((20, 3)), has_times=False,
    )  # fmt: skip
    with pytest.raises(RecordingError, match="do not begin in free fall"):
        in_model_units([still, still], GRAVITY, rate=100.0)


def test_a_model_without_a_free_body_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(CUBE.replace("<freejoint/>", "<joint/>"))
    with pytest.raises(ModelError, match="needs one free body"):
        free_body(load(path))


def test_both_forms_of_solref_give_the_same_contact() -> None:
    model = mujoco.MjModel.from_xml_string(CUBE)
    stiffness, damping = direct_solref(model, 1)
    most = model.geom_solimp[1, 1]
    falls = []
    for solref in ([0.02, 1.0], [-stiffness * most**2, -damping * most]):
        model.geom_solref[:] = solref
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, nstep=200)
        falls.append(data.qpos.copy())
    assert falls[1] == pytest.approx(falls[0], abs=1e-9)


def test_the_rotation_error_does_not_depend_on_the_sign_of_a_quaternion() -> None:
    half = 0.3
    one = np.array([[0, 0, 0, np.cos(half), np.sin(half), 0, 0]])
    other = np.array([[0, 0, 0, -1.0, 0, 0, 0]])
    assert rotation_errors(one, other)[0] == pytest.approx(2.0 * half)


def test_a_parameter_direction_without_effect_on_the_error_is_unobservable() -> None:
    # The error of a toss is (a - b - e)^2 with noise e; it does not depend on a + b.
    rng = np.random.default_rng(0)
    noise = 0.02 * rng.normal(size=60)
    coefficients = np.array([
        noise**2, -2.0 * noise, 2.0 * noise, np.ones(60), -2.0 * np.ones(60), np.ones(60),
    ])  # fmt: skip
    wobble = 1e-3 * rng.normal(size=coefficients.shape)
    found = bootstrap_minimum(Surface(np.full(2, 0.5), coefficients + wobble), [0, 1])
    assert len(found.undetermined) == 1
    assert abs(found.undetermined[0] @ np.array([1.0, 1.0])) == pytest.approx(
        np.sqrt(2.0), abs=0.05
    )


def test_a_random_difference_of_errors_is_not_taken_for_a_worse_prediction() -> None:
    rng = np.random.default_rng(1)
    one = rng.uniform(0.0, 1.0, 100)
    assert is_as_good(one, one + 0.1 * rng.normal(size=100) - 0.005)
    assert not is_as_good(one, one + 0.1)


@pytest.fixture(scope="module")
def identified(model_path: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    folder = tmp_path_factory.mktemp("tosses")
    np.savez(folder / "sim.npz", **{
        str(n): np.hstack([t, np.zeros((len(t), 6))])
        for n, t in enumerate(tosses_of(model_path, range(40, 48)))
    })  # fmt: skip
    (folder / "cube.xml").write_text(CUBE)
    (folder / "out").mkdir()
    document = identify_files(
        {
            "model": str(folder / "cube.xml"),
            "recordings": [str(folder / "sim.npz")],
            "held_out": [],
            "out": str(folder / "out"),
            "name": "table",
            "tosses": {"rate": RATE, "length": 1.0},
        }
    )
    return folder, document


def test_parameters_are_identified_from_tosses_simulated_with_a_smaller_time_step(
    identified: Any,
) -> None:
    _, document = identified
    values = {name.split(".")[1]: one["value"] for name, one in document["parameters"].items()}
    assert document["verdict"] == "accepted"
    assert values[FRICTION] == pytest.approx(TRUE[FRICTION], rel=0.15)
    assert values[OFFSET] == pytest.approx(TRUE[OFFSET], abs=0.001)
    held = document["held_out"]["cube"]
    assert held["toss_position"] < 0.5 * held["toss_position_nominal"]
    # Unobservable parameters are reported without an interval.
    fixed = {name.split(".")[1] for name in document["contact"]["held"]}
    assert set(values) | fixed == set(TRUE)
    assert "cube.contact_rolling_friction" in {
        one["expression"] for one in document["unobservable"]
    }


def test_the_record_states_the_solver_and_the_spread_over_other_solver_settings(
    identified: Any,
) -> None:
    contact = identified[1]["contact"]
    assert contact["solver"]["timestep"] == 0.002
    assert contact["solver"]["integrator"] == "EULER"
    assert contact["tosses"]["held_out"] == ["sim.npz:3", "sim.npz:7"]
    assert {row["simulation"] for row in contact["spread"]} == {
        "timestep 1 ms", "elliptic cone", "integrator implicitfast",
    }  # fmt: skip
    assert "timestep 1 ms" in identification.render(identified[1])


def test_an_interval_over_simulations_holds_the_estimates_of_other_numerical_settings(
    identified: Any,
) -> None:
    document = identified[1]
    spread = {one["simulation"]: one["parameters"] for one in document["contact"]["spread"]}
    for name, one in document["parameters"].items():
        low, high = one["ci95_over_simulations"]
        assert low <= one["ci95"][0] <= one["ci95"][1] <= high
        for simulation in ("timestep 1 ms", "integrator implicitfast"):
            assert low < spread[simulation][name] < high
    # The elliptic cone is another law: it does not widen the interval.
    friction = document["parameters"]["cube.contact_friction"]
    numerical = [friction["value"], *(spread[one]["cube.contact_friction"] for one in (
        "timestep 1 ms", "integrator implicitfast"))]  # fmt: skip
    width = friction["ci95"][1] / friction["value"]
    assert friction["ci95_over_simulations"][1] == pytest.approx(max(numerical) * width)


def test_a_twin_applies_the_identified_contact_parameters(identified: Any, tmp_path: Path) -> None:
    folder, document = identified
    (tmp_path / "cube.xml").write_text(CUBE)
    (tmp_path / "record.json").write_text(json.dumps(document))
    (tmp_path / "twin.yaml").write_text("model: cube.xml\nfit: [{file: record.json}]\n")
    twin = load_twin(tmp_path / "twin.yaml")
    laid = load(twin.first_realization.file, twin=twin).model
    fitted = load(folder / "out" / "realization" / "model.xml").model
    for name in ("geom_friction", "geom_solref", "geom_size", "geom_priority", "geom_condim"):
        assert getattr(laid, name) == pytest.approx(getattr(fitted, name), rel=1e-5), name
    assert laid.geom_priority[1] == 1
