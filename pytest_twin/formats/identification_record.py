"""Read ``identification.json`` for use in a twin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.errors import FormatError
from pytest_twin.formats import limits
from pytest_twin.formats.digest import bytes_sha256
from pytest_twin.formats.record_fields import (
    Matrix,
    covariance,
    digests,
    number,
    optional_table,
    read_record,
    standard_deviation,
    text,
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
        id: name of the identification.
        path: the file.
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
        sensors: calibrated sensors.
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
    held_out: Mapping[str, float]
    recordings: tuple[str, ...]
    filter: tuple[float, float, float] | None
    inputs: Mapping[str, str]
    units: Mapping[str, str] = field(default_factory=dict)
    deviations: Mapping[str, float] = field(default_factory=dict)
    position_rms: Mapping[str, float] = field(default_factory=dict)
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
        if content["schema"] != 1:
            raise KeyError("schema")
        together = content["covariance"]
        names = tuple(text(name) for name in together["names"])
        matrix = covariance(together["matrix"], len(names))
        used = {k: v for k, v in content["parameters"].items() if v.get("used", True)}
        filtered = content.get("filter")
        return IdentificationRecord(
            id=text(content["identification"]),
            path=path,
            sha256=bytes_sha256(data),
            verdict=text(content["verdict"]),
            fit=_fit(content["fit"]),
            stages={text(one["stage"]): text(one["state"]) for one in content["stages"]},
            values={text(name): number(one["value"]) for name, one in used.items()},
            covariance_names=names,
            covariance=matrix,
            held_out={
                text(joint): number(one["effort_relative"])
                for joint, one in content["held_out"].items()
                if "effort_relative" in one
            },
            recordings=tuple(text(name) for name in content["trials"]["held_out"]),
            filter=None
            if filtered is None
            else (
                number(filtered["cutoff"]),
                number(filtered["parallel"]),
                number(filtered["rate"]),
            ),
            inputs=digests(content),
            basis=optional_table(content.get("basis")),
            units={text(name): text(one["unit"]) for name, one in used.items() if "unit" in one},
            deviations={
                text(name): standard_deviation(one["ci95"])
                for name, one in used.items()
                if "ci95" in one
            },
            without_effort=tuple(text(joint) for joint in content.get("without_effort", ())),
            position_rms={
                text(joint): number(one["position_rms"])
                for joint, one in content["held_out"].items()
                if "position_rms" in one
            },
            sensors=tuple(
                sensor_fields(text(name), one) for name, one in content.get("sensors", {}).items()
            ),
            encoder_steps={
                text(joint): number(step)
                for joint, step in content.get("encoder_steps", {}).items()
            },
            encoders={
                text(joint): EncoderChange(_encoder(one["before"]), _encoder(one["after"]))
                for joint, one in content.get("encoders", {}).items()
            },
            drive_gains={
                text(joint): _positive(gain)
                for joint, gain in content.get("drive_gains", {}).items()
            },
        )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise FormatError(
            f"a field is missing or unusable: {error}", path=path, expected=f"{_EXPECTED}, schema 1"
        ) from None


def _positive(value: Any) -> float:
    if not number(value) > 0.0:
        raise ValueError(f"{value!r} is not positive")
    return number(value)


def _encoder(value: Mapping[str, Any]) -> Mapping[str, float]:
    found = {key: number(value[key]) for key in ("offset", "sign", "scale")}
    if abs(found["sign"]) != 1.0 or not found["scale"] > 0.0:
        raise ValueError("encoders: a sign that is not 1 or -1, or a scale that is not positive")
    return found


def _fit(value: Any) -> FittedAttributes:
    if not set(value) <= set(_FAMILIES):
        raise ValueError("fit")
    if sum(len(own) for own in value.values()) > limits.OBSERVATIONS.name_chars:
        raise ValueError("fit: too many elements")
    return {
        family: {
            text(name): {
                text(key): tuple(number(v) for v in one) if isinstance(one, list) else number(one)
                for key, one in patch.items()
            }
            for name, patch in own.items()
        }
        for family, own in value.items()
    }
