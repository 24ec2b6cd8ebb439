"""The table of blind cases, from nothing: cases, digests, diagnoses, scores.

    python benchmarks/concealed/table.py --out DIR [--seeds 20000:20200] [--jobs 2]

Goes on where it stopped. Writes DIR/cases, DIR/truth, DIR/digests.json before any diagnosis runs,
DIR/results and DIR/table.md. The digests that were committed stand in ``truth_digests.json`` beside
this file; the scorer says whether the truth is still theirs.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent


def step(script: str, *words: str) -> None:
    """One of the scripts beside this one; a failed check of digests does not hide the table."""
    done = subprocess.run([sys.executable, str(HERE / script), *words], check=False)
    if done.returncode not in (0, 1):
        raise SystemExit(done.returncode)


def main() -> None:
    """Every step of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", default="20000:20200", help="as cases.py has them")
    parser.add_argument("--jobs", default="2", help="cases at the same time, a core each")
    parser.add_argument("--seconds", default="600", help="a diagnosis may take")
    args = parser.parse_args()
    out: Path = args.out
    truth, cases, results = out / "truth", out / "cases", out / "results"
    if not (out / "digests.json").exists():
        step("cases.py", "--out", str(cases), "--truth", str(truth), "--seeds", args.seeds,
             "--jobs", args.jobs)  # fmt: skip
        step("score.py", "--truth", str(truth), "--digests", str(out / "digests.json"))
    step("run.py", "--cases", str(cases), "--out", str(results), "--seconds", args.seconds,
         "--jobs", args.jobs)  # fmt: skip
    step("score.py", "--truth", str(truth), "--results", str(results), "--out",
         str(out / "table.md"))  # fmt: skip
    print(out / "table.md")


if __name__ == "__main__":
    main()
