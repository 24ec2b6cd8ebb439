"""Compare the diagnoses of blind cases with the truth.

    python benchmarks/concealed/score.py --truth DIR --digests FILE
    python benchmarks/concealed/score.py --truth DIR --results DIR [--out FILE] [--page FILE]

The first command writes the digests of the truth files, which are committed before the diagnosis
runs. The second checks them and writes the tables: with the names of the cases to ``--out``, and
without them between the marks of ``--page`` (``record.md`` beside this file). The exit status is 1
if a truth file is not the committed one.

An effect counts as right if its id and its joint are right. A hidden effect that changes every
held-out recording by less than the sensor noise (``visibility`` below 1) cannot be found; figures
over hidden effects are given with and without these.

Intervals are compared by parameter name. The plant differs from the catalogue in details without a
parameter: its dry friction has 0.2 mrad of presliding, its teeth and surfaces are compliant.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cases import EFFECTS

Named = tuple[str, str | None]
UNNAMED = "unnamed_law"
"""Effect of a finding with a fitted curve instead of a known effect."""
WINDOW_SLACK = 0.2
"""Tolerance of a reported time interval at each end, s."""
MARKS = "<!-- blind figures -->\n", "<!-- end of blind figures -->\n"
"""Lines of a page that enclose the tables."""


def truth_digests(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every truth file."""
    files = sorted(folder.glob("*.json"))
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@dataclass
class Case:
    """Truth and diagnosis of a case; ``said`` is None without a result."""

    truth: dict[str, Any]
    run: dict[str, Any]
    said: dict[str, Any] | None

    @property
    def hidden(self) -> dict[Named, dict[str, Any]]:
        """(effect, joint) -> entry of the truth file."""
        return {(e["effect"], e["joint"]): e for e in self.truth["effects"]}

    @property
    def visible(self) -> dict[Named, dict[str, Any]]:
        """The part of :attr:`hidden` that is above the sensor noise."""
        return {name: e for name, e in self.hidden.items() if e.get("visibility", np.inf) >= 1.0}

    @property
    def found(self) -> list[Named]:
        """(effect, joint) of the named findings, the largest first."""
        found = self.said["findings"] if self.said else []
        return [(f["effect"], f["joint"]) for f in found if f["effect"] != UNNAMED]

    @property
    def largest(self) -> Named | None:
        """The hidden effect that changes the held-out recordings most."""
        hidden = self.hidden
        return max(hidden, key=lambda n: hidden[n].get("visibility", 0.0)) if hidden else None

    @property
    def label(self) -> str:
        """Command mode and number of joints."""
        t = self.truth
        contact = ", contact" if t.get("contact") else ""
        count = len(t["joints"])
        return f"{t['mode']} commands, {count} joint{'s' if count > 1 else ''}{contact}"


def load(truth: Path, results: Path) -> list[Case]:
    """Return every diagnosed case, with or without a result."""
    cases = []
    for path in sorted(truth.glob("*.json")):
        hidden = json.loads(path.read_text())
        run = results / f"{hidden['case']}.run.json"
        if run.exists():
            file = results / hidden["case"] / "diagnosis.json"
            said = json.loads(file.read_text()) if file.exists() else None
            cases.append(Case(hidden, json.loads(run.read_text()), said))
    return cases


def removed(said: dict[str, Any]) -> float | None:
    """Removed share of the explainable squared held-out error, over joints, or None."""
    before = after = 0.0
    for joint in said["held_out"].values():
        floor = joint["floor"] ** 2
        before += max(joint["rms_before"] ** 2 - floor, 0.0) / floor
        after += max(joint["rms_after"] ** 2 - floor, 0.0) / floor
    return None if before < 1.0 else 1.0 - after / before


def f1(hidden: Iterable[Named], found: Iterable[Named]) -> float:
    """F1 score: twice the common elements over the sum of both; 1 if both are empty."""
    hidden, found = set(hidden), set(found)
    total = len(hidden) + len(found)
    return 2 * len(hidden & found) / total if total else 1.0


def intervals(case: Case) -> Iterator[tuple[str, str, bool | None]]:
    """(effect, parameter, whether its interval contains the truth) of right findings.

    The third element is None without an interval, or if the truth has no such parameter.
    """
    for finding in case.said["findings"] if case.said else []:
        hidden = case.hidden.get((finding["effect"], finding["joint"]))
        if hidden is None:
            continue
        for name, parameter in finding["parameters"].items():
            true, ci95 = hidden["parameters"].get(name), parameter.get("ci95")
            bounded = ci95 is not None and None not in ci95
            if true is None or not bounded:
                yield finding["effect"], name, None
            else:
                yield finding["effect"], name, bool(ci95[0] <= true <= ci95[1])


