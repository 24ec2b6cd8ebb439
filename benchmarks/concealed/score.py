"""Open the truth of blind cases and hold the diagnoses against it.

    python benchmarks/concealed/score.py --truth DIR --results DIR [--markdown FILE]

Digests of the truth files, for committing before the diagnosis runs: ``--digests FILE``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np


def truth_digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every truth file."""
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.glob("*"))}


def names(items: list[dict[str, Any]]) -> set[tuple[str, str | None]]:
    """(effect, joint) of findings or of the truth."""
    return {(item["effect"], item["joint"]) for item in items}


def removed(diagnosis: dict[str, Any]) -> float | None:
    """Share of the explainable held-out squared error that is gone, over joints; None without."""
    before = after = 0.0
    for joint in diagnosis["held_out"].values():
        floor = joint["floor"] ** 2
        before += max(joint["rms_before"] ** 2 - floor, 0.0) / floor
        after += max(joint["rms_after"] ** 2 - floor, 0.0) / floor
    return None if before < 1.0 else 1.0 - after / before


def covered(truth: dict[str, Any], finding: dict[str, Any]) -> list[bool]:
    """Whether each interval of a right finding holds the true value."""
    named = (finding["effect"], finding["joint"])
    hidden = next(e for e in truth["effects"] if (e["effect"], e["joint"]) == named)
    found = []
    for name, parameter in finding["parameters"].items():
        if name in hidden["parameters"] and parameter.get("ci95"):
            low, high = parameter["ci95"]
            if low is not None and high is not None:
                found.append(low <= hidden["parameters"][name] <= high)
    return found


def score(truth_folder: Path, results: Path) -> tuple[list[str], list[str]]:
    """Lines of the table and of the failures."""
    first, f1, gains, intervals, outside, failures = [], [], [], [], [], []
    nothing = wrong_nothing = timeouts = total = 0
    confusion: Counter[tuple[str, str]] = Counter()
    for path in sorted(truth_folder.glob("*.json")):
        truth = json.loads(path.read_text())
        run = results / f"{truth['case']}.run.json"
        if not run.exists():
            continue
        total += 1
        file = results / truth["case"] / "diagnosis.json"
        if not file.exists():
            timeouts += 1
            status = json.loads(run.read_text())
            failures.append(f"{truth['case']}: no diagnosis ({status['status']})")
            continue
        diagnosis = json.loads(file.read_text())
        hidden, found = names(truth["effects"]), names(diagnosis["findings"])
        label = f"{truth['case']} ({truth['mode']}, {len(truth['joints'])} joints)"
        said = ", ".join(f"{e} {j or ''}".strip() for e, j in sorted(found, key=str)) or "nothing"
        meant = ", ".join(f"{e} {j or ''}".strip() for e, j in sorted(hidden, key=str)) or "nothing"
        if truth["outside"]:
            joint = truth["joints"][truth["outside"]["joint"]]
            right = diagnosis["verdict"] == "unexplained" and joint in diagnosis["unexplained"]
            outside.append(right)
            if not right:
                failures.append(f"{label}: {truth['outside']['kind']} at {joint}; said {said}")
            continue
        if not hidden:
            nothing += 1
            wrong_nothing += bool(found)
            if found:
                failures.append(f"{label}: nothing hidden; said {said}")
            continue
        hit = (
            bool(diagnosis["findings"])
            and (
                diagnosis["findings"][0]["effect"],
                diagnosis["findings"][0]["joint"],
            )
            in hidden
        )
        first.append(hit)
        if len(hidden) > 1:
            f1.append(2 * len(hidden & found) / (len(hidden) + len(found)))
        else:
            top = diagnosis["findings"][0]["effect"] if diagnosis["findings"] else "nothing"
            confusion[(truth["effects"][0]["effect"], top)] += 1
        if hidden != found:
            failures.append(f"{label}: hidden {meant}; said {said}")
        for finding in diagnosis["findings"]:
            if (finding["effect"], finding["joint"]) in hidden:
                intervals += covered(truth, finding)
        gain = removed(diagnosis)
        if gain is not None:
            gains.append(gain)

    def share(values: list[bool]) -> str:
        return f"{np.mean(values):.0%} of {len(values)}" if values else "none drawn"

    lines = [
        "| figure | goal | found |",
        "|---|---|---|",
        f"| cases diagnosed (no result in time) | 200 | {total} ({timeouts}) |",
        f"| an effect that is hidden named first, on the right joint | 95 % | {share(first)} |",
        f"| F1 over sets of effects, two or three hidden | 0.90 | "
        f"{f'{np.mean(f1):.2f} of {len(f1)}' if f1 else 'none drawn'} |",
        f"| cases with false findings where nothing is hidden | 0 | {wrong_nothing} of {nothing} |",
        f"| unexplained, outside the catalogue, right joint | 90 % | {share(outside)} |",
        f"| explainable held-out squared error removed, median | 95 % | "
        f"{f'{np.median(gains):.1%} of {len(gains)}' if gains else 'none drawn'} |",
        f"| 95 % intervals that hold the truth | 90 to 99 % | {share(intervals)} |",
    ]
    table = [
        "",
        "One effect hidden: what was said first.",
        "",
        "| hidden | said | cases |",
        "|---|---|---|",
    ]
    table += [f"| {h} | {s} | {n} |" for (h, s), n in sorted(confusion.items())]
    return lines + table, failures


def main() -> None:
    """Print, or write, the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--results", type=Path)
    parser.add_argument("--digests", type=Path)
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    if args.digests is not None:
        args.digests.write_text(json.dumps(truth_digests(args.truth), indent=1) + "\n")
    if args.results is not None:
        lines, failures = score(args.truth, args.results)
        text = "\n".join([*lines, "", "Every case that was not named in full:", ""]
                         + [f"- {f}" for f in failures]) + "\n"  # fmt: skip
        print(text)
        if args.markdown is not None:
            args.markdown.write_text(text)


if __name__ == "__main__":
    main()
