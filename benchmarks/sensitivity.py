"""How far the answers of a diagnosis depend on its thresholds.

    python benchmarks/sensitivity.py --out DIR [--minutes 60] [FIELD ...]

Each number in a settings object of ``pytest_twin.diagnosis`` is halved and doubled, one at a time,
and small cases are diagnosed again: a pendulum whose reality is integrated at 10 kHz, with one
effect, with two, and with none. A field that no function reads in a case is not tried there.
Answers are kept in DIR/answers.jsonl, so that a second run goes on where the first one stopped.
Writes DIR/sensitivity.md: for each field its value, what each change does to the answers, and the
simulations that the searches take.

FIELD: ``CLASS`` or ``CLASS.field``, such as ``SelectionSettings.earns``; all by default.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import json
import pkgutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "diagnosis"))

import two_pendulums

import pytest_twin.diagnosis
from pytest_twin.commands.replay import load_model
from pytest_twin.diagnosis.diagnose import diagnose
from pytest_twin.diagnosis.trials import read_trials

CASES: dict[str, dict[str, float]] = {
    "delay": {"delay": 0.02},
    "friction and lag": {"dry": 0.08, "lag": 0.01},
    "nothing": {},
}
FACTORS = (0.5, 2.0)
SAME_SHARE = 0.01
"""Of a parameter's value, by which answers may differ and count as the same."""


@dataclass(frozen=True)
class Field:
    """One number in a settings object; ``name`` is ``CLASS.attribute``."""

    name: str
    owner: Any
    attribute: str
    value: float

    def changed(self, factor: float) -> float | int:
        """The value times a factor; whole numbers stay whole and above zero."""
        scaled = self.value * factor
        return max(1, round(scaled)) if isinstance(self.value, int) else scaled

    @contextmanager
    def set_to(self, value: float) -> Iterator[None]:
        """Within, the settings object has this value."""
        object.__setattr__(self.owner, self.attribute, value)
        try:
            yield
        finally:
            object.__setattr__(self.owner, self.attribute, self.value)


def settings_fields() -> list[Field]:
    """Every number of every settings object of the diagnosis."""
    found: list[Any] = []
    package = pytest_twin.diagnosis
    for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        module = importlib.import_module(info.name)
        for value in vars(module).values():
            if (
                dataclasses.is_dataclass(value)
                and not isinstance(value, type)
                and type(value).__module__ == info.name
                and type(value).__name__.endswith("Settings")
            ):
                found.append(value)
    return [
        Field(f"{type(owner).__name__}.{field.name}", owner, field.name, getattr(owner, field.name))
        for owner in found
        for field in dataclasses.fields(owner)
        if isinstance(getattr(owner, field.name), int | float)
    ]


def answer(folder: Path) -> dict[str, Any]:
    """What the diagnosis of a case says, and its cost."""
    loaded = load_model(folder / "model.xml")
    files = sorted(folder.glob("*.mcap"))
    trials = read_trials(files, [], loaded.topics, loaded.realization.structure)
    found = diagnose(loaded.realization, trials, threads=1)
    return {
        "verdict": found.verdict,
        "findings": {
            f"{f.effect} at {f.joint}": {name: e.value for name, e in f.parameters.items()}
            for f in found.explained.findings
            if not f.small
        },
        "simulations": round(found.cost.simulations),
    }


def names_read(folder: Path) -> tuple[dict[str, Any], set[str]]:
    """The answer to a case, and all attribute names in the functions that the diagnosis called."""
    codes = set()

    def note(frame: Any, event: str, argument: object) -> None:
        if event == "call" and "pytest_twin/diagnosis" in frame.f_code.co_filename:
            codes.add(frame.f_code)

    sys.setprofile(note)
    try:
        said = answer(folder)
    finally:
        sys.setprofile(None)
    return said, {name for code in codes for name in code.co_names}


def difference(base: dict[str, Any], other: dict[str, Any]) -> str:
    """What is different about an answer, in words; empty where nothing is."""
    if "error" in other:
        return f"ends with {other['error']}"
    words = []
    if other["verdict"] != base["verdict"]:
        words.append(f"{base['verdict']} becomes {other['verdict']}")
    if set(other["findings"]) != set(base["findings"]):
        words.append(f"names {', '.join(other['findings']) or 'nothing'}")
    else:
        off = max(
            (
                abs(other["findings"][effect][name] - value) / max(abs(value), 1e-6)
                for effect, parameters in base["findings"].items()
                for name, value in parameters.items()
            ),
            default=0.0,
        )
        if off > SAME_SHARE:
            words.append(f"values by up to {100 * off:.1f} %")
    return "; ".join(words)


