"""Errors of two streams under the offset and transforms of a calibration record."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.clocks.calibrate_streams import seen_in, streams_of, stretches
from pytest_twin.calibration.clocks.offset import ClockFit, errors_at
from pytest_twin.calibration.plan import Plan
from pytest_twin.calibration.record_prediction import recorded_pose
from pytest_twin.calibration.solvers.algebraic import HandEye
from pytest_twin.errors import SpecError
from pytest_twin.formats.calibration_record import CalibrationRecord


def held_out_errors(plan: Plan, record: CalibrationRecord) -> tuple[FloatArray, FloatArray]:
    """(n,) translation (m) and rotation (rad) errors of the record's held-out poses.

    Args:
        plan: plan of the calibration, with the streams to predict.
        record: record of a calibration from streams.

    Raises:
        SpecError: the record lacks a transform, the offset or held-out poses.
        TwinError: a stream cannot be used.
    """
    if record.time_offset is None:
        raise SpecError(
            "no offset of the clocks", path=record.path, where="records.time_offset",
            expected="a record of the streams in the plan",
        )  # fmt: skip
    hand, camera = streams_of(plan)
    _, held = stretches(camera, plan)
    if not len(held):
        raise SpecError(
            "the calibration has no held-out observations",
            path=record.path,
            where="held_out",
            expected="hold_out: in its plan, with a fraction above 0",
        )
    mounted, world = (
        recorded_pose(plan, f"camera.{role}", record) for role in ("mounted", "world")
    )
    if hand.is_inverted:
        mounted, world = world, mounted
    fit = ClockFit.without_spread(
        record.time_offset[0], HandEye(mounted, world), record.clock_drift, record.target_scale
    )
    middle = float(camera.time.mean())
    part = camera.rows(held)
    # The record does not state whether the camera's poses were inverted; the better one is used.
    both = (
        errors_at(hand, part, seen_in(part, inverted=inverted), fit, middle)
        for inverted in (False, True)
    )
    return min(both, key=lambda errors: float(np.median(errors[0])))
