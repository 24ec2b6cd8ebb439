"""Open the truth of blind cases and hold the diagnoses against it.

    python benchmarks/concealed/score.py --truth DIR --digests FILE
    python benchmarks/concealed/score.py --truth DIR --results DIR [--committed FILE] [--out FILE]

The first writes the digests of the truth files, to be committed before the diagnosis runs; the
second checks them and writes the tables. Exit status 1 where a truth file is not the committed one.

An effect counts as named right where its id and its joint are. A hidden effect that changes no
held-out recording by as much as the sensors' noise (``visibility`` below 1) cannot be seen: every
figure over hidden effects is given with and without them.

Intervals are compared by name: plant and package mean the same by every parameter that both have.
Where the plant's laws differ, no parameter says so: its dry friction yields 0.2 mrad before it
slides, its teeth give, its surfaces creep.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cases import EFFECTS

Named = tuple[str, str | None]
WINDOW_SLACK = 0.2
"""s by which a claimed window may be beside the true one."""


def truth_digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every truth file."""
    files = sorted(folder.glob("*.json"))
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@dataclass
class Case:
    """A truth, and what the diagnosis said; None where it gave no result."""

    truth: dict[str, Any]
    run: dict[str, Any]
    said: dict[str, Any] | None

    @property
    def hidden(self) -> dict[Named, dict[str, Any]]:
        """(effect, joint) -> what the truth says of it."""
        return {(e["effect"], e["joint"]): e for e in self.truth["effects"]}

    @property
    def visible(self) -> dict[Named, dict[str, Any]]:
        """Of :attr:`hidden` what can be seen."""
        return {name: e for name, e in self.hidden.items() if e.get("visibility", np.inf) >= 1.0}

    @property
    def found(self) -> list[Named]:
        """(effect, joint) of the findings, the greatest first."""
        return [(f["effect"], f["joint"]) for f in self.said["findings"]] if self.said else []

    @property
    def largest(self) -> Named | None:
        """The hidden effect that changes the held-out recordings most."""
        hidden = self.hidden
        return max(hidden, key=lambda n: hidden[n].get("visibility", 0.0)) if hidden else None

    @property
    def label(self) -> str:
        """Name, drives, size."""
        t = self.truth
        contact = ", contact" if t.get("contact") else ""
        return f"{t['case']} ({t['mode']}, {len(t['joints'])} joints{contact})"


def load(truth: Path, results: Path) -> list[Case]:
    """Every case that was diagnosed, with or without a result."""
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
    """Share of the explainable held-out squared error that is gone, over joints; None without."""
    before = after = 0.0
    for joint in said["held_out"].values():
        floor = joint["floor"] ** 2
        before += max(joint["rms_before"] ** 2 - floor, 0.0) / floor
        after += max(joint["rms_after"] ** 2 - floor, 0.0) / floor
    return None if before < 1.0 else 1.0 - after / before


def f1(hidden: Iterable[Named], found: Iterable[Named]) -> float:
    """Twice the shared over the sum of both; 1 where both are empty."""
    hidden, found = set(hidden), set(found)
    total = len(hidden) + len(found)
    return 2 * len(hidden & found) / total if total else 1.0


def intervals(case: Case) -> Iterator[tuple[str, str, bool | None]]:
    """(effect, parameter, whether its interval holds the truth) of effects that are named right.

    None where it cannot be compared: no interval, or no such number in the truth.
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
    """s of the claimed windows that lie in the true ones, these widened by the slack."""
    wide: list[list[float]] = []
    for start, end in true:
        start, end = start - WINDOW_SLACK, end + WINDOW_SLACK
        if wide and start <= wide[-1][1]:
            wide[-1][1] = end
        else:
            wide.append([start, end])
    return sum(max(0.0, min(b, d) - max(a, c)) for a, b in claimed for c, d in wide)


def outside_right(case: Case) -> dict[str, bool]:
    """What a diagnosis got right of a force that is in no catalogue."""
    outside, said = case.truth["outside"], case.said
    if said is None:
        return {"verdict": False, "joint": False, "window": False}
    left = said["unexplained"].get(outside["joint"])
    windows = (left or {}).get("windows", {})
    claimed = sum(end - start for w in windows.values() for start, end in w)
    inside = sum(overlap(w, outside["windows"].get(file, [])) for file, w in windows.items())
    return {
        "verdict": said["verdict"] == "unexplained" and not said["findings"],
        "joint": left is not None,
        "window": claimed > 0.0 and inside >= 0.5 * claimed,
    }


def share(values: Iterable[bool]) -> str:
    """Per cent, with the count."""
    values = list(values)
    return f"{np.mean(values):.1%} of {len(values)}" if values else "none"


def listed(names: Iterable[Named]) -> str:
    """Effects with their joints, for people."""
    return ", ".join(f"{e} {j or ''}".strip() for e, j in names) or "nothing"


def table(head: list[str], rows: Iterable[Iterable[object]]) -> list[str]:
    """Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return [*lines, *("| " + " | ".join(str(v) for v in row) + " |" for row in rows), ""]


