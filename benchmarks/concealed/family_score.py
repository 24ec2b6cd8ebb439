"""Score diagnoses of the drawn families: sampled cells, other engines, real recordings.

    python benchmarks/concealed/family_score.py --truth DIR --results before=DIR
        [--results after=DIR] [--out FILE] [--page FILE --mark NAME]

The table has a column for each folder of results, over the cases that all folders have. With
``--page`` it is written between the lines ``<!-- NAME -->`` and ``<!-- end of NAME -->`` of a page.

Findings are classified as:

- *right*: a hidden effect on its joint. An effect that no recording can distinguish from it
  (``equivalents``) is right only where the hidden one has at least half of its confidence as an
  alternative.
- *background*: a background difference in the truth file, with its sign and at most
:data:`PLAUSIBLE` times its size.
- *false*: anything else except an unnamed law (``unnamed_``).

Small corrections, which a diagnosis lists separately (``small_corrections``), are no findings.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

SURE = 0.9
"""Smallest confidence with which a false finding is counted, because a user would act on it."""
PLAUSIBLE = 3.0
"""Largest ratio of a background finding to its true size."""
STANDS = (
    (0.0, 2.0, "less than 2"), (2.0, 5.0, "2 to 5"), (5.0, 10.0, "5 to 10"),
    (10.0, np.inf, "at least 10"),
)  # fmt: skip
"""Ranges of the ratio of an effect to the background: lower limit, upper limit, description."""
BANDS = ((0.5, 0.75), (0.75, 0.9), (0.9, 1.0))
SHAPES = ("harmonic", "stribeck_velocity", "in_loop", "cosine", "damping_time")
"""Parameters that do not measure the size of an effect."""
COMMITTED = Path(__file__).with_name("truth_digests.json")


@dataclass(frozen=True)
class Answer:
    """A case: truth, status of the run, and diagnosis; ``said`` is None without a diagnosis."""

    truth: dict[str, Any]
    run: dict[str, Any]
    said: dict[str, Any] | None

    @property
    def findings(self) -> list[dict[str, Any]]:
        """Findings without unnamed laws, the largest first."""
        found = self.said["findings"] if self.said else []
        return [f for f in found if not f["effect"].startswith("unnamed_")]

    @property
    def hidden(self) -> list[dict[str, Any]]:
        """Visible hidden effects, the largest first."""
        seen = [e for e in self.truth["effects"] if e["visibility"] >= 1.0]
        return sorted(seen, key=lambda e: -float(e["visibility"]))


Columns = dict[str, dict[str, Answer]]
"""Name of a folder of results -> case -> answer."""


def load(truth: Path, results: Path) -> dict[str, Answer]:
    """Return every diagnosed case, by name."""
    out = {}
    for path in sorted(truth.glob("*.json")):
        hidden = json.loads(path.read_text())
        run = results / f"{hidden['case']}.run.json"
        if run.exists():
            file = results / hidden["case"] / "diagnosis.json"
            said = json.loads(file.read_text()) if file.exists() else None
            out[hidden["case"]] = Answer(hidden, json.loads(run.read_text()), said)
    return out


def is_effect(finding: dict[str, Any], effect: dict[str, Any]) -> bool:
    """Whether a finding is a hidden effect on its joint, or equivalent with shared confidence."""
    if (finding["effect"], finding["joint"]) == (effect["effect"], effect["joint"]):
        return True
    if [finding["effect"], finding["joint"]] not in effect.get("equivalents", []):
        return False
    shared = [
        a["confidence"] for a in finding["alternatives"]
        if a["effect"] == effect["effect"] and a.get("joint", effect["joint"]) == effect["joint"]
    ]  # fmt: skip
    return any(s >= 0.5 * finding["confidence"] for s in shared)


def is_background(finding: dict[str, Any], truth: dict[str, Any]) -> bool:
    """Whether a finding is a background difference of the truth file."""
    return any(
        b["effect"] == finding["effect"] and b["joint"] in (None, finding["joint"])
        and _plausible(finding["parameters"], b["parameters"])
        for b in truth["background"]
    )  # fmt: skip


def _plausible(said: dict[str, Any], true: dict[str, float]) -> bool:
    for name in (set(said) & set(true)) - set(SHAPES):
        value = said[name]["value"]
        if abs(value) > PLAUSIBLE * abs(true[name]):
            return False
        if value * true[name] < 0 and abs(value) > abs(true[name]):
            return False
    return True


def kind_of(finding: dict[str, Any], truth: dict[str, Any]) -> str:
    """Classify a finding as ``right``, ``background`` or ``false``."""
    if any(is_effect(finding, e) for e in truth["effects"]):
        return "right"
    return "background" if is_background(finding, truth) else "false"


def first_right(answer: Answer) -> bool:
    """Whether the first finding is the largest hidden effect."""
    found = answer.findings
    return bool(found) and is_effect(found[0], answer.hidden[0])


def sure(answer: Answer, kind: str) -> list[dict[str, Any]]:
    """Return the findings of a class that a user would act on."""
    return [
        f for f in answer.findings
        if f["confidence"] >= SURE and kind_of(f, answer.truth) == kind
    ]  # fmt: skip


def removed(answer: Answer) -> float | None:
    """Removed share of the squared held-out error above the floor; None without such an error."""
    before = after = 0.0
    for joint in answer.said["held_out"].values() if answer.said else []:
        floor = joint["floor"] ** 2
        before += max(joint["rms_before"] ** 2 - floor, 0.0) / floor
        after += max(joint["rms_after"] ** 2 - floor, 0.0) / floor
    return None if before < 1.0 else 1.0 - after / before


def intervals(answer: Answer) -> Iterable[bool]:
    """Whether each interval of a right finding contains the true value."""
    for finding in answer.findings:
        for effect in answer.truth["effects"]:
            if (finding["effect"], finding["joint"]) != (effect["effect"], effect["joint"]):
                continue
            for name, parameter in finding["parameters"].items():
                true, bounds = effect["parameters"].get(name), parameter.get("ci95")
                if true is not None and bounds and None not in bounds:
                    yield bool(bounds[0] <= true <= bounds[1])


def unexplained_right(answer: Answer) -> bool:
    """Whether an outside force is reported as unexplained at its joint, without a false finding."""
    said = answer.said
    return (
        said is not None
        and said["verdict"] in ("unexplained", "improved")
        and answer.truth["outside"]["joint"] in said["unexplained"]
        and not sure(answer, "false")
    )


def simulations(answer: Answer) -> float | None:
    """Return the number of simulations of all data."""
    cost = answer.said.get("cost") if answer.said else None
    return float(cost["simulations"]) if cost else None


def calibration(answers: Iterable[Answer]) -> list[tuple[int, int]]:
    """Number of (right, all) findings in each of :data:`BANDS` of confidence."""
    counts = [[0, 0] for _ in BANDS]
    for answer in answers:
        for finding in answer.findings:
            for count, (low, high) in zip(counts, BANDS, strict=True):
                if low <= finding["confidence"] < high or finding["confidence"] == high == 1.0:
                    count[0] += kind_of(finding, answer.truth) != "false"
                    count[1] += 1
    return [(right, every) for right, every in counts]


def share(values: Iterable[bool]) -> str:
    """Format a count, its total, and the percentage."""
    values = list(values)
    return f"{sum(values)} of {len(values)} ({np.mean(values):.0%})" if values else "none"


def spread(values: Iterable[float | None], unit: str = "") -> str:
    """Median, 95th percentile and maximum."""
    known = [v for v in values if v is not None]
    if not known:
        return "none"
    middle, high, most = np.median(known), np.percentile(known, 95), max(known)
    return f"{middle:.0f}, {high:.0f}, {most:.0f}{unit} of {len(known)}"


def middle(values: Iterable[float | None]) -> str:
    """Median in per cent."""
    known = [v for v in values if v is not None]
    return f"{np.median(known):.1%} of {len(known)}" if known else "none"


def times_background(answer: Answer) -> float:
    """Return the ratio of hidden effects to the background."""
    drawn = answer.truth.get("stands_out") or {}
    return float(drawn.get("factor", answer.hidden[0]["visibility"]))


def rows(answers: Sequence[Answer]) -> list[tuple[str, str, str]]:
    """Return (figure, goal, value) for cases of a family."""
    ended = [a for a in answers if a.said is not None]
    hiding = [a for a in answers if a.hidden]
    named = [a for a in ended if a.truth["kind"] != "none"]
    nothing = [a for a in ended if a.truth["kind"] == "none"]
    outside = [a for a in answers if a.truth["outside"]]
    corrections = sum(len((a.said or {}).get("small_corrections", [])) for a in nothing)
    found = [
        ("cases with a result", "", f"{len(ended)} of {len(answers)}"),
        ("the largest hidden effect first, on the right joint", "95 %",
         share(first_right(a) for a in hiding)),
        ("the same, of cases with a result", "",
         share(first_right(a) for a in hiding if a.said is not None)),
        *(
            (f"the same, of effects of {words} times the background", "",
             share(first_right(a) for a in hiding if low <= times_background(a) < high))
            for low, high, words in STANDS
        ),
        ("cases with a false name at 0.9 or above, something hidden", "at most 1 in 20",
         share(bool(sure(a, "false")) for a in named)),
        ("cases with a false name at 0.9 or above, background alone", "0",
         share(bool(sure(a, "false")) for a in nothing)),
        ("cases with background named as missing physics at 0.9 or above, background alone", "",
         share(bool(sure(a, "background")) for a in nothing)),
        ("small corrections, background alone", "listed apart", str(corrections)),
        ("held-out squared error above the floor removed, median", "95 %",
         middle(removed(a) for a in ended if a.hidden)),
        ("95 % intervals that hold the hidden value", "90 to 99 %",
         share(v for a in ended for v in intervals(a))),
        ("force outside the catalogue unexplained at the right joint, no false name at 0.9", "",
         share(unexplained_right(a) for a in outside)),
    ]  # fmt: skip
    for (low, high), (right, every) in zip(BANDS, calibration(ended), strict=True):
        goal = "90 %" if high == 1.0 else ""
        value = f"{right} of {every} ({right / every:.0%})" if every else "none"
        figure = f"names with a confidence of {low:g} to {high:g} that are right"
        found.append((figure, goal, value))
    for count in sorted({len(a.truth["joints"]) for a in answers}):
        group = [a for a in answers if len(a.truth["joints"]) == count]
        joints = f"{count} joint{'s' if count > 1 else ''}"
        found.append((f"simulations of all data, {joints}: median, 95th percentile, maximum", "",
                      spread(simulations(a) for a in group)))  # fmt: skip
        found.append((f"wall time, {joints}: median, 95th percentile, maximum", "",
                      spread((a.run["seconds"] for a in group), " s")))  # fmt: skip
    return found


def table(columns: Columns) -> list[str]:
    """A family's figures, a column for each folder of results, over the cases of all."""
    common = sorted(set.intersection(*(set(c) for c in columns.values())))
    each = {name: rows([c[case] for case in common]) for name, c in columns.items()}
    lines = [f"| figure | goal | {' | '.join(each)} |", "|---|---|" + "---|" * len(each)]
    for figures in zip(*each.values(), strict=True):
        words, goal, _ = figures[0]
        lines.append(f"| {words} | {goal} | {' | '.join(f[2] for f in figures)} |")
    return [*lines, ""]


