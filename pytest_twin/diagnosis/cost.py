"""What a diagnosis costs, against what the engine alone would have taken for the same steps."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from pytest_twin.diagnosis.budget import Budget
from pytest_twin.effects.batch_simulator import BatchSimulator

_ROWS = 32
# Measured so often, or for so long in s: a core is not equally fast at all times.
_REPEATS, _LONG = 5, 1.0


@dataclass(frozen=True, slots=True)
class Cost:
    """Time of one diagnosis.

    Attributes:
        wall_seconds: from reading to the last number.
        engine_seconds: for the same number of steps of the nominal model, rolled out by MuJoCo
            in batches on the same threads, with all that it does of itself and nothing of this
            package between steps.
        steps: of simulations that the search asked for, in millions.
        repeated: of these, what it had asked for before and was not stepped again, in millions.
        simulations: the steps as simulations of all data.
        of_rivals: simulations of all recordings that the comparison of the final set of effects
            with other sets took.
    """

    wall_seconds: float
    engine_seconds: float
    steps: float
    repeated: float
    simulations: float
    of_alternatives: float = 0.0

    def to_json(self) -> dict[str, float]:
        """As ``diagnosis.json`` has it."""
        ratio = self.wall_seconds / max(self.engine_seconds, 1e-9)
        return {
            "wall_seconds": round(self.wall_seconds, 2),
            "engine_seconds": round(self.engine_seconds, 2),
            "wall_per_engine": round(ratio, 2),
            "simulations": round(self.simulations, 1),
            "million_steps": round(self.steps, 3),
            "million_steps_repeated": round(self.repeated, 3),
            "simulations_of_rival_sets": round(self.of_alternatives, 1),
        }


def cost(budget: Budget, since: float, of_alternatives: float = 0.0) -> Cost:
    """Cost of a diagnosis that began at ``since`` (``time.perf_counter``), of it the simulations
    of rival sets.
    """
    wall = time.perf_counter() - since
    problems = budget.problems
    problem = problems[0]
    known = problem.simulator
    simulator = BatchSimulator(known.segments, known.joints, threads=known.threads, sparing=False)
    stepped = sum(p.stepped + p.in_starts for p in problems)
    rows = np.resize(problem.fit, max(_ROWS, len(problem.fit)))
    simulator.trajectories(rows[:1], {})  # models are copied once
    before = simulator.stepped
    seconds: list[float] = []
    while len(seconds) < _REPEATS and sum(seconds) < _LONG:
        start = time.perf_counter()
        simulator.trajectories(rows, {})
        seconds.append(time.perf_counter() - start)
    per_step = float(np.median(seconds)) * len(seconds) / max(simulator.stepped - before, 1)
    repeated = sum(p.repeated for p in problems)
    return Cost(
        wall, per_step * stepped, stepped * 1e-6, repeated * 1e-6, budget.work, of_alternatives
    )
