"""Sensitivity of diagnoses to their thresholds.

    python benchmarks/sensitivity.py --out DIR [--minutes 60] [--page FILE] [FIELD ...]

Each number in a settings object of ``pytest_twin.diagnosis`` is halved and doubled, one at a time,
and small cases are diagnosed again. In each case, a pendulum or an arm of one joint is integrated
at 4 or 10 kHz with one effect, two effects, or none that the model lacks. Two further cases of one
joint are drawn as the blind cases are, from training seeds. A field is tried only in cases whose
diagnosis reads it. No diagnosis has a time limit, so the load of the machine does not change the
result.

Half of the changes need no run. One run of each case follows half and twice of every number through
all computations (``variants.py``). If each comparison has the same outcome, the result is the same.
The other changes are run, each in its quickest case first. All results are stored below DIR, in a
folder for the code that they are of. A second run with the same code continues the first one.

Writes DIR/sensitivity.md: for each field its value, how many cases read it, what each change does
to the answers, and which fields are not tried yet.

FIELD: ``CLASS`` or ``CLASS.field``, such as ``SelectionSettings.earns``, to be tried in this run;
all by default. The page has all fields.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import importlib
import json
import pkgutil
import shutil
import sys
import textwrap
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent / "concealed"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "diagnosis"))

import cases as concealed
import recorded_pendulum
import touching_arm
import two_pendulums
from record import revision
from variants import WithVariants

import pytest_twin
import pytest_twin.diagnosis
from pytest_twin.diagnosis.diagnose import diagnose
from pytest_twin.diagnosis.first_answer import first_answer
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.formats import atomic
from pytest_twin.loaded_model import load_model

Answer = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """One case: its name in the table, and functions that write its files and diagnose it."""

    name: str
    write: Callable[[Path], object]
    diagnose: Callable[[Path], Answer]

    def answer(self, out: Path) -> Answer:
        """Return its result; ``out`` has a folder of model and recordings for each case."""
        folder = self.folder(out)
        if not folder.exists():
            unfinished = folder.with_suffix(".unfinished")
            shutil.rmtree(unfinished, ignore_errors=True)
            self.write(unfinished)
            unfinished.rename(folder)
        return self.diagnose(folder)

    def folder(self, out: Path) -> Path:
        """Folder of its model and recordings."""
        return out / "cases" / self.name.replace(" ", "_")


def full_diagnosis(folder: Path) -> Answer:
    """Verdict, parameters of the findings, and number of simulations of a diagnosis."""
    loaded = load_model(folder / "model.xml")
    files = sorted(folder.glob("*.mcap"))
    trials = read_trials(files, [], loaded.topics, loaded.realization.structure)
    found = diagnose(loaded.realization, trials, threads=1)
    return {
        "verdict": found.verdict,
        "findings": {
            f"{f.effect} at {f.joint}": {name: e.value for name, e in f.parameters.items()}
            for f in found.explanation.findings
            if not f.small
        },
        "simulations": round(found.cost.simulations),
    }


def first_diagnosis(folder: Path) -> Answer:
    """Return the quick diagnosis of the recordings that are not held out."""
    loaded = load_model(folder / "model.xml")
    files = sorted(folder.glob("*.mcap"))
    trials = read_trials(files, [], loaded.topics, loaded.realization.structure)
    found = first_answer(loaded.realization, trials.fit, None, 1e6)
    if found is None:
        return {"verdict": "no first answer", "findings": {}, "simulations": 0}
    return {
        "verdict": f"error at {found.joint}: {found.where.summary}",
        "findings": {
            f"{s.place[0]} at {', '.join(s.place[1])}, else {[e for e, _ in s.alternatives]}": {
                name: value for name, (value, _) in s.values.items()
            }
            for s in found.likely_effects
        },
        "simulations": 0,
    }


def pendulum(**hidden: float) -> Callable[[Path], object]:
    """Return a function that writes a pendulum with effects that the model lacks."""
    return lambda folder: two_pendulums.case(folder, ("left",), seconds=0.8, metadata={}, **hidden)


def logged_effort(folder: Path) -> None:
    """A pendulum with dry friction whose log has the effort, 6 ms late, and the velocity."""
    reality = recorded_pendulum.Reality(
        dry=3.0, effort="measured", effort_late=0.006, velocity="sensor"
    )
    recorded_pendulum.cell(folder, reality, (2, 3, 4), seconds=1.0)


def table_too_high(folder: Path) -> None:
    """An arm of one joint whose tip touches a table 4 mm higher than the model's."""
    folder.mkdir(parents=True, exist_ok=True)
    touching_arm.case(folder, ("left",), seconds=1.0, offset=0.004)


