"""Split tosses into fitted and held-out ones: whole tosses, never samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import RecordingError
from pytest_twin.formats.pose_track import PoseTrack
from pytest_twin.formats.pose_tracks import read_pose_tracks
from pytest_twin.identification.contact.pushes import push_of
from pytest_twin.identification.contact.tosses import Toss, Units, in_model_units
from pytest_twin.realization.free_body import FreeBody
from pytest_twin.trial.roles import refuse_final

_ONE_HELD_OUT_OF = 4
"""One toss of so many is held out if no role is given."""


@dataclass(frozen=True)
class TossOptions:
    """Settings for reading tosses.

    Attributes:
        length: unit of length in m; None to detect it.
        rate: samples per second; None to detect it.
        body: name of the tossed body, if the model has several free bodies.
        topic: topic of the poses in a bag.
        wrench: topic of the external wrench in a bag.
    """

    length: float | None = None
    rate: float | None = None
    body: str | None = None
    topic: str | None = None
    wrench: str | None = None


@dataclass(frozen=True)
class TossSet:
    """Tosses by role.

    Attributes:
        units: stated or detected units of the recordings.
    """

    fit: tuple[Toss, ...]
    held_out: tuple[Toss, ...]
    units: Units
    notes: tuple[str, ...]


def read_by_role(
    recordings: Sequence[Path],
    held_out: Sequence[Path],
    gravity: FloatArray,
    body: FreeBody,
    centre: FloatArray,
    options: TossOptions,
) -> TossSet:
    """Read tosses and assign the role of each.

    The roles follow from ``held_out``, else from the metadata ``role`` of the recordings, else
    every fourth toss is held out. Units that are not stated are detected from the fitted tosses
    only.

    Args:
        recordings, held_out: ``.npz`` archives and bags.
        gravity: (3,) gravity of the model, m/s^2.
        centre: (3,) centre of mass of the object in its own axes, m.
        options: settings for reading.

    Raises:
        TwinError: a recording cannot be read, or there is no toss to fit.
    """
    aside = {path.resolve() for path in held_out}
    paths = [path for path in dict.fromkeys(recordings) if path.resolve() not in aside]
    fitting = [
        one for path in paths for one in read_pose_tracks(path, options.topic, options.wrench)
    ]
    if not fitting:
        raise RecordingError(
            "no recording remains to fit",
            path=held_out[0] if held_out else None,
            expected="at least one RECORDING that is not under --held-out",
        )
    testing = [
        one
        for path in dict.fromkeys(held_out)
        for one in read_pose_tracks(path, options.topic, options.wrench)
    ]
    for one in (*fitting, *testing):
        refuse_final(dict(one.metadata), one.path, "an identification")
    notes: list[str] = []
    if not testing:
        said = [one for one in fitting if dict(one.metadata).get("role") == "held_out"]
        if said:
            testing = said
        elif len(fitting) >= _ONE_HELD_OUT_OF:
            testing = fitting[_ONE_HELD_OUT_OF - 1 :: _ONE_HELD_OUT_OF]
            notes.append(
                f"held out (chosen automatically): every fourth toss, {len(testing)} of "
                f"{len(fitting)}; choose with --held-out"
            )
        chosen = {id(one) for one in testing}
        fitting = [one for one in fitting if id(one) not in chosen]
    if not testing:
        notes.append(
            "nothing is held out: no result can be accepted; record further tosses and name them "
            "with --held-out"
        )
    fit, units = in_model_units(fitting, gravity, options.length, options.rate)
    tested: list[Toss] = []
    if testing:
        known = units.length, None if units.period is None else 1.0 / units.period
        tested, _ = in_model_units(testing, gravity, *known, lag=units.lag)
    return TossSet(
        tuple(_with_wrenches(fit, fitting, body, centre)),
        tuple(_with_wrenches(tested, testing, body, centre)),
        units,
        (*notes, *units.notes),
    )


def _with_wrenches(
    tosses: Sequence[Toss], tracks: Sequence[PoseTrack], body: FreeBody, centre: FloatArray
) -> list[Toss]:
    """Return the tosses with their external wrenches."""
    return [
        toss
        if track.wrench is None
        else replace(
            toss,
            push=push_of(track.wrench, body, centre, toss.time, toss.poses, toss.path),
        )
        for toss, track in zip(tosses, tracks, strict=True)
    ]
