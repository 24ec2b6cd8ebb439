"""Run goldens in a child process, and convert its answers or its crash into outcomes."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, Self

from pytest_twin.checks import check_of
from pytest_twin.errors import TwinError
from pytest_twin.formats import atomic
from pytest_twin.golden import Golden
from pytest_twin.outcome import Measure, Outcome, Reason
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.twin import Twin

SECONDS = 600.0
"""Default limit of the wall time of one golden, s."""
# Limit of a quick diagnosis: s, or a multiple of the golden's wall time; the larger applies.
_QUICK_DIAGNOSIS_SECONDS, _QUICK_DIAGNOSIS_FACTOR = 30.0, 10.0

Progress = Callable[[float], None]
Plots = Literal["all", "failed"]
_WORKER = "pytest_twin.gate.worker"


class Runner:
    """Runs the goldens of each twin in one child process, which starts at the first golden.

    A crash of the child fails only the golden that was running.

    Args:
        seconds: limit of the wall time of one golden, s.
        confine: whether the child may read only the twin's folders and Python's files, and write
            only into a temporary folder.
        untrusted: folders from which no child imports modules, such as the root folder of pytest;
            the twin's folder is always one of them.
    """

    def __init__(
        self,
        seconds: float = SECONDS,
        *,
        confine: bool = False,
        untrusted: tuple[Path, ...] = (),
    ) -> None:
        self.seconds = seconds
        self.confine = confine
        self.untrusted = untrusted
        self.unsaved_plots: dict[Path, str] = {}
        """Root of a twin -> error that prevented its first plot from being saved."""
        self._children: dict[Path, Sandbox] = {}

    def child(self, twin: Twin) -> Sandbox:
        """The process that loads and steps the models of a twin; it starts at its first call."""
        if twin.root not in self._children:
            roots = (twin.root, *twin.roots.values()) if self.confine else None
            self._children[twin.root] = Sandbox(
                seconds=self.seconds,
                cwd=twin.root,
                confined_to=roots,
                untrusted=self.untrusted,
            )
        return self._children[twin.root]

    def run_golden(
        self,
        twin: Twin,
        golden: Golden,
        realization: str,
        *,
        reasons: tuple[Reason, ...] = (),
        plots: Plots = "all",
        progress: Progress | None = None,
    ) -> Outcome:
        """Run one golden on one realization; an error becomes an outcome and is not raised."""
        start = time.perf_counter()
        result: dict[str, Any] = {}
        error: str | None = None
        try:
            result = self._call("run_golden", twin, golden, realization, progress, plots=plots)
        except TwinError as problem:
            error = str(problem)
        measures = tuple(Measure.from_json(fields) for fields in result.get("measures", ()))
        if error is None and not measures:
            error = "nothing was compared"
        failed = [measure.subject for measure in measures if not measure.passed]
        passed = error is None and not failed
        seconds = time.perf_counter() - start
        needs_diagnosis = bool(failed) and check_of(golden.kind).recorded
        diagnosis = (
            self._quick_diagnosis(twin, golden, realization, failed, seconds)
            if needs_diagnosis
            else None
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
            diagnosis=diagnosis,
            notes=tuple(result.get("notes", ())),
            seconds=seconds,
        )

    def _quick_diagnosis(
        self, twin: Twin, golden: Golden, realization: str, failed: list[str], seconds: float
    ) -> str:
        """Description of a failure in one line, or the reason why there is none."""
        bound = min(self.seconds, max(_QUICK_DIAGNOSIS_SECONDS, _QUICK_DIAGNOSIS_FACTOR * seconds))
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
        """Save a plot; its path relative to the twin's root, None where it was not saved."""
        if svg is None:
            return None
        relative = plot_path(golden.id, realization)
        path = twin.root / relative
        try:
            atomic.make_folder(path.parent)
            atomic.write_text(path, svg)
        except TwinError as problem:
            # The verdict does not depend on the plot: goldens also run in a read-only checkout.
            self.unsaved_plots.setdefault(twin.root, str(problem))
            return None
        return relative.as_posix()

    def record(
        self, twin: Twin, golden: Golden, realization: str, *, progress: Progress | None = None
    ) -> dict[str, Any]:
        """Call :func:`pytest_twin.gate.worker.record` for one golden, and return its result.

        Raises:
            TwinError: an error of the check, the model or a file; or the child ended.
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

    def __exit__(self, *error: object) -> None:
        self.close()


def plot_path(golden_id: str, realization: str) -> Path:
    """Path of the plot of a golden, relative to the twin's root."""
    return Path(".twin") / "plots" / f"{golden_id}@{realization}.svg"