def listed(column: dict[str, Answer]) -> list[str]:
    """Return a line for each case: hidden effects and findings."""
    lines = []
    for name, a in column.items():
        t = a.truth
        unit = "background" if t["family"] == "real" else "noise"
        hidden = ", ".join(
            f"{e['effect']} {e['joint'] or ''}".strip()
            + f" ({e['visibility']:.3g} times the {unit})"
            for e in t["effects"]
        )
        hidden = hidden or (t["outside"] or {}).get("kind") or "background alone"
        if a.said is None:
            lines.append(f"- {name}: {hidden}; no result ({a.run['status']})")
            continue
        found = ", ".join(
            f"{f['effect']} {f['joint'] or ''}".strip() + f" {f['confidence']:.2f} "
            f"({kind_of(f, t)})" for f in a.findings
        )  # fmt: skip
        lines.append(f"- {name}: {hidden}; found {found or 'nothing'}; {a.said['verdict']}")
    return [*lines, ""]


def by_family(
    columns: dict[str, dict[str, Answer]],
    write: Callable[[dict[str, dict[str, Answer]]], list[str]],
) -> list[str]:
    """Apply ``write`` to each family, with its name as heading."""
    families = sorted({a.truth["family"] for c in columns.values() for a in c.values()})
    lines = []
    for family in families:
        own = {
            name: {k: a for k, a in c.items() if a.truth["family"] == family}
            for name, c in columns.items()
        }
        lines += [f"Family `{family}`:", "", *write(own)]
    return lines


