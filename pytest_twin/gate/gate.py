"""One twin in one pytest session: its goldens, plan, outcomes and facts for the verdict."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from pytest_twin import staleness
from pytest_twin.dependency import Part
from pytest_twin.errors import TwinError
from pytest_twin.gate import specs
from pytest_twin.gate.asset_chain import changes_since, lost_manifests
from pytest_twin.gate.authority import recorded_without_authority
from pytest_twin.gate.identity import digests
from pytest_twin.gate.parts import changed_since, collect_dependencies
from pytest_twin.gate.plan import (
    NEVER_PROVEN,
    Plan,
    Task,
    baseline_of,
    lacks_record,
    missing_and_dropped,
)
from pytest_twin.gate.process import GateProcess, released_files
from pytest_twin.gate.runner import Runner
from pytest_twin.gate.update import Update, record
from pytest_twin.gate.verdict import Facts, SessionFacts
from pytest_twin.golden import Golden
from pytest_twin.outcome import Outcome, Reason
from pytest_twin.realization.import_path import installed_modules_only
from pytest_twin.records.state import stale_lines, with_reasons_of_records
from pytest_twin.staleness import DependencyMap
from pytest_twin.twin import load_twin

if TYPE_CHECKING:
    from pytest_twin.release import Release

MAX_PLOTTED = 100
"""Number of goldens. A twin with more of them gets plots of failed goldens only."""

Progress = Callable[[float], None]


class Gate:
    """The gate of one twin.

    Args:
        twin_file: its ``twin.yaml``.
        runner: runs goldens in a child process.
        signing: whether a release is requested; models are then read again, without the cache.
        process: returns code and settings of this process, for the twin's folder.

    Raises:
        TwinError: ``twin.yaml`` is not valid.
    """

    def __init__(
        self,
        twin_file: Path,
        runner: Runner,
        *,
        signing: bool = False,
        process: Callable[[Path], GateProcess] = lambda root: GateProcess(),
    ) -> None:
        self.twin = load_twin(twin_file)
        self.root = self.twin.root
        self.runner = runner
        self.signing = signing
        self.process = GateProcess()
        """Code and settings of all processes that run goldens of the twin."""
        self._process_of = process
        self.outcomes: dict[str, Outcome] = {}
        self.updates: list[Update] = []
        self.unsaved_plots: str | None = None
        self._goldens: dict[Path, Golden | TwinError] = {}
        self._folders: dict[Path, bool] = {}
        self._plan: Plan | None = None

    # -- specs

    @cached_property
    def _files_of_twin(self) -> frozenset[Path]:
        return frozenset(self.twin.files)

    def is_spec(self, path: Path) -> bool:
        """Whether the file at ``path`` is a golden spec of the twin."""
        folder = path.parent
        if folder not in self._folders:
            self._folders[folder] = specs.contains_specs(folder, self.twin)
        return self._folders[folder] and path.suffix == ".yaml" and path not in self._files_of_twin

    def golden(self, path: Path) -> Golden:
        """The golden in a file; the file is read once.

        Raises:
            TwinError: the spec is not valid.
        """
        if path not in self._goldens:
            try:
                with installed_modules_only(self.runner.untrusted):
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
        """The plan; None before the first call of :meth:`plan`."""
        return self._plan

    def plan(self) -> Plan:
        """Determine which goldens are stale and why; computed once, before any golden runs."""
        if self._plan is None:
            goldens: list[Golden] = []
            broken: dict[Path, str] = {}
            for path in specs.spec_paths(self.twin):
                try:
                    goldens.append(self.golden(path))
                except TwinError as error:
                    broken[path] = str(error)
            with installed_modules_only(self.runner.untrusted):
                self._plan = self._make_plan(goldens, broken)
        return self._plan

    def _make_plan(self, goldens: list[Golden], broken: Mapping[Path, str]) -> Plan:
        traces = specs.trace_paths(self.twin)
        current = collect_dependencies(
            self.twin, goldens, self.runner.child(self.twin), fresh=self.signing
        )
        baseline, known, notes = self._baseline()
        self.add_process(self._process_of(self.root))
        dependencies = self._with_process(current.dependencies, baseline.parts if baseline else {})
        reasons = staleness.staleness(dependencies, baseline_of(baseline) if baseline else None)
        proofs = baseline.goldens if baseline else {}
        tasks = {
            (key := f"{golden.id}@{realization}"): Task(
                golden,
                realization,
                tuple(sorted(dependencies.depends_on[key])),
                (Reason(f"{realization}/model", "cannot be read"),)
                if realization in current.unread
                else with_reasons_of_records(
                    reasons[key], current.records, current.dependencies.depends_on[key]
                ),
                proofs.get(key),
            )
            for golden in goldens
            for realization in golden.realizations
        }
        # A golden with an invalid spec is not missing, and its trace is not an orphan.
        broken_ids = {specs.golden_id(path, self.twin) for path in broken}
        missing, dropped = missing_and_dropped(known, tasks, self.twin.retired, broken_ids)
        referred = {golden.path.parent / golden.trace.file for golden in goldens if golden.trace}
        referred |= {path.with_suffix(".trace.csv") for path in broken}
        return Plan(
            tasks=tasks,
            parts=dependencies.parts,
            baseline=baseline,
            missing=missing,
            dropped=dropped,
            orphans=tuple(
                path.relative_to(self.root).as_posix() for path in traces if path not in referred
            ),
            files=current.files,
            problems=(
                *broken.values(),
                *current.problems,
                *(() if known is None else lost_manifests(known, current.chain, self.twin)),
                *recorded_without_authority(goldens),
            ),
            chain=current.chain.content,
            chain_changes=() if baseline is None else tuple(changes_since(baseline, current.chain)),
            notes=(
                *notes,
                *current.chain.notes,
                *(note for state in current.records for note in state.notes),
            ),
            stale_records=stale_lines(current.records, self.twin),
        )

    def _with_process(
        self, dependencies: DependencyMap, released: Mapping[str, Part]
    ) -> DependencyMap:
        """Dependencies with the code and settings of this process and of the release."""
        process = released_files(self.root, released).merged_with(self.process)
        self.process = process
        wanted = frozenset(process.parts)
        return DependencyMap(
            {**dependencies.parts, **process.parts},
            {key: ids | wanted for key, ids in dependencies.depends_on.items()},
        )

    def add_process(self, process: GateProcess) -> None:
        """Add code and settings of a process that runs goldens."""
        self.process = self.process.merged_with(process)

    def _baseline(self) -> tuple[Release | None, Release | None, tuple[str, ...]]:
        """The last valid release, the last authentic release, and notes for the terminal."""
        if not (self.root / "releases").is_dir():
            return None, None, ()
        from pytest_twin import release

        try:
            found = release.baseline(self.root)
        except TwinError as error:
            return None, None, (f"no baseline: {error}",)
        return found.release, found.known, found.problems

    # -- running

    def run_golden(
        self,
        golden: Golden,
        realization: str,
        *,
        reasons: tuple[Reason, ...],
        progress: Progress | None,
    ) -> Outcome:
        """Run one golden; an error where its tolerance is blank or it was never recorded."""
        if golden.unwritten is not None or lacks_record(golden):
            return Outcome(
                golden=golden.id,
                kind=golden.kind,
                realization=realization,
                criticality=golden.criticality,
                status="error",
                error=golden.unwritten or NEVER_PROVEN,
                reasons=reasons,
            )
        return self.runner.run_golden(
            self.twin,
            golden,
            realization,
            reasons=reasons,
            plots="all" if len(self._goldens) <= MAX_PLOTTED else "failed",
            progress=progress,
        )

    def record(self, golden: Golden, progress: Progress | None) -> tuple[Outcome, Update | None]:
        """Record one golden on its first realization; the outcome says whether it then passes."""
        realization = golden.realizations[0]
        task = self.plan().tasks.get(f"{golden.id}@{realization}")
        parts = self.plan().parts
        # What a golden records does not come from this process.
        wanted = parts.keys() - self.process.parts.keys()
        depends_on = [parts[ident] for ident in task.parts if ident in wanted] if task else []
        update: Update | None = None
        error: str | None = None
        try:
            update = record(self.twin, golden, depends_on, self.runner, progress=progress)
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
        """Collect all facts that the verdict depends on.

        If a golden ran, the digests of all files are computed again, to detect a change during the
        run.
        """
        plan = self.plan()
        return Facts(
            criticality={key: task.golden.criticality for key, task in plan.tasks.items()},
            proven={
                key: task.proof.outcome
                for key, task in plan.tasks.items()
                if task.proof is not None and not task.is_stale
            },
            outcomes=self.outcomes,
            repeated=frozenset(filter(self._is_repeated, self.outcomes)),
            unproven=plan.unproven,
            orphans=plan.orphans,
            missing=plan.missing,
            dropped=plan.dropped,
            changed=self._changed(plan) if self.outcomes else (),
            chain_changes=plan.chain_changes,
            problems=(*plan.stale_records, *plan.problems, *self.process.problems),
            baseline=None if plan.baseline is None else plan.baseline.number,
            session=session,
        )

    def _is_repeated(self, key: str) -> bool:
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
            *changed_since(plan.parts, {**plan.files, **self.process.files}),
            *(f"{path}: a new spec" for path in sorted(paths)),
        )

    def ids(self) -> dict[str, object]:
        """Ids and digests of all members of the twin, from its asset to its declared parts."""
        twin, files, tasks = self.twin, self.plan().files, self.plan().tasks.values()

        def digests_of(paths: Iterable[Path]) -> dict[str, str]:
            return {
                os.path.relpath(path, self.root): files[path] for path in paths if path in files
            }

        return {
            "asset": digests_of(twin.source),
            "chain": dict(self.plan().chain),
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
