"""Measure the way from an empty folder to the first signed release of a robot.

    python benchmarks/first_release.py FOLDER ROBOT.urdf [--package-folder FOLDER] [--runs N]

The package is built from the checkout, and installed once beforehand to fill pip's cache; neither
is measured. Measured is what a user waits for in FOLDER/run: a new environment, pip install of the
wheel, `pytest-twin init` of the robot, and `pytest --twin-release`. The robot's folder, or that of
its package, is copied there. The goal is 60 s on two cores. A run without a release fails.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

GOAL = 60.0
"""Wall time of all parts together, s."""


def timed(command: Sequence[str | Path], folder: Path, environment: Mapping[str, str]) -> float:
    """Run a command; print and return its wall time in s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    done = subprocess.run(
        [str(part) for part in command], cwd=folder, env=environment, capture_output=True, text=True
    )
    seconds = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode != 0:
        sys.exit(f"{' '.join(map(str, command))}\n{done.stdout}{done.stderr}")
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    name = " ".join(Path(part).name for part in command[:3])
    print(f"  {name:<40} {seconds:6.1f} s  processor {processor:6.1f} s")
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="for the environments; emptied")
    parser.add_argument("robot", type=Path)
    parser.add_argument("--package-folder", type=Path, help="what is copied beside the robot")
    parser.add_argument("--runs", type=int, default=2)
    args = parser.parse_args()
    folder, robot = args.folder.resolve(), args.robot.resolve()
    package = (args.package_folder or robot.parent).resolve()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    # A signing key of this run only.
    environment = dict(os.environ) | {
        f"XDG_{kind}_HOME": str(folder / kind.lower()) for kind in ("CONFIG", "STATE")
    }
    print("beforehand")
    checkout = Path(__file__).parents[1]
    timed([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, checkout],
          folder, environment)  # fmt: skip
    (wheel,) = folder.glob("*.whl")
    for run in range(args.runs + 1):
        place = folder / "run"
        shutil.rmtree(place, ignore_errors=True)
        (place / package.name).parent.mkdir(parents=True)
        shutil.copytree(package, place / package.name)
        tools = place / ".venv" / "bin"
        parts = [timed([sys.executable, "-m", "venv", ".venv"], place, environment),
                 timed([tools / "pip", "install", "-q", wheel], place, environment)]  # fmt: skip
        if run == 0:
            continue
        model = Path(package.name) / robot.relative_to(package)
        parts.append(timed([tools / "pytest-twin", "init", model], place, environment))
        parts.append(timed([tools / "pytest", "--twin-release"], place, environment))
        if not (place / "releases" / "0001").is_dir():
            sys.exit("no release")
        print(f"run {run}: {sum(parts):.1f} s (goal: at most {GOAL:.0f} s)")


if __name__ == "__main__":
    main()
