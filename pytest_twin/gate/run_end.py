"""End of a run: verdict, signed release, report, and lines for the terminal."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from pytest_twin.errors import TwinError
from pytest_twin.formats import atomic
from pytest_twin.formats.paths import read_bytes
from pytest_twin.gate.authority import difference_lines
from pytest_twin.gate.coverage import Gap, assumptions, gaps
from pytest_twin.gate.failure_diagnosis import RealizationDiagnosis
from pytest_twin.gate.gate import Gate
from pytest_twin.gate.plan import NEVER_PROVEN, Task, lacks_record, line_of
from pytest_twin.gate.runner import plot_path
from pytest_twin.gate.unexamined import unexamined_changes
from pytest_twin.gate.verdict import Facts, Refused, Releasable, SessionFacts, StillValid, judge
from pytest_twin.outcome import Outcome
from pytest_twin.report.model import Entry, Report

if TYPE_CHECKING:
    from pytest_twin.release import Header, Release

_PLOT_BYTES = 8 * 2**20
"""Largest size of a plot in the report."""


@dataclass(frozen=True, slots=True)
class Policy:
    """Options of the user for the end of a run.

    Attributes:
        sign: whether to write a release.
        key, ini_key: path of the signing key, from the command line and the configuration file.
        report: path of the report, None for ``.twin/report.html``.
    """

    sign: bool
    key: str | None = None
    ini_key: str | None = None
    report: Path | None = None


@dataclass(frozen=True, slots=True)
class RunResult:
    """Result of a run.

    Attributes:
        is_blocked: whether a release was requested and refused.
        lines: lines for the terminal, the verdict last.
    """

    is_blocked: bool
    lines: tuple[str, ...]


def finish(
    gate: Gate,
    session: SessionFacts,
    policy: Policy,
    diagnosed: Sequence[RealizationDiagnosis] = (),
) -> RunResult:
    """Decide on a release, sign it where requested and allowed, and write the report.

    Args:
        gate: after its goldens ran.
        session: facts of the pytest session.
        diagnosed: diagnoses of failed goldens, for the report.
    """
    plan = gate.plan()
    facts = gate.facts(session)
    untested = _untested(gate, facts) if policy.sign else ()
    lines = [*(gap.sentence for gap in untested), *plan.notes]
    proven = facts.proven.keys() - facts.outcomes.keys()
    if proven and plan.baseline is not None:
        lines.append(f"{len(proven)} still proven by release {plan.baseline.number:04d}")
    lines += facts.chain_changes
    lines += [f"changed during the run: {changed}" for changed in facts.changed]
    if not policy.sign:
        shown_before = set(session.collection_errors)
        lines += [f"blocks a release: {p}" for p in facts.problems if p not in shown_before]
    if facts.outcomes:
        simulators = {name: ref.simulator for name, ref in gate.twin.realizations.items()}
        goldens = {task.golden.id: task.golden for task in plan.tasks.values()}
        outcomes = {**facts.proven, **facts.outcomes}
        lines += difference_lines(list(goldens.values()), outcomes, simulators)
    if gate.unsaved_plots is not None:
        lines.append(f"plots are not saved: {gate.unsaved_plots}")
    refusals: tuple[str, ...] = ()
    released: Release | None = None
    verdict = judge(facts) if policy.sign else None
    if isinstance(verdict, Releasable):
        try:
            released, notes = _sign(gate, facts, policy)
            lines += notes
        except TwinError as error:
            verdict = Refused((str(error),))
    if isinstance(verdict, Refused):
        refusals = verdict.reasons
    if policy.sign:
        lines += assumptions(_results(facts))
    header = released.header if released else None
    for item in diagnosed:
        lines.append(
            f"diagnosis of {item.realization}: {item.lines[0]}" if item.report else item.lines[0]
        )
        lines += [] if item.report is None else [f"  {item.report}"]
    lines.append(
        _write_report_with_notice(gate, facts, verdict, refusals, header, policy.report, diagnosed)
    )
    if isinstance(verdict, StillValid):
        lines.append(f"release {verdict.release:04d} still holds")
    elif released is not None:
        folder = gate.root / "releases" / f"{released.number:04d}"
        lines.append(f"release {released.number:04d} signed: {folder}")
    elif refusals:
        lines.append("no release:")
        lines += [f"  {reason}" for reason in refusals]
        if any(outcome.status == "error" for outcome in facts.outcomes.values()):
            lines.append(
                f"  goldens that do not fit the model any more: pytest-twin init {gate.twin.path} "
                "proposes them anew"
            )
    return RunResult(bool(refusals), tuple(lines))


def _results(facts: Facts) -> list[Outcome]:
    """Results of this run, and of the baseline where they are still valid."""
    return list({**facts.proven, **facts.outcomes}.values())


def _untested(gate: Gate, facts: Facts) -> tuple[Gap, ...]:
    """What the goldens of the release do not test, changes since the baseline included."""
    return gaps(_results(facts)) + unexamined_changes(gate.plan(), facts.outcomes)


def _write_report_with_notice(
    gate: Gate,
    facts: Facts,
    verdict: Releasable | StillValid | Refused | None,
    refusals: tuple[str, ...],
    header: Header | None,
    wanted: Path | None,
    diagnosed: Sequence[RealizationDiagnosis],
) -> str:
    """Write the report, and return a line that says where it is."""
    quiet = not (refusals or facts.outcomes or facts.unproven or facts.problems)
    if wanted is None and quiet and facts.baseline is not None and not gate.plan().stale:
        # No result is new: the report of the release applies.
        return f"report: {gate.root / 'releases' / f'{facts.baseline:04d}' / 'report.html'}"
    path = wanted or gate.root / ".twin" / "report.html"
    try:
        links = _links(path.parent, diagnosed)
        _write_report(path, _report(gate, facts, verdict, refusals, header, links))
    except TwinError as error:
        return f"the report is not saved: {error}"
    return f"report: {path}"


def _links(folder: Path, diagnosed: Sequence[RealizationDiagnosis]) -> dict[str, str]:
    """Key of a golden -> link to the report of its diagnosis, for a page in ``folder``."""
    return {
        key: quote(Path(os.path.relpath(item.report, folder)).as_posix())
        for item in diagnosed
        if item.report is not None
        for key in item.goldens
    }


def _sign(gate: Gate, facts: Facts, policy: Policy) -> tuple[Release, list[str]]:
    from pytest_twin import release

    plan = gate.plan()
    signer, notes = release.signer(gate.root, policy.key, policy.ini_key)
    proofs = tuple(_proof(gate, task, facts) for task in plan.tasks.values())
    draft = release.Draft(
        twin=gate.twin.name,
        valid_days=gate.twin.release.valid_days,
        ids=gate.ids(),
        parts={**plan.parts, **gate.process.parts},
        proofs=proofs,
        environment=release.environment(),
        files={**plan.files, **gate.process.files},
    )

    def page(header: Header) -> str:
        from pytest_twin.report.html import render

        return render(_report(gate, facts, Releasable(), (), header))

    written, more = release.write(gate.root, draft, signer, page)
    return written, [*notes, *more]


def _proof(gate: Gate, task: Task, facts: Facts) -> Any:
    from pytest_twin.release import Proof

    title, today = task.golden.title, task.golden.criticality
    outcome = facts.outcomes.get(task.key)
    if outcome is not None:
        return Proof(outcome, title, tuple(sorted({*task.parts, *gate.process.parts})))
    before = facts.proven[task.key]
    proof = task.proof
    assert proof is not None
    # The parts of then: code that was added to the gate's process later did not run this golden.
    return Proof(replace(before, criticality=today), title, proof.parts, proof.release, proof.at)


def _report(
    gate: Gate,
    facts: Facts,
    verdict: Releasable | StillValid | Refused | None,
    refusals: tuple[str, ...],
    header: Header | None,
    diagnoses: Mapping[str, str] = MappingProxyType({}),
) -> Report:
    from pytest_twin.release import environment

    plan = gate.plan()
    untested = _untested(gate, facts) if verdict is not None else ()
    failed = [
        outcome
        for outcome in facts.outcomes.values()
        if outcome.status != "passed" and outcome.criticality == "critical"
    ]
    return Report(
        twin=gate.twin.name,
        verdict=_verdict_word(verdict, bool(failed)),
        headline=_headline(facts, verdict, len(failed), untested),
        created=header.created if header else datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        entries=tuple(_entries(gate, facts, diagnoses)),
        refusals=refusals,
        notes=(
            *(gap.sentence for gap in untested),
            *(assumptions(_results(facts)) if verdict is not None else ()),
            *plan.notes,
        ),
        release=header.number if header else None,
        previous=facts.baseline,
        expires=header.expires if header else None,
        key_id=header.key_id if header else None,
        ids=gate.ids(),
        parts={ident: part.digest for ident, part in plan.parts.items()},
        environment=environment(),
    )


def _verdict_word(verdict: Releasable | StillValid | Refused | None, failed: bool) -> Any:
    if verdict is None:
        return "failed" if failed else "passed"
    return {Releasable: "released", StillValid: "holds", Refused: "refused"}[type(verdict)]


def _headline(
    facts: Facts,
    verdict: Releasable | StillValid | Refused | None,
    failed: int,
    untested: Sequence[Gap],
) -> str:
    ran, proven = len(facts.outcomes), len(facts.proven)
    counts = f"{ran} ran, {failed} critical failed, {proven} still proven"
    if not_run := len(facts.criticality.keys() - facts.outcomes.keys() - facts.proven.keys()):
        counts += f", {not_run} not run"
    if isinstance(verdict, Refused):
        return f"{verdict.reasons[0]} ({counts})"
    return "; ".join((*(gap.name for gap in untested if gap.name), counts))


def _entries(gate: Gate, facts: Facts, diagnoses: Mapping[str, str]) -> Iterator[Entry]:
    for task in gate.plan().tasks.values():
        golden = task.golden
        outcome = facts.outcomes.get(task.key)
        proof = None
        if outcome is None and task.proof is not None and not task.is_stale:
            proof = task.proof
            outcome = proof.outcome
        not_run = outcome is None
        if outcome is None:
            outcome = Outcome(
                golden=golden.id,
                kind=golden.kind,
                realization=task.realization,
                criticality=golden.criticality,
                status="error",
                error=NEVER_PROVEN if lacks_record(golden) else "stale, and not run",
                reasons=task.reasons,
            )
        path = golden.path.relative_to(gate.root).as_posix()
        yield Entry(
            outcome=outcome,
            title=golden.title,
            location=f"{path}:{line_of(golden, outcome)}",
            release=proof.release if proof else None,
            at=proof.at if proof else "",
            parts=task.parts,
            plot=_plot(gate, outcome) if outcome.plot or proof else None,
            not_run=not_run,
            diagnosis=diagnoses.get(task.key),
        )


def _plot(gate: Gate, outcome: Outcome) -> bytes | None:
    path = gate.root / plot_path(outcome.golden, outcome.realization)
    try:
        return read_bytes(path, _PLOT_BYTES)
    except TwinError:
        return None


def _write_report(path: Path, report: Report) -> None:
    from pytest_twin.report.html import render

    atomic.make_folder(path.parent)
    atomic.write_text(path, render(report))