class Answers:
    """Answers by case, field and value, in a file that grows."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.known: dict[tuple[str, str, float], dict[str, Any]] = {}
        if path.exists():
            for line in path.read_text().splitlines():
                entry = json.loads(line)
                key = entry["case"], entry["field"], entry["value"]
                self.known[key] = entry["answer"]

    def add(self, case: str, field: str, value: float, said: dict[str, Any]) -> None:
        """Keep one answer."""
        self.known[case, field, value] = said
        entry = {"case": case, "field": field, "value": value, "answer": said}
        with self.path.open("a") as stream:
            stream.write(json.dumps(entry) + "\n")


def row(
    field: Field, answers: Answers, base: dict[str, dict[str, Any]], read: dict[str, set[str]]
) -> str | None:
    """The field's line of the table; None where not all its runs are done."""
    cells, simulations = [], []
    cases = [case for case in CASES if field.attribute in read[case]]
    for factor in FACTORS:
        value = field.changed(factor)
        words, total = [], 0
        for case in cases if value != field.value else []:
            said = answers.known.get((case, field.name, value))
            if said is None:
                return None
            total += said.get("simulations", 0)
            if different := difference(base[case], said):
                words.append(f"{case}: {different}")
        cells.append("; ".join(words) or "same")
        simulations.append(f"{total}" if total else "")
    if not cases:
        cells, simulations = ["read in no case"] * 2, [""] * 2
    usual = sum(base[case]["simulations"] for case in cases)
    work = f"{simulations[0] or usual} / {usual} / {simulations[1] or usual}" if cases else ""
    return f"| `{field.name}` | {field.value:g} | {cells[0]} | {cells[1]} | {work} |"


def table(
    fields: list[Field],
    answers: Answers,
    base: dict[str, dict[str, Any]],
    read: dict[str, set[str]],
) -> str:
    """The page: one line for each field whose runs are done."""
    lines = [row(field, answers, base, read) for field in fields]
    done = [line for line in lines if line is not None]
    head = [
        "| field | value | halved | doubled | simulations: halved / as it is / doubled |",
        "|---|---|---|---|---|",
    ]
    rest = f"\n{len(lines) - len(done)} of {len(lines)} fields are not tried yet.\n"
    return "\n".join([*head, *done]) + "\n" + (rest if len(done) < len(lines) else "")


def main() -> int:
    """Run; see the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("fields", metavar="FIELD", nargs="*", help="all by default")
    parser.add_argument("--out", type=Path, required=True, help="folder of answers and the table")
    parser.add_argument("--minutes", type=float, default=60.0, help="stop after so many")
    args = parser.parse_args()
    until = time.monotonic() + 60.0 * args.minutes
    args.out.mkdir(parents=True, exist_ok=True)
    answers = Answers(args.out / "answers.jsonl")
    fields = [
        field
        for field in settings_fields()
        if not args.fields or {field.name, field.name.partition(".")[0]} & {*args.fields}
    ]
    base: dict[str, dict[str, Any]] = {}
    read: dict[str, set[str]] = {}
    for case, hidden in CASES.items():
        folder = args.out / "cases" / case.replace(" ", "_")
        two_pendulums.case(folder, ("left",), **hidden)
        base[case], read[case] = names_read(folder)
        print(f"{case}: {json.dumps(base[case])}", flush=True)
    for field in fields:
        for factor in FACTORS:
            value = field.changed(factor)
            for case in CASES:
                known = (case, field.name, value) in answers.known
                if known or value == field.value or field.attribute not in read[case]:
                    continue
                if time.monotonic() > until:
                    break
                with field.set_to(value):
                    try:
                        said = answer(args.out / "cases" / case.replace(" ", "_"))
                    except Exception as error:
                        said = {"error": type(error).__name__}
                answers.add(case, field.name, value, said)
                print(f"{field.name} = {value:g}: {case}: {said}", flush=True)
    (args.out / "sensitivity.md").write_text(table(fields, answers, base, read))
    return 0


if __name__ == "__main__":
    sys.exit(main())
