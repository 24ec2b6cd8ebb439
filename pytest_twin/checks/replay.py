"""Replay: simulate a recording's commands open loop, and compare with the measured states."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.checks.base import (
    Check,
    Measure,
    NothingToProposeError,
    Observation,
    Progress,
    Trace,
)
from pytest_twin.checks.episode import EPISODE_SCHEMA, recording_of
from pytest_twin.checks.fields import known_name, quantity, spec_error, tolerance_schema
from pytest_twin.checks.measured_pose import measured_and_predicted
from pytest_twin.checks.replay_sensors import (
    SENSORS_SCHEMA,
    as_read,
    sensor_measures,
    sensor_values,
)
from pytest_twin.checks.replay_signals import (
    MISSING,
    RESPONSES,
    effort_frequency,
    effort_rms,
    frequency,
)
from pytest_twin.checks.schemas import NO_FIELDS, any_of, array, mapping, table, text
from pytest_twin.dependency import Structure
from pytest_twin.errors import SpecError
from pytest_twin.golden import Golden
from pytest_twin.metrics.residual import Residual, residual, rotation_angle

if TYPE_CHECKING:
    from pytest_twin.open_loop import Replayed
    from pytest_twin.realization import Realization
    from pytest_twin.trial import Trial

_RESPONSE_BOUNDS = {name: name for name in RESPONSES}
# Joint type -> the tolerances that bound it: position (rms, maximum), velocity and effort (rms),
# and the frequency response.
_BOUNDS: Mapping[str, Mapping[str, str]] = {
    "hinge": {
        "rms": "angle_rms",
        "maximum": "angle_max",
        "velocity_rms": "angular_velocity_rms",
        "effort_rms": "torque_rms",
        **_RESPONSE_BOUNDS,
    },
    "slide": {
        "rms": "position_rms",
        "maximum": "position_max",
        "velocity_rms": "velocity_rms",
        "effort_rms": "force_rms",
        **_RESPONSE_BOUNDS,
    },
}
_TOLERANCES: Mapping[str, str] = {
    "angle_rms": "rad",
    "angle_max": "rad",
    "angular_velocity_rms": "rad/s",
    "position_rms": "m",
    "position_max": "m",
    "velocity_rms": "m/s",
    "torque_rms": "N*m",
    "force_rms": "N",
    "magnitude": "dB",
    "phase": "rad",
    "bandwidth": "Hz",
    "resonance": "Hz",
    "effort_magnitude": "dB",
    "effort_phase": "rad",
    "tcp_position_rms": "m",
    "tcp_position_max": "m",
    "tcp_orientation_max": "rad",
}
_JOINT_TOLERANCES = tuple(
    dict.fromkeys(name for names in _BOUNDS.values() for name in names.values())
)
_NAME: Mapping[str, Any] = {"type": "string", "minLength": 1}


class Replay(Check):
    """Residual between a realization and a recording, for each joint and at the tool.

    People write the golden's tolerance before they see the result. ``expected`` has the residuals
    at the last update and shows changes; it does not limit the result.

    ``values``: ``joints`` (joint -> ``type``, ``rms``, ``maximum``, ``mean``, ``at`` in s,
    ``predicted`` and ``recorded`` there, ``velocity_rms`` or None; where a tolerance bounds them
    ``effort_rms``, ``frequency`` and ``effort_frequency``), ``tcp`` (likewise, in m and rad) or
    None, ``sensors`` (sensor -> ``rms`` and ``unit`` by channel), ``marks`` (doubtful sections of
    the recording: kind -> count),
    ``command_between`` (held, interpolated or ramped), ``notes``.
    """

    kind: ClassVar[str] = "replay"
    needs_record: ClassVar[bool] = False
    dynamic: ClassVar[bool] = True
    recorded: ClassVar[bool] = True
    libraries: ClassVar[tuple[str, ...]] = ("numpy", "mcap")
    tolerances: ClassVar[Mapping[str, str]] = _TOLERANCES
    schema: ClassVar[Mapping[str, Any]] = {
        "target": table(
            {
                "recording": text(
                    "Recording to replay. The path is relative to the twin's "
                    "folder or to one of its roots.",
                    minLength=1,
                ),
                "episode": EPISODE_SCHEMA,
                "joints": any_of(
                    array(_NAME, minItems=1, uniqueItems=True),
                    mapping(
                        {
                            "type": ["object", "null"],
                            "properties": {
                                name: tolerance_schema(_TOLERANCES[name])
                                for name in _JOINT_TOLERANCES
                            },
                            "additionalProperties": False,
                        },
                        minProperties=1,
                    ),
                    description="Joints that are compared, as a list or as joint -> its own "
                    "tolerances. Default: all recorded joints.",
                ),
                "tcp": text(
                    "Frame of the tool. Its pose at the predicted joint positions "
                    "is compared with its pose at the measured ones.",
                    minLength=1,
                ),
                "tcp_topic": text(
                    "Topic with measured poses of the tool "
                    "(geometry_msgs/PoseStamped). The predicted poses are compared with these "
                    "instead.",
                    minLength=1,
                ),
                "sensors": SENSORS_SCHEMA,
                "controller": text(
                    "Controller with which the recording was made, as its metadata names it.",
                    minLength=1,
                ),
                "payload": text(
                    "Payload with which the recording was made, as its metadata names it.",
                    minLength=1,
                ),
            },
            required=["recording"],
            dependentRequired={"tcp_topic": ["tcp"]},
        ),
        "stimulus": NO_FIELDS,
    }

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return all parts that affect the joints' motion, the recording, its controller and
        payload, and the calibration of the joints' encoders."""
        target = golden.target
        joints = list(target["joints"]) if "joints" in target else None
        parts = set(structure.dynamics(joints)) | {f"recording:{target['recording']}"}
        parts |= structure.effects()
        parts |= {f"{key}:{target[key]}" for key in ("controller", "payload") if key in target}
        if "controller" in target or "payload" in target:
            # A variant is compiled separately.
            parts |= structure.additions()
        # Every recorded joint starts at its encoder's reading, even if it is not compared.
        parts |= {f"calibration:{joint}" for joint in structure.joint_body}
        parts |= {"encoder:*"} | {f"sensor:{name}" for name in target.get("sensors", ())}
        if "tcp" in target:
            parts |= structure.chain([target["tcp"]])
        return parts

    def trials(self, golden: Golden, realization: Realization) -> list[Trial]:
        """Read the recording as trials: one, or one for each section between gaps.

        Raises:
            RecordingError: joints have no names, and another order predicts the motion much better.
        """
        from pytest_twin.replay_order import refuse_other_order
        from pytest_twin.trial import make_trials

        twin = realization.twin
        if twin is None:
            raise SpecError(
                "a replay golden needs a twin.yaml",
                path=golden.path,
                expected="a twin.yaml in a folder above the golden; pytest-twin init writes one",
            )
        recording = recording_of(golden, twin)
        trials = make_trials(recording, realization.structure, twin.recordings)
        if all(len(t.time) < 2 for t in trials):
            raise spec_error(
                golden, "target.recording", "only one state: no comparison with a replay",
                value=recording.path.name, expected="a recording with states during the motion",
            )  # fmt: skip
        refuse_other_order(realization, trials)
        return trials

    def trial(self, golden: Golden, realization: Realization) -> Trial:
        """Return the longest section of the recording, all joints at the same stamps."""
        from pytest_twin.trial.common_stamps import resample_to_common_stamps

        return resample_to_common_stamps(
            max(self.trials(golden, realization), key=lambda t: t.duration)
        )

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose nothing: ``init`` itself proposes one for each given recording."""
        raise NothingToProposeError(
            "no recording was given; add some after the robot: pytest-twin init ROBOT RECORDING..."
        )

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Read the recording and replay it."""
        from pytest_twin import open_loop

        trials = self.trials(golden, realization)
        first = trials[0]
        self._check_variant(golden, realization, first)
        names = list(golden.target.get("joints", first.joints))
        for i, joint in enumerate(names):
            known_name(golden, f"target.joints.{i}", joint, first.joints, "recorded joint")
        results = [_replay(realization, trial, progress) for trial in trials]
        for result in results:
            if result.error is not None:
                raise result.error
        sensors = sensor_values(golden, realization, results) if "sensors" in golden.target else {}
        results = as_read(results, realization)
        joints = {joint: _of_joint(results, joint, realization.structure) for joint in names}
        for joint, numbers in joints.items():
            asked = _tolerances_of(golden, joint)
            if asked & {"torque_rms", "force_rms"}:
                numbers["effort_rms"] = effort_rms(results, joint)
            sources = {source for name, (source, _) in RESPONSES.items() if name in asked}
            if "frequency" in sources:
                numbers["frequency"] = frequency(results, joint)
            if "effort_frequency" in sources:
                numbers["effort_frequency"] = effort_frequency(results, joint)
        notes = [note for t in trials for note in t.notes]
        notes += dict.fromkeys(note for result in results for note in result.notes)
        values: dict[str, Any] = {
            "joints": joints,
            "tcp": None,
            "sensors": sensors,
            "marks": dict(Counter(mark.kind for t in trials for mark in t.marks)),
            "command_between": first.command_between,
            "notes": notes,
        }
        if "tcp" in golden.target:
            frame = golden.target["tcp"]
            if "tcp_topic" in golden.target:
                values["tcp"] = _of_tcp(
                    frame, *measured_and_predicted(golden, realization, results)
                )
            else:
                predicted = [open_loop.frame_poses(realization, r.qpos, frame) for r in results]
                measured = [
                    open_loop.frame_poses(
                        realization, open_loop.measured_qpos(realization, r), frame
                    )
                    for r in results
                ]
                values["tcp"] = _of_tcp(
                    frame, _time(trials), np.concatenate(predicted), np.concatenate(measured)
                )
        return Observation(
            values,
            _series(trials, joints, lambda i: {"position": results[i].position,
                                               "command": _commands(trials[i])}),
            against=_series(trials, joints, lambda i: {"position": trials[i].position}),
        )  # fmt: skip

    def _check_variant(self, golden: Golden, realization: Realization, trial: Trial) -> None:
        """Check that the spec states the recording's controller and payload."""
        for key, declared in (
            ("controller", realization.twin.controllers if realization.twin else {}),
            ("payload", realization.twin.payloads if realization.twin else {}),
        ):
            recorded = trial.metadata.get(key) or None
            stated = golden.target.get(key)
            if stated is not None and stated == recorded and stated not in declared:
                raise spec_error(
                    golden,
                    f"target.{key}",
                    f"twin.yaml declares no such {key}",
                    value=stated,
                    expected=", ".join(declared) or f"a {key} that twin.yaml declares under {key}s",
                )
            if stated != recorded and (stated is not None or declared):
                raise spec_error(
                    golden,
                    f"target.{key}",
                    f"not the {key} that {trial.path.name} was recorded with",
                    value=stated or "none",
                    expected=f"{key}: {recorded}" if recorded else f"no {key}",
                )

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare the residuals of each joint and of the tool with the tolerances."""
        measures = list(_joint_measures(golden, observation.values["joints"]))
        bounded = {measure.subject.partition(",")[0] for measure in measures}
        for joint in golden.target.get("joints", ()):
            if joint not in bounded:
                names = _BOUNDS[observation.values["joints"][joint]["type"]].values()
                raise spec_error(
                    golden,
                    "tolerance",
                    f"no tolerance bounds joint {joint!r}",
                    expected=" or ".join(names),
                )
        if observation.values["tcp"] is not None:
            measures += _tcp_measures(golden, observation.values["tcp"])
        measures += sensor_measures(golden, observation.values["sensors"])
        if not measures:
            wanted = ", ".join(_TOLERANCES)
            raise spec_error(golden, "tolerance", "no tolerance bounds the replay", expected=wanted)
        return measures

    def expect(
        self, golden: Golden, observation: Observation
    ) -> tuple[Mapping[str, Any], Trace | None]:
        """Return the residuals; the recording itself is not copied."""
        return observation.values, None


def _tolerances_of(golden: Golden, joint: str) -> set[str]:
    """Return the tolerances that apply to a joint."""
    stated = golden.target.get("joints", {})
    own = (stated.get(joint) or {}) if isinstance(stated, Mapping) else {}
    return {*golden.tolerance, *own}


def _replay(realization: Realization, trial: Trial, progress: Progress) -> Replayed:
    """Replay a trial, with effects that a diagnosis steps together with the model."""
    from pytest_twin.diagnosis.patched.model import read_patched_model
    from pytest_twin.diagnosis.patched.replay import replay_whole
    from pytest_twin.open_loop import replay

    patched = read_patched_model(realization)
    if patched is None:
        return replay(realization, [trial], progress=progress)[0]
    return replay_whole(realization, patched, trial, progress=progress)


def _time(trials: Sequence[Trial]) -> FloatArray:
    """Return (n,) times since the recording's first state, of all trials' states, s."""
    return np.concatenate([t.offset + t.time for t in trials])


def _of_joint(results: Sequence[Replayed], joint: str, structure: Structure) -> dict[str, Any]:
    """Compute residuals of one joint at its recorded samples."""
    column = results[0].trial.joints.index(joint)
    trials = [r.trial for r in results]
    predicted = np.concatenate([r.position[:, column] for r in results])
    recorded = np.concatenate([t.position[:, column] for t in trials])
    seen = np.isfinite(recorded)
    predicted, recorded, time = predicted[seen], recorded[seen], _time(trials)[seen]
    found = residual(predicted, recorded)
    velocity: float | None = None
    moved = [r for r in results if r.trial.velocity is not None]
    if moved:
        measured = np.concatenate([_velocity(r.trial, column) for r in moved])
        modelled = np.concatenate([r.velocity[:, column] for r in moved])
        some = np.isfinite(measured)
        if some.any():
            velocity = residual(modelled[some], measured[some]).rms
    return {
        "type": structure.joint_type[joint],
        **_numbers(found, time),
        "predicted": float(predicted[found.maximum_at]),
        "recorded": float(recorded[found.maximum_at]),
        "velocity_rms": velocity,
    }


def _velocity(trial: Trial, column: int) -> FloatArray:
    assert trial.velocity is not None
    return trial.velocity[:, column]


def _of_tcp(frame: str, time: FloatArray, predicted: FloatArray, measured: FloatArray) -> Any:
    # The measured pose of a frame needs the positions of all joints at one stamp.
    seen = np.isfinite(measured).all(axis=1)
    time, predicted, measured = time[seen], predicted[seen], measured[seen]
    distance = np.linalg.norm(predicted[:, :3] - measured[:, :3], axis=1)
    angle = rotation_angle(predicted[:, 3:], measured[:, 3:])
    return {
        "frame": frame,
        "position": _numbers(residual(distance, np.zeros_like(distance)), time),
        "orientation": _numbers(residual(angle, np.zeros_like(angle)), time),
    }


def _numbers(found: Residual, time: FloatArray) -> dict[str, float]:
    return {
        "rms": found.rms,
        "maximum": found.maximum,
        "mean": found.mean,
        "at": float(time[found.maximum_at]),
    }


def _commands(trial: Trial) -> FloatArray:
    """Return (n, j) position commands at the states' stamps; NaN without a command."""
    asked = trial.setpoint.at(trial.time)
    table = np.full_like(trial.position, np.nan)
    for column, joint in enumerate(trial.joints):
        if trial.mode_of(joint) == "position":
            table[:, column] = asked[:, trial.command_joints.index(joint)]
    return table


