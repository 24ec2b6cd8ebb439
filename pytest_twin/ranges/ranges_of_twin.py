"""Compute the content of ``ranges.json``: distribution, ranges, and check on final recordings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin import __version__
from pytest_twin.diagnosis.noise import sensor_noise
from pytest_twin.diagnosis.patched.model import read_patched_model
from pytest_twin.effects.sensing import EncoderBias
from pytest_twin.effects.timing import CommandDelay
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.formats import typed
from pytest_twin.ranges.bodies import Body
from pytest_twin.ranges.check import FEWEST_ROBOTS, assess, plot_data, predict_envelopes
from pytest_twin.ranges.distribution import Distribution
from pytest_twin.ranges.gather import UncertainParameters, collect_uncertain_parameters
from pytest_twin.ranges.quantities import quantities
from pytest_twin.ranges.range_comparison import compare
from pytest_twin.ranges.range_files import read_ranges
from pytest_twin.ranges.recordings import RecordingsByRole, read_check_recordings
from pytest_twin.ranges.simulate import Traces, VariedRobots
from pytest_twin.ranges.summary import summary_lines
from pytest_twin.ranges.widening import fewest_robots, widen
from pytest_twin.realization import Realization, load
from pytest_twin.realization.record_inputs import refuse_stale_records, result_basis
from pytest_twin.realization.sandbox import MEMORY_BYTES
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.time_limit import is_over, limited, skips
from pytest_twin.twin import Twin, load_twin

_SEED = 57
"""Seed of the check on final recordings, so that ranges can be repeated."""
_WIDENING_SEED = 58
"""Seed of the draws from which widening is computed: other robots than those of the check."""
_WIDENING_DRAWS = 128
"""Largest number of these draws."""


@dataclass(frozen=True)
class Request:
    """Request of the user.

    Attributes:
        final, held_out: recordings; they take precedence over those of the twin.
        draws: number of robots, or None for the twin's setting.
        share: coverage of the envelope, or None for the twin's setting.
        options: settings for reading recordings; they take precedence over the twin's.
        topics: role of a topic -> topic; these take precedence over the twin's.
        against: configuration whose ranges are compared, or None.
        folder: folder of the result; that of the twin if empty.
        seconds: limit of the processor time, s; 0 for none.
    """

    final: Sequence[Path] = ()
    held_out: Sequence[Path] = ()
    draws: int | None = None
    share: float | None = None
    options: Mapping[str, Any] | None = None
    topics: Mapping[str, str] | None = None
    against: Path | None = None
    folder: str = ""
    seconds: float = 0.0

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> Request:
        """Build a request from fields with paths as text."""
        return typed.build(fields, cls)


def ranges_of_file(
    path: str,
    request: Mapping[str, Any] | None = None,
    progress: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Return the content of ``ranges.json`` for a ``twin.yaml``.

    Args:
        path: path of the ``twin.yaml``.
        request: fields of :class:`Request`, with paths as text, as passed between processes.
        progress: called with the fraction done.

    Raises:
        TwinError: a twin, a record or a recording cannot be used.
    """
    twin = load_twin(Path(path))
    refuse_stale_records(twin)
    first = twin.first_realization
    realization = load(first.file, twin=twin, name=first.name)
    asked = Request.from_json(request or {})
    with limited(asked.seconds) as limit:
        document = ranges(twin, realization, asked, progress or (lambda done: None))
    document["not_tried"] = limit.not_tried
    if note := limit.note():
        document["notes"].insert(0, note)
    document["basis"] = result_basis(realization, "ranges", Path(asked.folder or twin.root))
    return document