def overlap(claimed: list[list[float]], true: list[list[float]]) -> float:
    """Duration, s, of reported windows inside the true ones, which are widened by the tolerance."""
    wide: list[list[float]] = []
    for start, end in true:
        start, end = start - WINDOW_SLACK, end + WINDOW_SLACK
        if wide and start <= wide[-1][1]:
            wide[-1][1] = end
        else:
            wide.append([start, end])
    return sum(max(0.0, min(b, d) - max(a, c)) for a, b in claimed for c, d in wide)


def outside_right(case: Case) -> dict[str, bool]:
    """Score of a diagnosis for a force that is not in the catalogue."""
    outside, said = case.truth["outside"], case.said
    if said is None:
        return {"verdict": False, "joint": False, "window": False}
    left = said["unexplained"].get(outside["joint"])
    windows = (left or {}).get("windows", {})
    claimed = sum(end - start for w in windows.values() for start, end in w)
    inside = sum(overlap(w, outside["windows"].get(file, [])) for file, w in windows.items())
    return {
        "verdict": said["verdict"] == "unexplained" and not case.found,
        "joint": left is not None,
        "window": claimed > 0.0 and inside >= 0.5 * claimed,
    }


def modelled(case: Case) -> bool:
    """Whether a fitted law removes at least half of the squared held-out error at the joint."""
    outside, said = case.truth["outside"], case.said
    if said is None:
        return False
    error = said["held_out"].get(outside["joint"])
    law = any(f["effect"] == UNNAMED and f["joint"] == outside["joint"] for f in said["findings"])
    return law and error is not None and error["rms_after"] ** 2 <= 0.5 * error["rms_before"] ** 2


def share(values: Iterable[bool]) -> str:
    """Format a percentage with its count."""
    values = list(values)
    return f"{np.mean(values):.1%} of {len(values)}" if values else "none"


def listed(names: Iterable[Named]) -> str:
    """Format effects with their joints."""
    return ", ".join(f"{e} {j or ''}".strip() for e, j in names) or "nothing"


def table(head: list[str], rows: Iterable[Iterable[object]]) -> list[str]:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return [*lines, *("| " + " | ".join(str(v) for v in row) + " |" for row in rows), ""]


def figures(cases: list[Case]) -> list[str]:
    """Return the figures that have a goal."""
    effects = [c for c in cases if c.hidden]
    plain = [c for c in effects if len(c.visible) == len(c.hidden)]
    several, seen_several = ([c for c in g if len(c.hidden) > 1] for g in (effects, plain))
    nothing = [c for c in cases if c.truth["kind"] == "none"]
    beyond = [c for c in cases if c.truth["outside"]]

    def first(group: list[Case], *, any_of: bool = False) -> str:
        return share(
            bool(c.found) and (c.found[0] in c.hidden if any_of else c.found[0] == c.largest)
            for c in group
        )

    def mean_f1(group: list[Case]) -> str:
        if not group:
            return "none"
        pairs = [(len(set(c.hidden) & set(c.found)), len(c.hidden) + len(c.found)) for c in group]
        pooled = 2 * sum(a for a, _ in pairs) / sum(b for _, b in pairs)
        mean = np.mean([f1(c.hidden, c.found) for c in group])
        return f"{mean:.3f} of {len(group)} (pooled {pooled:.3f})"

    def gone(group: list[Case]) -> str:
        gains = [g for c in group if c.said and (g := removed(c.said)) is not None]
        return f"{np.median(gains):.1%} of {len(gains)}" if gains else "none"

    def held(group: list[Case]) -> str:
        return share(v for c in group for _, _, v in intervals(c) if v is not None)

    def outside(group: list[Case]) -> str:
        return share(all(outside_right(c).values()) for c in group)

    false = f"{sum(bool(c.found) for c in nothing)} of {len(nothing)}"
    seen_beyond = [c for c in beyond if c.truth["outside"].get("visibility", np.inf) >= 1.0]
    rows = [
        ("the largest hidden effect named first, on the right joint", "95 %", first(effects),
         first(plain)),
        ("an effect that is hidden named first, on the right joint", "",
         first(effects, any_of=True), first(plain, any_of=True)),
        ("F1 over sets of effects, two or three hidden", "0.90", mean_f1(several),
         mean_f1(seen_several)),
        ("cases with false findings where nothing is hidden", "0", false, false),
        ("`unexplained`, right joint and window, outside the catalogue", "90 %", outside(beyond),
         outside(seen_beyond)),
        ("explainable held-out squared error removed, median", "95 %", gone(effects), gone(plain)),
        ("95 % intervals that contain the truth", "90 to 99 %", held(effects), held(plain)),
    ]  # fmt: skip
    return table(["figure", "goal", "all cases", "cases with all effects visible"], rows)


