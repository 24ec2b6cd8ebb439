"""Accuracy of a frame: forward kinematics compared with externally measured poses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
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
from pytest_twin.checks.poses import configuration, encoder_parts, joints_above, joints_to_give
from pytest_twin.checks.schemas import NO_FIELDS, name_field, table
from pytest_twin.dependency import Structure
from pytest_twin.golden import Golden
from pytest_twin.metrics.pose import orientation_error, position_error

if TYPE_CHECKING:
    from pytest_twin.calibration.observations import Observations
    from pytest_twin.realization import Realization


class TcpAccuracy(Check):
    """Error of a frame's pose at recorded joint positions, relative to external measurements.

    ``values``: ``position`` and ``orientation``: measurement -> error in m and rad.
    """

    kind: ClassVar[str] = "tcp_accuracy"
    needs_record: ClassVar[bool] = False
    tolerances: ClassVar[Mapping[str, str]] = {
        "position": "m",
        "orientation": "rad",
        "position_rms": "m",
        "orientation_rms": "rad",
    }
    schema: ClassVar[Mapping[str, Any]] = {
        "target": table(
            {
                "frame": name_field("Body or site whose pose was measured."),
                "measurements": name_field(
                    "CSV file with one row for each measurement. The path is "
                    "relative to the twin's folder or to one of its roots. Columns: joint.NAME of "
                    "every joint that moves the frame (encoder reading, rad or m), and flange.x y "
                    "z qw qx qy qz (pose of the frame in the world, m) or point.FRAME.x y z "
                    "(position of its origin in the world, m)."
                ),
            },
            required=["frame", "measurements"],
        ),
        "stimulus": NO_FIELDS,
    }

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return kinematics of the chain to the frame, its joint zeros, the base and the file."""
        chain = structure.chain([golden.target["frame"]])
        return (
            chain
            | encoder_parts(structure, chain)
            | {"base:calibration", f"file:{golden.target['measurements']}"}
        )

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Compute the frame at every measured configuration with MuJoCo."""
        import mujoco

        from pytest_twin.realization.encoders import Encoders, calibration_of

        structure = realization.structure
        frame = golden.target["frame"]
        known_name(golden, "target.frame", frame, structure.frame_body, "frame")
        measured = _measurements(golden, realization)
        joints = sorted(
            joints_to_give(realization, joints_above(structure, [structure.frame_body[frame]]))
        )
        readings = _readings(golden, measured, joints)
        encoders = Encoders.of(calibration_of(realization), joints)
        positions = encoders.model_position(readings)
        data = mujoco.MjData(realization.model)
        errors: dict[str, dict[str, float]] = {"position": {}, "orientation": {}}
        for row, name in enumerate(measured.ids):
            values = dict(zip(joints, positions[row].tolist(), strict=True))
            data.qpos[:] = configuration(realization, values)
            mujoco.mj_kinematics(realization.model, data)
            found = realization.frame_pose(data, frame)
            if measured.flange is not None:
                pose = measured.flange[row]
                errors["position"][name] = position_error(found[:3, 3], pose[:3, 3])
                errors["orientation"][name] = orientation_error(found[:3, :3], pose[:3, :3])
            else:
                point = measured.points[frame][row]
                errors["position"][name] = position_error(found[:3, 3], point)
            progress((row + 1) / len(measured))
        return Observation(errors)

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare the worst measurement, or the root mean square error, with the tolerances."""
        return _measures(golden, observation.values, golden.target["frame"], self.tolerances)

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose nothing, because the check needs external measurements."""
        raise NothingToProposeError(
            "it needs measured poses of a frame; docs/kinds/tcp_accuracy.md has an example"
        )


def _measures(
    golden: Golden,
    errors: Mapping[str, Mapping[str, float]],
    subject: str,
    units: Mapping[str, str],
) -> list[Measure]:
    """Return a measure for each tolerance: ``NAME`` for the worst, ``NAME_rms`` for all.

    Args:
        golden: golden with the tolerances.
        errors: ``position`` and ``orientation`` -> measurement -> error, m and rad.
        units: tolerance -> SI unit.

    Raises:
        SpecError: no tolerance, or a tolerance of a quantity that was not measured.
    """
    if not golden.tolerance:
        raise spec_error(
            golden, "tolerance", "no tolerance bounds the errors", expected=", ".join(units)
        )
    measures = []
    for name, bound in golden.tolerance.items():
        each = errors[name.removesuffix("_rms")]
        if not each:
            raise spec_error(
                golden,
                f"tolerance.{name}",
                "no orientation was measured",
                expected="measured poses (flange.x y z qw qx qy qz), or tolerances of position",
            )
        worst = max(each, key=each.__getitem__)
        if name.endswith("_rms"):
            error = float(np.sqrt(np.mean(np.square(list(each.values())))))
            of = f"{subject} over {len(each)} measurements (worst: {worst})"
        else:
            error, of = each[worst], f"{subject} at measurement {worst} (worst of {len(each)})"
        measures.append(Measure.of_error(name, of, error, bound, "measurement"))
    return measures


def _measurements(golden: Golden, realization: Realization) -> Observations:
    """Return the rows of the file with a measurement of the frame."""
    twin = realization.twin
    if twin is None:
        raise spec_error(
            golden,
            "target.measurements",
            "a tcp_accuracy golden needs a twin.yaml",
            expected="a twin.yaml in a folder above the golden; pytest-twin init writes one",
        )
    frame, reference = golden.target["frame"], golden.target["measurements"]
    # The import takes a third of a second, and `pytest-twin init` loads this class for its schema.
    from pytest_twin.calibration.observations import load_observations

    found = load_observations(find_file(golden, "target.measurements", reference, twin))
    if found.flange is not None:
        there = np.isfinite(found.flange).all(axis=(1, 2))
    elif frame in found.points:
        there = np.isfinite(found.points[frame]).all(axis=1)
    else:
        there = np.zeros(len(found), dtype=bool)
    if not there.any():
        raise spec_error(
            golden,
            "target.measurements",
            f"no measurement of frame {frame!r}",
            value=reference,
            expected=f"columns flange.x y z qw qx qy qz (its pose in the world) or "
            f"point.{frame}.x y z (its origin), in m",
        )
    return found.rows(np.flatnonzero(there))


def _readings(golden: Golden, measured: Observations, joints: list[str]) -> np.ndarray:
    """Return the (rows, joints) encoder readings, rad or m."""
    columns = np.zeros((len(measured), len(joints)))
    for at, joint in enumerate(joints):
        values = measured.joints.get(joint, np.full(len(measured), np.nan))
        empty = np.flatnonzero(~np.isfinite(values))
        if len(empty):
            raise spec_error(
                golden,
                "target.measurements",
                f"no position of joint {joint!r}, which moves {golden.target['frame']!r}",
                value=f"measurement {measured.ids[empty[0]]}",
                expected=f"a column joint.{joint} with its encoder reading in every row, in rad "
                "(m where it slides)",
            )
        columns[:, at] = values
    return columns
