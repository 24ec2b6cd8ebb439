"""Record goldens: write the observed values into the spec, and list the changes.

No other module writes golden specs.
"""

from __future__ import annotations

import getpass
import hashlib
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from pytest_twin.dependency import Part, canonical
from pytest_twin.errors import UnwrittenToleranceError
from pytest_twin.formats import atomic, yaml
from pytest_twin.gate.runner import Runner
from pytest_twin.golden import Golden
from pytest_twin.outcome import Measure
from pytest_twin.twin import Twin

Progress = Callable[[float], None]
_SPEC_LAYERS = ("spec:", "trace:")


@dataclass(frozen=True, slots=True)
class Change:
    """Change of one recorded value; ``old`` or ``new`` is empty where there is no value."""

    field: str
    old: str
    new: str


@dataclass(frozen=True, slots=True)
class Update:
    """Changes by the recording of a golden.

    Attributes:
        first: whether this is its first recording.
        changes: recorded values that differ, in SI units.
        moved: deviations of the observation from the previous record.
        measures: comparison of the observation with the new record and with independent
            references.
        written: written files, relative to the twin's root; empty where nothing has changed.
    """

    golden: str
    first: bool
    changes: tuple[Change, ...]
    moved: tuple[Measure, ...]
    measures: tuple[Measure, ...]
    written: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON-able values."""
        return {
            "golden": self.golden,
            "first": self.first,
            "changes": [asdict(change) for change in self.changes],
            "moved": [measure.to_json() for measure in self.moved],
            "measures": [measure.to_json() for measure in self.measures],
            "written": list(self.written),
        }

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> Update:
        """Build an update from what :meth:`to_json` returned."""
        return cls(
            golden=fields["golden"],
            first=fields["first"],
            changes=tuple(Change(**change) for change in fields["changes"]),
            moved=tuple(Measure.from_json(measure) for measure in fields["moved"]),
            measures=tuple(Measure.from_json(measure) for measure in fields["measures"]),
            written=tuple(fields["written"]),
        )


def record(
    twin: Twin,
    golden: Golden,
    parts: Iterable[Part],
    runner: Runner,
    *,
    recorded_by: str | None = None,
    progress: Progress | None = None,
) -> Update:
    """Run a golden on its first realization, and write the result into its spec.

    ``expected``, ``trace`` and ``provenance`` are written below the marker of recorded fields, and
    the trace into a file next to the spec. Nothing is written where the record is the same.

    Args:
        twin: the twin that the golden belongs to.
        parts: the parts that its result depends on.
        recorded_by: person or service that is responsible; by default the current user.
        progress: called with the fraction that is done, 0 to 1.

    Raises:
        TwinError: an error of the check, the model or a file; nothing was written.
    """
    if golden.unwritten is not None:
        raise UnwrittenToleranceError(golden.unwritten)
    realization = golden.realizations[0]
    result = runner.record(twin, golden, realization, progress=progress)
    recorded: dict[str, Any] = {}
    if result["expected"]:
        recorded["expected"] = result["expected"]
    trace_file = golden.trace.file if golden.trace else f"{golden.path.stem}.trace.csv"
    if result["trace"] is not None:
        recorded["trace"] = {"file": trace_file, "sha256": _sha256(result["trace"].encode())}
    digests = layer_digests(parts)
    simulator = twin.realizations[realization].simulator
    recorded["provenance"] = {
        "recorded_by": recorded_by or _user(),
        "recorded_at": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "realization": realization,
        "simulator": f"{simulator} {metadata.version(simulator)}",
        "parts": digests,
    }
    changes = tuple(_changes(golden, recorded))
    written: list[Path] = []
    if changes or golden.provenance is None or golden.provenance.parts != digests:
        written = _write(golden, recorded, result["trace"])
    return Update(
        golden=golden.id,
        first=golden.provenance is None,
        changes=changes,
        moved=tuple(Measure.from_json(fields) for fields in result["moved"]),
        measures=tuple(Measure.from_json(fields) for fields in result["measures"]),
        written=tuple(path.relative_to(twin.root).as_posix() for path in written),
    )


def _user() -> str:
    """Name of the current user, or its number where it has no name, as in a container."""
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return f"user {os.getuid()}"


def layer_digests(parts: Iterable[Part]) -> dict[str, str]:
    """SHA-256 of each layer, such as ``mujoco/inertia`` or ``simulator``.

    A spec states digests of layers, not of parts, so that it stays readable.
    """
    layers: dict[str, dict[str, str]] = {}
    for part in parts:
        if not part.id.startswith(_SPEC_LAYERS):
            layers.setdefault(part.id.partition(":")[0], {})[part.id] = part.digest
    return {layer: _sha256(canonical(layers[layer])) for layer in sorted(layers)}


def _write(golden: Golden, recorded: dict[str, Any], trace: str | None) -> list[Path]:
    text = yaml.rewrite_recorded(yaml.read_text(golden.path), recorded, golden.path)
    written = []
    if trace is not None:
        path = golden.path.parent / recorded["trace"]["file"]
        # The trace is written first, so that a spec never refers to a missing trace.
        atomic.write_text(path, trace)
        written.append(path)
    atomic.write_text(golden.path, text)
    written.append(golden.path)
    if trace is None and golden.trace is not None:
        (golden.path.parent / golden.trace.file).unlink(missing_ok=True)
    return written


def _changes(golden: Golden, recorded: Mapping[str, Any]) -> Iterator[Change]:
    old = dict(_leaves(golden.expected or {}, ""))
    new = dict(_leaves(recorded.get("expected", {}), ""))
    for name in (*old, *(name for name in new if name not in old)):
        before, now = old.get(name, ""), new.get(name, "")
        if before != now:
            yield Change(name, _format(before), _format(now))
    before = golden.trace.sha256 if golden.trace else ""
    now = recorded["trace"]["sha256"] if "trace" in recorded else ""
    if before != now:
        yield Change("trace", before[:12], now[:12])


def _leaves(value: object, where: str) -> Iterator[tuple[str, object]]:
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _leaves(item, f"{where}.{key}" if where else str(key))
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _leaves(item, f"{where}[{index}]")
    else:
        yield where, value


def _format(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.9g}" if math.isfinite(value) else str(value)
    return str(value)


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