def kinds(cases: list[Case]) -> list[str]:
    """Number of right and false findings and verdicts, by number of hidden effects."""
    rows = []
    for kind in ("none", "one", "two", "three", "outside"):
        group = [c for c in cases if c.truth["kind"] == kind]
        verdicts = Counter(c.said["verdict"] if c.said else "no result" for c in group)
        told = ", ".join(f"{v} {n}" for v, n in verdicts.most_common())
        whole = sum(set(c.hidden) == set(c.found) for c in group if c.said)
        wrong = sum(bool(set(c.found) - set(c.hidden)) for c in group)
        rows.append((kind, len(group), whole, wrong, told))
    head = ["hidden effects", "cases", "all found, nothing else", "with a false one", "verdicts"]
    return table(head, rows)


def outsiders(cases: list[Case]) -> list[str]:
    """Forces outside the catalogue, by kind."""
    groups: dict[str, list[dict[str, bool]]] = defaultdict(list)
    for c in cases:
        if c.truth["outside"]:
            right = {**outside_right(c), "modelled": modelled(c)}
            groups[c.truth["outside"]["kind"]].append(right)
    rows = [
        (kind, len(g), *(sum(r[k] for r in g) for k in ("verdict", "joint", "window", "modelled")))
        for kind, g in sorted(groups.items())
    ]
    head = [
        "force", "cases", "`unexplained`, no name", "right joint", "right time interval",
        "half of the held-out error removed by a fitted law",
    ]  # fmt: skip
    return table(head, rows)


def confusion(cases: list[Case]) -> dict[tuple[str, str], int]:
    """(hidden, found) -> number of times, over every case with a result.

    A hidden effect that is not found is paired with a false finding at its joint, else with any
    other false finding, else with ``nothing``. A false finding that remains is paired with
    ``nothing``, or with ``outside`` where a force outside the catalogue is hidden.
    """
    count: Counter[tuple[str, str]] = Counter()
    for c in cases:
        if c.said is None:
            count.update((effect, "no result") for effect, _ in c.hidden)
            continue
        missed = [h for h in c.hidden if h not in c.found]
        wrong = [f for f in c.found if f not in c.hidden]
        count.update((effect, effect) for effect, joint in c.hidden if (effect, joint) in c.found)
        for h in sorted(missed, key=lambda h: all(f[1] != h[1] for f in wrong)):
            near = next((f for f in wrong if f[1] == h[1]), wrong[0] if wrong else None)
            if near is None:
                count[h[0], "nothing"] += 1
                continue
            wrong.remove(near)
            count[h[0], near[0] if near[0] != h[0] else f"{near[0]}, other joint"] += 1
        left = "outside" if c.truth["outside"] else "nothing"
        count.update((left, f[0]) for f in wrong)
        if not c.hidden and not c.found:
            count[left, "nothing"] += 1
    return dict(count)


def by_effect(cases: list[Case]) -> list[str]:
    """Return the confusion matrix, a row for each hidden effect."""
    matrix = confusion(cases)
    alone = Counter(e for c in cases if c.truth["kind"] == "one" for e, _ in c.hidden)
    named = Counter(
        e for c in cases if c.truth["kind"] == "one" for e, j in c.hidden if (e, j) in c.found
    )
    rows = []
    for effect in (*EFFECTS, "outside", "nothing"):
        said = {s: n for (h, s), n in matrix.items() if h == effect}
        right = said.pop(effect if effect in EFFECTS else "nothing", 0)
        others = ", ".join(f"{s} {n}" for s, n in sorted(said.items(), key=lambda x: -x[1]))
        total = right + sum(said.values())
        single = f"{named[effect]} of {alone[effect]}" if effect in EFFECTS else ""
        rows.append((effect, single, f"{right} of {total}", others))
    return table(["hidden", "found, if alone", "found, all cases", "found instead"], rows)


def interval_table(cases: list[Case]) -> list[str]:
    """Coverage of the intervals by parameter."""
    held: dict[tuple[str, str], list[bool | None]] = defaultdict(list)
    for c in cases:
        for effect, name, value in intervals(c):
            held[effect, name].append(value)
    rows = []
    for (effect, name), values in sorted(held.items()):
        known = [v for v in values if v is not None]
        why = len(values) - len(known) or ""
        rows.append((f"{effect}.{name}", f"{sum(known)} of {len(known)}" if known else "", why))
    return table(["parameter", "interval contains the truth", "not comparable"], rows)


