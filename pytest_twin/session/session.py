"""Pytest hooks of a session with twins: collection, running, verdict and report."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Generator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from pytest_twin.checks import kinds
from pytest_twin.errors import TwinError
from pytest_twin.gate.failure_diagnosis import RealizationDiagnosis, diagnose_failures
from pytest_twin.gate.gate import Gate
from pytest_twin.gate.plan import line_of
from pytest_twin.gate.plan_lines import update_lines, why_lines
from pytest_twin.gate.process import GateProcess
from pytest_twin.gate.run_end import Policy, finish
from pytest_twin.gate.runner import Runner
from pytest_twin.gate.update import Update
from pytest_twin.gate.verdict import SessionFacts
from pytest_twin.golden import Golden
from pytest_twin.interrupts import sigterm_as_interrupt
from pytest_twin.outcome import Outcome, Reason
from pytest_twin.realization.import_path import installed_modules_only
from pytest_twin.report.failure import failure_text, what
from pytest_twin.report.text import quantity
from pytest_twin.session import selection
from pytest_twin.session.items import FailureText, GoldenFailedError, GoldenFile, GoldenItem
from pytest_twin.session.options import Options
from pytest_twin.session.process_code import process_code
from pytest_twin.session.progress import ProgressLine

_MARKERS = {
    "critical": "a golden that blocks a release",
    "advisory": "a golden that is reported and blocks nothing",
}


OUTCOME_ATTRIBUTE = "twin_outcome"
"""Attribute of a test report with the outcome as JSON; pytest-xdist sends it to the controller."""
_FULL_DIAGNOSIS = "; full diagnosis: pytest --twin-diagnose"


class TwinSession:
    """Hooks of a session with at least one twin.

    With pytest-xdist, the controller has one object, which plans, decides and signs, and each
    worker has one, which runs goldens. Without pytest-xdist, one object does both.
    """

    def __init__(self, config: pytest.Config, options: Options) -> None:
        self.config = config
        self.options = options
        self.gates: dict[Path, Gate] = {}
        self.broken: dict[Path, TwinError] = {}
        self.reported_broken: set[Path] = set()
        self.runner = Runner(options.seconds, confine=options.confine, untrusted=(config.rootpath,))
        self.progress = ProgressLine(config)
        self.failures: list[str] = []
        self.collection_errors: list[str] = []
        self.deselected = 0
        self.collected: set[str] = set()
        self.test_modules: set[Path] = set()
        self.failed: dict[tuple[Path, str], pytest.TestReport] = {}
        self.advisories: list[tuple[Gate, str]] = []
        self.summaries: list[tuple[Gate, list[str]]] = []
        self.worker_input: dict[str, Any] = json.loads(
            getattr(config, "workerinput", {}).get("twin", "{}")
        )
        # Schedulers and CI send SIGTERM; pytest itself would end without a report.
        self.interrupts = contextlib.ExitStack()
        self.interrupts.enter_context(sigterm_as_interrupt())
        for name, text in _MARKERS.items():
            config.addinivalue_line("markers", f"{name}: {text}")
        for kind in kinds():
            config.addinivalue_line("markers", f"{kind}: goldens of kind {kind}")

    @property
    def is_worker(self) -> bool:
        """Whether this process runs goldens for a controller."""
        return hasattr(self.config, "workerinput")

    # -- collection

    def add_audits(self) -> None:
        """Write the golden that audits the model into each twin without one, before collection.

        A run of selected goldens adds none: it would not record it.
        """
        if tuple(selection.selected_by(self.config)) or self.config.getoption("collectonly"):
            return
        for gate in self.gates.values():
            if selection.partial_arguments(self.config, gate.root):
                continue
            try:
                with installed_modules_only(self.runner.untrusted):
                    from pytest_twin.setup.missing_audit import add_audit

                    path = add_audit(gate.twin)
            except TwinError as error:
                raise pytest.UsageError(str(error)) from None
            if path is not None:
                self.progress.say(f"{path}: a new golden, which audits the model")

    def gate(self, twin_file: Path) -> Gate | None:
        """The gate of a twin, None where its ``twin.yaml`` is not valid."""
        if twin_file not in self.gates and twin_file not in self.broken:
            try:
                self.gates[twin_file] = Gate(
                    twin_file,
                    self.runner,
                    signing=self.options.release,
                    process=self._process_code,
                )
            except TwinError as error:
                self.broken[twin_file] = error
        return self.gates.get(twin_file)

    def spec(self, path: Path, twin_file: Path, parent: pytest.Collector) -> GoldenFile | None:
        """Collector of a spec, None where ``path`` is not a spec.

        An invalid ``twin.yaml`` is reported once, by the collector of the first spec.
        """
        gate = self.gate(twin_file)
        if gate is not None and not gate.is_spec(path):
            return None

        if gate is None:
            if twin_file in self.reported_broken:
                return None
            self.reported_broken.add(twin_file)

        def load() -> tuple[Gate, Golden]:
            if gate is None:
                raise self.broken[twin_file]
            return gate, gate.golden(path)

        return GoldenFile.of(parent, path=path, load=load, run=self.run)

    @pytest.hookimpl(tryfirst=True, wrapper=True)
    def pytest_collection_modifyitems(
        self, session: pytest.Session, items: list[pytest.Item]
    ) -> Generator[None, None, None]:
        """Count the tests that other plugins deselect, then deselect the fresh goldens."""
        collected = list(items)
        self.collected.update(item.key for item in items if isinstance(item, GoldenItem))
        self.test_modules.update(i.path for i in items if not isinstance(i, GoldenItem))
        yield
        self.deselected = len(collected) - len(items)
        if self.config.getoption("collectonly") or session.testsfailed:
            return
        deselected = [item for item in items if not self._is_selected(item)]
        if deselected:
            self.config.hook.pytest_deselected(items=deselected)
            items[:] = [item for item in items if item not in set(deselected)]

    def _is_selected(self, item: pytest.Item) -> bool:
        if self.options.why:
            return False
        if not isinstance(item, GoldenItem):
            return True
        if self.options.update:
            return item.realization == item.golden.realizations[0]
        return self.options.everything or self._is_stale(item)

    def _is_stale(self, item: GoldenItem) -> bool:
        if self.is_worker:
            return item.key in self._plan_from_controller(item.gate)["stale"]
        return item.gate.plan().tasks[item.key].is_stale

    def pytest_report_collectionfinish(self) -> list[str]:
        """Return one line per twin with the numbers of stale and fresh goldens."""
        if self.config.getoption("collectonly") or self.is_worker:
            return []
        return [
            f"twin {gate.twin.name}: {len(plan.stale)} stale, {len(plan.fresh)} still proven"
            + (f" by release {plan.baseline.number:04d}" if plan.baseline else "")
            for gate in self.gates.values()
            if (plan := gate.planned) is not None
        ]

    # -- pytest-xdist

    def for_workers(self) -> str:
        """The stale goldens of all twins as JSON, for the workers of pytest-xdist."""
        return json.dumps(
            {
                str(gate.twin.path): {
                    "stale": {
                        task.key: [asdict(reason) for reason in task.reasons]
                        for task in gate.plan().tasks.values()
                        if task.is_stale
                    }
                }
                for gate in self.gates.values()
            }
        )

    def _plan_from_controller(self, gate: Gate) -> dict[str, Any]:
        handed: dict[str, Any] = self.worker_input.get(str(gate.twin.path), {"stale": {}})
        return handed

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        """Store which tests a worker collected and deselected."""
        message = json.loads(getattr(node, "workeroutput", {}).get("twin", "{}"))
        self.collected.update(message.get("collected", ()))
        self.deselected = max(self.deselected, message.get("deselected", 0))
        for twin_file, process in message.get("processes", {}).items():
            if (gate := self.gate(Path(twin_file))) is not None:
                gate.add_process(GateProcess.from_json(process))

    # -- running

    def run(self, item: GoldenItem) -> None:
        """Run one golden, and attach its outcome to the item as JSON.

        Raises:
            GoldenFailedError: it did not pass.
        """
        gate = item.gate
        message: dict[str, Any] = {"twin": str(gate.twin.path)}
        with self.progress.of(item) as progress:
            if self.options.update:
                outcome, update = gate.record(item.golden, progress)
                message["update"] = update and update.to_json()
            else:
                outcome = gate.run_golden(
                    item.golden,
                    item.realization,
                    reasons=self._reasons(item),
                    progress=progress,
                )
        message["outcome"] = outcome.to_json()
        message["unsaved_plots"] = self.runner.unsaved_plots.get(gate.root)
        item.outcome_json = json.dumps(message)
        item.user_properties.extend(_properties(outcome))
        if outcome.status != "passed":
            location = f"{os.path.relpath(item.path)}:{line_of(item.golden, outcome)}"
            plot = outcome.plot and os.path.relpath(gate.root / outcome.plot)
            advice = "" if self.options.diagnose else _FULL_DIAGNOSIS
            text = failure_text(outcome, location=location, plot=plot, advice=advice)
            raise GoldenFailedError(text, what(outcome), line_of(item.golden, outcome))

    def _reasons(self, item: GoldenItem) -> tuple[Reason, ...]:
        if self.is_worker:
            handed = self._plan_from_controller(item.gate)["stale"].get(item.key, ())
            return tuple(Reason(**reason) for reason in handed)
        return item.gate.plan().tasks[item.key].reasons

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Attach the outcome to the report; report an advisory failure as an expected failure."""
        report = yield
        if not isinstance(item, GoldenItem) or call.when != "call" or item.outcome_json is None:
            return report
        setattr(report, OUTCOME_ATTRIBUTE, item.outcome_json)
        error = None if call.excinfo is None else call.excinfo.value
        if isinstance(error, GoldenFailedError):
            path, _, domain = report.location
            report.location = (path, error.line - 1, domain)
            if item.golden.criticality == "advisory":
                report.outcome = "skipped"
                report.wasxfail = f"advisory: {error.headline}"
        return report

    def pytest_report_teststatus(
        self, report: pytest.CollectReport | pytest.TestReport
    ) -> tuple[str, str, str] | None:
        """Report the failure of an advisory golden as ``advisory``."""
        if getattr(report, "when", None) == "call" and _is_advisory(report):
            return "advisory", "a", "ADVISORY"
        return None

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Store outcomes of goldens and failures of ordinary tests."""
        outcome_json = getattr(report, OUTCOME_ATTRIBUTE, None)
        if outcome_json is None:
            if report.failed and not self.is_worker:
                self.failures.append(report.nodeid)
            return
        message = json.loads(outcome_json)
        outcome = Outcome.from_json(message["outcome"])
        if isinstance(report.longrepr, str):
            # A worker sends plain text; the object gives summaries and JUnit one line.
            path, line, _ = report.location
            text = FailureText(report.longrepr, what(outcome), path, (line or 0) + 1)
            report.longrepr = text  # type: ignore[assignment]
        if self.is_worker:
            return
        gate = self.gate(Path(message["twin"]))
        if gate is None:
            return
        gate.unsaved_plots = gate.unsaved_plots or message["unsaved_plots"]
        if "update" not in message:
            gate.outcomes[outcome.key] = outcome
            if outcome.status == "failed":
                self.failed[gate.root, outcome.key] = report
        elif message["update"] is not None:
            gate.updates.append(Update.from_json(message["update"]))
        if _is_advisory(report):
            self.advisories.append((gate, str(report.longrepr)))

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Store the errors of the collection."""
        if report.failed:
            lines = str(report.longrepr).strip().splitlines()
            self.collection_errors.append(lines[-1] if lines else report.nodeid)

    # -- the end

    def pytest_sessionfinish(self, session: pytest.Session, exitstatus: int) -> None:
        """Decide, sign and report; a worker sends the collected tests to the controller."""
        self.runner.close()
        if self.is_worker:
            self.config.workeroutput["twin"] = json.dumps(  # type: ignore[attr-defined]
                {
                    "collected": sorted(self.collected),
                    "deselected": self.deselected,
                    "processes": {
                        str(gate.twin.path): self._process_code(gate.root).to_json()
                        for gate in self.gates.values()
                    },
                }
            )
            return
        if self.config.getoption("collectonly"):
            return
        if exitstatus == pytest.ExitCode.NO_TESTS_COLLECTED and self._are_all_goldens_fresh():
            session.exitstatus = pytest.ExitCode.OK
        if exitstatus == pytest.ExitCode.INTERNAL_ERROR or self.options.why:
            return
        for gate in self.gates.values():
            gate.add_process(self._process_code(gate.root))
            with installed_modules_only(self.runner.untrusted):
                self._finish(gate, session, exitstatus)

    def _process_code(self, root: Path) -> GateProcess:
        return process_code(self.config, root, self.test_modules)

    def _are_all_goldens_fresh(self) -> bool:
        """Whether nothing ran because all goldens are fresh."""
        return not self.collection_errors and any(
            self.options.why or (gate.planned is not None and gate.planned.fresh)
            for gate in self.gates.values()
        )

    def _finish(self, gate: Gate, session: pytest.Session, exitstatus: int) -> None:
        if self.options.update:
            self.summaries.append((gate, update_lines(gate.updates)))
            return
        if gate.planned is None and not self.options.release:
            return
        diagnosed = self._diagnose(gate, exitstatus)
        policy = Policy(
            sign=self.options.release,
            key=self.options.key,
            ini_key=self.options.ini_key,
            report=self._report_path(gate),
        )
        result = finish(gate, self._facts(gate, session, exitstatus), policy, diagnosed)
        self.summaries.append((gate, list(result.lines)))
        if result.is_blocked and session.exitstatus in (
            pytest.ExitCode.OK,
            pytest.ExitCode.NO_TESTS_COLLECTED,
        ):
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def _diagnose(self, gate: Gate, exitstatus: int) -> list[RealizationDiagnosis]:
        """Diagnose failures against recordings, and add the text to the reports of their tests."""
        finished = (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED)
        if not self.options.diagnose or exitstatus not in finished:
            return []
        with self.progress.named(f"diagnosis of {gate.twin.name}") as progress:
            found = diagnose_failures(gate, self.progress.say, progress)
        for diagnosed in found:
            place = [] if diagnosed.report is None else [f"report: {diagnosed.report}"]
            text = "\n".join((*diagnosed.lines, *place))
            for key in diagnosed.goldens:
                report = self.failed.get((gate.root, key))
                if report is not None:
                    report.sections.append(("diagnosis", text))
                # Goldens of one realization share a diagnosis; only the first report shows it.
                text = f"see {diagnosed.goldens[0]}"
        return found

    def _facts(self, gate: Gate, session: pytest.Session, exitstatus: int) -> SessionFacts:
        chosen = list(selection.selected_by(self.config))
        if self.deselected:
            chosen.append(f"{self.deselected} deselected")
        chosen += selection.partial_arguments(self.config, gate.root)
        if not chosen and not self.collection_errors:
            left = [key for key in gate.plan().tasks if key not in self.collected]
            if left:
                chosen.append(f"{len(left)} goldens not collected, such as {left[0]}")
        interrupted = None
        if session.shouldfail or session.shouldstop:
            interrupted = str(session.shouldfail or session.shouldstop)
        elif exitstatus == pytest.ExitCode.INTERRUPTED and not self.collection_errors:
            interrupted = "interrupted"
        return SessionFacts(
            selection=tuple(chosen),
            collection_errors=tuple(self.collection_errors),
            failures=tuple(self.failures),
            interrupted=interrupted,
        )

    def _report_path(self, gate: Gate) -> Path | None:
        path = self.options.report
        if path is None or len(self.gates) == 1:
            return path
        return path.with_name(f"{path.stem}-{gate.twin.name}{path.suffix}")

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Write the results of all twins at the end of the terminal output."""
        if self.is_worker or self.config.getoption("collectonly"):
            return
        write = terminalreporter.write_line
        if self.options.why:
            for gate in self.gates.values():
                terminalreporter.write_sep("=", f"twin {gate.twin.name}: fresh or stale, and why")
                for line in why_lines(gate.plan()):
                    write(line)
        for gate, text in self.advisories:
            terminalreporter.write_sep("=", f"twin {gate.twin.name}: advisory, blocks nothing")
            write(text)
        for gate, lines in self.summaries:
            terminalreporter.write_sep("=", f"twin {gate.twin.name}")
            for line in lines:
                write(line)

    def pytest_unconfigure(self) -> None:
        """End the child processes, and restore the handler of SIGTERM."""
        self.runner.close()
        self.interrupts.close()


def _is_advisory(report: pytest.CollectReport | pytest.TestReport) -> bool:
    return getattr(report, OUTCOME_ATTRIBUTE, None) is not None and hasattr(report, "wasxfail")


def _properties(outcome: Outcome) -> list[tuple[str, object]]:
    """Properties of a golden for the JUnit report."""
    properties: list[tuple[str, object]] = [
        ("kind", outcome.kind),
        ("realization", outcome.realization),
        ("criticality", outcome.criticality),
        ("status", outcome.status),
    ]
    worst = outcome.worst
    if worst is not None:
        properties += [
            ("worst", f"{worst.name} of {worst.subject}"),
            ("error", quantity(worst.error, worst.unit)),
            ("tolerance", quantity(worst.tolerance, worst.unit)),
            ("margin", quantity(worst.margin, worst.unit)),
        ]
    if outcome.reasons:
        properties.append(("stale_because", str(outcome.reasons[0])))
    return properties
