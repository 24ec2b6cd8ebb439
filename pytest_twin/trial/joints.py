"""Rename the joints of a recording to the names of the model."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import DEGREE, JointSeries
from pytest_twin.recording_options import JointNames
from pytest_twin.words import list_names

# Largest number of names in a message, before "and n more".


def in_model_names(
    series: JointSeries, names: JointNames, joints: Collection[str] | None, path: Path
) -> tuple[JointSeries, list[str]]:
    """Rename the joints of a topic to the names of the model, and remove joints that it lacks.

    The joints get the order of the model: results must not depend on the order in a message.

    Args:
        names: mapping from recorded names to the model's.
        joints: joints of the model in its order; None to keep all joints.
        path: path of the recording, for errors.

    Returns:
        The series, and a note on removed joints.

    Raises:
        RecordingError: two recorded joints get one name, or none is a joint of the model.
    """
    renamed = [names.in_model(name, joints or ()) for name in series.names]
    twice = [name for name, count in Counter(renamed).items() if count > 1]
    if twice:
        both = [old for old, new in zip(series.names, renamed, strict=True) if new == twice[0]]
        raise RecordingError(
            f"two recorded joints become {twice[0]!r} of the model",
            path=path,
            where=series.topic,
            value=", ".join(both),
            expected="one; 'joints:' in twin.yaml or --joints says which",
        )
    order = {name: place for place, name in enumerate(renamed if joints is None else joints)}
    keep = sorted(
        (i for i, name in enumerate(renamed) if name in order), key=lambda i: order[renamed[i]]
    )
    if not keep:
        raise _no_such_joint(series, renamed, joints or (), path)
    notes = []
    if len(keep) < len(renamed):
        gone = [name for name in renamed if name not in order]
        note = f"{series.topic}: left out, not in the model: {list_names(gone)}"
        others = [joint for joint in joints or () if joint not in renamed]
        offers = suggest_mappings(gone, others)
        if offers:
            note += f" ('joints: {{{offers[0]}}}' in twin.yaml would map them)"
        elif others:
            note += f"; of the model not recorded: {list_names(others)}"
        notes.append(note)
    if keep != list(range(len(renamed))) or tuple(renamed) != series.names:
        series = replace(
            series,
            names=tuple(renamed[i] for i in keep),
            position=None if series.position is None else series.position[:, keep],
            velocity=None if series.velocity is None else series.velocity[:, keep],
            effort=None if series.effort is None else series.effort[:, keep],
            degrees=tuple(series.degrees[i] for i in keep) if series.degrees else (),
        )
    return series, notes


def name_by_actuators(
    series: JointSeries, names: JointNames, actuator_joints: Mapping[str, Sequence[str]]
) -> tuple[JointSeries, list[str]]:
    """Name the values of a topic without joint names by the order of the model's actuators.

    Args:
        series: series of one topic; without names its joints are 0, 1, 2, ...
        names: mapping of a user; with one, the series is not changed.
        actuator_joints: actuator -> joints that it drives, in the order of the model.

    Returns:
        The series, and a note on the assumed names.
    """
    places = tuple(str(place) for place in range(len(series.names)))
    driven = [joints[0] for joints in actuator_joints.values() if len(joints) == 1]
    if series.names != places or names.names or len(set(driven)) != len(places):
        return series, []
    note = (
        f"{series.topic}: values without joint names, taken in the order of the model's actuators: "
        f"{list_names(driven)} ('joints: {{\"0\": {driven[0]}, ...}}' in twin.yaml says otherwise)"
    )
    return replace(series, names=tuple(driven)), [note]


def metres_of_slides(
    series: JointSeries, joint_type: Mapping[str, str]
) -> tuple[JointSeries, list[str]]:
    """Return the series with prismatic joints as written, if joints were read as degrees; notes."""
    slides = np.array([
        is_degree and joint_type.get(name) == "slide"
        for name, is_degree in zip(series.names, series.degrees, strict=False)
    ])  # fmt: skip
    if not slides.any():
        return series, []
    scale = np.where(slides, 1.0 / DEGREE, 1.0)
    names = [name for name, slide in zip(series.names, slides, strict=True) if slide]
    return replace(
        series,
        position=None if series.position is None else series.position * scale,
        velocity=None if series.velocity is None else series.velocity * scale,
    ), [f"{series.topic}: prismatic joints are read in m, not in degrees: {list_names(names)}"]


def _no_such_joint(
    series: JointSeries, names: Sequence[str], joints: Collection[str], path: Path
) -> RecordingError:
    expected = f"one of {list_names(list(joints))}" if joints else "a model with joints"
    offers = suggest_mappings(names, joints)
    if offers:
        expected += "; in twin.yaml " + " or ".join(f"joints: {{{offer}}}" for offer in offers)
        expected += ", or --joints " + offers[0].replace(": ", "=")
    elif joints:
        expected += "; --joints RECORDED=MODEL,... or 'joints:' in twin.yaml maps names"
    return RecordingError(
        "the model has no such joint" if len(names) == 1 else "the model has none of these joints",
        path=path,
        where=series.topic,
        value=list_names(names),
        expected=expected,
    )


def suggest_mappings(names: Sequence[str], joints: Collection[str]) -> list[str]:
    """Prefixes or suffixes that would map names to the model's, such as ``prefix: left_``.

    The one that maps most joints is the first.
    """
    found: Counter[str] = Counter()
    for longs, shorts in ((names, joints), (list(joints), names)):
        for long in longs:
            for short in shorts:
                if not short or long == short:
                    continue
                if long.endswith(short):
                    found[f"prefix: {long.removesuffix(short)}"] += 1
                elif long.startswith(short):
                    found[f"suffix: {long.removeprefix(short)}"] += 1
    if not found:
        return []
    most = max(found.values())
    return [offer for offer, count in found.most_common(3) if 2 * count > most]
