"""Write a replay for viewers: the measured and the predicted robot side by side."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pytest_twin.formats import atomic
from pytest_twin.formats.recording import JointSeries
from pytest_twin.formats.viewer_mcap import Comparison, Surface, layout, write_comparison
from pytest_twin.formats.viewer_rerun import write_rerun
from pytest_twin.trial import Trial, predicted_rows

if TYPE_CHECKING:
    from pytest_twin.realization import Realization

_POSES_PER_SECOND = 50.0


def write_viewer_files(
    files: Mapping[str, str],
    realization: Realization,
    trials: Sequence[Trial],
    predicted: JointSeries,
) -> None:
    """Write the files that a user asked for.

    Args:
        files: ``view`` or ``rerun`` -> path.
        trials: the measured trials, as they were replayed.
        predicted: prediction at the stamps of all trials.
    """
    from pytest_twin.realization.body_motion import body_motion, body_triangles

    model = realization.model
    joints = [name for name in predicted.names if all(name in t.joints for t in trials)]
    assert predicted.position is not None
    positions = {
        "measured": np.concatenate([
            t.position[predicted_rows(t)][:, [t.joints.index(name) for name in joints]]
            for t in trials
        ]),
        "predicted": predicted.position[:, [predicted.names.index(name) for name in joints]],
    }  # fmt: skip
    stamp = predicted.stamp
    drawn = _drawn(stamp)
    poses = {}
    bodies: tuple[str, ...] = ()
    for robot, position in positions.items():
        rows = position[drawn]
        motion = body_motion(model, joints, rows)
        bodies = motion.names
        poses[robot] = np.full((len(stamp), len(bodies), 7), np.nan)
        poses[robot][drawn] = np.concatenate([motion.position, motion.quaternion_wxyz], axis=2)
    comparison = Comparison(
        stamp, bodies, poses,
        {body: Surface(one.vertices, one.faces) for body, one in body_triangles(model).items()},
        {name: np.column_stack([positions["measured"][:, at], positions["predicted"][:, at]])
         for at, name in enumerate(joints)},
        drawn, (realization.path.name, realization.path.read_bytes()),
    )  # fmt: skip
    if "view" in files:
        view = Path(files["view"])
        write_comparison(view, comparison)
        text = json.dumps(layout(comparison), indent=1) + "\n"
        atomic.write_text(view.with_suffix(".layout.json"), text)
    if "rerun" in files:
        write_rerun(Path(files["rerun"]), comparison)


def _drawn(stamp: np.ndarray) -> np.ndarray:
    """Rows at most so many times a second."""
    slots = ((stamp - stamp[0]) * 1e-9 * _POSES_PER_SECOND).astype(np.int64)
    return np.unique(slots, return_index=True)[1]
