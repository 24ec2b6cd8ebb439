"""An unexplained residual is located where its cause acts, also if whole motions diverge."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from pytest_twin.diagnosis.build_problem import build_problem, residuals_everywhere
from pytest_twin.diagnosis.findings import Explanation
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.search_result import SearchResult
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.unexplained import locate_unexplained
from pytest_twin.diagnosis.verdict import JointError
from pytest_twin.estimation.hypothesis import EMPTY
from pytest_twin.formats.mcap import JointSeries, read_recording, write_recording
from pytest_twin.realization import load
from pytest_twin.trial import make_trial

ARM = """
<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="arm"><inertial pos="0 0 0.15" mass="1" diaginertia="0.01 0.01 0.002"/>
 <joint name="lift" axis="0 1 0" damping="0.1"/></body></worldbody>
<actuator><velocity name="lift" joint="lift" kv="3"/></actuator></mujoco>
"""
TAUT = 0.25
"""Position in rad above which a cable pulls back with 20 N*m/rad."""


def recorded(folder: Path, seed: int) -> Path:
    """Record an arm with a velocity servo that a cable pulls back above ``TAUT``."""
    model = mujoco.MjModel.from_xml_string(ARM)
    model.opt.timestep = 2e-4
    data = mujoco.MjData(model)
    time = np.arange(0.0, 6.0, 0.01)
    command = np.cos(1.1 * time + 0.2 * seed)[:, None] * 0.7
    position = np.empty_like(command)
    for k in range(len(time)):
        position[k], data.ctrl[:] = data.qpos, command[k]
        for _ in range(50):
            data.qfrc_applied[0] = -20.0 * max(float(data.qpos[0]) - TAUT, 0.0)
            mujoco.mj_step(model, data)
    stamp = 10**18 + np.rint(time * 1e9).astype(np.int64)
    noisy = position + 1e-4 * np.random.default_rng(seed).standard_normal(position.shape)
    path = folder / f"{seed}.mcap"
    series = [
        JointSeries("/joint_commands", ("lift",), stamp, stamp, None, command, None),
        JointSeries("/joint_states", ("lift",), stamp, stamp, noisy, None, None),
    ]
    write_recording(path, series, {})
    return path


def search_without_findings(prepared: PreparedProblem, trials: TrialSet) -> SearchResult:
    """The result of a search that found no effect."""
    problem = prepared.problem
    left = residuals_everywhere(problem, EMPTY)
    rms = float(np.sqrt(np.mean(left**2)))
    errors = {"lift": JointError(rms, rms, float(problem.floor[0]), "rad")}
    return SearchResult(
        prepared,
        trials,
        0,
        Explanation((), EMPTY),
        left,
        left,
        errors,
        "unexplained",
    )


def share_in(windows: list[list[float]], time: np.ndarray, taut: np.ndarray) -> float:
    """Share of the samples in ``windows`` at which the cable pulls."""
    inside = np.any([(time >= a) & (time <= b) for a, b in windows], axis=0)
    return float(np.mean(taut[inside]))


def test_a_cable_under_a_velocity_servo_is_located_where_it_pulls(tmp_path: Path) -> None:
    """A velocity error accumulates, so whole motions have their largest error at another place."""
    (tmp_path / "arm.xml").write_text(ARM)
    realization = load(tmp_path / "arm.xml")
    recordings = [read_recording(recorded(tmp_path, seed)) for seed in (1, 2)]
    fit, held_out = (make_trial(r, realization.structure) for r in recordings)
    setup = ModelSetup(realization, threads=1)
    whole, trials = build_problem(setup, TrialSet((fit,), (held_out,), ()), [])
    cut, kept = build_problem(setup, trials, [], window=0.5)
    found = search_without_findings(whole, trials)
    place = locate_unexplained(found, cut, kept)["lift"].where
    low, high = (float(x) for x in place.summary.split(" rad (")[0].split()[1::2])
    assert TAUT - 0.02 < low < high < TAUT + 0.2
    assert set(place.windows) == {"1.mcap", "2.mcap"}
    of_whole_motions = locate_unexplained(found, whole, trials)["lift"].where
    near, far = (
        [
            share_in(where.windows[t.path.name], t.time, t.position[:, 0] > TAUT)
            for t in (fit, held_out)
            if t.path.name in where.windows
        ]
        for where in (place, of_whole_motions)
    )
    assert min(near) > 0.85
    assert min(near) > min(far) + 0.2