def training_case(seed: int) -> Callable[[Path], object]:
    """Return a function that writes a case of a training seed: 6 s to fit and 6 s held out."""

    def write(folder: Path) -> None:
        whole, concealed.DURATION = concealed.DURATION, 6.0
        try:
            name = concealed.make(seed, folder / "drawn", folder / "truth")
        finally:
            concealed.DURATION = whole
        shutil.copy(folder / "drawn" / name / "model.xml", folder)
        recordings = sorted((folder / "drawn" / name / "recordings").iterdir())
        for recording in (recordings[0], recordings[-1]):
            shutil.copy(recording, folder)

    return write


CASES = (
    Case("first answer", pendulum(delay=0.02), first_diagnosis),
    Case("nothing", pendulum(), full_diagnosis),
    Case("friction and lag", pendulum(dry=0.08, lag=0.01), full_diagnosis),
    Case("contact", table_too_high, full_diagnosis),
    Case("logged effort", logged_effort, full_diagnosis),
    Case("stick-slip", pendulum(dry=0.3), full_diagnosis),
    Case("delay", pendulum(delay=0.02), full_diagnosis),
    Case("unnamed force", pendulum(magnet=0.2), full_diagnosis),
    Case("training seed 5015", training_case(5015), full_diagnosis),
    Case("training seed 5023", training_case(5023), full_diagnosis),
)
HEAD = """# How sensitive a diagnosis is to its thresholds

<!-- Written by benchmarks/sensitivity.py. -->

Each number in a settings object is halved and doubled, one at a time, and small cases are diagnosed
again. `python benchmarks/sensitivity.py --out DIR --page docs/sensitivity.md` continues the answers
in DIR and writes this page. The cases: {cases}. `cases` is how many of them read the field. Half of
the changes need no run: one run of each case follows half and twice of every number through all
computations, and if each comparison has the same outcome, so has the diagnosis. `runs` is how many
of the other changes were run, the quickest cases first. `same` means the same verdict, the same
findings, and parameters within 1 %. A field that no case reads is not shown to be without
influence, and neither is one whose changes were run in some cases only. `tests` is how many tests
depend on the field: some comparison in them has another outcome with half or twice of the number
(`python benchmarks/shown_by_tests.py --out DIR tests/diagnosis`; child processes of tests are not
followed). Fields without a row were not measured. Revision `{revision}`, {date}.

"""
FACTORS = (0.5, 2.0)
SAME_SHARE = 0.01
"""Largest relative difference of parameters for which results are equal."""


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
        """Context in which the settings object has this value."""
        object.__setattr__(self.owner, self.attribute, value)
        try:
            yield
        finally:
            object.__setattr__(self.owner, self.attribute, self.value)


def settings_fields() -> list[Field]:
    """Return every number of every settings object of the diagnosis."""
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
        if type(getattr(owner, field.name)) in (int, float)
    ]


Change = tuple[str, float]
"""Name of a field and the factor on its value."""


@dataclass(frozen=True)
class Traced:
    """What a diagnosis of one case depends on.

    Attributes:
        read: names of the thresholds that it reads.
        altering: changes of thresholds that may change its result.
    """

    read: frozenset[str]
    altering: frozenset[Change]


