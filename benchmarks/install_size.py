"""Measure what a base install takes on disk, by distribution.

    python benchmarks/install_size.py FOLDER

Installs the checkout into a new environment in FOLDER. The size of a distribution is that of the
disk blocks of the files in its RECORD, in MiB, without bytecode, which pip writes after the
download. pip and setuptools do not count. What MuJoCo and Pinocchio require stands apart, because
every user of these simulators has it. The goal is 260 MiB for the rest.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

GOAL = 260.0
"""Size beside MuJoCo and Pinocchio, MiB."""
SIMULATORS = ("mujoco", "pin", "coal")
_LIST = """
import importlib.metadata, json, re
def name(text): return re.sub(r"[-_.]+", "-", text).lower()
out = {}
for found in importlib.metadata.distributions():
    paths = [found.locate_file(file) for file in found.files or []]
    sizes = [p.stat().st_blocks * 512 for p in paths if p.is_file() and p.suffix != ".pyc"]
    required = [r for r in found.requires or [] if "extra ==" not in r]
    needs = [re.match(r"[A-Za-z0-9._-]+", r)[0] for r in required]
    out[name(found.metadata["Name"])] = [sum(sizes), [name(need) for need in needs]]
print(json.dumps(out))
"""


def required_by(roots: Sequence[str], needs: dict[str, list[str]]) -> set[str]:
    """The distributions that some need, with themselves; only those that are installed."""
    found: set[str] = set()
    waiting = list(roots)
    while waiting:
        name = waiting.pop()
        if name in needs and name not in found:
            found.add(name)
            waiting += needs[name]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder.resolve()
    python = folder / "bin" / "python"
    subprocess.run([sys.executable, "-m", "venv", "--clear", str(folder)], check=True)
    checkout = str(Path(__file__).parents[1])
    subprocess.run([python, "-m", "pip", "install", "-q", checkout], check=True)
    listed = subprocess.run([python, "-c", _LIST], capture_output=True, text=True, check=True)
    found = json.loads(listed.stdout)
    needs = {name: more for name, (_, more) in found.items()}
    simulators = required_by(SIMULATORS, needs)
    size = {name: blocks / 2**20 for name, (blocks, _) in found.items()}
    rest = {name: mib for name, mib in size.items()
            if name not in simulators | {"pip", "setuptools"}}  # fmt: skip
    for name, mib in sorted(rest.items(), key=lambda item: -item[1]):
        print(f"{mib:8.1f} MiB  {name}")
    plots = required_by(["matplotlib"], needs) - simulators
    print(f"{sum(size[name] for name in simulators):8.1f} MiB  MuJoCo and Pinocchio with theirs")
    print(f"{sum(size[name] for name in plots):8.1f} MiB  of matplotlib with theirs")
    print(f"{sum(rest.values()):8.1f} MiB  beside MuJoCo and Pinocchio (goal: at most {GOAL:.0f})")


if __name__ == "__main__":
    main()