def _series(
    trials: Sequence[Trial],
    joints: Mapping[str, Any],
    tables: Callable[[int], Mapping[str, FloatArray]],
) -> Trace:
    """Return columns of all trials; ``tables`` gives those of one. Incomplete ones are omitted."""
    time, first = np.unique(_time(trials), return_index=True)
    columns = {}
    each = [tables(i) for i in range(len(trials))]
    for joint, values in joints.items():
        unit = "m" if values["type"] == "slide" else "rad"
        for name in each[0]:
            column = np.concatenate(
                [of[name][:, t.joints.index(joint)] for of, t in zip(each, trials, strict=True)]
            )[first]
            if np.isfinite(column).all():
                columns[f"{name}:{joint}"] = (unit, column)
    return Trace(("time", "s"), time, columns)


def _joint_measures(golden: Golden, joints: Mapping[str, Any]) -> Iterator[Measure]:
    stated = golden.target.get("joints", {})
    for joint, values in joints.items():
        own = (stated.get(joint) or {}) if isinstance(stated, Mapping) else {}
        for number, name in _BOUNDS[values["type"]].items():
            unit = _TOLERANCES[name]
            if name in own:
                bound = quantity(golden, f"target.joints.{joint}.{name}", own[name], unit)
            elif name in golden.tolerance:
                bound = golden.tolerance[name].value
            else:
                continue
            source, part = RESPONSES.get(number, ("", number))
            response = (values.get(source) or {}) if source else values
            error = response.get(part)
            if error is None:
                words = MISSING.get(number, "the recording has no velocity of {joint!r}")
                what = {"effort_rms": "efforts"}.get(number, "velocities")
                if source:
                    what = "a longer excitation of the band"
                raise spec_error(
                    golden,
                    f"tolerance.{name}",
                    words.format(joint=joint),
                    expected=f"a recording with {what}, or a spec without this tolerance",
                )
            predicted, recorded = error, 0.0
            if number == "maximum":
                predicted, recorded = values["predicted"], values["recorded"]
            elif f"{part}_predicted" in response:
                predicted, recorded = response[f"{part}_predicted"], response[f"{part}_measured"]
            yield Measure(
                name=name,
                subject=_subject(joint, response, part) if source else joint,
                measured=predicted,
                golden=recorded,
                error=error,
                tolerance=bound,
                unit=unit,
                against="recording",
                time=values["at"] if number in ("rms", "maximum") else None,
            )


def _subject(joint: str, response: Mapping[str, Any], part: str) -> str:
    """Return joint, supported frequencies and, for a spectrum, the worst frequency."""
    words = f"{joint}, {response['lowest']:.3g} to {response['highest']:.3g} Hz"
    worst = response.get(f"{part}_at")
    return words if worst is None else f"{words}, worst at {worst:.3g} Hz"


def _tcp_measures(golden: Golden, values: Mapping[str, Any]) -> Iterator[Measure]:
    for name, quantity_name, number in (
        ("tcp_position_rms", "position", "rms"),
        ("tcp_position_max", "position", "maximum"),
        ("tcp_orientation_max", "orientation", "maximum"),
    ):
        if name in golden.tolerance:
            error = values[quantity_name][number]
            time, bound = values[quantity_name]["at"], golden.tolerance[name]
            yield Measure.of_error(name, values["frame"], error, bound, "recording", time)
