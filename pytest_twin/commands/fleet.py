"""The option ``--fleet``: diagnose or follow several robots."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from pytest_twin.commands import json_output
from pytest_twin.commands.terminal import show
from pytest_twin.errors import SpecError, TwinError
from pytest_twin.formats import atomic, results, yaml
from pytest_twin.formats.declared_inputs import DeclaredInputs, declared_inputs, declaring
from pytest_twin.formats.file_names import portable_name
from pytest_twin.gate.failure_diagnosis import REPORT_FILE
from pytest_twin.interrupts import StopRequest, stop_on_interrupt
from pytest_twin.realization.executor import Dask, Executor, Forks
from pytest_twin.realization.forks import usable_cores
from pytest_twin.report.text import printable

FLEET_FILE = "fleet.json"
_FIELDS = frozenset({"model", "recordings", "held_out"})
_MOST_ROBOTS = 1000
"""Largest number of robots in a fleet file."""


@dataclass(frozen=True, slots=True)
class Robot:
    """One robot of a fleet.

    Attributes:
        name: name of the robot and of its folder.
        model: MJCF, URDF or ``twin.yaml``, or the folder of an earlier diagnosis.
        recordings, held_out: files and folders, as for ``diagnose``.
    """

    name: str
    model: Path
    recordings: tuple[Path, ...]
    held_out: tuple[Path, ...] = ()


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result for one robot.

    Attributes:
        verdict: verdict of its diagnosis; None if its input cannot be used, or if it was not
            tried.
        error: the reason in that case.
        seconds: wall time, s.
        is_tried: whether its diagnosis began before the fleet was stopped.
    """

    name: str
    verdict: str | None
    error: str = ""
    seconds: float = 0.0
    is_tried: bool = True


@dataclass(frozen=True, slots=True)
class Options:
    """Options that all robots of a fleet share.

    Attributes:
        out: parent of the folders of all robots.
        threads: cores of each diagnosis, 0 for all.
        arguments: fields of ``DiagnosisRequest`` other than files.
        declared: folders that the command line declares.
        stop: request that ends the running diagnoses early; the others do not begin.
    """

    out: Path
    threads: int = 0
    arguments: Mapping[str, Any] = field(default_factory=dict)
    declared: DeclaredInputs = field(default_factory=DeclaredInputs)
    stop: StopRequest | None = None


def read_fleet(path: Path) -> list[Robot]:
    """Read the robots of a fleet file; paths are relative to it.

    Raises:
        SpecError: a field is missing, unknown or not a path; with its line.
        FormatError: not strict YAML.
    """
    document = yaml.load(path)

    def refuse(where: str, problem: str, expected: str, value: object = None) -> SpecError:
        return SpecError(
            problem, path=path, line=document.lines.get(where), where=where, value=value,
            expected=expected,
        )  # fmt: skip

    data = document.data
    robots = data.get("robots") if isinstance(data, dict) else None
    if not isinstance(robots, dict) or not robots or set(data) != {"robots"}:
        raise refuse("", "not a fleet", "robots: {NAME: {model: FILE, recordings: [FILE, ...]}}")
    if len(robots) > _MOST_ROBOTS:
        raise refuse("robots", "too many robots", f"at most {_MOST_ROBOTS}", len(robots))
    found = []
    for name, item in robots.items():
        here = f"robots.{name}"
        if portable_name(name) != name:
            raise refuse(here, "not a folder name", f"a plain name: {portable_name(name)}", name)
        if not isinstance(item, dict) or not {"model", "recordings"} <= set(item) <= _FIELDS:
            raise refuse(here, "wrong fields", "model, recordings and, if wanted, held_out")
        files = {}
        for key in ("recordings", "held_out"):
            given = item.get(key, [])
            if not isinstance(given, list) or not all(isinstance(f, str) for f in given):
                raise refuse(f"{here}.{key}", "not files", "a list of files")
            files[key] = tuple(path.parent / f for f in given)
        if not files["recordings"]:
            raise refuse(f"{here}.recordings", "no recording", "a list of files")
        if not isinstance(item["model"], str):
            raise refuse(f"{here}.model", "not a file", "a file or a folder")
        found.append(
            Robot(name, path.parent / item["model"], files["recordings"], files["held_out"])
        )
    return found


@dataclass(frozen=True, slots=True)
class Task:
    """What is done with every robot of a fleet.

    Attributes:
        work: function of a robot and the options that writes its folder and returns its verdict.
        open_verdicts: verdicts with which the exit status is 1.
        report: file name of a robot's page.
        failed: words for a robot whose input cannot be used.
    """

    work: Callable[[Robot, Options], str]
    open_verdicts: frozenset[str]
    report: str
    failed: str


def diagnose_robot(robot: Robot, options: Options) -> str:
    """Diagnose one robot into its folder; return its verdict."""
    from pytest_twin.commands.diagnose import diagnose_into

    summary = diagnose_into(
        options.out / robot.name,
        robot.model,
        robot.recordings,
        robot.held_out,
        {**options.arguments, "threads": options.threads},
        options.stop,
    )
    return str(summary["verdict"])


