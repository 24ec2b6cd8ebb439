"""Read ``calibration.json`` for use in a twin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.formats import typed
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

Vector = tuple[float, float, float]
Transform = tuple[Vector, tuple[float, float, float, float] | None]
_EXPECTED = "calibration.json of pytest-twin calibrate"


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
    direction: Vector
    value: float


@dataclass(frozen=True, slots=True)
class CalibrationRecord:
    """Content of one ``calibration.json`` that a twin uses.

    Attributes:
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
    base_world: tuple[Vector, tuple[float, float, float, float]] | None
    held_out: Mapping[str, Size]
    transforms: Mapping[str, Transform] = field(default_factory=dict)
    points: Mapping[str, Vector] = field(default_factory=dict)
    held_out_ids: tuple[str, ...] = ()
    seen: Mapping[str, tuple[float, float, float, float, float, float, float]] = field(
        default_factory=dict
    )
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
    content, data = read_record(path, _EXPECTED)
    try:
        records = content["records"]
        homes, zeros, points, links = (
            records.get(name, {"values": {}})["values"]
            for name in ("encoder_home", "joint_zeros", "points", "geometry")
        )
        poses = {name: entry for name, entry in records.items() if "transform" in entry}
        together = content.get("covariance", _of_homes(homes))
        offset = records.get("time_offset")
        transforms = {name: _transform(entry["transform"]) for name, entry in poses.items()}
        record = typed.build(
            {
                **content,
                "id": content["calibration"],
                "path": path,
                "sha256": bytes_sha256(data),
                "joint_zeros": {name: v["value"] for name, v in {**homes, **zeros}.items()},
                "homes": {name: home["sign"] for name, home in homes.items()},
                "base_world": transforms.get("base_world"),
                "held_out": {k: v for k, v in content["held_out"].items() if k.endswith("_rms")},
                "held_out_ids": content["held_out"].get("ids", ()),
                "transforms": transforms,
                "points": {name: point["xyz"] for name, point in points.items()},
                "seen": field_of(content.get("images", {}), "camera_from_target"),
                "inputs": digests(content),
                "frames": {
                    name: (entry["parent"], entry["child"])
                    for name, entry in poses.items()
                    if "parent" in entry
                },
                "covariances": field_of(poses, "covariance"),
                "covariance_names": together["of"],
                "covariance": together["matrix"],
                "deviations": {
                    label: {**link, "is_rotation": link["kind"] == "rotation"}
                    for label, link in links.items()
                    if "direction" in link
                },
                "time_offset": offset and (offset["value"], standard_deviation(offset["ci95"])),
                "clock_drift": _drift(offset),
                "scale": records.get("scale", {"value": None})["value"],
                "target_scale": records.get("target_scale", {"value": 1.0})["value"],
            },
            CalibrationRecord,
        )
        for name, matrix in record.covariances.items():
            check_square(matrix, len(records[name]["covariance_of"]))
        check_square(record.covariance, len(record.covariance_names))
    except UNUSABLE as error:
        raise unusable(path, error, _EXPECTED) from None
    return record


def _drift(offset: Mapping[str, Any] | None) -> Any:
    drift = {} if offset is None else offset.get("drift", {})
    return drift["value"] if drift.get("used") else 0.0


def _of_homes(homes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the diagonal covariance of the home positions, whose errors are independent."""
    sizes = [standard_deviation(one["ci95"]) ** 2 for one in homes.values()]
    count = range(len(sizes))
    matrix = [[sizes[row] if row == column else 0.0 for column in count] for row in count]
    return {"of": [f"joint_zeros.{name}" for name in homes], "matrix": matrix}


def _transform(value: Mapping[str, Any]) -> tuple[Any, Any]:
    return value["xyz"], value["quaternion_wxyz"]
