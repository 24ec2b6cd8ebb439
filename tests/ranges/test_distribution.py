"""Distributions of drawn robots, their sources and widening, and the simulation of the robots."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy import stats

sys.path.append(str(Path(__file__).parent))

from ranges_files import (
    ARM,
    MEANS,
    NAMES,
    NOISE,
    STD,
    TIMESTEP,
    covariance,
    make_twin,
    record,
    record_motion,
    true_arm,
)

from pytest_twin.metrics.envelope import coverage_interval, envelope, is_inside
from pytest_twin.open_loop import replay
from pytest_twin.ranges.check import assess, predict_envelopes
from pytest_twin.ranges.distribution import Coordinate
from pytest_twin.ranges.gather import UncertainParameters, collect_uncertain_parameters
from pytest_twin.ranges.ranges_of_twin import ranges_of_file
from pytest_twin.ranges.recordings import read_check_recordings
from pytest_twin.ranges.simulate import VariedRobots
from pytest_twin.realization import Realization, load
from pytest_twin.trial import Trial
from pytest_twin.twin import load_twin


@pytest.mark.parametrize(("mean", "std"), [(1.0, 0.1), (0.3, 0.3), (-0.2, 0.4), (0.0, 1.0)])
def test_a_positive_coordinate_has_a_truncated_normal_distribution(mean: float, std: float) -> None:
    one = Coordinate("x", "N*m", mean, std, 0.0)
    drawn = one.values(np.random.default_rng(0).standard_normal(20_000))
    law = stats.truncnorm(-mean / std, np.inf, loc=mean, scale=std)
    assert stats.kstest(drawn, law.cdf).pvalue > 0.01
    assert drawn.min() > 0.0
    assert one.interval(0.95) == pytest.approx(law.ppf([0.025, 0.975]), rel=1e-6)


def test_the_envelope_contains_the_stated_share_of_new_traces() -> None:
    rng = np.random.default_rng(0)
    found = envelope(rng.standard_normal((63, 400, 2)), 0.9)
    assert is_inside(rng.standard_normal((200, 400, 2)), found).mean() == pytest.approx(
        0.9, abs=0.005
    )
    assert coverage_interval(0.9, 1e9) == pytest.approx((0.9, 0.9), abs=1e-3)
    assert coverage_interval(1.0, 10.0)[0] == pytest.approx(0.025 ** (1 / 10), abs=1e-6)


def recorded_arm(folder: Path) -> tuple[Realization, UncertainParameters, Trial]:
    """The arm, its uncertain parameters, and a recording of its motion with the mean ones."""
    twin = load_twin(make_twin(folder, [record(covariance())]))
    record_motion(folder / "a.mcap", true_arm(MEANS), np.random.default_rng(0), seconds=2.0)
    robot = load(twin.first_realization.file, twin=twin)
    found = collect_uncertain_parameters(twin, robot, None)
    final = [folder / "a.mcap"]
    trial = read_check_recordings(twin, robot, final, [], twin.recordings, twin.topics).final[0]
    return robot, found, trial


def test_a_robot_with_mean_parameters_moves_like_the_replay_of_the_twin(tmp_path: Path) -> None:
    robot, found, trial = recorded_arm(tmp_path)
    robots = VariedRobots(robot, None, found.distribution.coordinates, found.bodies, 2**32)
    means = np.array([[one.mean for one in found.distribution.coordinates]])
    (traces,) = robots.simulate([trial], means)
    replayed = replay(robot, [trial])[0].position
    assert np.abs(traces.robots[0] - replayed).max() < 2e-6


def test_robots_that_do_not_fit_in_memory_are_simulated_in_batches_at_fewer_samples(
    tmp_path: Path,
) -> None:
    robot, found, trial = recorded_arm(tmp_path)
    draws = found.distribution.draws(24, 5)
    little, enough = (
        VariedRobots(robot, None, found.distribution.coordinates, found.bodies, memory)
        for memory in (2**19, 2**33)
    )
    (reduced,), (whole,) = (robots.simulate([trial], draws) for robots in (little, enough))
    assert len(reduced.time) < len(whole.time) == len(trial.time)
    columns = np.searchsorted(whole.time, reduced.time)
    assert np.array_equal(whole.time[columns], reduced.time)
    assert np.array_equal(whole.measured[columns], reduced.measured)
    assert np.array_equal(whole.robots[:, columns], reduced.robots)
    assert little.steps == enough.steps


def test_a_drawn_robot_moves_like_a_compiled_model_with_its_values(tmp_path: Path) -> None:
    """The model is compiled with the drawn mass, centre, inertia, friction and armature."""
    robot, found, trial = recorded_arm(tmp_path)
    robots = VariedRobots(robot, None, found.distribution.coordinates, found.bodies, 2**32)
    draws = found.distribution.draws(3, 5)
    (traces,) = robots.simulate([trial], draws)
    spec = mujoco.MjSpec.from_string(ARM)
    columns = {one.name: k for k, one in enumerate(found.distribution.coordinates)}
    for joint in spec.joints:
        own = {k: draws[2, columns[f"{joint.name}.{k}"]] for k in
               ("viscous_friction", "coulomb_friction", "armature")}  # fmt: skip
        joint.damping[0] = own["viscous_friction"]
        joint.frictionloss, joint.armature = own["coulomb_friction"], own["armature"]
    for body in found.bodies:
        x = np.zeros((1, 10))
        for one in found.distribution.coordinates:
            if one.body == body.name:
                x[0, one.index] = draws[2, columns[one.name]]
        mass, com, second = (part[0] for part in body.rigid(x))
        tensor = np.trace(second) * np.eye(3) - second
        element = spec.body(body.name)
        element.mass, element.ipos, element.inertia = mass, com, [0.0, 0.0, 0.0]
        element.fullinertia = [tensor[i, k] for i, k in
                               ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]  # fmt: skip
    (tmp_path / "drawn.xml").write_text(spec.to_xml())
    other = replay(load(tmp_path / "drawn.xml"), [trial])[0].position
    assert np.abs(traces.robots[2] - other).max() < 2e-6
    assert np.abs(traces.robots[0] - other).max() > 1e-3


def test_the_spread_over_trials_includes_the_correlation_of_friction_and_temperature(
    tmp_path: Path,
) -> None:
    rng = np.random.default_rng(2)
    more = "ranges:\n  trials:\n"
    for k in range(8):
        one = record(covariance(0.05), f"trial{k}")
        warm = float(20 + 3 * k)
        value = 0.2 + 0.01 * (warm - 30.0) + 0.002 * rng.standard_normal()
        one["parameters"]["elbow.coulomb_friction"]["value"] = value
        (tmp_path / f"trial{k}.json").write_text(json.dumps(one))
        more += f"  - {{file: trial{k}.json, temperature: {warm}}}\n"
    twin = load_twin(make_twin(tmp_path, [record(covariance(0.05))], more))
    found = collect_uncertain_parameters(twin, load(twin.first_realization.file, twin=twin), None)
    names = [one.name for one in found.distribution.coordinates]
    friction, temperature = names.index("elbow.coulomb_friction"), names.index("trials.temperature")
    assert found.distribution.correlation[friction, temperature] > 0.97
    kinds = [s.kind for s in found.distribution.coordinates[friction].sources]
    assert kinds == ["covariance", "trials"]
    # Student's t for eight groups; friction rises by 0.01 N*m per degree over 21 degrees.
    spread = np.std(0.01 * 3 * np.arange(8), ddof=1)
    factor = stats.t.ppf(0.975, 7) / 1.96 * np.sqrt(1 + 1 / 8)
    assert found.distribution.std[friction] == pytest.approx(spread * factor, rel=0.05)


def test_held_out_recordings_widen_too_narrow_ranges(tmp_path: Path) -> None:
    """The record states a fifth of the true deviation; the robot is two true deviations off."""
    twin = make_twin(tmp_path, [record(covariance(0.2))])
    (tmp_path / "recordings").mkdir()
    rng = np.random.default_rng(4)
    robot = true_arm(MEANS + np.array([2.0, 2.0, 0, 2.0, 2.0, 0, 0, 0]) * STD)
    for name, role in (("a", "held_out"), ("b", "held_out"), ("c", "final")):
        record_motion(tmp_path / f"recordings/{name}.mcap", robot, rng, role=role)
    found = ranges_of_file(str(twin))
    assert found["widening"]["factors"]["elbow"] > 2.0
    assert any(line.startswith("widened: elbow: standard deviations") for line in found["words"])
    widened = [one for one in found["coordinates"] if one["name"] == "elbow.viscous_friction"]
    assert [source["kind"] for source in widened[0]["sources"]] == ["covariance", "widening"]
    assert found["verdict"] == "useful"


def test_tolerances_add_to_the_record_and_a_mass_tolerance_scales_the_inertia(
    tmp_path: Path,
) -> None:
    more = "ranges:\n  tolerance:\n  - {parameter: elbow.armature, absolute: 0.03}\n"
    more += "  - {parameter: fore.mass, relative: 0.1}\n"
    twin = load_twin(make_twin(tmp_path, [record(covariance(0.01))], more))
    found = collect_uncertain_parameters(twin, load(twin.first_realization.file, twin=twin), None)
    std = {one.name: one.std for one in found.distribution.coordinates}
    armature = 0.01 * STD[NAMES.index("elbow.armature")]
    assert std["elbow.armature"] == pytest.approx(np.hypot(armature, 0.03 / np.sqrt(3)))
    draws = found.distribution.draws(4000, 0)
    (fore,) = [body for body in found.bodies if body.name == "fore"]
    x = np.zeros((len(draws), 10))
    for column, one in enumerate(found.distribution.coordinates):
        if one.body == "fore":
            x[:, one.index] = draws[:, column]
    mass, com, second = fore.rigid(x)
    assert mass.std() == pytest.approx(0.1 / np.sqrt(3), rel=0.05)
    assert com[:, 0].std() < 0.01 * com[:, 0].mean()
    for axis in range(3):
        assert np.corrcoef(mass, second[:, axis, axis])[0, 1] > 0.98


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("{parameter: elbo.armature, relative: 0.1}", "no such parameter"),
        ("{parameter: elbow.colour, relative: 0.1}", "no such parameter"),
        ("{parameter: hand.mass, relative: 0.1}", "no body of this name"),
        (
            "{parameter: elbow.command_delay, relative: 0.1}",
            "a relative tolerance of a value that is zero",
        ),
    ],
)
def test_a_tolerance_of_an_unknown_parameter_is_refused(
    tmp_path: Path, line: str, words: str
) -> None:
    more = f"ranges:\n  tolerance:\n  - {line}\n"
    twin = load_twin(make_twin(tmp_path, [record(covariance())], more))
    with pytest.raises(Exception, match=words) as error:
        collect_uncertain_parameters(twin, load(twin.first_realization.file, twin=twin), None)
    assert "ranges.tolerance.0" in str(error.value)


def test_recordings_of_robots_drawn_from_the_record_lie_in_the_envelope_at_the_stated_share(
    tmp_path: Path,
) -> None:
    """Independently simulated robots with two final recordings each; the stated share is 95 %."""
    rng = np.random.default_rng(11)
    twin = load_twin(make_twin(tmp_path, [record(covariance())]))
    robot = load(twin.first_realization.file, twin=twin)
    found = collect_uncertain_parameters(twin, robot, None)
    draws = found.distribution.draws(64, 3)
    coverages = []
    for _ in range(6):
        truth = true_arm(rng.multivariate_normal(MEANS, covariance()))
        paths = [record_motion(tmp_path / f"{k}.mcap", truth, rng, seconds=1.5) for k in range(2)]
        final = read_check_recordings(twin, robot, paths, [], twin.recordings, twin.topics).final
        robots = VariedRobots(robot, None, found.distribution.coordinates, found.bodies, 2**32)
        noise = dict.fromkeys(("shoulder", "elbow"), NOISE)
        envelopes = predict_envelopes(robots.simulate(final, draws), noise, 0.95, 0)
        coverages.append(assess(envelopes, 0.95)["coverage"])
        # The number of simulated steps is that of all robots together.
        assert robots.steps == pytest.approx(2 * 64 * 1.5 / TIMESTEP, rel=0.01)
    assert 0.90 <= np.mean(coverages) <= 0.99, coverages
