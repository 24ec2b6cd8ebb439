"""Changes of a twin since its last release that no result of a golden shows.

A golden that depends on a changed part runs again, and passes too where its result does not depend
on the changed value: a robot that falls on a floor of greater friction does not show the friction
of its feet. This module reads no files.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING

from pytest_twin.dependency import Part, canonical
from pytest_twin.gate.coverage import Gap
from pytest_twin.gate.plan import Plan, Task
from pytest_twin.outcome import Measure, Outcome, Reason
from pytest_twin.staleness import changes
from pytest_twin.words import counted, join_words, list_names

if TYPE_CHECKING:
    from pytest_twin.release import Release

_LEAST_SHARE = 1e-2
"""Share of its tolerance by which a result has to move, to show a change. Rounding errors of one
model on two machines are far smaller."""
_OF_THE_TWIN = ("controller", "payload", "calibration", "base", "sensor", "encoder")
"""Layers of ``twin.yaml`` that change predictions."""
_NO_PREDICTION = ("geom", "elements", "custom")
"""Layers of a realization that change no prediction: visual shapes, elements that are not compiled,
custom fields."""
_NO_MOTION = ("keyframe", "frame", "sensor")
"""Layers that no golden has to depend on: named poses, named frames and sensors. Many models have
dozens of them."""
_MOST_CHANGES = 6
"""Largest number of changes that are listed."""


def unexamined_changes(plan: Plan, outcomes: Mapping[str, Outcome]) -> tuple[Gap, ...]:
    """Changes since the baseline that no result shows, and parts that no golden depends on.

    Args:
        plan: the plan of the run.
        outcomes: outcomes of the run, by key.
    """
    dependents = _dependents(plan)
    gaps: list[Gap] = []
    if plan.baseline is not None:
        gaps += _changes_without_result(plan, plan.baseline, outcomes, dependents)
    alone = sorted(
        ident
        for ident, part in plan.parts.items()
        if _matters(ident)
        and part.content
        and _layer(ident) not in _NO_MOTION
        and not dependents.get(ident)
    )
    if alone:
        gaps.append(
            Gap("", f"no golden depends on {list_names(alone)}: no result would show a change")
        )
    return tuple(gaps)


def _matters(ident: str) -> bool:
    """Whether a part can change a prediction."""
    of_realization = "/" in ident.partition(":")[0]
    return _layer(ident) not in _NO_PREDICTION if of_realization else _layer(ident) in _OF_THE_TWIN


def _layer(ident: str) -> str:
    return ident.partition(":")[0].rpartition("/")[2]


def _dependents(plan: Plan) -> dict[str, list[Task]]:
    """Part -> goldens whose result depends on it, today or in the baseline."""
    dependents: dict[str, list[Task]] = {}
    for task in plan.tasks.values():
        before = () if task.proof is None else task.proof.parts
        for ident in {*task.parts, *before}:
            dependents.setdefault(ident, []).append(task)
    return dependents


def _changes_without_result(
    plan: Plan,
    baseline: Release,
    outcomes: Mapping[str, Outcome],
    dependents: Mapping[str, Collection[Task]],
) -> Iterator[Gap]:
    changed = {
        ident: reasons
        for ident in sorted(filter(_matters, baseline.parts.keys() | plan.parts.keys()))
        # Releases of earlier versions hold only parts that a golden depends on.
        if (ident in baseline.parts or dependents.get(ident))
        and (reasons := _changes(ident, baseline.parts.get(ident), plan.parts.get(ident)))
    }
    moved = {
        key: {_layer(ident) for ident in changed if task in dependents.get(ident, ())}
        for key, task in plan.tasks.items()
        if _result_moved(task, baseline, plan, outcomes)
    }
    unseen: dict[tuple[str, str, str], list[str]] = {}
    together: dict[str, set[str]] = {}
    for ident, reasons in changed.items():
        goldens = dependents.get(ident, ())
        layers = [moved[task.key] for task in goldens if task.key in moved]
        if not layers:
            why = (
                f"the {counted(len(goldens), 'golden')} that may depend on it gave the same "
                "results as before"
                if goldens
                else "no golden depends on it"
            )
            layer, _, name = ident.partition(":")
            for reason in reasons:
                unseen.setdefault((layer, _value_of(reason), why), []).append(name)
        elif not any(of_result == {_layer(ident)} for of_result in layers):
            together.setdefault(_layer(ident), set()).update(*layers)
    lines = [
        f"unexamined: {':'.join(filter(None, (layer, list_names(names))))}: {change}: {why}"
        for (layer, change, why), names in unseen.items()
    ]
    if lines:
        name = counted(len(lines), "unexamined change")
        if len(lines) > _MOST_CHANGES:
            more = counted(len(lines) - _MOST_CHANGES, "more change")
            lines[_MOST_CHANGES:] = [f"unexamined: {more} that no result of a golden shows"]
        yield from (Gap("" if number else name, line) for number, line in enumerate(lines))
    for layer, others in sorted(together.items()):
        yield Gap(
            "",
            f"changes of layer {layer} came together with those of "
            f"{join_words(sorted(others - {layer}))}: no result of a golden shows {layer} alone; "
            "to see each effect, release one change at a time",
        )


def _changes(ident: str, before: Part | None, today: Part | None) -> list[Reason]:
    if before is None:
        return [Reason(ident, "is new")]
    if today is None:
        return [Reason(ident, "was removed")]
    return [] if before.digest == today.digest else changes(before, today)


def _value_of(reason: Reason) -> str:
    """The changed value without the names of elements, so that equal changes are listed once."""
    return str(Reason(reason.field.rpartition(".")[2], "", reason.old, reason.new))


def _result_moved(
    task: Task, baseline: Release, plan: Plan, outcomes: Mapping[str, Outcome]
) -> bool:
    """Whether a golden gave another result than in the baseline, or was recorded with another."""
    outcome = outcomes.get(task.key)
    if outcome is None or task.proof is None:
        return False
    was = {_subject(measure): measure for measure in task.proof.outcome.measures}
    now = {_subject(measure): measure for measure in outcome.measures}
    return (
        outcome.status != task.proof.outcome.status
        or was.keys() != now.keys()
        or any(_moved(was[subject], measure) for subject, measure in now.items())
        or _record(task, baseline.parts) != _record(task, plan.parts)
    )


def _subject(measure: Measure) -> tuple[str, str, str]:
    return measure.name, measure.subject, measure.against


def _moved(before: Measure, after: Measure) -> bool:
    bound = after.tolerance if math.isfinite(after.tolerance) else 0.0
    return any(
        not math.isclose(then, now, rel_tol=0.0, abs_tol=_LEAST_SHARE * bound)
        and not (math.isnan(then) and math.isnan(now))
        for then, now in (
            (before.measured, after.measured),
            (before.golden, after.golden),
            (before.error, after.error),
        )
    )


def _record(task: Task, parts: Mapping[str, Part]) -> tuple[bytes, str | None]:
    """What a golden is compared with: its recorded trace, and its spec without the tolerances."""
    spec, trace = (parts.get(f"{layer}:{task.golden.id}") for layer in ("spec", "trace"))
    stated = {} if spec is None else {k: v for k, v in spec.content.items() if k != "tolerance"}
    # A release holds the canonical form, in which numbers are rounded.
    return canonical(stated), None if trace is None else trace.digest
