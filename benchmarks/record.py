"""Run a benchmark and store its output with date, revision and machine.

    python benchmarks/record.py [--results benchmarks/results] NAME [ARGUMENT ...]

NAME is a script in ``benchmarks``, such as ``staleness`` or ``real/emps``. Writes
RESULTS/NAME.json; ``benchmarks/page.py`` writes the page of the documentation from this folder. The
exit status is that of the benchmark; failed runs are stored too.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import resource
import subprocess
import sys
import time
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
RESULTS = HERE / "results"
LONGEST = 20_000
"""Largest number of characters of output in a record, from its end."""


def machine() -> dict[str, Any]:
    """Return processor, cores, Python version and the packages on which figures depend."""
    info = Path("/proc/cpuinfo")
    model = re.search(r"model name\s*:\s*(.+)", info.read_text()) if info.exists() else None
    return {
        "system": platform.platform(terse=True),
        "processor": model[1] if model else platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "packages": {name: version(name) for name in ("mujoco", "numpy", "scipy")},
    }


def revision() -> str:
    """Return the git revision of the tree, with ``+`` if it has changes."""
    git = ["git", "-C", str(HERE)]
    commit = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    changed = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True)
    return commit.stdout.strip() + ("+" if changed.stdout.strip() else "")


def record(name: str, arguments: list[str], results: Path) -> int:
    """Run a benchmark, write its record and return its exit status."""
    script = HERE / f"{name}.py"
    if not script.is_file():
        sys.exit(f"record.py: {name!r} is no script in {HERE}; expected for example 'staleness'")
    kept: dict[str, Any] = {
        "benchmark": name,
        "command": " ".join(["python", f"benchmarks/{name}.py", *arguments]),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "revision": revision(),
        "machine": machine(),
        "load_before": round(os.getloadavg()[0], 2),
    }
    before, since = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run(
        [sys.executable, str(script), *arguments], capture_output=True, text=True, cwd=HERE.parent
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    kept |= {
        "wall_seconds": round(time.monotonic() - since, 1),
        "processor_seconds": round(
            after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime, 1
        ),
        "load_after": round(os.getloadavg()[0], 2),
        "exit_status": done.returncode,
        "output": (done.stdout if not done.returncode else done.stdout + done.stderr)[-LONGEST:],
    }
    results.mkdir(parents=True, exist_ok=True)
    path = results / f"{name.replace('/', '-')}.json"
    path.write_text(json.dumps(kept, indent=1) + "\n")
    print(f"{path}: exit status {done.returncode}")
    return done.returncode


def main() -> int:
    """Run; see the module's docstring."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the records")
    parser.add_argument("name", metavar="NAME", help="script in benchmarks, without .py")
    parser.add_argument("arguments", metavar="ARGUMENT", nargs=argparse.REMAINDER)
    args = parser.parse_args()
    return record(args.name, args.arguments, args.results)


if __name__ == "__main__":
    sys.exit(main())
