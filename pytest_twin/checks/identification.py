"""Check an accepted identification on its held-out recordings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, ClassVar

from pytest_twin.checks.base import (
    Check,
    Measure,
    NothingToProposeError,
    Observation,
    Progress,
    Trace,
)
from pytest_twin.checks.fields import known_name, spec_error
from pytest_twin.checks.files import find_file
from pytest_twin.checks.records import check_unchanged, twin_of
from pytest_twin.checks.schemas import NO_FIELDS, array, name_field, table
from pytest_twin.dependency import Structure
from pytest_twin.golden import Golden

if TYPE_CHECKING:
    from pytest_twin.realization import Realization


class IdentificationCheck(Check):
    """Compare the realization's effort along held-out motion with the measured effort.

    ``values``: ``joints``: joint -> ``relative``, ``rms``, ``slide``; ``recorded``: joint ->
    relative error at identification time.
    """

    kind: ClassVar[str] = "identification"
    needs_record: ClassVar[bool] = False
    dynamic: ClassVar[bool] = True
    libraries: ClassVar[tuple[str, ...]] = ("numpy", "scipy", "pin")
    tolerances: ClassVar[Mapping[str, str]] = {"effort": "1", "torque": "N*m", "force": "N"}
    schema: ClassVar[Mapping[str, Any]] = {
        "target": table(
            {
                "record": name_field("Id under fit: in twin.yaml."),
                "recordings": array(
                    name_field(),
                    "Held-out recordings of the record. The paths are relative to the twin's "
                    "folder or to one of its roots.",
                    minItems=1,
                    uniqueItems=True,
                ),
            },
            required=["record", "recordings"],
        ),
        "stimulus": NO_FIELDS,
    }

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return the record, its recordings, all parts that affect motion, and encoder zeros."""
        target = golden.target
        parts = {f"fit:{target['record']}"} | {f"recording:{r}" for r in target["recordings"]}
        parts |= {f"calibration:{joint}" for joint in structure.joint_body}
        return parts | set(structure.dynamics(None))

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Compute inverse dynamics along the measured motion."""
        from pytest_twin.identification.recheck import recheck

        twin = twin_of(golden, realization, "an identification", "fit")
        entries = {entry.record.id: entry for entry in twin.fits}
        name = golden.target["record"]
        record = entries[known_name(golden, "target.record", name, entries, "fit")].record
        paths = []
        for at, reference in enumerate(golden.target["recordings"]):
            where = f"target.recordings.{at}"
            path = find_file(golden, where, reference, twin)
            if path.is_file():
                expected = f"one of {', '.join(record.recordings)}, unchanged"
                check_unchanged(golden, where, reference, path, record.inputs, expected)
            if path.name not in record.recordings:
                raise spec_error(
                    golden,
                    where,
                    f"a recording that {name} was fitted on",
                    value=reference,
                    expected=f"one that was held out: {', '.join(record.recordings)}",
                )
            paths.append(path)
        found = recheck(realization, record, paths)
        progress(1.0)
        return Observation(
            {
                "joints": {
                    joint: {
                        **asdict(one),
                        "slide": realization.structure.joint_type[joint] == "slide",
                    }
                    for joint, one in found.items()
                },
                "recorded": dict(record.held_out),
            }
        )

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare each joint's error, relative or root mean square, with its tolerance."""
        measures = []
        recorded = observation.values["recorded"]
        for joint, one in observation.values["joints"].items():
            for name, bound in golden.tolerance.items():
                if name != "effort" and (name == "force") != one["slide"]:
                    continue
                error = float(one["relative" if name == "effort" else "rms"])
                measures.append(
                    Measure(
                        name=name,
                        subject=f"{joint}, effort predicted by {golden.target['record']}",
                        measured=error,
                        golden=float(recorded.get(joint, 0.0)) if name == "effort" else 0.0,
                        error=error,
                        tolerance=bound.value,
                        unit=self.tolerances[name],
                        against="record" if name == "effort" else "recording",
                    )
                )
        return measures

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose nothing, because a new twin has no identification."""
        raise NothingToProposeError(
            "it needs an accepted identification; docs/kinds/identification.md has an example"
        )
