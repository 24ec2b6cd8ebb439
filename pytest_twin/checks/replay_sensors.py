"""Predict the readings of a twin's sensors along the motion of a replay golden."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pytest_twin.checks.base import Measure
from pytest_twin.checks.fields import known_name, quantity, spec_error, tolerance_schema
from pytest_twin.checks.schemas import mapping, table
from pytest_twin.formats.recording import JointSeries
from pytest_twin.golden import Golden
from pytest_twin.units import Quantity

if TYPE_CHECKING:
    from pytest_twin.open_loop import Replayed
    from pytest_twin.realization import Realization

_BY_UNIT: Mapping[str, str] = {
    "N": "force_rms",
    "N*m": "torque_rms",
    "rad/s": "angular_velocity_rms",
    "m/s^2": "acceleration_rms",
    "rad": "angle_rms",
}
"""Unit of a channel -> its tolerance."""
SENSORS_SCHEMA: Mapping[str, Any] = mapping(
    table({name: tolerance_schema(unit) for unit, name in _BY_UNIT.items()}, minProperties=1),
    "Sensor of a record under fit: in twin.yaml -> tolerances of its channels.",
    minProperties=1,
)


def as_read(results: Sequence[Replayed], realization: Realization) -> list[Replayed]:
    """Return the replays with positions quantized as by the encoders of the twin's records."""
    from pytest_twin.identification.sensing.reading_prediction import encoders_of

    encoders = encoders_of(realization.twin)
    if not encoders:
        return list(results)
    found = []
    for one in results:
        position = one.position.copy()
        for column, joint in enumerate(one.trial.joints):
            if joint in encoders:
                position[:, column] = encoders[joint].measured(position[:, column])
        found.append(replace(one, position=position))
    return found


def sensor_values(
    golden: Golden, realization: Realization, results: Sequence[Replayed]
) -> dict[str, Any]:
    """Return sensor -> ``rms`` of predicted minus recorded values and ``unit``, by channel.

    Args:
        golden: golden that names the sensors.
        realization: the model, with its twin.
        results: replays before quantization by encoders.

    Raises:
        SpecError: no record has a sensor, or the recording lacks its readings.
    """
    from pytest_twin.identification.sensing.reading_prediction import compare_readings, sensors_of

    twin = realization.twin
    known = sensors_of(twin)
    for name in golden.target["sensors"]:
        known_name(golden, f"target.sensors.{name}", name, known, "sensor of a record under fit")
    assert twin is not None
    asked = {name: known[name] for name in golden.target["sensors"]}
    path = results[0].trial.path
    found, notes = compare_readings(
        asked, path, realization, _motion(results), twin.topics["state"]
    )
    for name in asked:
        if name not in found:
            raise spec_error(
                golden,
                f"target.sensors.{name}",
                next(
                    (note for note in notes if note.startswith(f"sensor {name} ")), "not compared"
                ),
                expected=f"a recording with readings on {asked[name].topic}",
            )
    return found


def sensor_measures(golden: Golden, values: Mapping[str, Any]) -> Iterator[Measure]:
    """Compare each channel of each sensor with its tolerance.

    Raises:
        SpecError: a tolerance applies to no channel of the sensor.
    """
    for name, one in values.items():
        own = golden.target["sensors"][name]
        units = {_BY_UNIT[unit]: unit for unit in one["unit"].values()}
        for tolerance, stated in own.items():
            where = f"target.sensors.{name}.{tolerance}"
            if tolerance not in units:
                raise spec_error(
                    golden, where, f"no channel of {name} has this unit",
                    expected=" or ".join(units),
                )  # fmt: skip
            bound = Quantity(quantity(golden, where, stated, units[tolerance]), units[tolerance])
            for axis, unit in one["unit"].items():
                if unit == units[tolerance]:
                    subject, error = f"{name}, {axis}", one["rms"][axis]
                    yield Measure.of_error(tolerance, subject, error, bound, "recording")


def _motion(results: Sequence[Replayed]) -> JointSeries:
    """Return the predicted motion as one topic, with stamps in ns."""
    stamp = np.concatenate([r.trial.stamps for r in results])
    return JointSeries(
        topic="",
        names=results[0].trial.joints,
        stamp=stamp,
        log_time=stamp,
        position=np.concatenate([r.position for r in results]),
        velocity=np.concatenate([r.velocity for r in results]),
        effort=np.concatenate([r.effort for r in results]),
    )
