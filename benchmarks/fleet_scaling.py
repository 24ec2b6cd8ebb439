"""Measure the speed-up of a fleet diagnosis by more jobs, on the same robots.

    python benchmarks/fleet_scaling.py [--robots 4] [--jobs 2]

The robots are one-joint pendulums without hidden effects, simulated by the tests' plant. Both runs
use one core for each job, so the ratio depends on the number of jobs only.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "diagnosis"))

from two_pendulums import case

from pytest_twin.commands.fleet import Options, Robot, outcomes_of
from pytest_twin.realization.executor import Forks


def robots(folder: Path, count: int) -> list[Robot]:
    """Write each model with its recordings to its own folder."""
    found = []
    for k in range(count):
        model, *recordings = map(Path, case(folder / f"robot{k}", joints=("left",)))
        found.append(Robot(f"robot{k}", model, tuple(recordings)))
    return found


def main() -> None:
    """Diagnose the same robots with one job and with several."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    arguments = {"topics": {}, "options": {}}
    with tempfile.TemporaryDirectory() as scratch:
        fleet = robots(Path(scratch), args.robots)
        seconds = {}
        for jobs in (1, args.jobs):
            options = Options(Path(scratch) / f"jobs{jobs}", 1, arguments)
            start = time.perf_counter()
            outcomes = outcomes_of(fleet, options, Forks(jobs))
            seconds[jobs] = time.perf_counter() - start
            said = [o.verdict or o.error for o in outcomes]
            print(f"{jobs} jobs: {seconds[jobs]:.1f} s, verdicts {said}")
    print(f"ratio {seconds[1] / seconds[args.jobs]:.2f} of {args.jobs}")


if __name__ == "__main__":
    main()
