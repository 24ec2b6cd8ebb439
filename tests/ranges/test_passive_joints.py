"""Drawn joints generate no energy, and drawn values keep the bounds of their laws."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy import stats

from pytest_twin import ranges
from pytest_twin.budget.effect_parameters import bounds
from pytest_twin.diagnosis.patched.model import read_patched_model
from pytest_twin.effects import catalogue
from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import JointSeries
from pytest_twin.ranges import gather
from pytest_twin.ranges.distribution import Coordinate, Distribution
from pytest_twin.ranges.files import write_files
from pytest_twin.ranges.gather import collect_uncertain_parameters
from pytest_twin.ranges.ranges_of_twin import ranges_of_file
from pytest_twin.ranges.recordings import read_check_recordings
from pytest_twin.ranges.simulate import VariedRobots
from pytest_twin.realization import load
from pytest_twin.twin import load_twin

DAMPING, BACK_EMF, STD, CORRELATION = 0.06, 0.055, 0.02, 0.9
MODEL = f"""<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <inertial pos="0 0 -0.1" mass="0.5" diaginertia="1e-4 1e-4 1e-4"/>
      <joint name="a" axis="0 -1 0" damping="{DAMPING}" armature="0.001"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="a" kp="1.0"/></actuator>
</mujoco>
"""
WATCHDOG = {"inverse_timeout": 10.0, "back_emf": BACK_EMF}
"""A drive that switches off 0.1 s after its command has stopped."""
NAMES = {"a.viscous_friction": DAMPING, "a.watchdog_timeout.back_emf": BACK_EMF}


def make_twin(folder: Path, names: dict[str, float] = NAMES) -> Path:
    """A pendulum whose back-EMF is most of its damping; both are correlated."""
    (folder / "fit").mkdir(parents=True)
    (folder / "fit/model.xml").write_text(MODEL)
    effect = {"effect": "watchdog_timeout", "joint": "a", "values": WATCHDOG, "in_model": False}
    effects = {"schema": 1, "joints": ["a"], "effects": [effect]}
    (folder / "fit/effects.json").write_text(json.dumps(effects))
    matrix = np.full((len(names),) * 2, CORRELATION * STD**2)
    np.fill_diagonal(matrix, STD**2)
    record = {
        "schema": 1,
        "identification": "fitted",
        "verdict": "accepted",
        "stages": [{"stage": "drive", "state": "accepted"}],
        "parameters": {
            name: {"value": value, "unit": "N*m*s/rad", "ci95": [value - STD, value + STD]}
            for name, value in names.items()
        },
        "covariance": {"names": list(names), "matrix": matrix.tolist()},
        "held_out": {"a": {"position_rms": 0.1, "position_unit": "rad"}},
        "trials": {"fit": ["a.mcap"], "held_out": ["b.mcap"]},
        "fit": {},
    }
    (folder / "record.json").write_text(json.dumps(record))
    path = folder / "twin.yaml"
    path.write_text("model: fit\ncommand_between: held\nfit:\n  - {file: record.json}\n")
    return path


def record_release(path: Path) -> Path:
    """A recording of 5 s whose command does not change, so that the drive switches off."""
    stamps = (1e7 * np.arange(500)).astype(np.int64) + 10**18
    states, commands = np.full((500, 1), 0.6), np.full((500, 1), 1.0)
    series = [
        JointSeries(topic, ("a",), stamps, stamps, table, None, None)
        for topic, table in (("/joint_states", states), ("/joint_commands", commands))
    ]
    write_recording(path, series, {"command_between": "held", "role": "final"})
    return path


def sampler() -> ModuleType:
    """The sampler that is written beside ``ranges.json``."""
    path = Path(ranges.__file__).parent / "written/sampler.py"
    spec = importlib.util.spec_from_file_location("written_sampler", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def finite(**bounds: float) -> dict[str, float | None]:
    """Bounds as ``ranges.json`` has them: null for none."""
    return {name: value if np.isfinite(value) else None for name, value in bounds.items()}


def turns(folder: Path) -> np.ndarray:
    """Largest distance of each of 64 drawn robots from its lowest position, in turns."""
    twin = load_twin(make_twin(folder))
    robot = load(twin.first_realization.file, twin=twin)
    patched = read_patched_model(robot)
    found = collect_uncertain_parameters(twin, robot, patched)
    paths = [record_release(folder / "final.mcap")]
    trials = read_check_recordings(twin, robot, paths, [], twin.recordings, twin.topics).final
    robots = VariedRobots(robot, patched, found.distribution.coordinates, found.bodies, 2**32)
    (traces,) = robots.simulate(trials, found.distribution.draws(64, 1))
    return np.abs(traces.robots[:, :, 0]).max(axis=1) / (2.0 * np.pi)


def test_no_drawn_joint_turns_faster_and_faster_after_its_drive_switched_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert turns(tmp_path / "passive").max() < 0.5
    # Without the rule a part of the robots generates energy and turns over.
    monkeypatch.setattr(gather, "with_passive_joints", lambda distribution, *others: distribution)
    assert (turns(tmp_path / "as_drawn") > 1.0).mean() > 0.1


def test_drawn_back_emf_is_a_part_of_the_drawn_damping_in_both_samplers(tmp_path: Path) -> None:
    twin = load_twin(make_twin(tmp_path))
    robot = load(twin.first_realization.file, twin=twin)
    found = collect_uncertain_parameters(twin, robot, read_patched_model(robot)).distribution
    whole, part = found.draws(10_000, 0).T
    assert (part <= whole).all()
    apart = STD * np.sqrt(2.0 * (1.0 - CORRELATION))
    share = stats.norm.cdf((BACK_EMF - DAMPING) / apart)
    assert (part == whole).mean() == pytest.approx(share, abs=0.03)
    (tmp_path / "ranges.json").write_text(json.dumps(ranges_of_file(str(twin.path))))
    write_files(tmp_path)
    code = (
        "import sys; sys.modules['pytest_twin'] = sys.modules['scipy'] = None\n"
        "from sampler import Ranges; robots = Ranges.load().draw(10_000, seed=1)\n"
        "whole, part = robots['a.viscous_friction'], robots['a.watchdog_timeout.back_emf']\n"
        "assert (part <= whole).all() and (part == whole).any() and (part < whole).any()\n"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, timeout=300)


@pytest.mark.parametrize(
    ("name", "side", "bound"),
    [
        ("a.viscous_friction", "lower", BACK_EMF),
        ("a.watchdog_timeout.back_emf", "upper", DAMPING),
    ],
)
def test_a_part_or_whole_that_does_not_vary_is_the_bound_of_the_other(
    tmp_path: Path, name: str, side: str, bound: float
) -> None:
    twin = load_twin(make_twin(tmp_path, {name: NAMES[name]}))
    robot = load(twin.first_realization.file, twin=twin)
    (one,) = collect_uncertain_parameters(
        twin, robot, read_patched_model(robot)
    ).distribution.coordinates
    assert getattr(one, side) == pytest.approx(bound)
    drawn = one.values(np.random.default_rng(0).standard_normal(2000))
    assert (drawn >= bound).all() if side == "lower" else (drawn <= bound).all()


def test_a_twin_whose_back_emf_exceeds_its_damping_is_named(tmp_path: Path) -> None:
    path = make_twin(tmp_path)
    (tmp_path / "fit/model.xml").write_text(MODEL.replace(str(DAMPING), "0.03"))
    notes = ranges_of_file(str(path))["notes"]
    expected = "a: the back-EMF of watchdog_timeout (0.055) exceeds the whole damping of the joint"
    assert any(note.startswith(expected) for note in notes)


@pytest.mark.parametrize(
    ("effect", "parameter", "stated", "total", "expected"),
    [
        ("load_dependent_friction", "coefficient", 0.3, None, (0.0, 0.8)),
        ("command_delay", "delay", 0.01, None, (0.0, 0.3)),
        ("controller_gain", "stiffness_error", -0.2, None, (0.0, np.inf)),
        ("stribeck_friction", "coulomb", -0.1, 0.2, (-0.3, np.inf)),
        ("torque_rolloff", "back_emf", 0.05, None, (0.0, np.inf)),
    ],
)
def test_drawn_values_keep_the_physical_bounds_of_their_law(
    effect: str, parameter: str, stated: float, total: float | None, expected: tuple[float, float]
) -> None:
    """An addition may be negative as long as the sum with the model's value is not."""
    (law,) = (one for one in catalogue()[effect].parameters if one.name == parameter)
    assert bounds(law, stated, total) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("mean", "lower", "upper"),
    [(0.3, 0.0, 0.8), (0.3, 0.25, 0.31), (-1.0, 0.0, 0.8), (3.0, 0.0, 0.8), (0.5, -np.inf, 0.4)],
)
def test_a_coordinate_with_bounds_has_a_truncated_normal_distribution(
    mean: float, lower: float, upper: float
) -> None:
    one = Coordinate("x", "1", mean, 0.2, lower, upper)
    drawn = one.values(np.random.default_rng(0).standard_normal(20_000))
    law = stats.truncnorm((lower - mean) / 0.2, (upper - mean) / 0.2, loc=mean, scale=0.2)
    assert stats.kstest(drawn, law.cdf).pvalue > 0.01
    assert lower <= drawn.min()
    assert drawn.max() <= upper
    written = {"name": "x", "body": None, "at_most": None, "mean": mean, "std": 0.2}
    written |= finite(lower=lower, upper=upper)
    document = {"schema": 1, "coordinates": [written], "bodies": [], "correlation": [[1.0]]}
    as_written = sampler().Ranges(document).draw(20_000, seed=0)["x"]
    assert as_written == pytest.approx(drawn, abs=1e-9)
    assert one.values(np.array([-1.0, 0.0, 1.0])).tolist() == sorted(one.values(np.arange(-1.0, 2)))


