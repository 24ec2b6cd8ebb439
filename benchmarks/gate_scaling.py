"""Measure the time of a gate as a function of the number of goldens, up to 10,000.

    python benchmarks/gate_scaling.py [--sizes 1000 3000 10000] [--run]

For each size, the time of collection, of an up-to-date gate and of `--twin-why` is printed, in
seconds and in milliseconds per golden without the time of an empty session. With --run, a gate in
which every golden is stale is measured too. The last line fits time ~ size^k.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from twins import environment, make_twin, multiply, pytest_command


def seconds(folder: Path, *arguments: str) -> float:
    start = time.perf_counter()
    result = subprocess.run(
        pytest_command("-q", "-p", "no:cacheprovider", *arguments),
        cwd=folder,
        env=environment(folder),
        capture_output=True,
        text=True,
    )
    assert result.returncode in (0, 5), result.stdout[-2000:] + result.stderr[-2000:]
    return time.perf_counter() - start


def exponent(sizes: list[int], taken: list[float], idle: float) -> float:
    """Slope of log time over log size, from the first size to the last, without start-up time."""
    first, last = max(taken[0] - idle, 1e-3), max(taken[-1] - idle, 1e-3)
    return math.log(last / first) / math.log(sizes[-1] / sizes[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[1000, 3000, 10000])
    parser.add_argument("--run", action="store_true", help="run every golden as well")
    options = parser.parse_args()
    taken: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as name:
        empty = Path(name) / "empty"
        empty.mkdir()
        idle = min(seconds(empty) for _ in range(3))
        print(f"empty session {idle:.2f} s")
        for size in options.sizes:
            twin = Path(name) / str(size) / "twin"
            make_twin(twin)
            multiply(twin, size)
            released = seconds(twin, "--twin-release")
            steps = {
                "collect": seconds(twin, "--collect-only"),
                "nothing stale": seconds(twin),
                "why": seconds(twin, "--twin-why"),
            }
            if options.run:
                steps["all stale, signed"] = released
            for step, time_taken in steps.items():
                taken.setdefault(step, []).append(time_taken)
                each = 1e3 * (time_taken - idle) / size
                print(f"{size:>6} goldens  {step:<18} {time_taken:8.2f} s  {each:7.2f} ms each")
    for step, values in taken.items() if len(options.sizes) > 1 else ():
        print(f"{step:<18} time ~ size^{exponent(options.sizes, values, idle):.2f}")


if __name__ == "__main__":
    main()
