"""The frozen yardstick: problems with known answers, by which two searches are compared.

    python benchmarks/yardstick.py list [ROW ...]
    python benchmarks/yardstick.py run --answers FILE [--entry MODULE:FUNCTION] [ROW ...]
    python benchmarks/yardstick.py compare OLD [NEW]
    python benchmarks/yardstick.py freeze [ROW ...]

A row is a problem and a time limit, such as ``table/backlash@none``; ROW is a pattern such as
``table/*`` or ``*@none``. ``run`` answers the rows that FILE lacks and appends a line of JSON for
each, so that a killed run goes on where it was. ``compare`` prints old answers beside new ones, row
by row and pooled by family; its exit status is 1 if a row is worse. ``frozen/comparison.py``
defines that. ``--entry`` names a function that gets the arguments of ``pytest-twin`` and returns
the exit status, for a search that is no command yet.

Inputs are drawn from seeds, or read from folders that ``TWIN_RECORDINGS`` (real machines) and
``TWIN_PROBLEMS`` (made recordings) name; rows whose inputs are missing are skipped with a word.
``frozen/digests.json`` has a digest of the inputs of each problem. A row whose inputs have another
digest is not run: its answer could not be compared.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Iterator, Sequence
from fnmatch import fnmatch
from pathlib import Path

from frozen import answer as answers
from frozen import drawn, recorded
from frozen.comparison import Judged, table, worse
from frozen.problem import LIMITS, Inputs, MissingInputError, Problem
from frozen.run_row import ENTRY, run
from record import revision

HERE = Path(__file__).parent
DIGESTS = HERE / "frozen" / "digests.json"
RESULT = {"diagnose": "diagnosis.json", "identify": "identification.json"}
PROCESSOR_SECONDS = 3600
"""Processor time, s, after which a command without a time limit is killed."""


def problems() -> list[Problem]:
    """Return all problems, the quick families first."""
    return [*recorded.problems(), *drawn.problems()]


def rows_of(patterns: Sequence[str]) -> Iterator[tuple[str, Problem, str]]:
    """Yield row, problem and time limit of all rows that a pattern names; all without patterns."""
    for problem in problems():
        for limit in problem.limits:
            row = f"{problem.name}@{limit}"
            if not patterns or any(fnmatch(row, p) or fnmatch(problem.name, p) for p in patterns):
                yield row, problem, limit


def inputs_of(problem: Problem, work: Path) -> Inputs:
    """Write or find the inputs of a problem in its own folder."""
    folder = work / problem.name
    shutil.rmtree(folder, ignore_errors=True)
    return problem.write(folder)


def frozen() -> dict[str, dict[str, object]]:
    """Return problem -> digest of its inputs, and its truth."""
    return dict(json.loads(DIGESTS.read_text())) if DIGESTS.exists() else {}


def freeze(patterns: Sequence[str], work: Path) -> int:
    """Add digest and truth of problems that are not frozen yet."""
    for problem in dict.fromkeys(problem for _, problem, _ in rows_of(patterns)):
        known = frozen()
        if problem.name in known:
            continue
        try:
            inputs = inputs_of(problem, work)
        except MissingInputError as error:
            print(f"{problem.name}: not frozen: {error}", flush=True)
            continue
        known[problem.name] = {"digest": inputs.digest(), "truth": inputs.truth}
        part = DIGESTS.with_suffix(".part")
        part.write_text(_lines_of(known))
        part.replace(DIGESTS)
        print(problem.name, flush=True)
        shutil.rmtree(work / problem.name, ignore_errors=True)
    return 0


def _lines_of(known: dict[str, dict[str, object]]) -> str:
    """Return the file of digests with a line for each problem."""
    lines = [
        f"{json.dumps(name)}: {json.dumps(of, sort_keys=True, separators=(',', ':'))}"
        for name, of in sorted(known.items())
    ]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def answer_row(
    row: str, problem: Problem, limit: str, inputs: Inputs, args: argparse.Namespace
) -> answers.Answer:
    """Run the command of a row and return its answer."""
    folder = args.work / problem.name
    out = folder / "out"
    command = [problem.command, *inputs.arguments(), *LIMITS[limit], "--out", str(out)]
    ended = run(args.entry, command, folder, PROCESSOR_SECONDS if limit == "none" else 0)
    found: answers.Answer = {
        "row": row, "digest": inputs.digest(), "entry": args.entry, "revision": revision(),
        "status": ended.status, "processor_seconds": round(ended.processor_seconds, 1),
        "wall_seconds": round(ended.wall_seconds, 1),
    }  # fmt: skip
    file = out / RESULT[problem.command]
    if not file.is_file():
        return found | {"stderr": ended.stderr}
    document = json.loads(file.read_text())
    if problem.command == "identify":
        return found | answers.of_identification(document)
    found |= answers.of_diagnosis(document)
    names = set(document["trials"]["held_out"])
    held_out = [p for p in (*inputs.fit, *inputs.held_out) if p.name in names]
    found["replayed"] = answers.replayed(out, held_out)
    if inputs.others:
        found["others"] = answers.replayed(out, inputs.others)
    return found


def run_rows(args: argparse.Namespace) -> int:
    """Answer all rows that the file of answers lacks, or that it has of other inputs."""
    for row, problem, limit in rows_of(args.rows):
        digest = frozen().get(problem.name, {}).get("digest")
        known = answers.read(args.answers).get(row)
        if known is not None and known["digest"] == digest:
            continue
        try:
            inputs = inputs_of(problem, args.work)
        except MissingInputError as error:
            print(f"{row}: skipped: {error}", flush=True)
            continue
        if inputs.digest() != digest:
            why = "its inputs are not the frozen ones" if digest else "it is not frozen"
            print(f"{row}: skipped: {why}", flush=True)
            continue
        found = answer_row(row, problem, limit, inputs, args)
        answers.append(args.answers, found)
        print(row, found.get("verdict", found["status"]), f"{found['processor_seconds']:g} s",
              flush=True)  # fmt: skip
        shutil.rmtree(args.work / problem.name, ignore_errors=True)
    return 0


def compare(old_file: Path, new_file: Path | None) -> int:
    """Print the comparison; return 1 if a row is worse."""
    known = frozen()
    old = answers.read(old_file)
    new = None if new_file is None else answers.read(new_file)
    compared = []
    for row, one in old.items():
        truth = known.get(row.rpartition("@")[0], {}).get("truth", {})
        if new is None:
            compared.append((row, Judged(one, truth), None))
        elif row not in new:
            print(f"{row}: not in {new_file}")
        elif new[row]["digest"] != one["digest"]:
            print(f"{row}: not compared: its inputs differ")
        else:
            compared.append((row, Judged(one, truth), Judged(new[row], truth)))
    print("\n".join(table(compared)))
    return int(any(new_one is not None and worse(a, new_one) for _, a, new_one in compared))


def main() -> int:
    """Run a subcommand."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("list", "freeze", "run"):
        sub = commands.add_parser(name)
        sub.add_argument("rows", nargs="*", metavar="ROW", help="patterns; all rows by default")
        sub.add_argument("--work", type=Path, default=Path("yardstick.work").resolve(),
                         help="folder of inputs and results while a row runs")  # fmt: skip
    sub.add_argument("--answers", type=Path, required=True, help="file of answers, continued")
    sub.add_argument("--entry", default=ENTRY, help=f"by default {ENTRY}")
    sub = commands.add_parser("compare")
    sub.add_argument("old", type=Path)
    sub.add_argument("new", type=Path, nargs="?")
    args = parser.parse_args()
    match args.command:
        case "list":
            print("\n".join(row for row, _, _ in rows_of(args.rows)))
            return 0
        case "freeze":
            return freeze(args.rows, args.work.resolve())
        case "compare":
            return compare(args.old, args.new)
    args.work = args.work.resolve()
    return run_rows(args)


if __name__ == "__main__":
    sys.exit(main())
