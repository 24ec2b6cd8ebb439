"""Read ``calibration.json`` for use in a twin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.errors import FormatError
from pytest_twin.formats.digest import bytes_sha256
from pytest_twin.formats.record_fields import (
    Matrix,
    covariance,
    digests,
    number,
    numbers,
    optional_table,
    read_record,
    standard_deviation,
    text,
)

Transform = tuple[tuple[float, ...], tuple[float, ...] | None]


@dataclass(frozen=True, slots=True)
class Deviation:
    """One deviation of the nominal placement of a joint on its parent link.

    Attributes:
        joint: the joint whose placement deviates.
        is_rotation: True for an angle (rad), False for an offset (m).
        direction: (3,) axis of rotation or translation, in the joint's frame.
        value: size of the deviation, rad or m.
    """

    joint: str
    is_rotation: bool
    direction: tuple[float, ...]
    value: float


@dataclass(frozen=True, slots=True)
class CalibrationRecord:
    """Content of one ``calibration.json`` that a twin uses.

    Attributes:
        id: name of the calibration.
        path: the file.
        sha256: SHA-256 of the file, hex.
        verdict: ``accepted``, ``rejected`` or ``degenerate``.
        joint_zeros: joint -> offset added to its reading, rad or m. It is the encoder's home
            position where the record has no external measurement of the joint.
        homes: joint -> sign of the reading (1 or -1) with which the home position was found.
        base_world: position (m) and quaternion w x y z of the base in the world, or None.
        held_out: root mean square errors on held-out observations, m and rad.
        transforms: record -> position (m) and quaternion w x y z of its child in its parent; the
            quaternion is None where a point was estimated.
        points: marker, or ``pivot.NAME`` -> (3,) position in the record's parent frame, m.
        held_out_ids: held-out observations.
        seen: observation -> position (m) and quaternion w x y z of the target in the camera
            frame, from its image.
        inputs: file, relative to the plan's folder -> SHA-256, hex.
        frames: record -> its parent frame and child frame.
        covariances: record -> covariance of x y z [m] and, for a pose, rx ry rz [rad].
        covariance_names, covariance: names and joint covariance of all estimated parameters.
        deviations: label -> deviation of a link.
        time_offset: offset between the two clocks and its standard deviation, s, or None.
        clock_drift: rate at which the offset grows, s/s; 0 if none was estimated.
        scale: scale of the camera's positions relative to m, or None if they are in m.
        target_scale: stated size of the target divided by its real one.
        basis: field ``basis`` as written: content of the inputs that it used; None in a record of
            an earlier version.
    """

    id: str
    path: Path
    sha256: str
    verdict: str
    joint_zeros: Mapping[str, float]
    base_world: tuple[tuple[float, ...], tuple[float, ...]] | None
    held_out: Mapping[str, float]
    transforms: Mapping[str, Transform] = field(default_factory=dict)
    points: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    held_out_ids: tuple[str, ...] = ()
    seen: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)
    frames: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    covariances: Mapping[str, Matrix] = field(default_factory=dict)
    covariance_names: tuple[str, ...] = ()
    covariance: Matrix = ()
    deviations: Mapping[str, Deviation] = field(default_factory=dict)
    time_offset: tuple[float, float] | None = None
    clock_drift: float = 0.0
    scale: float | None = None
    target_scale: float = 1.0
    homes: Mapping[str, float] = field(default_factory=dict)
    basis: Mapping[str, Any] | None = None


def read_calibration_record(path: Path) -> CalibrationRecord:
    """Read a ``calibration.json``.

    Raises:
        PathError: missing, a link, or no regular file.
        LimitError: beyond ``limits.OBSERVATIONS``.
        FormatError: the content is not what ``pytest-twin calibrate`` writes.
    """
    content, data = read_record(path, "calibration.json of pytest-twin calibrate")
    try:
        if content["schema"] != 1:
            raise KeyError("schema")
        records = content["records"]
        homes = records.get("encoder_home", {"values": {}})["values"]
        zeros = {**homes, **records.get("joint_zeros", {"values": {}})["values"]}
        base = records.get("base_world")
        together = content.get("covariance", _of_homes(homes))
        names = tuple(text(name) for name in together["of"])
        offset = records.get("time_offset")
        return CalibrationRecord(
            id=text(content["calibration"]),
            path=path,
            sha256=bytes_sha256(data),
            verdict=text(content["verdict"]),
            joint_zeros={text(name): number(one["value"]) for name, one in zeros.items()},
            base_world=None
            if base is None
            else (
                numbers(base["transform"]["xyz"], 3),
                numbers(base["transform"]["quaternion_wxyz"], 4),
            ),
            held_out={
                name: number(value)
                for name, value in content["held_out"].items()
                if name.endswith("_rms")
            },
            transforms={
                text(name): _transform(one["transform"])
                for name, one in records.items()
                if "transform" in one
            },
            points={
                text(name): numbers(one["xyz"], 3)
                for name, one in records.get("points", {"values": {}})["values"].items()
            },
            held_out_ids=tuple(text(name) for name in content["held_out"].get("ids", ())),
            seen={
                text(name): numbers(one["camera_from_target"], 7)
                for name, one in content.get("images", {}).items()
                if "camera_from_target" in one
            },
            inputs=digests(content),
            basis=optional_table(content.get("basis")),
            frames={
                text(name): (text(one["parent"]), text(one["child"]))
                for name, one in records.items()
                if "transform" in one and "parent" in one
            },
            covariances={
                text(name): covariance(one["covariance"], len(one["covariance_of"]))
                for name, one in records.items()
                if "transform" in one and "covariance" in one
            },
            covariance_names=names,
            covariance=covariance(together["matrix"], len(names)),
            deviations={
                text(label): Deviation(
                    text(one["joint"]),
                    one["kind"] == "rotation",
                    numbers(one["direction"], 3),
                    number(one["value"]),
                )
                for label, one in records.get("geometry", {"values": {}})["values"].items()
                if "direction" in one
            },
            time_offset=None
            if offset is None
            else (number(offset["value"]), standard_deviation(offset["ci95"])),
            clock_drift=_drift(offset),
            scale=number(records["scale"]["value"]) if "scale" in records else None,
            target_scale=number(records.get("target_scale", {"value": 1.0})["value"]),
            homes={text(name): number(one["sign"]) for name, one in homes.items()},
        )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise FormatError(
            f"a field is missing or unusable: {error}",
            path=path,
            expected="calibration.json of pytest-twin calibrate, schema 1",
        ) from None


def _drift(offset: Mapping[str, Any] | None) -> float:
    drift = {} if offset is None else offset.get("drift", {})
    return number(drift["value"]) if drift.get("used") else 0.0


def _of_homes(homes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the diagonal covariance of the home positions, whose errors are independent."""
    sizes = [standard_deviation(one["ci95"]) ** 2 for one in homes.values()]
    count = range(len(sizes))
    matrix = [[sizes[row] if row == column else 0.0 for column in count] for row in count]
    return {"of": [f"joint_zeros.{name}" for name in homes], "matrix": matrix}


def _transform(value: Any) -> Transform:
    quaternion = value["quaternion_wxyz"]
    return (
        numbers(value["xyz"], 3),
        None if quaternion is None else numbers(quaternion, 4),
    )