def ranges(
    twin: Twin,
    realization: Realization,
    request: Request,
    progress: Callable[[float], None] = lambda done: None,
) -> dict[str, Any]:
    """Return the randomization ranges of a loaded twin, and their check."""
    given = None if request.against is None else (request.against, *read_ranges(request.against))
    patched = read_patched_model(realization)
    share = request.share or twin.ranges.share
    count = request.draws or twin.ranges.draws
    found = collect_uncertain_parameters(twin, realization, patched)
    options = RecordingOptions.from_json(request.options or {}).over(twin.recordings)
    checked = read_check_recordings(
        twin, realization, request.final, request.held_out, options,
        {**twin.topics, **(request.topics or {})},
    )  # fmt: skip
    robots = VariedRobots(
        realization, patched, found.distribution.coordinates, found.bodies, MEMORY_BYTES
    )
    compared: list[int] = []
    if checked.final:
        compared = robots.sample_counts(checked.final, count)
    noise = _noise(robots, checked)
    distribution, widening = _widen(found, checked, robots, noise, count, share, progress)
    document = _document(twin, realization, found, distribution, share, noise, checked)
    document["widening"] = widening
    if given is not None:
        own = quantities(distribution, found.bodies, share)
        document["against"] = compare(*given, own, twin.ranges.trials, share)
    if checked.final:
        if count < FEWEST_ROBOTS:
            document["notes"].append(
                f"{count} robots are too few to find ranges wider than need be: draw at least "
                f"{FEWEST_ROBOTS}"
            )
        draws = distribution.draws(count, _SEED)
        before = robots.steps, robots.seconds
        traces = robots.simulate(checked.final, draws, lambda done: progress(0.3 + 0.6 * done))
        steps, seconds = robots.steps - before[0], robots.seconds - before[1]
        document["notes"] += [
            f"{trial.name}: {samples} of {len(trial.time)} samples are compared, because those of "
            f"{count} robots would not fit in memory"
            for trial, samples in zip(checked.final, compared, strict=True)
            if samples < len(trial.time)
        ]
        simulated = len(traces[0].robots) if traces else 0
        if simulated >= FEWEST_ROBOTS or simulated == count:
            envelopes = predict_envelopes(traces, noise, share, _SEED)
            document["check"] = assess(envelopes, share)
            document["envelopes"] = plot_data(envelopes)
            document["verdict"] = document["check"]["verdict"]
            if document["verdict"] == "useful" and len(traces) < len(checked.final):
                document["verdict"] = "not_checked"
        document["throughput"] = {
            "robots": simulated, "simulated": steps * float(realization.model.opt.timestep),
            "steps": steps, "seconds": seconds, "steps_per_second": steps / max(seconds, 1e-9),
        }  # fmt: skip
    document["words"] = summary_lines(document)
    progress(1.0)
    return document


def _noise(robots: VariedRobots, checked: RecordingsByRole) -> dict[str, float]:
    """Return joint -> standard deviation of an encoder reading, rad or m.

    It is estimated from held-out recordings if there are any."""
    found: dict[str, list[float]] = {}
    for trial in checked.held_out or checked.final:
        own = sensor_noise(trial.time, trial.position)
        for joint in robots.joints_of(trial):
            found.setdefault(joint, []).append(float(own[trial.joints.index(joint)]))
    return {joint: float(np.median(values)) for joint, values in found.items()}


def _widen(
    found: UncertainParameters,
    checked: RecordingsByRole,
    robots: VariedRobots,
    noise: Mapping[str, float],
    count: int,
    share: float,
    progress: Callable[[float], None],
) -> tuple[Distribution, dict[str, Any] | None]:
    if not checked.held_out:
        return found.distribution, None

    def simulate(distribution: Distribution) -> list[Traces]:
        progress(0.1)
        draws = distribution.draws(drawn, _WIDENING_SEED)
        traces = robots.simulate(checked.held_out, draws)
        if is_over():
            raise OutOfTime
        return traces

    recorded = {joint for trial in checked.held_out for joint in robots.joints_of(trial)}
    drawn = max(min(count, _WIDENING_DRAWS), fewest_robots(len(recorded)))
    joints = {one.joint for one in found.distribution.coordinates if one.joint is not None}
    carrying = {joint: robots.carrying(joint) for joint in joints}
    try:
        return widen(found.distribution, simulate, noise, carrying, share)
    except OutOfTime:
        skips("whether held-out recordings ask for wider ranges")
        return found.distribution, None


