"""Computing time of a diagnosis, compared with the engine alone for the same number of steps."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from pytest_twin.diagnosis.budget import Budget
from pytest_twin.effects.batch_simulator import BatchSimulator

# Simulations of the shortest recording for each thread, in a batch of the measurement.
_ROWS_PER_THREAD = 16
# Number of repetitions, or their total time in s: the speed of a core varies.
_REPEATS, _MIN_SECONDS = 3, 0.2


@dataclass(frozen=True, slots=True)
class Cost:
    """Time of one diagnosis.

    Attributes:
        wall_seconds: wall-clock time from reading to the result, s.
        engine_seconds: time of MuJoCo alone for the same number of steps of the nominal model, in
            batches on the same threads, s.
        steps: simulated steps, those from the cache included, in millions.
        cached_steps: steps that came from the cache, in millions.
        simulations: number of simulations of all recordings with as many steps.
    """

    wall_seconds: float
    engine_seconds: float
    steps: float
    cached_steps: float
    simulations: float

    def to_json(self) -> dict[str, float]:
        """The object ``cost`` of ``diagnosis.json``."""
        ratio = self.wall_seconds / max(self.engine_seconds, 1e-9)
        return {
            "wall_seconds": round(self.wall_seconds, 2),
            "engine_seconds": round(self.engine_seconds, 2),
            "wall_per_engine": round(ratio, 2),
            "simulations": round(self.simulations, 1),
            "million_steps": round(self.steps, 3),
            "million_steps_repeated": round(self.cached_steps, 3),
        }


def measure_cost(budget: Budget, since: float) -> Cost:
    """Measure the cost of a diagnosis.

    Args:
        budget: the budget with all problems of the diagnosis.
        since: ``time.perf_counter`` at its start, s.
    """
    wall = time.perf_counter() - since
    problems = budget.problems
    problem = problems[0]
    known = problem.simulator
    simulator = BatchSimulator(
        known.segments, known.joints, threads=known.threads, disable_unused=False
    )
    steps = sum(p.simulated_steps + p.memory.steps_for_initial_states for p in problems)
    shortest = min(problem.fit, key=lambda at: len(known.segments[at].time))
    rows = np.full(_ROWS_PER_THREAD * known.threads, shortest)
    simulator.trajectories(rows[:1], {})  # models are copied once, outside the measured time
    before = simulator.simulated_steps
    seconds: list[float] = []
    while len(seconds) < _REPEATS and sum(seconds) < _MIN_SECONDS:
        start = time.perf_counter()
        simulator.trajectories(rows, {})
        seconds.append(time.perf_counter() - start)
    per_step = float(np.median(seconds)) * len(seconds) / max(simulator.simulated_steps - before, 1)
    repeated = sum(p.cached_steps for p in problems)
    return Cost(wall, per_step * steps, steps * 1e-6, repeated * 1e-6, budget.work)