LOAD = {"coefficient": 0.3, "stiction_excess": 0.3, "stribeck_velocity": 0.3}
LOAD_NAMES = {f"a.motor_load_friction.{name}": LOAD[name] for name in ("coefficient",
              "stiction_excess")}  # fmt: skip


def with_load_friction(folder: Path, names: dict[str, float]) -> Distribution:
    """Distribution of a pendulum with friction by the effort of its motor, known to 0.3."""
    path = make_twin(folder, names)
    effect = {"effect": "motor_load_friction", "joint": "a", "values": LOAD, "in_model": False}
    effects = {"schema": 1, "joints": ["a"], "effects": [effect]}
    (folder / "fit/effects.json").write_text(json.dumps(effects))
    record = json.loads((folder / "record.json").read_text())
    record["covariance"]["matrix"] = (0.09 * np.eye(len(names))).tolist()
    (folder / "record.json").write_text(json.dumps(record))
    twin = load_twin(path)
    robot = load(twin.first_realization.file, twin=twin)
    return collect_uncertain_parameters(twin, robot, read_patched_model(robot)).distribution


def test_every_drawn_drive_can_start_its_joint(tmp_path: Path) -> None:
    """The friction of the motor's own effort, at rest and in motion together, is at most 80 %."""
    found = with_load_friction(tmp_path / "both", LOAD_NAMES)
    columns = {one.name: k for k, one in enumerate(found.coordinates)}
    draws = found.draws(10_000, 0)
    moving, more = (draws[:, columns[name]] for name in LOAD_NAMES)
    assert (moving + more).max() <= 0.8 + 1e-12
    assert np.isclose(moving + more, 0.8).mean() > 0.01
    assert moving.max() > 0.7
    for name, value in LOAD_NAMES.items():
        (one,) = with_load_friction(tmp_path / name, {name: value}).coordinates
        assert one.upper == pytest.approx(0.5)