def figures(cases: list[Case]) -> list[str]:
    """The figures that have a goal."""
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
        ("95 % intervals that hold the truth", "90 to 99 %", held(effects), held(plain)),
    ]  # fmt: skip
    return table(["figure", "goal", "all cases", "all of it visible"], rows)


def cost(cases: list[Case]) -> list[str]:
    """Wall time, and against the engine alone where the diagnosis says so."""

    def row(name: str, group: list[Case]) -> tuple[object, ...]:
        wall = [float(c.run["seconds"]) for c in group]
        told = [c.said["cost"] for c in group if c.said and c.said.get("cost")]
        told = [t for t in told if t["engine_seconds"]]
        if not wall:
            return name, 0, "", "", "", "not told", "not told"
        middle, most = f"{np.median(wall):.0f} s", f"{max(wall):.0f} s"
        ratios = (ratio(told, engine_seconds), ratio(told, engine_once))
        return name, len(group), f"{sum(wall):.0f} s", middle, most, *ratios

    def ratio(told: list[Cost], engine: Callable[[Cost], float]) -> str:
        if not told:
            return "not told"
        pooled = sum(t["wall_seconds"] for t in told) / sum(map(engine, told))
        middle = np.median([t["wall_seconds"] / engine(t) for t in told])
        return f"{pooled:.2f} (median {middle:.2f} of {len(told)})"

    counts = sorted({len(c.truth["joints"]) for c in cases})
    rows = [row("all", cases)]
    rows += [row(f"{n} joints", [c for c in cases if len(c.truth["joints"]) == n]) for n in counts]
    head = ["cases", "number", "wall time, sum", "median", "most"]
    return table([*head, "wall / engine", "each simulation once"], rows)


Cost = dict[str, float]
"""``cost`` of a diagnosis."""


def engine_seconds(cost: Cost) -> float:
    """s that the engine alone takes for all simulations that were asked for."""
    return cost["engine_seconds"]


def engine_once(cost: Cost) -> float:
    """The same without those that had been asked for before."""
    repeated = cost.get("million_steps_repeated", 0.0)
    return cost["engine_seconds"] * (1.0 - repeated / cost["million_steps"])


def kinds(cases: list[Case]) -> list[str]:
    """Each kind of case by what was said."""
    rows = []
    for kind in ("none", "one", "two", "three", "outside"):
        group = [c for c in cases if c.truth["kind"] == kind]
        verdicts = Counter(c.said["verdict"] if c.said else "no result" for c in group)
        told = ", ".join(f"{v} {n}" for v, n in verdicts.most_common())
        whole = sum(set(c.hidden) == set(c.found) for c in group if c.said)
        wrong = sum(bool(set(c.found) - set(c.hidden)) for c in group)
        rows.append((kind, len(group), whole, wrong, told))
    head = ["hidden", "cases", "named in full, nothing else", "with a wrong name", "verdicts"]
    return table(head, rows)


def outsiders(cases: list[Case]) -> list[str]:
    """Forces that are in no catalogue, by kind."""
    groups: dict[str, list[dict[str, bool]]] = defaultdict(list)
    for c in cases:
        if c.truth["outside"]:
            groups[c.truth["outside"]["kind"]].append(outside_right(c))
    rows = [
        (kind, len(g), *(sum(r[k] for r in g) for k in ("verdict", "joint", "window")))
        for kind, g in sorted(groups.items())
    ]
    return table(["kind", "cases", "`unexplained`, no name", "right joint", "right window"], rows)


