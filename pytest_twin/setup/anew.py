"""Propose the goldens of an existing twin anew, after its model or its drives changed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pytest_twin.errors import TwinError
from pytest_twin.gate.gate import Gate
from pytest_twin.gate.plan import lacks_record
from pytest_twin.gate.specs import spec_paths
from pytest_twin.setup.writing import spec_places, write_spec

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class Anew:
    """Goldens of a twin after new proposals.

    Attributes:
        written: specs that are new, or replace one that could not be compared.
        replaced: of these, replaced spec -> why it could not be compared.
        kept: number of goldens that run and are unchanged.
        broken: golden that cannot be compared and has no new proposal -> why.
    """

    written: Sequence[Path]
    replaced: Mapping[Path, str]
    kept: int
    broken: Mapping[Path, str]


def propose_anew(gate: Gate, specs: Sequence[Mapping[str, Any]], progress: Progress) -> Anew:
    """Write the proposals that are new or replace a golden that cannot be compared any more.

    A golden that runs is never changed, nor one that was not recorded or whose tolerance a person
    has to write.

    Args:
        gate: gate of the twin, before it runs a golden.
        specs: proposals for the present model.
        progress: called with the fraction that is done, 0 to 1.

    Raises:
        PathError: a spec cannot be written.
    """
    places = spec_places(gate.root, specs)
    present = spec_paths(gate.twin)
    errors: dict[Path, str] = {}
    for done, path in enumerate(present):
        progress(done / len(present))
        reason = _why_not_compared(gate, path)
        if reason is not None:
            errors[path] = reason
    written = [path for path in places if path in errors or not path.exists()]
    for path in written:
        _remove_trace(gate, path)
        write_spec(gate.root, path, places[path])
    return Anew(
        written,
        {path: errors[path] for path in written if path in errors},
        len(present) - len(errors),
        {path: reason for path, reason in errors.items() if path not in places},
    )


def _why_not_compared(gate: Gate, path: Path) -> str | None:
    """Why a recorded golden cannot be compared with the present model; None where it can."""
    try:
        golden = gate.golden(path)
    except TwinError:
        # A person has to correct the spec itself; pytest names the fault.
        return None
    if golden.unwritten is not None or lacks_record(golden):
        return None
    outcome = gate.run_golden(golden, golden.realizations[0], reasons=(), progress=None)
    return outcome.error if outcome.status == "error" else None


def _remove_trace(gate: Gate, path: Path) -> None:
    """Remove the trace of a golden that is replaced: its successor may have none."""
    if path.exists():
        trace = gate.golden(path).trace
        if trace is not None:
            (path.parent / trace.file).unlink(missing_ok=True)
