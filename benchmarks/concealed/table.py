"""Make blind cases, diagnose them and write the tables of the results.

    python benchmarks/concealed/table.py --out DIR [--seeds 20000:20200] [--jobs 2] [--page FILE]
        [--family held|cell|engine|real]

A second run continues the first one. DIR/cases, DIR/truth and DIR/digests.json are written before
any diagnosis runs, then DIR/results and DIR/table.md. ``--page docs/blind_cases.md`` also writes
the tables to this page. The committed digests are in ``truth_digests.json`` in this folder; the
score states whether the truth files still have them.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
FAMILIES = {"held": "cases.py", "cell": "cell_cases.py", "engine": "engine_cases.py",
            "real": "real_cases.py"}  # fmt: skip
"""Script that draws the cases of each family: held commands, sampled cells, other engines, real
recordings with hidden effects."""


def step(script: str, *words: str) -> None:
    """Run another script of this folder; a failed check of digests does not stop the table."""
    done = subprocess.run([sys.executable, str(HERE / script), *words], check=False)
    if done.returncode not in (0, 1):
        raise SystemExit(done.returncode)


def main() -> None:
    """Make cases, diagnose, score."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", default="20000:20200", help="first and last + 1, as in cases.py")
    parser.add_argument("--family", choices=FAMILIES, default="held")
    parser.add_argument("--jobs", default="2", help="cases at the same time, one core each")
    parser.add_argument("--seconds", default="600", help="time limit of a diagnosis")
    parser.add_argument("--page", type=Path, help="page that gets the tables between its marks")
    args = parser.parse_args()
    out: Path = args.out
    truth, cases, results = out / "truth", out / "cases", out / "results"
    if not (out / "digests.json").exists():
        step(
            FAMILIES[args.family], "--out", str(cases), "--truth", str(truth),
            "--seeds", args.seeds, "--jobs", args.jobs,
        )  # fmt: skip
        step("score.py", "--truth", str(truth), "--digests", str(out / "digests.json"))
    step("run.py", "--cases", str(cases), "--out", str(results), "--seconds", args.seconds,
         "--jobs", args.jobs)  # fmt: skip
    page = [] if args.page is None else ["--page", str(args.page)]
    score = "score.py" if args.family == "held" else "family_score.py"
    step(score, "--truth", str(truth), "--results", str(results), "--out",
         str(out / "table.md"), *page)  # fmt: skip
    print(out / "table.md")


if __name__ == "__main__":
    main()