DIAGNOSIS = Task(
    diagnose_robot, frozenset({"improved", "unexplained"}), REPORT_FILE, "not diagnosed"
)


def outcome_of(robot: Robot, options: Options, task: Task = DIAGNOSIS) -> Outcome:
    """Do the task for one robot; unusable input gives an outcome instead of an error."""
    if options.stop is not None and options.stop.is_sent:
        return Outcome(robot.name, None, "the fleet was stopped before its turn", is_tried=False)
    since = time.perf_counter()
    try:
        with declaring(options.declared):
            verdict = task.work(robot, options)
    except TwinError as error:
        return Outcome(robot.name, None, str(error), time.perf_counter() - since)
    return Outcome(robot.name, verdict, "", time.perf_counter() - since)


def outcomes_of(
    robots: Sequence[Robot], options: Options, executor: Executor, task: Task = DIAGNOSIS
) -> list[Outcome]:
    """Do the task for every robot, and return the outcomes in the same order.

    Args:
        robots: robots with different names.
        options: options that they share.
    """
    return executor.map(partial(outcome_of, options=options, task=task), robots)


def add_arguments(parser: argparse.ArgumentParser, verb: str) -> None:
    """Declare the options of a fleet.

    Args:
        verb: what is done with a robot, such as ``diagnose``.
    """
    parser.add_argument(
        "--fleet",
        metavar="FILE.yaml",
        type=Path,
        help=f"{verb} several robots, instead of one model and its recordings: "
        "`robots: {NAME: {model: FILE, recordings: [FILE, ...], held_out: [FILE, ...]}}`; "
        f"a folder for each robot and {FLEET_FILE} are written to --out",
    )
    parser.add_argument(
        "--jobs",
        metavar="N",
        type=int,
        help="number of robots at the same time (default: the number of cores)",
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="run the fleet on the workers of this Dask scheduler, tcp://HOST:PORT (extra `dask`); "
        "they need access to the same files",
    )


def refuse_alone(args: argparse.Namespace) -> None:
    """Refuse the options of a fleet without one.

    Raises:
        TwinError: an option of a fleet is given.
    """
    if args.scheduler is not None or args.jobs is not None:
        raise TwinError(
            "only for a fleet", where="--jobs, --scheduler", expected="--fleet FILE.yaml"
        )


def run(args: argparse.Namespace, arguments: Mapping[str, Any], task: Task = DIAGNOSIS) -> int:
    """Do the task for a fleet; return the exit status.

    It is 1 if a verdict is open or a robot was not tried, 2 if an input cannot be used, else 0.

    Args:
        args: parsed arguments of the command.
        arguments: fields of the task's request other than files.

    Raises:
        TwinError: the fleet file or the output folder cannot be used.
    """
    out: Path = args.out.absolute()
    if not out.parent.is_dir():
        raise TwinError("no such folder", path=out.parent, expected="a folder that exists")
    robots = [
        Robot(r.name, r.model.absolute(), *(tuple(f.absolute() for f in files)
              for files in (r.recordings, r.held_out)))
        for r in read_fleet(args.fleet)
    ]  # fmt: skip
    jobs = min(args.jobs or usable_cores(), len(robots))
    threads = max(1, usable_cores() // jobs) if args.scheduler is None else 1
    if getattr(args, "seconds", None) is not None:
        arguments = {**arguments, "seconds": args.seconds / len(robots)}
    # It describes the robots' folders, which are replaced one by one.
    results.withdraw(out, FLEET_FILE)
    with stop_on_interrupt(_tell) as stop:
        executor: Executor = Forks(jobs) if args.scheduler is None else Dask(args.scheduler, stop)
        options = Options(out, threads, arguments, declared_inputs(), stop)
        outcomes = outcomes_of(robots, options, executor, task)
        document = _document(outcomes)
        with results.result_folder(out, FLEET_FILE) as staging:
            atomic.write_json(staging / FLEET_FILE, document)
        json_output.give(args, document)
        width = max(len(o.name) for o in outcomes)
        for o in outcomes:
            words = o.verdict or f"{task.failed}: {o.error}"
            show(printable(f"{o.name:<{width}}  {words}"))
        show(f"reports: {args.out}/NAME/{task.report}")
    if any(o.verdict is None and o.is_tried for o in outcomes):
        return 2
    return int(any(o.verdict is None or o.verdict in task.open_verdicts for o in outcomes))


def _tell() -> None:
    print(
        "stopping: the robots that have begun are written with their best result so far; "
        "Ctrl-C again aborts",
        file=sys.stderr, flush=True,
    )  # fmt: skip


def _document(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return the content of ``fleet.json``."""
    return {
        "schema": 1,
        "robots": {
            o.name: {
                "verdict": o.verdict,
                "seconds": round(o.seconds, 2),
                **({"error": o.error} if o.verdict is None else {"folder": f"{o.name}/"}),
            }
            for o in outcomes
        },
        "not_tried": [o.name for o in outcomes if not o.is_tried],
    }
