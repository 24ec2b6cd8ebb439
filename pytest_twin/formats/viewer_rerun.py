"""Write a comparison of two motions of one robot as a recording of Rerun (extra ``rerun``)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pytest_twin.errors import FormatError
from pytest_twin.formats.viewer_mcap import PLOTTED_JOINTS, Comparison

if TYPE_CHECKING:
    from rerun.blueprint import Blueprint

_COLOURS = {"measured": (158, 166, 178, 255), "predicted": (13, 102, 204, 140)}


def write_rerun(path: Path, comparison: Comparison) -> None:
    """Write the file.

    Raises:
        FormatError: rerun-sdk is not installed.
    """
    try:
        import rerun
    except ImportError:
        raise FormatError(
            "files of Rerun are written by rerun-sdk, which is not installed",
            path=path,
            expected="pip install 'pytest-twin[rerun]'",
        ) from None
    recording = rerun.RecordingStream("pytest-twin")
    recording.save(str(path), default_blueprint=_blueprint(comparison))
    recording.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    seconds = (comparison.stamp - comparison.stamp[0]) * 1e-9
    drawn = rerun.TimeColumn("time", duration=seconds[comparison.drawn])
    for robot, poses in comparison.poses.items():
        for at, body in enumerate(comparison.bodies):
            entity = f"{robot}/{rerun.escape_entity_path_part(body)}"
            if body in comparison.surfaces:
                surface = comparison.surfaces[body]
                recording.log(
                    entity,
                    rerun.Mesh3D(
                        vertex_positions=surface.vertices,
                        triangle_indices=surface.faces,
                        albedo_factor=_COLOURS[robot],
                    ),
                    static=True,
                )
            pose = poses[comparison.drawn, at]
            columns = rerun.Transform3D.columns(
                translation=pose[:, :3], quaternion=np.roll(pose[:, 3:], -1, axis=1)
            )
            recording.send_columns(entity, indexes=[drawn], columns=columns)
    time = rerun.TimeColumn("time", duration=seconds)
    for joint, values in comparison.joints.items():
        part = rerun.escape_entity_path_part(joint)
        series = {"measured": values[:, 0], "predicted": values[:, 1],
                  "residual": values[:, 1] - values[:, 0]}  # fmt: skip
        for name, scalars in series.items():
            columns = rerun.Scalars.columns(scalars=scalars)
            recording.send_columns(f"joints/{part}/{name}", indexes=[time], columns=columns)
    recording.disconnect()


def _blueprint(comparison: Comparison) -> Blueprint:
    """Both robots beside a plot for each joint, as in the layout of the MCAP file."""
    from rerun import blueprint, escape_entity_path_part

    plots = [
        blueprint.TimeSeriesView(origin=f"joints/{escape_entity_path_part(joint)}", name=joint)
        for joint in list(comparison.joints)[:PLOTTED_JOINTS]
    ]
    robots = blueprint.Spatial3DView(origin="/", name="measured and predicted")
    return blueprint.Blueprint(blueprint.Horizontal(robots, blueprint.Vertical(*plots)))