def confusion(cases: list[Case]) -> dict[tuple[str, str], int]:
    """(hidden, said) -> times, over every case with a result.

    A hidden effect that is not named goes with a wrong name at its joint, else with any wrong name
    that is left, else with ``nothing``; a wrong name that is left over with ``nothing`` hidden, or
    ``outside`` where a force is in no catalogue.
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
    """The confusion matrix, its rows written out: what was said of each effect."""
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
    return table(["hidden", "named, alone", "named, in all", "said instead"], rows)


def matrix_table(cases: list[Case]) -> list[str]:
    """The confusion matrix with numbered columns: only what was ever said has one."""
    matrix = confusion(cases)
    hidden = [*EFFECTS, "outside", "nothing"]
    said = [s for s in (*hidden, "no result") if any(k[1] == s for k in matrix)]
    said += sorted({k[1] for k in matrix} - set(said))
    rows = [
        (h, *(matrix.get((h, s), "") for s in said))
        for h in hidden
        if any(h == k[0] for k in matrix)
    ]
    key = [f"{i}: {name}" for i, name in enumerate(said, 1)]
    numbers = [str(i) for i in range(1, len(said) + 1)]
    return [*table(["hidden \\ said", *numbers], rows), "; ".join(key), ""]


def interval_table(cases: list[Case]) -> list[str]:
    """Intervals by parameter, and which cannot be compared."""
    held: dict[tuple[str, str], list[bool | None]] = defaultdict(list)
    for c in cases:
        for effect, name, value in intervals(c):
            held[effect, name].append(value)
    rows = []
    for (effect, name), values in sorted(held.items()):
        known = [v for v in values if v is not None]
        why = len(values) - len(known) or ""
        rows.append((f"{effect}.{name}", f"{sum(known)} of {len(known)}" if known else "", why))
    return table(["parameter", "interval holds the truth", "without interval or truth"], rows)


def failures(cases: list[Case]) -> list[str]:
    """Each case that was not named in full, and nothing else with it."""
    lines = []
    for c in cases:
        said = listed(c.found)
        outside = c.truth["outside"]
        if c.said is None:
            lines.append(f"{c.label}: no diagnosis ({c.run['status']}); hidden {listed(c.hidden)}")
        elif outside:
            right = outside_right(c)
            if not all(right.values()):
                wrong = ", ".join(k for k, v in right.items() if not v)
                at = ", ".join(c.said["unexplained"]) or "no joint"
                lines.append(
                    f"{c.label}: {outside['kind']} at {outside['joint']}; said {said}, "
                    f"{c.said['verdict']}, unexplained at {at}; wrong: {wrong}"
                )
        elif set(c.hidden) != set(c.found):
            faint = [n for n in c.hidden if n not in c.visible]
            note = f"; below the noise: {listed(faint)}" if faint else ""
            seen = ", ".join(
                f"{e['effect']} {e['joint'] or ''} ({e['visibility']:.3g} sigma)".replace("  ", " ")
                for e in sorted(c.truth["effects"], key=lambda e: -e["visibility"])
            )
            lines.append(f"{c.label}: hidden {seen or 'nothing'}; said {said}{note}")
    return [*(f"- {line}" for line in lines), ""]


def report(cases: list[Case], checked: str) -> str:
    """Everything, as Markdown."""
    none = sum(c.said is None for c in cases)
    faint = sum(len(c.hidden) - len(c.visible) for c in cases)
    confined = sum(bool(c.run.get("confined")) for c in cases)
    parts = [
        f"{len(cases)} cases, {none} without a result; {faint} hidden effects below the sensors' "
        f"noise. {checked} Kept by the kernel from every file but the case's and the programs': "
        f"{confined} of {len(cases)}.", "", *figures(cases), *cost(cases), "By what is hidden:", "",
        *kinds(cases), "Outside the catalogue:", "", *outsiders(cases),
        "What was said of each effect, alone or beside others:", "", *by_effect(cases),
        "The same as a matrix:", "", *matrix_table(cases),
        "Intervals, of effects that are named right:", "", *interval_table(cases),
        "Every case that was not named in full, or more with it:", "", *failures(cases),
    ]  # fmt: skip
    return "\n".join(parts)


def checked_digests(truth: Path, committed: Path, names: Iterable[str]) -> tuple[str, bool]:
    """What to say of the truth files of cases, and whether all of them are the committed ones."""
    was = json.loads(committed.read_text()) if committed.exists() else {}
    now = truth_digests(truth)
    files = [f"{name}.json" for name in names]
    other = [f for f in files if was.get(f) != now[f]]
    if other:
        told = ", ".join(other[:5]) + (", ..." if len(other) > 5 else "")
        return f"**Not the committed truth ({committed.name}): {len(other)} files, {told}.**", False
    return f"Every truth file is the committed one ({committed.name}).", True


def main() -> int:
    """Write digests, or the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--results", type=Path)
    parser.add_argument("--digests", type=Path, help="write the digests of the truth files there")
    parser.add_argument(
        "--committed", type=Path, default=Path(__file__).with_name("truth_digests.json")
    )
    parser.add_argument("--out", type=Path, help="write the report there, not to standard output")
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
    if args.out is None:
        print(text)
    else:
        args.out.write_text(text)
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
