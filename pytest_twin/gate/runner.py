"""Runs goldens in a child process and turns what it says, or its end, into outcomes."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from pytest_twin.checks import check_of
from pytest_twin.errors import TwinError
from pytest_twin.formats import atomic
from pytest_twin.golden import Golden
from pytest_twin.outcome import Measure, Outcome, Reason
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.twin import Twin

SECONDS = 600.0
"""Default bound on the wall time of one golden."""
# Bound on a first look at a failure, s, or in times of the golden's own wall time.
_GLANCE_SECONDS, _GLANCE_SHARE = 30.0, 10.0

Progress = Callable[[float], None]
Plots = Literal["all", "failed"]
_WORKER = "pytest_twin.gate.worker"


class Runner:
    """One child process per twin, started at its first golden; a crash costs that golden only.

    Args:
        seconds: bound on the wall time of one golden.
        confine: whether the child may read only its twin's roots and Python's files, and write
            only a scratch folder.
    """

    def __init__(self, seconds: float = SECONDS, *, confine: bool = False) -> None:
        self.seconds = seconds
        self.confine = confine
        self.unsaved_plots: dict[Path, str] = {}
        """Root of a twin -> why the first of its plots could not be saved."""
        self._children: dict[Path, Sandbox] = {}

    def child(self, twin: Twin) -> Sandbox:
        """The process that loads and steps this twin's models; it starts with its first call."""
        if twin.root not in self._children:
            roots = (twin.root, *twin.roots.values()) if self.confine else None
            self._children[twin.root] = Sandbox(
                seconds=self.seconds, cwd=twin.root, confined_to=roots
            )
        return self._children[twin.root]

    def prove(
        self,
        twin: Twin,
        golden: Golden,
        realization: str,
        *,
        reasons: tuple[Reason, ...] = (),
        plots: Plots = "all",
        progress: Progress | None = None,
    ) -> Outcome:
        """Run one golden on one realization. Raises nothing: what went wrong is the outcome."""
        start = time.perf_counter()
        result: dict[str, Any] = {}
        error: str | None = None
        try:
            result = self._call("prove", twin, golden, realization, progress, plots=plots)
        except TwinError as problem:
            error = str(problem)
        measures = tuple(Measure.from_json(fields) for fields in result.get("measures", ()))
        if error is None and not measures:
            error = "nothing was compared"
        failed = [measure.subject for measure in measures if not measure.passed]
        passed = error is None and not failed
        seconds = time.perf_counter() - start
        looked_at = bool(failed) and check_of(golden.kind).recorded
        look = (
            self._quick_diagnosis(twin, golden, realization, failed, seconds) if looked_at else None
        )
        return Outcome(
            golden=golden.id,
            kind=golden.kind,
            realization=realization,
            criticality=golden.criticality,
            status="error" if error is not None else "passed" if passed else "failed",
            measures=measures,
            error=error,
            reasons=reasons,
            plot=self._save_plot(twin, golden, realization, result.get("plot")),
            diagnosis=look,
            seconds=seconds,
        )

    def _quick_diagnosis(
        self, twin: Twin, golden: Golden, realization: str, failed: list[str], seconds: float
    ) -> str:
        """Description of a failure in one line, or the reason why there is none."""
        bound = min(self.seconds, max(_GLANCE_SECONDS, _GLANCE_SHARE * seconds))
        try:
            said = self._call(
                "quick_diagnosis", twin, golden, realization, None, bound=bound, failed=failed
            )
        except TwinError as problem:
            return f"could not be made: {' '.join(str(problem).split())}"
        return str(said["line"])

    def _save_plot(
        self, twin: Twin, golden: Golden, realization: str, svg: str | None
    ) -> str | None:
        """Path of the plot relative to the twin's root; None where there is none on the disk."""
        if svg is None:
            return None
        relative = plot_path(golden.id, realization)
        path = twin.root / relative
        try:
            atomic.make_folder(path.parent)
            atomic.write_text(path, svg)
        except TwinError as problem:
            # The verdict does not depend on the plot: a read-only checkout is proven as well.
            self.unsaved_plots.setdefault(twin.root, str(problem))
            return None
        return relative.as_posix()

    def record(
        self, twin: Twin, golden: Golden, realization: str, *, progress: Progress | None = None
    ) -> dict[str, Any]:
        """What ``gate.worker.record`` says of one golden.

        Raises:
            TwinError: the check, the model or a file is at fault, or the child ended.
        """
        return self._call("record", twin, golden, realization, progress)

    def _call(
        self,
        function: str,
        twin: Twin,
        golden: Golden,
        realization: str,
        progress: Progress | None,
        bound: float | None = None,
        **arguments: object,
    ) -> dict[str, Any]:
        result: dict[str, Any] = self.child(twin).call(
            f"{_WORKER}:{function}",
            {
                "twin": str(twin.path),
                "spec": str(golden.path),
                "realization": realization,
                **arguments,
            },
            seconds=bound,
            progress=progress,
        )
        return result

    def close(self) -> None:
        """End every child."""
        for child in self._children.values():
            child.close()
        self._children.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def plot_path(golden_id: str, realization: str) -> Path:
    """Where the plot of a golden lies, relative to the twin's root."""
    return Path(".twin") / "plots" / f"{golden_id}@{realization}.svg"
