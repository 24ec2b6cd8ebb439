"""Where nothing changed: alarms of ``diagnose --before`` on real machines, one test a recording.

    TWIN_RECORDINGS=FOLDER python benchmarks/changes/unchanged.py [MACHINE ...]

Each of Baxter's eight recordings, and each of eight parts of the recordings of EMPS, Panda and
TIAGo, is compared with the other seven at a level of 5 %.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import baxter
import machines
from injected import LEVEL, interval

from pytest_twin.changes.comparison import compare

MACHINES = ("baxter", "emps", "panda", "tiago")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("machines", nargs="*", default=MACHINES)
    alarms = named = tests = 0
    for machine in parser.parse_args().machines:
        if machine == "baxter":
            with tempfile.TemporaryDirectory() as scratch:
                robot = baxter.read(baxter.write_recordings(Path(scratch)))
        else:
            robot = machines.read(machine)
        found = [
            compare(
                robot.rows, [[i] for i in range(robot.count) if i != new], [[new]], robot.shapes,
                LEVEL,
            )
            for new in range(robot.count)
        ]  # fmt: skip
        own = sum(comparison.is_changed for comparison in found)
        sure = sum(change.confidence >= 0.9 for one in found for change in one.changes)
        print(f"{machine}: {own} alarms of {robot.count}, {sure} names at 0.9", flush=True)
        alarms, named, tests = alarms + own, named + sure, tests + robot.count
    print(
        f"together {alarms} alarms of {tests} ({interval(alarms, tests)}; level {LEVEL:.0%}), "
        f"{named} names at 0.9"
    )


if __name__ == "__main__":
    main()
