"""Measure the cost of collection and of an up-to-date gate, as ratios within one run.

    python benchmarks/collection.py [--specs 1000] [--rounds 5]

collecting:  N specs against N trivial test functions in files of 100
gate:        a gate with nothing stale against bare collection of the same specs

Times are processor times of the session and its children, so the load of the machine has little
influence.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from twins import environment, make_twin, multiply, pytest_command


def functions(folder: Path, count: int) -> None:
    for start in range(0, count, 100):
        lines = [f"def test_{i}():\n    pass\n" for i in range(start, min(start + 100, count))]
        (folder / f"test_{start}.py").write_text("\n".join(lines))


def seconds(folder: Path, *arguments: str, ok: tuple[int, ...] = (0,)) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    result = subprocess.run(
        pytest_command("-q", "-p", "no:cacheprovider", *arguments),
        cwd=folder,
        env=environment(folder),
        capture_output=True,
        text=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    taken = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    assert result.returncode in ok, result.stdout + result.stderr
    return taken


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--specs", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        base = Path(name)
        plain, twin = base / "plain", base / "twin"
        plain.mkdir()
        functions(plain, options.specs)
        make_twin(twin)
        multiply(twin, options.specs)
        seconds(twin, "--twin-release")
        taken: dict[str, list[float]] = {"functions": [], "specs": [], "gate": [], "signing": []}
        for _ in range(options.rounds):
            taken["functions"].append(seconds(plain, "--collect-only"))
            taken["specs"].append(seconds(twin, "--collect-only"))
            taken["gate"].append(seconds(twin))
            taken["signing"].append(seconds(twin, "--twin-release"))
    best = {key: min(values) for key, values in taken.items()}
    for key, values in taken.items():
        print(f"{key:<10} best {best[key]:.3f} s, median {statistics.median(values):.3f} s")
    print(
        f"collecting {options.specs} specs / {options.specs} functions: "
        f"{best['specs'] / best['functions']:.2f}  (goal: at most 3)"
    )
    print(
        f"gate with nothing stale / bare collection: "
        f"{best['gate'] / best['specs']:.2f}  (goal: at most 1.5)"
    )
    print(f"the same, asked to sign / bare collection: {best['signing'] / best['specs']:.2f}")


if __name__ == "__main__":
    main()