@contextmanager
def followed(fields: list[Field]) -> Iterator[tuple[set[str], set[Change]]]:
    """Context that collects the fields that are read, and the changes that may alter the result."""
    read: set[str] = set()
    altering: set[Change] = set()
    known = {(type(field.owner), field.attribute): field for field in fields}

    def noting(owner: object, attribute: str) -> object:
        field = known.get((type(owner), attribute))
        if field is None:
            return object.__getattribute__(owner, attribute)
        read.add(field.name)
        variants = {(field.name, factor): field.changed(factor) for factor in FACTORS}
        return WithVariants(field.value, variants, altering)

    owners = {type(field.owner) for field in fields}
    for owner in owners:
        owner.__getattribute__ = noting
    try:
        yield read, altering
    finally:
        for owner in owners:
            del owner.__getattribute__


def traced(case: Case, fields: list[Field], usual: Answer, out: Path) -> Traced:
    """Follow every field through one run of a case.

    A run that ends otherwise than the usual one shows nothing: all that it reads may alter it.
    """
    with followed(fields) as (read, altering):
        try:
            same = case.answer(out) == usual
        except Exception as error:
            print(f"{case.name}: cannot be followed: {error!r}", flush=True)
            same = False
    every = {(name, factor) for name in read for factor in FACTORS}
    return Traced(frozenset(read), frozenset(altering if same else every))


@dataclass(frozen=True)
class Result:
    """Result of a case with the usual settings.

    Attributes:
        answer: what the diagnosis returns.
        seconds: CPU time of the diagnosis, s.
        traced: settings that it reads, and changes that may alter it.
    """

    answer: Answer
    seconds: float
    traced: Traced


def stored_path(case: Case, out: Path) -> Path:
    """File with the usual result of a case."""
    return out / f"{case.folder(out).name}.json"


def usual_result(case: Case, fields: list[Field], out: Path) -> Result:
    """Diagnose and trace a case with the usual settings, or read the stored result."""
    path = stored_path(case, out)
    if not path.exists():
        since = time.process_time()
        answer = case.answer(out)
        seconds = time.process_time() - since
        found = traced(case, fields, answer, out)
        stored = {
            "answer": answer,
            "seconds": seconds,
            "read": sorted(found.read),
            "altering": sorted(found.altering),
        }
        atomic.write_text(path, json.dumps(stored))
        counts = f"reads {len(found.read)} fields, {len(found.altering)} changes may alter it"
        print(f"{case.name}: {seconds:.0f} s, {counts}: {json.dumps(answer)}", flush=True)
    stored = json.loads(path.read_text())
    altering = frozenset((name, factor) for name, factor in stored["altering"])
    return Result(stored["answer"], stored["seconds"], Traced(frozenset(stored["read"]), altering))


def code_digest() -> str:
    """Digest of the code that the results depend on: the package and the plants of the cases."""
    plants = (recorded_pendulum, touching_arm, two_pendulums, concealed)
    package = Path(pytest_twin.__file__).parent
    files = [*package.rglob("*.py"), *(Path(str(module.__file__)) for module in plants)]
    total = hashlib.sha256()
    for file in sorted(files):
        total.update(file.read_bytes())
    return total.hexdigest()[:12]


def difference(base: dict[str, Any], other: dict[str, Any]) -> str:
    """Describe the differences of a result; empty if there are none."""
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
    """Results by case, field and value, in a file to which lines are appended."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.known: dict[tuple[str, str, float], dict[str, Any]] = {}
        if path.exists():
            for line in path.read_text().splitlines():
                entry = json.loads(line)
                key = entry["case"], entry["field"], entry["value"]
                self.known[key] = entry["answer"]

    def add(self, case: str, field: str, value: float, said: dict[str, Any]) -> None:
        """Store one result."""
        self.known[case, field, value] = said
        entry = {"case": case, "field": field, "value": value, "answer": said}
        with self.path.open("a") as stream:
            stream.write(json.dumps(entry) + "\n")


def tests_of_fields(out: Path) -> Counter[str]:
    """Return field -> number of tests that depend on it, from ``shown_by_tests.py``."""
    path = out / "tests.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    found = {entry["test"]: entry["altering"] for entry in map(json.loads, lines)}
    return Counter(name for changes in found.values() for name in {name for name, _ in changes})


def row(
    field: Field,
    answers: Answers,
    base: dict[str, Answer],
    trace: dict[str, Traced],
    tests: Counter[str],
) -> str | None:
    """Return the field's line of the table; None if a change that may matter has no run yet."""
    reading = [case for case in base if field.name in trace[case].read]
    head = f"| `{field.name}` | {field.value:g} | {tests[field.name]} | {len(reading)} |"
    if not reading:
        return f"{head} | read in no case | read in no case |"
    runs = needed = 0
    cells = []
    for factor in FACTORS:
        value = field.changed(factor)
        if value == field.value:
            cells.append("(rounds to the value)")
            continue
        altered = [case for case in reading if (field.name, factor) in trace[case].altering]
        run = [case for case in altered if (case, field.name, value) in answers.known]
        if altered and not run:
            return None
        runs += len(run)
        needed += len(altered)
        words = [
            f"{case}: {different}"
            for case in run
            if (different := difference(base[case], answers.known[case, field.name, value]))
        ]
        cells.append("; ".join(words) or "same")
    count = f"{runs} of {needed}" if needed else ""
    return f"{head} {count} | {' | '.join(cells)} |"


