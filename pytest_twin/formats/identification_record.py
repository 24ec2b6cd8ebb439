"""Read ``identification.json`` for use in a twin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pytest_twin.formats import limits, typed
from pytest_twin.formats.digest import bytes_sha256
from pytest_twin.formats.record_fields import (
    UNUSABLE,
    Matrix,
    Size,
    check_square,
    digests,
    field_of,
    read_record,
    standard_deviation,
    unusable,
)
from pytest_twin.formats.sensor_record import SensorFields, sensor_fields

_EXPECTED = "identification.json of pytest-twin identify"
_FAMILIES = ("joint", "actuator", "body", "geom", "pair")
FittedAttributes = Mapping[str, Mapping[str, Mapping[str, float | tuple[float, ...]]]]
"""Family -> element -> attribute -> value in SI units."""


@dataclass(frozen=True, slots=True)
class EncoderChange:
    """Calibration of one encoder, ``model = sign * scale * measured + offset``, before and after.

    Attributes:
        before: ``offset`` (rad or m), ``sign`` and ``scale`` in the twin that was identified,
            without its records of identifications.
        after: the same fields, estimated from the measured efforts.
    """

    before: Mapping[str, float]
    after: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class IdentificationRecord:
    """Content of one ``identification.json`` that a twin uses.

    Attributes:
        sha256: SHA-256 of the file, hex.
        verdict: ``accepted``, ``improved`` or ``rejected``.
        fit: model attributes that the identification replaces.
        stages: stage -> its state, such as ``accepted``.
        values: parameter -> value in its unit, for the accepted stages.
        covariance_names, covariance: names and covariance of the parameters.
        held_out: joint -> relative error of its effort on held-out recordings.
        recordings: names of the held-out recordings.
        filter: cutoff of the low-pass, cutoff of the decimation filter (applied to regressor and
            effort alike) and sample rate, Hz; None without measured effort.
        inputs: file -> SHA-256, hex.
        units: parameter -> unit.
        deviations: parameter -> standard deviation in its unit.
        position_rms: joint -> root mean square error of its simulated position on held-out
            recordings, rad or m.
        without_effort: joints with measured motion but without measured effort.
        encoder_steps: joint -> quantization step of its encoder, rad or m.
        encoders: joint -> calibration of its encoder, before and after.
        drive_gains: joint -> recorded current per N*m (N); the parameters belong to the current
            divided by it.
        basis: field ``basis`` as written: content of the inputs that it used; None in a record of
            an earlier version.
    """

    id: str
    path: Path
    sha256: str
    verdict: str
    fit: FittedAttributes
    stages: Mapping[str, str]
    values: Mapping[str, float]
    covariance_names: tuple[str, ...]
    covariance: Matrix
    held_out: Mapping[str, Size]
    recordings: tuple[str, ...]
    filter: tuple[float, float, float] | None
    inputs: Mapping[str, str]
    units: Mapping[str, str] = field(default_factory=dict)
    deviations: Mapping[str, float] = field(default_factory=dict)
    position_rms: Mapping[str, Size] = field(default_factory=dict)
    without_effort: tuple[str, ...] = ()
    sensors: tuple[SensorFields, ...] = ()
    encoder_steps: Mapping[str, float] = field(default_factory=dict)
    encoders: Mapping[str, EncoderChange] = field(default_factory=dict)
    drive_gains: Mapping[str, float] = field(default_factory=dict)
    basis: Mapping[str, Any] | None = None


def read_identification_record(path: Path) -> IdentificationRecord:
    """Read an ``identification.json``.

    Raises:
        PathError: missing, a link, or no regular file.
        LimitError: beyond ``limits.OBSERVATIONS``.
        FormatError: the content is not what ``pytest-twin identify`` writes.
    """
    content, data = read_record(path, _EXPECTED)
    try:
        together = content["covariance"]
        used = {k: v for k, v in content["parameters"].items() if v.get("used", True)}
        filtered = content.get("filter")
        record = typed.build(
            {
                **content,
                "id": content["identification"],
                "path": path,
                "sha256": bytes_sha256(data),
                "stages": {stage["stage"]: stage["state"] for stage in content["stages"]},
                "values": {name: entry["value"] for name, entry in used.items()},
                "units": field_of(used, "unit"),
                "deviations": {
                    name: standard_deviation(interval)
                    for name, interval in field_of(used, "ci95").items()
                },
                "covariance_names": together["names"],
                "covariance": together["matrix"],
                "held_out": field_of(content["held_out"], "effort_relative"),
                "position_rms": field_of(content["held_out"], "position_rms"),
                "recordings": content["trials"]["held_out"],
                "filter": filtered and [filtered[key] for key in ("cutoff", "parallel", "rate")],
                "inputs": digests(content),
                "sensors": (),
            },
            IdentificationRecord,
        )
        _check(record)
        sensors = (sensor_fields(*item) for item in content.get("sensors", {}).items())
        return replace(record, sensors=tuple(sensors))
    except UNUSABLE as error:
        raise unusable(path, error, _EXPECTED) from None


def _check(record: IdentificationRecord) -> None:
    check_square(record.covariance, len(record.covariance_names))
    if not set(record.fit) <= set(_FAMILIES):
        raise ValueError("fit")
    if sum(map(len, record.fit.values())) > limits.OBSERVATIONS.name_chars:
        raise ValueError("fit: too many elements")
    for gain in record.drive_gains.values():
        if not gain > 0.0:
            raise ValueError(f"{gain!r} is not positive")
    for change in record.encoders.values():
        for encoder in (change.before, change.after):
            if set(encoder) != {"offset", "sign", "scale"}:
                raise ValueError("encoders: not offset, sign and scale")
            if abs(encoder["sign"]) != 1.0 or not encoder["scale"] > 0.0:
                raise ValueError(
                    "encoders: a sign that is not 1 or -1, or a scale that is not positive"
                )
