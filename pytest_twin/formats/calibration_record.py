"""``calibration.json`` as a twin reads it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.errors import FormatError
from pytest_twin.formats.digest import bytes_sha256
from pytest_twin.formats.record_fields import number, numbers, read_record, text

Transform = tuple[tuple[float, ...], tuple[float, ...] | None]


@dataclass(frozen=True, slots=True)
class CalibrationRecord:
    """What a twin takes from one calibration.

    Attributes:
        id: of the record.
        path: the file.
        sha256: of the file, hex.
        verdict: ``accepted``, ``rejected`` or ``degenerate``.
        joint_zeros: joint -> what is added to its reading, rad or m.
        base_world: position (m) and quaternion w x y z of the base in the world, or None.
        held_out: root mean squares on observations that nothing was fitted on, m and rad.
        transforms: record -> position (m) and quaternion w x y z of its child in its parent; the
            quaternion is None where a point was estimated.
        points: marker, or ``pivot.NAME`` -> its place in the record's parent, m.
        held_out_ids: observations that nothing was fitted on.
        seen: observation -> position (m) and quaternion w x y z of the target in the camera, from
            its image.
        inputs: file, relative to the plan's folder -> SHA-256, hex.
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


def read_calibration_record(path: Path) -> CalibrationRecord:
    """Read a ``calibration.json``.

    Raises:
        PathError: missing, a link, or no regular file.
        LimitError: beyond ``limits.OBSERVATIONS``.
        FormatError: not what ``pytest-twin calibrate`` writes.
    """
    content, data = read_record(path, "calibration.json of pytest-twin calibrate")
    try:
        if content["schema"] != 1:
            raise KeyError("schema")
        records = content["records"]
        zeros = records.get("joint_zeros", {"values": {}})["values"]
        base = records.get("base_world")
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
            inputs={
                text(name): text(one["sha256"]) for name, one in content.get("inputs", {}).items()
            },
        )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise FormatError(
            f"a field is missing or unusable: {error}",
            path=path,
            expected="calibration.json of pytest-twin calibrate, schema 1",
        ) from None


def _transform(value: Any) -> Transform:
    quaternion = value["quaternion_wxyz"]
    return (
        numbers(value["xyz"], 3),
        None if quaternion is None else numbers(quaternion, 4),
    )
