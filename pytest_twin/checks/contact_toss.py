"""Simulate a recorded toss from its first measured state, and compare the poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pytest_twin.checks.base import Measure, Observation, Progress
from pytest_twin.checks.fields import quantity, spec_error
from pytest_twin.checks.files import find_file
from pytest_twin.checks.records import twin_of
from pytest_twin.checks.schemas import array, name_field, number, quantity_field
from pytest_twin.golden import Golden

if TYPE_CHECKING:
    from pytest_twin.realization import Realization

TOSS = "toss"
UNITS: Mapping[str, str] = {
    "toss_position": "m",
    "toss_rotation": "rad",
    "toss_position_mean": "m",
    "toss_rotation_mean": "rad",
}
FIELDS: Mapping[str, Any] = {
    "recording": name_field(
        "For toss: an .npz file of tosses, or a bag with poses of the first of the "
        "pair. The path is relative to the twin's folder or to one of its roots."
    ),
    "tosses": array(
        name_field(),
        "For toss: names of arrays in the .npz file. Default: all.",
        minItems=1,
        uniqueItems=True,
    ),
    "topic": name_field("For toss: topic of the poses. Needed if a bag has several."),
    "length_unit": quantity_field(
        "For toss: length of one unit of the .npz file, m. Default: found from the acceleration "
        "in free fall."
    ),
    "rate": number(
        "For toss: sampling rate of the .npz file, Hz. Default: found from positions and "
        "velocities.",
        exclusiveMinimum=0,
    ),
}


def observe(golden: Golden, realization: Realization, progress: Progress) -> Observation:
    """Compute the mean errors of each toss over its samples.

    ``values``: ``position`` (m) and ``rotation`` (rad): toss -> mean error.

    Raises:
        SpecError: the recording lacks a toss of the spec.
    """
    import numpy as np

    from pytest_twin.formats.pose_tracks import read_pose_tracks
    from pytest_twin.identification.contact.loss import errors_of, whole_toss
    from pytest_twin.identification.contact.tosses import in_model_units
    from pytest_twin.realization.free_body import free_body
    from pytest_twin.trial.roles import refuse_final

    target = golden.target
    twin = twin_of(golden, realization, "a recorded toss's", "roots")
    if "recording" not in target:
        raise spec_error(
            golden, "target.recording", "a toss needs a recording",
            expected="an .npz file of tosses, or a bag with poses",
        )  # fmt: skip
    path = find_file(golden, "target.recording", target["recording"], twin)
    tracks = read_pose_tracks(path, target.get("topic"))
    for track in tracks:
        refuse_final(dict(track.metadata), path, "a golden")
    length = target.get("length_unit")
    tosses, _ = in_model_units(
        tracks,
        np.array(realization.model.opt.gravity),
        None if length is None else quantity(golden, "target.length_unit", length, "m"),
        target.get("rate"),
    )
    by_name = {track.name: toss for track, toss in zip(tracks, tosses, strict=True)}
    names = target.get("tosses", list(by_name))
    for at, name in enumerate(names):
        if name not in by_name:
            known = ", ".join(list(by_name)[:8]) + (", ..." if len(by_name) > 8 else "")
            raise spec_error(
                golden, f"target.tosses.{at}", "no toss of this name", value=name,
                expected=f"one of {known}",
            )  # fmt: skip
    progress(0.3)
    geom_body = realization.structure.geom_body
    first = target["pair"][0]
    body = free_body(realization, geom_body.get(first, first))
    rows = [replace(whole_toss(by_name[name])) for name in names]
    errors = errors_of([realization.model], body, rows)[0]
    progress(1.0)
    return Observation(
        {
            "position": dict(zip(names, errors.position.tolist(), strict=True)),
            "rotation": dict(zip(names, errors.rotation.tolist(), strict=True)),
        }
    )


def measures(golden: Golden, values: Mapping[str, Any]) -> list[Measure]:
    """Compare the worst toss and the mean over all with the tolerances."""
    found = []
    for name, bound in golden.tolerance.items():
        errors: Mapping[str, float] = values["position" if "position" in name else "rotation"]
        if name.endswith("_mean"):
            subject = f"mean of {len(errors)} tosses of {golden.target['recording']}"
            error = sum(errors.values()) / len(errors)
        else:
            worst = max(errors, key=errors.__getitem__)
            subject, error = f"toss {worst} of {golden.target['recording']}", errors[worst]
        found.append(Measure.of_error(name, subject, error, bound, "recording"))
    return found
