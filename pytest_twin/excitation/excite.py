"""Design safe motions for a twin within approved limits, predict covariances, write files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco

from pytest_twin.excitation import files, prediction
from pytest_twin.excitation.approved_limits import ApprovedLimits, missing_lines
from pytest_twin.excitation.approved_robot import ApprovedRobot, load_twin_model
from pytest_twin.excitation.closed_loop import servo_modes
from pytest_twin.excitation.designs import (
    several_joint_designs,
    single_joint_designs,
)
from pytest_twin.excitation.document import courses, document_of, on_abort
from pytest_twin.excitation.find_safe import RejectedDesign, Robot, SafeMotion, find_safe
from pytest_twin.excitation.gravity_grid import static_base
from pytest_twin.excitation.noise import SampleNoise
from pytest_twin.excitation.prediction import PredictedAccuracy
from pytest_twin.excitation.read_limits import missing_error, movable_joints
from pytest_twin.excitation.template import template
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.file_names import portable_names
from pytest_twin.identification.regressor.base_parameters import BaseParameters
from pytest_twin.identification.regressor.regressor import Regressor
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.realization.model import Realization
from pytest_twin.recording_options import CommandMode
from pytest_twin.time_limit import TimeLimit, limited
from pytest_twin.twin import Twin

FOLDER = "trajectories"


@dataclass(frozen=True, slots=True)
class Excitation:
    """Result of a design.

    Attributes:
        realization, approved, noise: model, limits and measurement noise.
        regressor, base: regressor and base parameters of the approved joints.
        safe, refused: safe motions, and designs without a safe motion.
        predicted: parameters that the motions of role fit determine.
        seed: seed of all random choices.
    """

    realization: Realization
    approved: ApprovedLimits
    noise: SampleNoise
    regressor: Regressor
    base: BaseParameters
    safe: tuple[SafeMotion, ...]
    refused: tuple[RejectedDesign, ...]
    predicted: tuple[PredictedAccuracy, ...]
    seed: int


def missing_template(model: str) -> dict[str, Any]:
    """Return the missing lines of a twin as YAML to fill in; empty if none is missing.

    Args:
        model: MJCF, URDF or ``twin.yaml``.
    """
    realization, twin = load_twin_model(Path(model))
    section = {} if twin is None else twin.excitation or {}
    missing = missing_lines(section, movable_joints(realization))
    if not missing:
        return {"template": "", "missing": []}
    text = template(realization, missing)
    if twin is None:
        text = f"# twin.yaml\nmodel: {Path(model).name}\n{text}"
    return {"template": text, "missing": missing}


def excite_file(
    model: str,
    out: str,
    seed: int,
    progress: Callable[[float], None] = lambda fraction: None,
    seconds: float = 0.0,
) -> dict[str, Any]:
    """Design, check, write; runs in the child process.

    Args:
        model: ``twin.yaml``.
        out: folder for the motions.
        seed: seed of all random choices.
        progress: called with the fraction done.
        seconds: limit of the processor time, s; 0 for none.

    Returns:
        ``document`` and ``abort``, the content of ``excitation.json`` and ``abort.json``, and
            ``drawn``, series over time for the page.
    """
    path = Path(model)
    realization, twin = load_twin_model(path)
    if twin is None:
        raise missing_error(path, missing_lines({}, movable_joints(realization)), None)
    with limited(seconds) as limit:
        written = write_motions(excite(realization, twin, seed, progress), path, Path(out))
    state_limit(written["document"], limit)
    return written


def state_limit(document: dict[str, Any], limit: TimeLimit) -> None:
    """Write into ``excitation.json`` what a run left out, and why it ended early."""
    document["not_tried"] = limit.not_tried
    document["ended_early"] = limit.note()


def write_motions(found: Excitation, twin: Path, out: Path) -> dict[str, Any]:
    """Write the motions and return their document, as for :func:`excite_file`."""
    document = document_of(found, _write(found, out))
    document["model"] = {
        "file": str(found.realization.path),
        "sha256": file_sha256(found.realization.path),
        "twin": str(twin),
        "twin_sha256": file_sha256(twin),
    }
    drawn = {one.motion.name: courses(one, found.approved) for one in found.safe}
    return {"document": document, "abort": on_abort(found), "drawn": drawn}


def excite(
    realization: Realization,
    twin: Twin,
    seed: int = 1,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Excitation:
    """Design all requested motions, and predict the parameters that they determine.

    Raises:
        SpecError: lines are missing, a value is invalid, or the start is not safe.
    """
    robot = ApprovedRobot.of(realization, twin, seed)
    approved, noise, regressor = robot.approved, robot.noise, robot.regressor
    payloads = tuple(twin.payloads)
    optimal = robot.optimal if "inertia" in approved.mechanisms else None
    designs = single_joint_designs(approved, robot.loads, seed) + several_joint_designs(
        approved, regressor, noise.effort, robot.around, payloads, optimal, seed
    )
    wanted = {design.payload for design in designs}
    robots = {
        payload: Robot(realization.variant(payload=payload), approved)
        for payload in (None, *payloads)
        if payload in wanted
    }
    safe, refused = find_safe(designs, approved, robots, progress)
    carrier = _carrier(twin, realization, regressor)
    predicted = _predict_accuracies(safe, approved, noise, regressor, robot.base, robots, carrier)
    return Excitation(
        realization, approved, noise, regressor, robot.base, tuple(safe), tuple(refused),
        tuple(predicted), seed,
    )  # fmt: skip


def _predict_accuracies(
    safe: Sequence[SafeMotion],
    approved: ApprovedLimits,
    noise: SampleNoise,
    regressor: Regressor,
    base: BaseParameters,
    robots: Mapping[str | None, Robot],
    carrier: str,
) -> list[PredictedAccuracy]:
    """Predict the parameters that motions of role fit determine, for each mechanism.

    ``carrier`` is the joint that moves the body with the payloads.
    """
    fit = [one for one in safe if one.motion.role == "fit"]
    found: list[PredictedAccuracy] = []
    for at, joint in enumerate(approved.joints):
        own = [one for one in fit if one.motion.moved == (joint.name,)]
        kinds = {kind: [one for one in own if one.motion.kind == kind] for kind in _SINGLE}
        if kinds["steps"]:
            responses = [one.response for one in kinds["steps"]]
            found.append(prediction.delay(responses, at, approved, noise))
        for one in kinds["chirp"]:
            gains = robots[None].nominal.servo_derivatives(one.motion, at)
            found += prediction.closed_loop(one.response, gains, at, approved, noise)
        slow = [one.motion for one in kinds["reversals"]]
        if slow and "friction" in approved.mechanisms:
            found += prediction.friction(slow, at, regressor, approved, noise)
        if slow and "backlash" in approved.mechanisms:
            found.append(prediction.backlash(slow, at, approved, noise))
    for one in fit:
        if one.motion.kind == "grid" and one.motion.payload is None:
            if "gravity" in approved.mechanisms:
                static = static_base(regressor, approved)
                found += prediction.gravity(one.motion, static, regressor, approved, noise)
            if "payload" in approved.mechanisms:
                found += prediction.payload(one.motion, carrier, regressor, approved, noise)
        if one.motion.kind == "fourier":
            found += prediction.inertia([one.motion], base, regressor, approved, noise)
    return found


_SINGLE = ("steps", "chirp", "reversals")


def _carrier(twin: Twin, realization: Realization, regressor: Regressor) -> str:
    """Return the joint that moves the body with declared payloads; by default the last joint."""
    model = realization.model
    for bodies in twin.payloads.values():
        for name in bodies:
            body = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name))
            while body > 0:
                for index in range(model.njnt):
                    joint = model.joint(index).name
                    if model.jnt_bodyid[index] == body and joint in regressor.joints:
                        return str(joint)
                body = int(model.body_parentid[body])
    return regressor.joints[-1]


def modes_of(found: Excitation) -> tuple[CommandMode, ...]:
    """Return each joint's command mode; position without servos in the model."""
    modes = servo_modes(found.realization, found.approved.names)
    if modes is not None:
        return modes
    position: CommandMode = "position"
    return tuple(position for _ in found.approved.joints)


def _write(found: Excitation, out: Path) -> dict[str, list[str]]:
    """Write all motions; return motion -> its files, relative to ``out``."""
    folder = out / FOLDER
    names = portable_names([one.motion.name for one in found.safe])
    encoders = Encoders.of(calibration_of(found.realization), found.approved.names)
    written: dict[str, list[str]] = {}
    if found.safe:
        folder.mkdir(exist_ok=True)
    for one in found.safe:
        position = encoders.read_position(one.motion.position)
        paths = files.write(
            folder / names[one.motion.name], one.motion, found.approved.names, 1.0 / encoders.slope,
            position, modes_of(found),
        )  # fmt: skip
        written[one.motion.name] = [str(path.relative_to(out)) for path in paths]
    return written
