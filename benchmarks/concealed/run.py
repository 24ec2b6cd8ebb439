"""Diagnose blind cases, each in a process that is given the case folder alone.

    python benchmarks/concealed/run.py --cases DIR --out DIR [--seconds 600]

Writes DIR/<case>/diagnosis.json and what the command printed; the truth is nowhere in reach of it.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path


def diagnose(case: Path, out: Path, seconds: float) -> dict[str, object]:
    """Run the command on one case; its status, wall time and last words."""
    recordings = sorted(str(path) for path in (case / "recordings").glob("*.mcap"))
    command = [
        str(Path(sys.executable).with_name("pytest-twin")), "diagnose", str(case / "model.xml"),
        *recordings, "--out", str(out),
    ]  # fmt: skip
    start = time.perf_counter()
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, cwd=case)
    except subprocess.TimeoutExpired:
        return {"case": case.name, "status": "timeout", "seconds": seconds}
    return {
        "case": case.name,
        "status": done.returncode,
        "seconds": time.perf_counter() - start,
        "stderr": done.stderr[-2000:],
    }


def main() -> None:
    """Diagnose every case of a folder that has no result yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=600.0)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for case in sorted(path.parent for path in args.cases.glob("*/model.xml")):
        result = args.out / f"{case.name}.run.json"
        if not result.exists():
            told = diagnose(case, args.out / case.name, args.seconds)
            result.write_text(json.dumps(told, indent=1) + "\n")
            print(case.name, told["status"], f"{told['seconds']:.0f} s", flush=True)


if __name__ == "__main__":
    main()
