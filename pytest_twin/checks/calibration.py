"""Check an accepted calibration on its held-out observations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

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
from pytest_twin.checks.poses import encoder_parts
from pytest_twin.checks.records import check_unchanged, twin_of
from pytest_twin.checks.schemas import NO_FIELDS, name_field, table
from pytest_twin.dependency import Structure
from pytest_twin.golden import Golden
from pytest_twin.twin import CalibrationEntry, Twin

if TYPE_CHECKING:
    from pytest_twin.calibration.plan import Plan
    from pytest_twin.calibration.residual_errors import Errors
    from pytest_twin.formats.calibration_record import CalibrationRecord
    from pytest_twin.realization import Realization
    from pytest_twin.realization.serial_chain import SerialChain

_ERRORS = {"position": "translation", "orientation": "rotation"}


class CalibrationCheck(Check):
    """Compare predictions with a record of ``calibrations:`` with its held-out observations.

    ``values``: ``held_out``: root mean square errors as in ``calibration.json``, and the worst
    observation of each kind; ``recorded``: the root mean square errors at calibration time.
    """

    kind: ClassVar[str] = "calibration"
    needs_record: ClassVar[bool] = False
    libraries: ClassVar[tuple[str, ...]] = ("numpy", "scipy", "pin")
    tolerances: ClassVar[Mapping[str, str]] = {"position": "m", "orientation": "rad"}
    required_tolerances: ClassVar[frozenset[str]] = frozenset({"position"})
    schema: ClassVar[Mapping[str, Any]] = {
        "target": table(
            {
                "record": name_field("Id under calibrations: in twin.yaml."),
                "plan": name_field(
                    "The calibration.yaml of the record. The path is relative to "
                    "the twin's folder or to one of its roots."
                ),
                "observations": name_field(
                    "File of the record's observations. The path is given as for "
                    "the plan. A calibration of streams has none."
                ),
                "streams": table(
                    {
                        "hand": name_field("Poses on the hand's clock."),
                        "camera": name_field("Poses on the camera's clock."),
                    },
                    "Files of the record's two pose streams, instead of observations. The paths "
                    "are given as for the plan.",
                    required=["hand", "camera"],
                ),
                "flange": name_field("The plan's flange, if the plan has a robot."),
            },
            required=["record", "plan"],
        ),
        "stimulus": NO_FIELDS,
    }

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return the record, its files, kinematics and joint zeros of the chain to the flange."""
        target = golden.target
        parts = {f"record:{target['record']}"}
        files = [target["plan"], target.get("observations"), *target.get("streams", {}).values()]
        parts |= {f"file:{name}" for name in files if name is not None}
        if "flange" in target:
            chain = structure.chain([target["flange"]])
            parts |= chain | encoder_parts(structure, chain)
        return parts

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Compute errors of the realization's forward kinematics with the record's transforms."""
        from pytest_twin.calibration.calibrate import without_gross_errors
        from pytest_twin.calibration.coincident_markers import without_coincident
        from pytest_twin.calibration.observations import load_observations
        from pytest_twin.calibration.plan import load_plan
        from pytest_twin.calibration.problem import make_problem
        from pytest_twin.calibration.record_prediction import held_out_observations, recorded_state
        from pytest_twin.calibration.residual_errors import errors_of

        twin = twin_of(golden, realization, "a calibration", "calibrations")
        record = _entry(golden, twin).record
        plan = load_plan(_file(golden, "plan", golden.target["plan"], record.inputs, twin))
        if plan.streams:
            found = _of_streams(golden, plan, record, twin)
            progress(1.0)
            return Observation({"held_out": found, "recorded": dict(record.held_out)})
        if "observations" not in golden.target:
            raise spec_error(
                golden, "target", "no observations",
                expected="observations: the file that the plan names",
            )  # fmt: skip
        data = _file(golden, "observations", golden.target["observations"], record.inputs, twin)
        observations = load_observations(data)
        observations, _ = without_coincident(observations)
        held = held_out_observations(observations, record)
        chain = None
        if plan.robot is not None and observations.joints:
            chain = _chain(golden, plan, realization)
        # Zeros and geometry come from the realization.
        kept = tuple(name for name in plan.estimate if name not in ("joint_zeros", "geometry"))
        problem = make_problem(replace(plan, estimate=kept), held, chain)
        if record.scale is not None:
            problem = problem.in_unit(1.0 / record.scale)
        errors, _ = without_gross_errors(errors_of(problem, recorded_state(problem, record)))
        progress(1.0)
        return Observation(
            {
                "held_out": {**errors.summary(), "worst": _worst(errors)},
                "recorded": dict(record.held_out),
            }
        )

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare root mean square errors with tolerances, as ``accept`` of a plan does."""
        found, recorded = observation.values["held_out"], observation.values["recorded"]
        measures = []
        for name, bound in golden.tolerance.items():
            field, unit = _ERRORS[name], self.tolerances[name]
            if f"{field}_rms" not in found:
                raise spec_error(
                    golden,
                    f"tolerance.{name}",
                    "no orientation was measured",
                    expected="a tolerance of position alone",
                )
            worst = found["worst"][field]
            error = float(found[f"{field}_rms"])
            measures.append(
                Measure(
                    name=name,
                    subject=f"{golden.target['record']} on {found['count']} held-out observations "
                    f"(worst: {worst['id']}, {worst['error']:.3g} {unit})",
                    measured=error,
                    golden=float(recorded.get(f"{field}_rms", 0.0)),
                    error=error,
                    tolerance=bound.value,
                    unit=unit,
                    against="record",
                )
            )
        return measures

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose nothing, because a new twin has no calibration."""
        raise NothingToProposeError(
            "it needs an accepted calibration; docs/kinds/calibration.md has an example"
        )


def _worst(errors: Errors) -> dict[str, dict[str, Any]]:
    """Return ``translation`` and ``rotation`` -> observation with the largest error, m and rad."""
    sizes = {
        "translation": np.linalg.norm(errors.translation, axis=1),
        "rotation": np.linalg.norm(errors.rotation, axis=1),
    }
    return {
        name: {"id": errors.ids[int(np.nanargmax(size))], "error": float(np.nanmax(size))}
        for name, size in sizes.items()
        if np.isfinite(size).any()
    }


def _entry(golden: Golden, twin: Twin) -> CalibrationEntry:
    entries = {entry.record.id: entry for entry in twin.calibrations}
    name = golden.target["record"]
    return entries[known_name(golden, "target.record", name, entries, "calibration")]


def _of_streams(
    golden: Golden, plan: Plan, record: CalibrationRecord, twin: Twin
) -> dict[str, Any]:
    """Compute errors of the streams' held-out sections with the record's offset and transforms."""
    from pytest_twin.calibration.clocks.record_errors import held_out_errors

    stated = golden.target.get("streams")
    if stated is None:
        raise spec_error(
            golden, "target", "no streams", expected="streams: {hand: FILE, camera: FILE}"
        )
    files = {
        name: _file(golden, f"streams.{name}", stated[name], record.inputs, twin)
        for name in ("hand", "camera")
    }
    errors = held_out_errors(replace(plan, streams=files), record)
    sizes = dict(zip(_ERRORS.values(), errors, strict=True))
    return {
        **{f"{name}_rms": float(np.sqrt(np.mean(one**2) / 3.0)) for name, one in sizes.items()},
        "count": len(errors[0]),
        "worst": {
            name: {"id": f"number {int(np.argmax(one)) + 1}", "error": float(one.max())}
            for name, one in sizes.items()
        },
    }


def _file(
    golden: Golden, field: str, reference: str, inputs: Mapping[str, str], twin: Twin
) -> Path:
    """Return a file of the calibration, after checking its digest in the record."""
    where = f"target.{field}"
    path = find_file(golden, where, reference, twin)
    made_from = ", ".join(inputs) or "no files"
    expected = f"one of {made_from}, unchanged; calibrate again after a change"
    check_unchanged(golden, where, reference, path, inputs, expected)
    return path


def _chain(golden: Golden, plan: Plan, realization: Realization) -> SerialChain:
    """Return the realization's chain to the flange, with the signs and zeros of the twin."""
    from pytest_twin.realization.encoders import Encoders, calibration_of
    from pytest_twin.realization.serial_chain import load_serial_chain

    stated = golden.target.get("flange")
    if stated != plan.flange:
        raise spec_error(
            golden,
            "target.flange",
            "not the flange of the plan",
            value=stated,
            expected=plan.flange,
        )
    chain = load_serial_chain(realization.path, plan.flange)
    encoders = Encoders.of(calibration_of(realization), chain.joints)
    return replace(chain, signs=encoders.slope, offsets=encoders.offset)
