"""Run one command in a child process of its own, and measure its processor time.

The child runs ``ENTRY(arguments)``, a function such as ``pytest_twin.cli:main``, so that a search
that is not a command yet can be measured too.
"""

from __future__ import annotations

import importlib
import os
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

ENTRY = "pytest_twin.cli:main"
"""Function that gets the arguments of the command line and returns the exit status."""


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Attributes:
        status: exit status; negative: the signal that ended it.
        processor_seconds, wall_seconds: of the command and its children.
        stderr: its last lines.
    """

    status: int
    processor_seconds: float
    wall_seconds: float
    stderr: str


def run(entry: str, arguments: list[str], folder: Path, processor_seconds: int) -> Ended:
    """Run a command on one core; it is killed after so much processor time, s, 0 for no limit."""
    folder.mkdir(parents=True, exist_ok=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    since = time.monotonic()
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "TMPDIR": str(folder)}
    child = subprocess.run(
        [sys.executable, str(Path(__file__)), entry, str(processor_seconds), *arguments],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=folder, env=environment,
        check=False,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Ended(child.returncode, used, time.monotonic() - since, child.stderr[-600:])


def main() -> int:
    """Run the command of the child."""
    entry, limit, *arguments = sys.argv[1:]
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, cores[-1:])
    if int(limit):
        resource.setrlimit(resource.RLIMIT_CPU, (int(limit), int(limit)))
    module, _, name = entry.partition(":")
    # An entry may be a script of benchmarks/, and none is beside this file.
    sys.path[0] = str(Path(__file__).parents[1])
    return int(getattr(importlib.import_module(module), name)(arguments))


if __name__ == "__main__":
    sys.exit(main())
