"""Write a comparison of two motions of one robot as an MCAP file that viewers open by itself.

Foxglove and Lichtblick draw ``foxglove.SceneUpdate`` in the frames of ``foxglove.FrameTransforms``
without further files. https://docs.foxglove.dev/docs/sdk/schemas
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.formats.atomic import open_replacement
from pytest_twin.formats.ros_serialization import Floats, Integers

WORLD = "world"
LAYOUT = "layout.json"
"""Name of the attachment with the layout."""
_COLOURS: Mapping[str, tuple[float, float, float, float]] = {
    "measured": (0.62, 0.65, 0.7, 1.0),
    "predicted": (0.05, 0.4, 0.8, 0.55),
}
"""Robot -> red, green, blue, opacity."""
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_FRAMES: dict[str, Any] = {
    "type": "object",
    "properties": {
        "transforms": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "timestamp": _TIME,
                    "parent_frame_id": {"type": "string"},
                    "child_frame_id": {"type": "string"},
                    "translation": {"type": "object"},
                    "rotation": {"type": "object"},
                },
            },
        }
    },
}
_SCENE: dict[str, Any] = {
    "type": "object",
    "properties": {"deletions": {"type": "array"}, "entities": {"type": "array"}},
}
_SERIES: dict[str, Any] = {
    "type": "object",
    "properties": {name: {"type": "number"} for name in ("measured", "predicted", "residual")},
}
PLOTTED_JOINTS = 6
"""Largest number of joints with a plot in a layout."""


@dataclass(frozen=True, slots=True)
class Surface:
    """Triangles of a body in its frame: (v, 3) vertices in m and (f, 3) indices of them."""

    vertices: Floats
    faces: Integers


@dataclass(frozen=True, slots=True)
class Comparison:
    """Measured and predicted motion of one robot.

    Attributes:
        stamp: (n,) ns.
        bodies: (b,) names.
        poses: ``measured`` and ``predicted`` -> (n, b, 7) x, y, z (m), then w, x, y, z.
        surfaces: body -> triangles.
        joints: joint -> (n, 2) measured and predicted position, rad or m.
        drawn: rows whose poses are written.
        model: name and content of the model's file, which is attached.
    """

    stamp: Integers
    bodies: Sequence[str]
    poses: Mapping[str, Floats]
    surfaces: Mapping[str, Surface]
    joints: Mapping[str, Floats]
    drawn: Integers
    model: tuple[str, bytes]


def topic_of(joint: str) -> str:
    """Topic of a joint's series."""
    return "/joints/" + re.sub(r"[^A-Za-z0-9_]", "_", joint)


def write_comparison(path: Path, comparison: Comparison) -> None:
    """Write the file, atomically.

    Raises:
        PathError: the file cannot be written.
    """
    from mcap.writer import CompressionType, Writer

    with open_replacement(path) as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="", library="pytest-twin")
        start = int(comparison.stamp[0])

        def channel(topic: str, name: str, schema: Mapping[str, Any]) -> int:
            text = json.dumps({"title": name, **schema}).encode()
            number: int = writer.register_channel(
                topic, "json", writer.register_schema(name, "jsonschema", text)
            )
            return number

        layout_text = json.dumps(layout(comparison)).encode()
        for name, kind, content in (
            (LAYOUT, "application/json", layout_text),
            (comparison.model[0], "application/xml", comparison.model[1]),
        ):
            writer.add_attachment(start, start, name, kind, content)
        for robot in comparison.poses:
            number = channel(f"/{robot}/robot", "foxglove.SceneUpdate", _SCENE)
            writer.add_message(number, start, _dumps(_scene(comparison, robot)), start)
        frames = channel("/tf", "foxglove.FrameTransforms", _FRAMES)
        for row in comparison.drawn.tolist():
            stamp = int(comparison.stamp[row])
            writer.add_message(frames, stamp, _dumps(_transforms(comparison, row)), stamp)
        for joint, values in comparison.joints.items():
            number = channel(topic_of(joint), "pytest_twin.JointComparison", _SERIES)
            for stamp, (measured, predicted) in zip(
                comparison.stamp.tolist(), values.tolist(), strict=True
            ):
                found = {
                    "measured": measured, "predicted": predicted, "residual": predicted - measured
                }  # fmt: skip
                known = {name: value for name, value in found.items() if np.isfinite(value)}
                writer.add_message(number, stamp, _dumps(known), stamp)
        writer.finish()  # type: ignore[no-untyped-call]


