"""Each law of the catalogue, alone on a joint that excites it, converges from its own starts."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

from frozen.one_law import TRIES, Plant, draw, laws

from pytest_twin.diagnosis.build_problem import build_problem
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.problem import CandidateMask
from pytest_twin.diagnosis.search.physics import SimulatedPhysics
from pytest_twin.diagnosis.search.search import Search
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.loaded_model import load_model

LAWS = laws()
WORSE = 1.1
"""Largest ratio of the residual to that with the true parameters."""
SAMPLE = ("coulomb_friction", "torque_saturation", "velocity_feedforward")
NO_SLOPE = "watchdog_timeout"
"""Its time acts in steps of the simulation: its fit ends at two noise floors."""
SEEDS = 5
"""Draws among which the first is taken that excites the law."""


def floors_after(effect: str, seed: int, folder: Path) -> tuple[float, ...] | None:
    """RMS residual of a drawn joint with the law, in noise floors.

    Without the law, with the law as the search finds it among no other candidates, and with its
    true parameters. None if the recordings cannot show its parameters: a warm-up takes longer.
    """
    rng = np.random.default_rng([seed, LAWS.index(effect)])
    for _ in range(TRIES):
        drawn = draw(effect, rng)
        (folder / "model.xml").write_text(drawn.mjcf)
        loaded = load_model(folder / "model.xml")
        coarse = Plant(drawn, loaded.realization, 1)
        theta = coarse.size_of(effect, rng)
        if theta is not None:
            break
    else:
        pytest.skip(f"no drawn motion excites {effect}")
    plant = Plant(drawn, loaded.realization, 4)
    (real,) = plant.readings([plant.only(effect, theta)])
    fit, _ = plant.write(folder, real, rng)
    trials = read_trials(fit, [], loaded.topics, loaded.realization.structure)
    mask = CandidateMask(frozenset({effect}))
    setup = replace(ModelSetup.of(loaded.realization, None, threads=1), mask=mask)
    with np.errstate(over="ignore", invalid="ignore"):
        prepared, trials = build_problem(setup, trials, [])
        search = Search(SimulatedPhysics(setup, prepared, trials))
        found = search.run()
        to = prepared.problem.scales
        (term,) = plant.only(effect, theta).terms
        scales = [
            plant.scales.value(p, term.joint) / to.value(p, term.joint) for p in term.parameters
        ]
        true = search.simulated(plant.only(effect, theta * scales))
        if search.physics.refusals(true.hypothesis):
            return None
    return tuple(
        float(np.sqrt(m.mean_square / found.comparison.floor**2).max())
        for m in (found.nominal, found.incumbent, true)
    )


def not_converged(effects: Sequence[str], folder: Path) -> dict[str, tuple[float, float]]:
    """Effect -> RMS residual as found and with the true parameters, in noise floors."""
    out = {}
    for effect in effects:
        drawn = (floors_after(effect, seed, folder) for seed in range(SEEDS))
        _, after, true = next(
            (d for d in drawn if d is not None and d[0] > VERDICT.at_floor), (0.0, 0.0, 0.0)
        )
        if after > max(VERDICT.identifiable, WORSE * true):
            out[effect] = after, true
    return out


@pytest.mark.parametrize(
    "effects",
    [
        pytest.param(SAMPLE, id="sample"),
        pytest.param(
            tuple(e for e in LAWS if e not in (*SAMPLE, NO_SLOPE)),
            id="all others",
            marks=pytest.mark.nightly,
        ),
        pytest.param(
            (NO_SLOPE,),
            id=NO_SLOPE,
            marks=[
                pytest.mark.nightly,
                pytest.mark.xfail(reason="its slope is that of whole steps"),
            ],
        ),
    ],
)
def test_a_law_alone_converges_from_its_own_starts(
    effects: tuple[str, ...], tmp_path: Path
) -> None:
    assert not not_converged(effects, tmp_path)
