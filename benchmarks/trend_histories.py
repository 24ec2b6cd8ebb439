"""Alarms of ``pytest-twin trend`` where nothing changes, and where one parameter does.

    python benchmarks/trend_histories.py --histories 200 [--fleet 100]

Histories are those of ``tests/trend/histories.py``: another motion in every session, masses 10 %
off the model, drive parameters that scatter by 3 % between sessions. With ``--fleet N`` it also
measures N robots of six joints with 20 sessions each through the command itself.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from scipy.stats import beta

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "trend"))

from histories import History, Parameters

from pytest_twin.loaded_model import load_model
from pytest_twin.trend.sessions import read_sessions
from pytest_twin.trend.trend import follow


def interval(count: int, of: int) -> str:
    """Exact 95 % interval of a frequency (Clopper, Pearson 1934), in percent."""
    low = float(beta.ppf(0.025, count, of - count + 1)) if count else 0.0
    high = float(beta.ppf(0.975, count + 1, of - count)) if count < of else 1.0
    return f"{100 * low:.1f} to {100 * high:.1f} %"


def worn(after: int, factor: float) -> History:
    """History in which the elbow's dry friction grows after some sessions."""

    def change(session: int, parameters: Parameters) -> None:
        if session >= after:
            parameters["elbow.coulomb_friction"] *= factor

    return History(sessions=12, change=change)


def run(history: History, count: int) -> tuple[int, int]:
    """Number of histories with an alarm, and of those that name the elbow's friction first."""
    alarms = named = 0
    for seed in range(count):
        with tempfile.TemporaryDirectory() as name:
            paths = history.write(Path(name), seed)
            loaded = load_model(Path(name) / "twin.yaml")
            sessions, _ = read_sessions(loaded.realization, paths, loaded.topics, loaded.options)
            found = follow(loaded.realization, sessions, 0.05)
        alarms += found.is_alarm
        first = found.changes[0].followed.name if found.changes else ""
        named += first == "elbow.coulomb_friction"
    return alarms, named


def fleet(robots: int) -> float:
    """Wall time of the command for a fleet, s."""
    from fleet_of_arms import write_fleet

    with tempfile.TemporaryDirectory() as name:
        path = write_fleet(Path(name), robots, sessions=20)
        since = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "pytest_twin.cli", "trend", "--fleet", str(path), "--out",
             str(Path(name) / "out")], check=False, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        return time.perf_counter() - since


def main() -> None:
    """Print counts with their exact intervals."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--histories", type=int, default=200)
    parser.add_argument("--fleet", type=int, default=0)
    args = parser.parse_args()
    count = args.histories
    for sessions in (6, 12):
        alarms, _ = run(History(sessions=sessions), count)
        print(f"nothing changes, {sessions} sessions: {alarms} of {count} alarms, "
              f"{interval(alarms, count)}")  # fmt: skip
    for after, factor in ((6, 1.1), (6, 1.2), (6, 1.5), (11, 1.2), (11, 1.5)):
        alarms, named = run(worn(after, factor), max(count // 4, 1))
        print(f"dry friction times {factor:g} after session {after} of 12: alarm in {alarms}, "
              f"named first in {named} of {max(count // 4, 1)}")  # fmt: skip
    if args.fleet:
        print(f"{args.fleet} robots x 20 sessions x 6 joints: {fleet(args.fleet):.0f} s")


if __name__ == "__main__":
    main()