def layout(comparison: Comparison) -> dict[str, Any]:
    """Return a layout of Foxglove and Lichtblick: both robots, and each joint with its residual."""
    panels: dict[str, Any] = {
        "3D!robots": {
            "followTf": WORLD,
            "topics": {f"/{robot}/robot": {"visible": True} for robot in comparison.poses},
            "layers": {"grid": {"layerId": "foxglove.Grid", "visible": True, "size": 4.0}},
        }
    }
    for joint in list(comparison.joints)[:PLOTTED_JOINTS]:
        topic = topic_of(joint)
        panels[f"Plot!{topic.removeprefix('/joints/')}"] = {
            "foxglovePanelTitle": joint,
            "showLegend": True,
            "isSynced": True,
            "xAxisVal": "timestamp",
            "paths": [
                {"value": f"{topic}.{name}", "enabled": True, "timestampMethod": "receiveTime"}
                for name in _SERIES["properties"]
            ],
        }
    plots = [name for name in panels if name.startswith("Plot!")]
    column: Any = plots[-1] if plots else None
    for at, name in enumerate(reversed(plots[:-1]), 2):
        column = {"direction": "column", "first": name, "second": column,
                  "splitPercentage": 100.0 / at}  # fmt: skip
    robots = "3D!robots"
    content = robots if column is None else {
        "direction": "row", "first": robots, "second": column, "splitPercentage": 55.0
    }  # fmt: skip
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": content,
    }


def _dumps(message: object) -> bytes:
    return json.dumps(message, separators=(",", ":")).encode()


def _time(stamp: int) -> dict[str, int]:
    return {"sec": stamp // 10**9, "nsec": stamp % 10**9}


def _xyz(values: Sequence[float]) -> dict[str, float]:
    return dict(zip("xyz", values, strict=True))


def _transforms(comparison: Comparison, row: int) -> dict[str, Any]:
    time = _time(int(comparison.stamp[row]))
    return {
        "transforms": [
            {
                "timestamp": time,
                "parent_frame_id": WORLD,
                "child_frame_id": f"{robot}/{body}",
                "translation": _xyz(pose[:3]),
                "rotation": dict(zip("wxyz", pose[3:], strict=True)),
            }
            for robot, poses in comparison.poses.items()
            for body, pose in zip(comparison.bodies, poses[row].tolist(), strict=True)
        ]
    }


def _scene(comparison: Comparison, robot: str) -> dict[str, Any]:
    time = _time(int(comparison.stamp[0]))
    origin = {"position": _xyz((0.0, 0.0, 0.0)), "orientation": {**_xyz((0.0, 0.0, 0.0)), "w": 1.0}}
    colour = dict(zip("rgba", _COLOURS[robot], strict=True))
    return {
        "deletions": [],
        "entities": [
            {
                "timestamp": time,
                "frame_id": f"{robot}/{body}",
                "id": body,
                "lifetime": {"sec": 0, "nsec": 0},
                "frame_locked": True,
                "metadata": [],
                **{name: [] for name in ("arrows", "cubes", "spheres", "cylinders", "lines",
                                         "texts", "models")},
                "triangles": [{
                    "pose": origin,
                    "points": [_xyz(p) for p in np.round(surface.vertices, 5).tolist()],
                    "color": colour,
                    "colors": [],
                    "indices": surface.faces.ravel().tolist(),
                }],
            }
            for body, surface in comparison.surfaces.items()
        ],
    }  # fmt: skip