def write_between(page: Path, mark: str, text: str) -> None:
    """Replace the text of a page between the lines of a mark.

    Raises:
        SystemExit: the page has no such lines.
    """
    start, end = f"<!-- {mark} -->\n", f"<!-- end of {mark} -->\n"
    before, _, rest = page.read_text().partition(start)
    _, found, after = rest.partition(end)
    if not found:
        raise SystemExit(f"{page}: expected the lines {start.strip()} and {end.strip()}")
    page.write_text(f"{before}{start}{text}{end}{after}")


def named_folder(words: str) -> tuple[str, Path]:
    """Parse ``before=DIR`` to a name and a folder."""
    name, _, folder = words.partition("=")
    return (name, Path(folder)) if folder else (Path(name).name, Path(name))


def main() -> int:
    """Write the tables; return 1 if a truth file is not the committed one."""
    from score import checked_digests  # needs the plant's numba

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--results", type=named_folder, action="append", required=True)
    parser.add_argument("--out", type=Path, help="write tables and cases there")
    parser.add_argument("--page", type=Path, help="page that gets the tables")
    parser.add_argument("--mark", default="family figures", help="of the lines around them")
    args = parser.parse_args()
    columns = {name: load(args.truth, folder) for name, folder in args.results}
    cases = {case for c in columns.values() for case in c}
    if not cases:
        parser.error(f"no *.run.json of a case in {args.truth}")
    told, same = checked_digests(args.truth, COMMITTED, sorted(cases))
    tables = [told, "", *by_family(columns, table)]
    if args.page is not None:
        write_between(args.page, args.mark, "\n".join(tables) + "\n")
    last = list(columns)[-1]
    text = "\n".join([*tables, *by_family({last: columns[last]}, lambda c: listed(c[last]))])
    if args.out is None:
        print(text)
    else:
        args.out.write_text(text + "\n")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
