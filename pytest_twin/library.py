"""Functions for programs that use pytest-twin; ``pytest_twin`` itself lists them.

:func:`load_model`, :func:`read_trials` and :func:`replay` work in this process. The others do what
the command of their name does: files are read in a child process under bounds, the result appears
in ``out`` at once or not at all, and the returned document is its JSON file.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pytest_twin import release as releases
from pytest_twin.commands import calibrate as calibration
from pytest_twin.commands import diagnose as diagnosis
from pytest_twin.commands import identify as identification
from pytest_twin.commands.prediction import predict
from pytest_twin.formats.recording import JointSeries
from pytest_twin.gate.failure_diagnosis import DIAGNOSIS_FILE
from pytest_twin.loaded_model import LoadedModel, load_model
from pytest_twin.recording_options import NO_OPTIONS, RecordingOptions
from pytest_twin.release import Verdict
from pytest_twin.trial import Trial, make_trials, recording_at

__all__ = [
    "LoadedModel",
    "calibrate",
    "diagnose",
    "identify",
    "load_model",
    "read_trials",
    "replay",
    "verify",
]

StrPath = str | Path


def read_trials(
    model: LoadedModel,
    recording: StrPath,
    *,
    episode: int | None = None,
    options: RecordingOptions = NO_OPTIONS,
) -> list[Trial]:
    """Read a recording as trials of a model: one, or one for each part between gaps.

    >>> model = load_model("twin.yaml")
    >>> [trial] = read_trials(model, "recordings/moves.csv")
    >>> trial.joints, trial.duration, trial.position.shape
    (('slide',), 5.99, (600, 1))

    Args:
        model: it decides joint names, units, topics and options where ``options`` does not.
        recording: MCAP, rosbag2, CSV file, or LeRobot data set.
        episode: episode of a data set, from 0.
        options: how to read it, as on the command line.

    Raises:
        TwinError: it cannot be read, or it does not belong to the model.
    """
    chosen = options.over(model.options)
    read = recording_at(Path(recording), model.topics, chosen, episode)
    return make_trials(read, model.realization.structure, chosen)


def replay(model: LoadedModel, trials: Sequence[Trial]) -> list[JointSeries]:
    """Simulate trials open loop: from the commands and the first state of each.

    >>> model = load_model("twin.yaml")
    >>> [trial] = read_trials(model, "recordings/moves.csv")
    >>> [predicted] = replay(model, [trial])
    >>> error = predicted.position - trial.position  # m
    >>> print(f"{1e3 * error.std():.1f} mm")
    9.1 mm

    Returns:
        For each trial, the predicted joint states at its stamps.

    Raises:
        TwinError: a controller or payload of a trial is not in the twin, or the motion diverged.
    """
    predicted, _ = predict(model.realization, model.patched, trials, lambda fraction: None)
    return predicted


def diagnose(
    model: StrPath,
    recordings: Sequence[StrPath],
    held_out: Sequence[StrPath] = (),
    *,
    out: StrPath,
    seconds: float = diagnosis.SECONDS,
) -> dict[str, Any]:
    """Find the physics that a model lacks; return ``diagnosis.json``.

    >>> document = diagnose(
    ...     "twin.yaml",
    ...     ["recordings/steps.csv", "recordings/sweep.csv"],
    ...     held_out=["recordings/moves.csv"],
    ...     out="why",
    ... )
    >>> document["verdict"], [finding["effect"] for finding in document["findings"]]
    ('explained', ['viscous_friction', 'coulomb_friction'])
    >>> patched = load_model("why")

    Args:
        model: MJCF or URDF file, ``twin.yaml``, or the folder of an earlier diagnosis.
        recordings: recordings of which some are fitted.
        held_out: recordings that only test the result; by default some of ``recordings``.
        out: folder of the result, new or that of an earlier diagnosis.
        seconds: limit of the processor time, s; 0 for none.

    Raises:
        TwinError: the input cannot be used.
    """
    folder = Path(out).absolute()
    arguments = {"topics": {}, "options": {}, "seconds": seconds}
    diagnosis.diagnose_into(folder, Path(model), _paths(recordings), _paths(held_out), arguments)
    document: dict[str, Any] = json.loads((folder / DIAGNOSIS_FILE).read_text("utf-8"))
    return document


def identify(
    model: StrPath,
    recordings: Sequence[StrPath],
    held_out: Sequence[StrPath] = (),
    *,
    out: StrPath,
) -> dict[str, Any]:
    """Identify the parameters of a model; return ``identification.json``.

    >>> document = identify("arm.xml", ["one.csv", "two.csv"], ["check.csv"], out="identified")
    >>> document["verdict"]
    'accepted'
    >>> friction = document["parameters"]["shoulder.viscous_friction"]
    >>> print(f"{friction['value']:.1f} {friction['unit']}")
    1.5 N*m*s/rad

    Args:
        model: MJCF or URDF file, or ``twin.yaml``.
        recordings: recordings that are fitted.
        held_out: recordings that only test the result; by default some of ``recordings``.
        out: folder of the result, new or that of an earlier identification.

    Raises:
        TwinError: the input cannot be used.
    """
    folder = Path(out).absolute()
    return identification.identify_into(
        folder, Path(model), _paths(recordings), _paths(held_out), {}
    )


def calibrate(
    plan: StrPath, *, out: StrPath, seconds: float = calibration.SECONDS
) -> dict[str, Any]:
    """Estimate what a calibration plan asks for; return ``calibration.json``.

    >>> document = calibrate("calibration.yaml", out="calibrated")
    >>> document["verdict"], list(document["records"])
    ('accepted', ['joint_zeros', 'base_world', 'hand_eye', 'target_scale'])

    Args:
        plan: the plan's file.
        out: folder of the result, new or that of an earlier calibration.
        seconds: limit of the processor time, s; 0 for none.

    Raises:
        TwinError: the input cannot be used.
    """
    return calibration.calibrate_into(Path(out).absolute(), Path(plan).absolute(), seconds)


def verify(release: StrPath, *, keys: StrPath | None = None) -> Verdict:
    """Check signature, digests and age of a release.

    >>> verdict = verify("cell/releases/0001")
    >>> verdict.holds, verdict.release.number
    (True, 1)

    Args:
        keys: folder of trusted public keys; ``keys/`` of the twin by default.

    Raises:
        TwinError: the keys cannot be read.
    """
    return releases.check(Path(release), keys=None if keys is None else Path(keys))


def _paths(names: Sequence[StrPath]) -> list[Path]:
    return [Path(name) for name in names]
