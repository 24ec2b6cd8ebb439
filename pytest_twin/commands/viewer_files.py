"""Write a replay for viewers: the measured and the predicted robot side by side."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pytest_twin.commands.terminal import show
from pytest_twin.errors import TwinError
from pytest_twin.formats import atomic
from pytest_twin.formats.recording import JointSeries
from pytest_twin.formats.viewer_mcap import Comparison, Surface, layout, write_comparison
from pytest_twin.formats.viewer_rerun import write_rerun
from pytest_twin.trial import Trial, predicted_rows

if TYPE_CHECKING:
    from pytest_twin.realization import Realization

_POSES_PER_SECOND = 50.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare ``--view`` and ``--rerun``."""
    parser.add_argument(
        "--view",
        metavar="FILE.mcap",
        type=Path,
        help="also write the measured and the predicted robot side by side, with plots of the "
        "joints, for Foxglove and Lichtblick; the layout is beside it (FILE.layout.json)",
    )
    parser.add_argument(
        "--rerun", metavar="FILE.rrd", type=Path, help="the same for Rerun (extra rerun)"
    )


def chosen(args: argparse.Namespace, recording: Path) -> dict[str, str]:
    """Name of an option -> its file.

    Raises:
        TwinError: a file has another suffix, or would overwrite the recording.
    """
    files = {"view": args.view, "rerun": args.rerun}
    for name, suffix in (("view", ".mcap"), ("rerun", ".rrd")):
        if files[name] is not None:
            check_name(files[name], recording, suffix)
    return {name: str(path) for name, path in files.items() if path is not None}


def check_name(out: Path, recording: Path, suffix: str) -> None:
    """Check the name of a file that will be written.

    Raises:
        TwinError: another suffix, the recording itself, or a folder that does not exist.
    """
    if out.suffix != suffix:
        raise TwinError("not a file name of a recording", path=out, expected=f"FILE{suffix}")
    if out.resolve() == recording:
        raise TwinError("would overwrite the recording itself", path=out, expected="another file")
    if not out.absolute().parent.is_dir():
        raise TwinError("no such folder", path=out.parent, expected="a folder that exists")


def tell(files: Mapping[str, str]) -> None:
    """Print the names of the files."""
    for path in files.values():
        show(f"  for viewers: {path}")


def write(
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