def table(
    fields: list[Field],
    answers: Answers,
    base: dict[str, Answer],
    trace: dict[str, Traced],
    tests: Counter[str],
) -> str:
    """Return the page with one line for each field whose changes are known in some case."""
    lines = [row(field, answers, base, trace, tests) for field in fields]
    done = [line for line in lines if line is not None]
    head = [
        "| field | value | tests | cases | runs | halved | doubled |",
        "|---|---|---|---|---|---|---|",
    ]
    text = "\n".join([*head, *done]) + "\n"
    untried = [f.name for f, line in zip(fields, lines, strict=True) if line is None]
    if untried:
        names = textwrap.fill(", ".join(f"`{name}`" for name in untried), 100)
        text += f"\n{len(untried)} of {len(lines)} fields are not measured yet:\n{names}\n"
    return text


def attempt(case: Case, field: Field, value: float, answers: Answers, out: Path) -> None:
    """Diagnose a case with one field changed, unless its result is known."""
    if value == field.value or (case.name, field.name, value) in answers.known:
        return
    with field.set_to(value):
        try:
            said = case.answer(out)
        except Exception as error:
            said = {"error": type(error).__name__}
    answers.add(case.name, field.name, value, said)
    print(f"{field.name} = {value:g}: {case.name}: {said}", flush=True)


def main() -> int:
    """Run; see the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("fields", metavar="FIELD", nargs="*", help="all by default")
    parser.add_argument("--out", type=Path, required=True, help="folder of answers and the table")
    parser.add_argument("--minutes", type=float, default=60.0, help="stop after so many")
    parser.add_argument("--page", type=Path, help="page of the documentation to write")
    args = parser.parse_args()
    until = time.monotonic() + 60.0 * args.minutes
    out = args.out / code_digest()
    out.mkdir(parents=True, exist_ok=True)
    answers = Answers(out / "answers.jsonl")
    fields = settings_fields()
    tried = [
        field
        for field in fields
        if not args.fields or {field.name, field.name.partition(".")[0]} & {*args.fields}
    ]
    results = {}
    for case in CASES:
        if time.monotonic() < until or stored_path(case, out).exists():
            results[case.name] = usual_result(case, fields, out)
    base = {name: one.answer for name, one in results.items()}
    trace = {name: one.traced for name, one in results.items()}
    known = [case for case in CASES if case.name in results]
    quickest_first = sorted(known, key=lambda case: results[case.name].seconds)
    for turn in range(len(known)):
        # The quickest case of each change first, then the second, ...
        for field, factor in product(tried, FACTORS):
            change = field.name, factor
            cases = [c for c in quickest_first if change in trace[c.name].altering]
            for case in cases[turn : turn + 1]:
                if time.monotonic() < until:
                    attempt(case, field, field.changed(factor), answers, out)
    head = HEAD.format(
        cases=", ".join(case.name for case in known),
        revision=revision(),
        date=datetime.now(UTC).strftime("%Y-%m-%d"),
    )
    text = table(fields, answers, base, trace, tests_of_fields(out))
    for path in filter(None, (args.out / "sensitivity.md", args.page)):
        path.write_text(head + text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
