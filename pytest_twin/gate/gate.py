"""One twin in one session: its goldens, its plan, its outcomes, its verdict."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from pytest_twin import staleness
from pytest_twin.errors import TwinError
from pytest_twin.gate import specs
from pytest_twin.gate.authority import recorded_elsewhere
from pytest_twin.gate.identity import digests
from pytest_twin.gate.parts import changed_since, look_around
from pytest_twin.gate.plan import NEVER_PROVEN, Plan, Task, missing_and_dropped, vouched
from pytest_twin.gate.runner import Runner
from pytest_twin.gate.update import Update, record
from pytest_twin.gate.verdict import Facts, SessionFacts
from pytest_twin.golden import Golden
from pytest_twin.outcome import Outcome, Reason
from pytest_twin.twin import load_twin

if TYPE_CHECKING:
    from pytest_twin.release import Release

MAX_PLOTTED = 100
"""Goldens of a twin up to which each has its plot; above, those that fail have."""

Progress = Callable[[float], None]


class Gate:
    """The gate of one twin.

    Args:
        twin_file: its ``twin.yaml``.
        runner: runs what has to run in a child process.
        signing: whether a release is wanted: nothing is then taken from a cache.

    Raises:
        TwinError: ``twin.yaml`` is broken.
    """

    def __init__(self, twin_file: Path, runner: Runner, *, signing: bool = False) -> None:
        self.twin = load_twin(twin_file)
        self.root = self.twin.root
        self.runner = runner
        self.signing = signing
        self.outcomes: dict[str, Outcome] = {}
        self.updates: list[Update] = []
        self.unsaved_plots: str | None = None
        self._goldens: dict[Path, Golden | TwinError] = {}
        self._folders: dict[Path, bool] = {}
        self._plan: Plan | None = None

    # -- specs

    @cached_property
    def _named(self) -> frozenset[Path]:
        return frozenset(self.twin.files)

    def is_spec(self, path: Path) -> bool:
        """Whether the file at ``path`` is one of the twin's golden specs."""
        folder = path.parent
        if folder not in self._folders:
            self._folders[folder] = specs.holds_specs(folder, self.twin)
        return self._folders[folder] and path.suffix == ".yaml" and path not in self._named

    def golden(self, path: Path) -> Golden:
        """The golden in a file, read once.

        Raises:
            TwinError: it is broken.
        """
        if path not in self._goldens:
            try:
                self._goldens[path] = specs.load_golden(path, self.twin)
            except TwinError as error:
                self._goldens[path] = error
        found = self._goldens[path]
        if isinstance(found, TwinError):
            raise found
        return found

    # -- plan

    @property
    def planned(self) -> Plan | None:
        """The plan; None before its first use."""
        return self._plan

    def plan(self) -> Plan:
        """What is stale and why, found out once, before anything runs."""
        if self._plan is None:
            goldens: list[Golden] = []
            broken: dict[Path, str] = {}
            for path in specs.spec_paths(self.twin):
                try:
                    goldens.append(self.golden(path))
                except TwinError as error:
                    broken[path] = str(error)
            self._plan = self._made(goldens, broken)
        return self._plan

    def _made(self, goldens: list[Golden], broken: Mapping[Path, str]) -> Plan:
        traces = specs.trace_paths(self.twin)
        today = look_around(self.twin, goldens, self.runner.child(self.twin), fresh=self.signing)
        baseline, known, notes = self._baseline()
        reasons = staleness.staleness(today.stock, vouched(baseline) if baseline else None)
        proofs = baseline.goldens if baseline else {}
        tasks = {
            (key := f"{golden.id}@{realization}"): Task(
                golden,
                realization,
                tuple(sorted(today.stock.rests_on[key])),
                (Reason(f"{realization}/model", "cannot be read"),)
                if realization in today.unread
                else reasons[key],
                proofs.get(key),
            )
            for golden in goldens
            for realization in golden.realizations
        }
        # The golden of a broken spec is neither missing nor without a spec.
        there = {specs.golden_id(path, self.twin) for path in broken}
        missing, dropped = missing_and_dropped(known, tasks, self.twin.retired, there)
        referred = {golden.path.parent / golden.trace.file for golden in goldens if golden.trace}
        referred |= {path.with_suffix(".trace.csv") for path in broken}
        return Plan(
            tasks=tasks,
            parts=today.stock.parts,
            baseline=baseline,
            missing=missing,
            dropped=dropped,
            orphans=tuple(
                path.relative_to(self.root).as_posix() for path in traces if path not in referred
            ),
            files=today.files,
            problems=(*broken.values(), *today.problems, *recorded_elsewhere(goldens)),
            notes=notes,
        )

    def _baseline(self) -> tuple[Release | None, Release | None, tuple[str, ...]]:
        """The last release that holds, the last one that is authentic, and what to say."""
        if not (self.root / "releases").is_dir():
            return None, None, ()
        from pytest_twin import release

        try:
            found = release.baseline(self.root)
        except TwinError as error:
            return None, None, (f"no baseline: {error}",)
        return found.release, found.known, found.problems

    # -- running

    def prove(
        self,
        golden: Golden,
        realization: str,
        *,
        reasons: tuple[Reason, ...],
        progress: Progress | None,
    ) -> Outcome:
        """Run one golden, unless its tolerance is blank or it was never recorded."""
        if golden.unwritten is not None or golden.provenance is None:
            return Outcome(
                golden=golden.id,
                kind=golden.kind,
                realization=realization,
                criticality=golden.criticality,
                status="error",
                error=golden.unwritten or NEVER_PROVEN,
                reasons=reasons,
            )
        return self.runner.prove(
            self.twin,
            golden,
            realization,
            reasons=reasons,
            plots="all" if len(self._goldens) <= MAX_PLOTTED else "failed",
            progress=progress,
        )

    def record(self, golden: Golden, progress: Progress | None) -> tuple[Outcome, Update | None]:
        """Record one golden on its first realization; the outcome says whether it now passes."""
        realization = golden.realizations[0]
        task = self.plan().tasks.get(f"{golden.id}@{realization}")
        parts = self.plan().parts
        rests_on = [parts[ident] for ident in task.parts if ident in parts] if task else []
        update: Update | None = None
        error: str | None = None
        try:
            update = record(self.twin, golden, rests_on, self.runner, progress=progress)
        except TwinError as problem:
            error = str(problem)
        measures = update.measures if update else ()
        passed = error is None and all(measure.passed for measure in measures)
        outcome = Outcome(
            golden=golden.id,
            kind=golden.kind,
            realization=realization,
            criticality=golden.criticality,
            status="error" if error else "passed" if passed else "failed",
            measures=measures,
            error=error,
        )
        return outcome, update

    # -- verdict

    def facts(self, session: SessionFacts) -> Facts:
        """Everything that the verdict depends on; digests are taken again where something ran."""
        plan = self.plan()
        return Facts(
            criticality={key: task.golden.criticality for key, task in plan.tasks.items()},
            proven={
                key: task.proof.outcome
                for key, task in plan.tasks.items()
                if task.proof is not None and not task.is_stale
            },
            outcomes=self.outcomes,
            repeated=frozenset(filter(self._repeated, self.outcomes)),
            unproven=plan.unproven,
            orphans=plan.orphans,
            missing=plan.missing,
            dropped=plan.dropped,
            changed=self._changed(plan) if self.outcomes else (),
            problems=plan.problems,
            baseline=None if plan.baseline is None else plan.baseline.number,
            session=session,
        )

    def _repeated(self, key: str) -> bool:
        task = self.plan().tasks.get(key)
        return (
            task is not None
            and task.proof is not None
            and task.proof.outcome.status == self.outcomes[key].status != "passed"
            and all(reason.part.startswith("failed in release ") for reason in task.reasons)
        )

    def _changed(self, plan: Plan) -> tuple[str, ...]:
        paths = set(specs.spec_paths(self.twin)) - plan.files.keys()
        return (
            *changed_since(plan.parts, plan.files),
            *(f"{path}: a new spec" for path in sorted(paths)),
        )

    def ids(self) -> dict[str, object]:
        """The tuple of ids that people call this twin's parts by, with their files' digests."""
        twin, files, tasks = self.twin, self.plan().files, self.plan().tasks.values()

        def digests_of(paths: Iterable[Path]) -> dict[str, str]:
            return {
                os.path.relpath(path, self.root): files[path] for path in paths if path in files
            }

        return {
            "asset": digests_of(twin.source),
            "realizations": {
                name: digests_of([ref.file]) for name, ref in twin.realizations.items()
            },
            "calibration": twin.calibration.id if twin.calibration else None,
            "fit": twin.fit.id if twin.fit else None,
            "controllers": sorted(twin.controllers),
            "payloads": sorted(twin.payloads),
            "parts": {
                name: part.id if part.id is not None else part.value
                for name, part in twin.parts.items()
            },
            "digests": digests(twin, {t.golden.id: t.golden for t in tasks}.values(), files),
        }
