"""Score diagnoses of cases from real recordings (``real_cases.py``).

    python benchmarks/concealed/real_score.py --truth DIR --results DIR [--out FILE] [--page FILE]
        [--named]

The tables go to ``--out``, and without names of cases between the marks of ``--page``. Digests of
the truth are those of ``score.py``. :func:`verdict_on` is a pure function of a truth file and a
``diagnosis.json``; other tables may use it.

A finding is right where its name and joint are those of a concealed effect or of a name that shows
alike on these recordings (``equivalents``). It is background where the truth names it as physics
of the real machine that the model that follows lacks. Anything else is false, but for a free law
(``unnamed_law`` and the like), which names nothing. Small corrections of model parameters, which a
diagnosis lists apart, are no findings.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

SURE = 0.9
"""Confidence from which a false name counts: a user would act on it."""
NAMELESS = "unnamed_"
"""What the id of a law without a name begins with."""
MARKS = "<!-- real figures -->\n", "<!-- end of real figures -->\n"
"""Lines of a page between which the tables are."""
COMMITTED = Path(__file__).with_name("truth_digests.json")

Named = tuple[str, str | None]


@dataclass(frozen=True)
class Verdict:
    """What a diagnosis got right of one case.

    Attributes:
        first: whether the first finding is the largest concealed effect or alike; None where
            nothing is concealed or there is no result.
        found: share of concealed effects that are named, themselves or alike; None likewise.
        false: names that are neither concealed nor alike nor background, with their confidence.
        removed: share of the held-out squared error above the floor that is gone; None without.
        intervals: for each parameter of a concealed effect that is named itself, whether its
            interval holds the truth.
    """

    first: bool | None
    found: float | None
    false: tuple[tuple[str, str | None, float], ...]
    removed: float | None
    intervals: tuple[bool, ...]

    @property
    def sure_and_false(self) -> tuple[tuple[str, str | None, float], ...]:
        """False names that a user would act on."""
        return tuple(f for f in self.false if f[2] >= SURE)


def accepted(effect: dict[str, Any]) -> set[Named]:
    """Names that are as right as each other for a concealed effect."""
    alike = {(name, joint) for name, joint in effect.get("equivalents", [])}
    return {(effect["effect"], effect["joint"]), *alike}


def verdict_on(truth: dict[str, Any], said: dict[str, Any] | None) -> Verdict:
    """Compare a truth with a ``diagnosis.json``; None without a result."""
    effects = sorted(truth["effects"], key=lambda e: -e["visibility"])
    if said is None:
        missed = False if effects else None
        return Verdict(missed, 0.0 if effects else None, (), None, ())
    findings = [f for f in said["findings"] if f["effect"] != "unnamed_law"]
    named: list[Named] = [(f["effect"], f["joint"]) for f in findings]
    right = set().union(*(accepted(e) for e in effects)) if effects else set()
    background = {(b["effect"], b["joint"]) for b in truth["background"]}
    false = tuple(
        (f["effect"], f["joint"], float(f["confidence"])) for f in findings
        if (f["effect"], f["joint"]) not in right | background
        and not f["effect"].startswith(NAMELESS)
    )  # fmt: skip
    # What the machine has beyond its model may come first, if it is the larger.
    ahead = [n for n in named if n in right or n not in background]
    first = bool(ahead) and ahead[0] in accepted(effects[0]) if effects else None
    found = float(np.mean([bool(accepted(e) & set(named)) for e in effects])) if effects else None
    return Verdict(first, found, false, removed(said), tuple(_intervals(effects, findings)))


def removed(said: dict[str, Any]) -> float | None:
    """Share of the held-out squared error above the floor that is gone, over joints, each in
    multiples of its floor; None where there was none.
    """
    before = after = 0.0
    for joint in said["held_out"].values():
        floor = joint["floor"] ** 2
        before += max(joint["rms_before"] ** 2 - floor, 0.0) / floor
        after += max(joint["rms_after"] ** 2 - floor, 0.0) / floor
    return None if before < 1.0 else 1.0 - after / before


def _intervals(
    effects: Sequence[dict[str, Any]], findings: Sequence[dict[str, Any]]
) -> Iterable[bool]:
    for effect in effects:
        for finding in findings:
            if (finding["effect"], finding["joint"]) != (effect["effect"], effect["joint"]):
                continue
            for name, parameter in finding["parameters"].items():
                true, bounds = effect["parameters"].get(name), parameter.get("ci95")
                if true is not None and bounds and None not in bounds:
                    yield bool(bounds[0] <= true <= bounds[1])


@dataclass(frozen=True)
class Scored:
    """A case: its truth, how its run ended, what was said, and how right that is."""

    truth: dict[str, Any]
    run: dict[str, Any]
    said: dict[str, Any] | None
    verdict: Verdict


def load(truth: Path, results: Path) -> list[Scored]:
    """Every case that was diagnosed, with or without a result."""
    out = []
    for path in sorted(truth.glob("real*.json")):
        hidden = json.loads(path.read_text())
        run = results / f"{hidden['case']}.run.json"
        if run.exists():
            file = results / hidden["case"] / "diagnosis.json"
            said = json.loads(file.read_text()) if file.exists() else None
            out.append(Scored(hidden, json.loads(run.read_text()), said, verdict_on(hidden, said)))
    return out


def share(values: Iterable[bool]) -> str:
    """Count of count, and per cent."""
    values = list(values)
    if not values:
        return "none"
    return f"{sum(values)} of {len(values)} ({np.mean(values):.0%})"


def figures(cases: Sequence[Scored]) -> list[str]:
    """Rows with a goal: all cases, and those with a result alone."""
    ended = [c for c in cases if c.said is not None]

    def row(words: str, goal: str, of: Any) -> str:
        return f"| {words} | {goal} | {of(cases)} | {of(ended)} |"

    def concealing(group: Sequence[Scored]) -> list[Scored]:
        return [c for c in group if c.truth["effects"]]

    def nothing(group: Sequence[Scored]) -> list[Scored]:
        return [c for c in group if not c.truth["effects"] and c.said is not None]

    def gone(group: Sequence[Scored]) -> str:
        values = [c.verdict.removed for c in concealing(group) if c.verdict.removed is not None]
        return f"{np.median(values):.1%} of {len(values)}" if values else "none"

    return [
        "| figure | goal | all cases | cases with a result |",
        "|---|---|---|---|",
        row("the largest concealed effect named first, on the right joint", "95 %",
            lambda g: share(bool(c.verdict.first) for c in concealing(g))),
        row("every concealed effect named, itself or alike", "",
            lambda g: share(c.verdict.found == 1.0 for c in concealing(g))),
        row("cases with a name at 0.9 or more that is neither concealed nor background",
            "at most 1 in 20",
            lambda g: share(bool(c.verdict.sure_and_false) for c in concealing(g) if c.said)),
        row("cases with a false name at 0.9 or more where nothing is concealed", "0",
            lambda g: share(bool(c.verdict.sure_and_false) for c in nothing(g))),
        row("held-out squared error above the floor removed, median", "95 %", gone),
        row("95 % intervals that hold the concealed value", "90 to 99 %",
            lambda g: share(v for c in g for v in c.verdict.intervals)),
        "",
    ]  # fmt: skip


def by(cases: Sequence[Scored], head: str, key: Any) -> list[str]:
    """A table by machine or by effect."""
    groups: dict[str, list[Scored]] = defaultdict(list)
    for c in cases:
        groups[key(c)].append(c)
    lines = [f"| {head} | cases | without a result | first name right | with a false name at 0.9 |",
             "|---|---|---|---|---|"]  # fmt: skip
    for name, group in sorted(groups.items()):
        known = [c for c in group if c.truth["effects"]]
        right = f"{sum(bool(c.verdict.first) for c in known)} of {len(known)}" if known else ""
        missing = sum(c.said is None for c in group)
        false = sum(bool(c.verdict.sure_and_false) for c in group)
        lines.append(f"| {name} | {len(group)} | {missing} | {right} | {false} |")
    return [*lines, ""]


def concealed_in(case: Scored) -> str:
    """The effects of a case, or how its recordings were disturbed."""
    names = " + ".join(sorted(e["effect"] for e in case.truth["effects"]))
    if names:
        return names
    return "nothing, readings disturbed" if case.truth["disturbed"] else "nothing"


def listed(cases: Sequence[Scored], *, named: bool) -> list[str]:
    """A line for each case: what was concealed, what was said."""
    lines = []
    for c in cases:
        t = c.truth
        label = f"{t['case']}, {t['machine']}" if named else t["machine"]
        hidden = ", ".join(
            f"{e['effect']} {e['joint'] or ''} ({e['visibility']:g} times the background)".replace(
                "  ", " "
            )
            for e in t["effects"]
        )
        hidden = hidden or t["disturbed"] or "nothing"
        if c.said is None:
            lines.append(f"- {label}: {hidden}; no result within the limit")
            continue
        found = ", ".join(
            f"{f['effect']} {f['joint'] or ''} {f['confidence']:.2f}".replace("  ", " ")
            for f in c.said["findings"]
        )
        lines.append(f"- {label}: {hidden}; found {found or 'nothing'} ({c.said['verdict']})")
    return [*lines, ""]


def report(cases: Sequence[Scored], checked: str, *, named: bool = True) -> str:
    """All tables as Markdown."""
    without = sum(c.said is None for c in cases)
    parts = [
        f"{len(cases)} cases, {without} without a result. {checked}", "", *figures(cases),
        "By machine:", "", *by(cases, "machine", lambda c: c.truth["machine"]),
        "By what is concealed:", "", *by(cases, "concealed", concealed_in),
        "Case by case:", "", *listed(cases, named=named),
    ]  # fmt: skip
    return "\n".join(parts)


def write_between_marks(page: Path, text: str) -> None:
    """Replace what a page has between ``MARKS``.

    Raises:
        SystemExit: the page has no such lines.
    """
    start, end = MARKS
    before, _, rest = page.read_text().partition(start)
    _, found, after = rest.partition(end)
    if not found:
        raise SystemExit(f"{page}: expected the lines {start.strip()} and {end.strip()}")
    page.write_text(f"{before}{start}{text}{end}{after}")


def main() -> int:
    """Write the report; 1 where a truth file is not the committed one."""
    from score import checked_digests  # needs the plant's numba

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--out", type=Path, help="write the tables there, not to standard output")
    parser.add_argument("--page", type=Path, help="page that gets the tables between its marks")
    args = parser.parse_args()
    cases = load(args.truth, args.results)
    if not cases:
        parser.error(f"{args.results}: no real*.run.json of a case in {args.truth}")
    told, same = checked_digests(args.truth, COMMITTED, (c.truth["case"] for c in cases))
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