def _document(
    twin: Twin,
    realization: Realization,
    found: UncertainParameters,
    distribution: Distribution,
    share: float,
    noise: Mapping[str, float],
    checked: RecordingsByRole,
) -> dict[str, Any]:
    """Return the parts of the document that do not need the final recordings."""
    notes = [*found.notes, *checked.notes]
    if not checked.held_out:
        notes.append(
            "no held-out recording: whether the ranges are too narrow for recordings that nothing "
            "was fitted on is not known before the final ones"
        )
    if not checked.final:
        notes.append(
            "no final recording: the ranges are not checked; record some that no fit or choice "
            "uses, with the role final in their metadata, and name them with --final"
        )
    if names := _only_in_sampler(distribution):
        notes.append(
            "the configurations of simulators set friction, armature and bodies, and state delays "
            f"and encoder zeros; only sampler.py has: {', '.join(names)}"
        )
    return {
        "schema": 1,
        "twin": twin.name,
        "verdict": "not_checked",
        "words": [],
        "share": share,
        "records": list(found.records),
        "coordinates": [
            {
                "name": one.name,
                "unit": one.unit,
                "mean": one.mean,
                "std": one.std,
                "law": one.law,
                "lower": one.lower if np.isfinite(one.lower) else None,
                "upper": one.upper if np.isfinite(one.upper) else None,
                "at_most": None if one.at_most is None else one.at_most.to_json(),
                "varies": "with the trial" if one.is_condition else "per episode",
                "joint": one.joint,
                "body": one.body,
                "sources": [source.to_json() for source in one.sources],
            }
            for one in distribution.coordinates
        ],
        "correlation": distribution.correlation.tolist(),
        "bodies": [_body(body, distribution) for body in found.bodies],
        "noise": [
            {"name": f"{joint}.position_noise", "joint": joint, "std": std,
             "unit": "m" if realization.structure.joint_type[joint] == "slide" else "rad",
             "varies": "per sample"}
            for joint, std in noise.items()
        ],
        "quantities": [one.to_json() for one in quantities(distribution, found.bodies, share)],
        "places": _places(realization, distribution, found.bodies),
        "widening": None,
        "check": None,
        "envelopes": [],
        "throughput": None,
        "against": None,
        "left_out": list(found.left_out),
        "notes": notes,
        "software": {"pytest-twin": __version__},
    }  # fmt: skip


def _only_in_sampler(distribution: Distribution) -> list[str]:
    """Return the coordinates that no configuration of a simulator sets: effects of drives, laws."""
    return [
        one.name
        for one in distribution.coordinates
        if one.effect is not None and one.effect not in (CommandDelay.id, EncoderBias.id)
    ]


def _body(body: Body, distribution: Distribution) -> dict[str, Any]:
    names = [one.name for one in distribution.coordinates if one.body == body.name]
    index = [one.index for one in distribution.coordinates if one.body == body.name]
    return {"name": body.name, "joint": body.joint, "root": body.root.tolist(),
            "middle": body.middle.tolist(), "floor": body.floor,
            "coordinates": names, "index": index}  # fmt: skip


def _places(
    realization: Realization, distribution: Distribution, bodies: Sequence[Body]
) -> dict[str, Any]:
    """Return the MuJoCo ids of the joints and bodies that vary."""
    joints = {one.joint for one in distribution.coordinates if one.joint is not None}
    return {
        "joints": {joint: realization.joint_dof_index(joint) for joint in sorted(joints)},
        "bodies": {body.name: int(realization.model.body(body.name).id) for body in bodies},
    }