def failures(cases: list[Case], *, named: bool) -> list[str]:
    """Return a line for each case with a missed or false effect; with its name if ``named``."""
    lines = []
    for c in cases:
        said = listed(c.found)
        label = f"{c.truth['case']}, {c.label}" if named else c.label
        outside = c.truth["outside"]
        if c.said is None:
            lines.append(f"{label}: no diagnosis ({c.run['status']}); hidden {listed(c.hidden)}")
        elif outside:
            right = outside_right(c)
            if not all(right.values()):
                wrong = ", ".join(k for k, v in right.items() if not v)
                at = ", ".join(c.said["unexplained"]) or "no joint"
                lines.append(
                    f"{label}: hidden {outside['kind']} {outside['joint']}; found {said}, "
                    f"{c.said['verdict']}, unexplained at {at}; wrong: {wrong}"
                )
        elif set(c.hidden) != set(c.found):
            faint = [n for n in c.hidden if n not in c.visible]
            note = f"; below the noise: {listed(faint)}" if faint else ""
            seen = ", ".join(
                f"{listed([(e['effect'], e['joint'])])} ({e['visibility']:.3g} times the noise)"
                for e in sorted(c.truth["effects"], key=lambda e: -e["visibility"])
            )
            lines.append(f"{label}: hidden {seen or 'nothing'}; found {said}{note}")
    return [*(f"- {line}" for line in lines), ""]


def report(cases: list[Case], checked: str, *, named: bool = True) -> str:
    """Return all tables as Markdown; failures have the names of their cases if ``named``."""
    none = sum(c.said is None for c in cases)
    faint = sum(len(c.hidden) - len(c.visible) for c in cases)
    confined = sum(bool(c.run.get("confined")) for c in cases)
    parts = [
        f"{len(cases)} cases, {none} without a result. {faint} hidden effects are below the sensor "
        f"noise. {checked} {confined} of {len(cases)} diagnoses ran without access to other files.",
        "", *figures(cases),
        "By number of hidden effects:", "", *kinds(cases),
        "Forces outside the catalogue:", "", *outsiders(cases),
        "By hidden effect:", "", *by_effect(cases),
        "Cases with a missed or false effect:", "", *failures(cases, named=named),
        "Coverage of the 95 % intervals of right findings:", "", *interval_table(cases),
    ]  # fmt: skip
    return "\n".join(parts)


def checked_digests(truth: Path, committed: Path, names: Iterable[str]) -> tuple[str, bool]:
    """Return a sentence about the truth files, and whether all are the committed ones."""
    was = json.loads(committed.read_text()) if committed.exists() else {}
    now = truth_digests(truth)
    files = [f"{name}.json" for name in names]
    other = [f for f in files if was.get(f) != now[f]]
    if other:
        told = ", ".join(other[:5]) + (", ..." if len(other) > 5 else "")
        return f"**{len(other)} truth files differ from {committed.name}: {told}.**", False
    return f"Every truth file has the committed digest ({committed.name}).", True


def write_between_marks(page: Path, text: str) -> None:
    """Replace the text of a page between ``MARKS``."""
    start, end = MARKS
    before, _, rest = page.read_text().partition(start)
    _, found, after = rest.partition(end)
    if not found:
        raise SystemExit(f"{page}: expected the lines {start.strip()} and {end.strip()}")
    page.write_text(f"{before}{start}{text}{end}{after}")


def main() -> int:
    """Write digests, or the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--results", type=Path)
    parser.add_argument("--digests", type=Path, help="write the digests of the truth files there")
    parser.add_argument(
        "--committed", type=Path, default=Path(__file__).with_name("truth_digests.json")
    )
    parser.add_argument("--out", type=Path, help="write the tables there, not to standard output")
    parser.add_argument("--page", type=Path, help="page that gets the tables between its marks")
    args = parser.parse_args()
    if args.digests is not None:
        args.digests.write_text(json.dumps(truth_digests(args.truth), indent=1) + "\n")
    if args.results is None:
        return 0
    cases = load(args.truth, args.results)
    if not cases:
        parser.error(f"{args.results}: no *.run.json of a case in {args.truth}")
    told, same = checked_digests(args.truth, args.committed, (c.truth["case"] for c in cases))
    text = report(cases, told)
    if args.page is not None:
        write_between_marks(args.page, report(cases, told, named=False))
    if args.out is None:
        print(text)
    else:
        args.out.write_text(text)
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
