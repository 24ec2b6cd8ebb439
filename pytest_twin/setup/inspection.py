"""Inspect a robot's model and propose first goldens; runs in the child process."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pytest_twin.audit.audit_file import findings_of
from pytest_twin.checks import check_of, kinds
from pytest_twin.checks.base import NothingToProposeError
from pytest_twin.checks.proposals import Actuation, fixed_base
from pytest_twin.errors import TwinError
from pytest_twin.excitation.template import blank_section
from pytest_twin.realization import Realization, load
from pytest_twin.realization.joint_limits import model_effort
from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings
from pytest_twin.twin import load_twin

_TOOL = re.compile(r"(^|_)(tcp|tool0?|ee|ee_link|end_effector|gripper_?frame)$", re.IGNORECASE)


def inspect_model(model: str) -> dict[str, Any]:
    """Inspect a model: files, repaired inertias, notes, critical findings, tool frame, motors.

    Args:
        model: path of the model file.

    Raises:
        TwinError: the model cannot be loaded.
    """
    realization = load(Path(model), accept_invalid_inertia=True)
    source = realization.source
    located = source.located
    assert located is not None
    assert located.root is not None
    return {
        "files": [str(path) for path in source.files],
        "root": str(located.root.folder),
        "packages": {
            name: str(found.folder) for name, found in sorted(located.packages.found.items())
        },
        "notes": [
            *realization.notes,
            *_unnamed_elements(realization),
            *filter(None, [fixed_base(realization)]),
        ],
        "inertia_repairs": {
            link: [float(value) for value in values]
            for link, values in source.inertia_repairs.items()
        },
        "critical": [
            finding
            for finding, one in findings_of(realization.path, located).items()
            if one.severity == "critical"
        ],
        "tcp": _last_frame(realization),
        "motors": _motors(realization),
        "alike": _joints_alike(realization),
        "excitation": blank_section(realization),
        "drives": {
            actuator: joints[0]
            for actuator, joints in realization.structure.actuator_joints.items()
            if len(joints) == 1
        },
    }


def _joints_alike(realization: Realization) -> list[list[str]]:
    """Joints that may have the same motor: their armatures and effort limits are equal."""
    alike: dict[tuple[float, ...], list[str]] = {}
    for joints in realization.structure.actuator_joints.values():
        if len(joints) != 1 or (limits := model_effort(realization, joints[0])) is None:
            continue
        armature = float(realization.model.dof_armature[realization.joint_dof_index(joints[0])])
        of_motor = alike.setdefault((armature, *limits), [])
        if joints[0] not in of_motor:
            of_motor.append(joints[0])
    return [joints for joints in alike.values() if len(joints) > 1]


def _motors(realization: Realization) -> dict[str, str]:
    """Actuator -> ``hinge`` or ``slide``, for a URDF without servos; else empty."""
    commands = Actuation.of(realization).commands
    if realization.path.suffix.lower() != ".urdf" or commands != {"effort"}:
        return {}
    structure = realization.structure
    return {
        actuator: structure.joint_type[joints[0]]
        for actuator, joints in structure.actuator_joints.items()
        if joints
    }


def _unnamed_elements(realization: Realization) -> list[str]:
    """One line for each kind of element with unnamed elements."""
    model = realization.model
    counts = {
        "joint": (model.njnt, "joints"),
        "body": (model.nbody, "bodies"),
        "actuator": (model.nactuator, "actuators"),
    }
    return [
        f"{realization.path}: {count - named} of {count} {plural} have no name: "
        "name them, so that goldens can refer to them"
        for kind, (count, plural) in counts.items()
        if (named := len(realization.names(kind))) < count
    ]


def first_specs(twin: str, progress: Any) -> dict[str, Any]:
    """First specs of all installed kinds, with the kinds that propose none and the failed ones.

    Args:
        twin: path of ``twin.yaml``.
        progress: called with the fraction that is done, 0 to 1.

    Returns:
        ``specs``, ``silent`` (kind -> error) and ``none`` (kind -> reason).
    """
    loaded = load_twin(Path(twin))
    first = loaded.first_realization
    realization = load(first.file, twin=loaded, name=first.name)
    specs: list[dict[str, Any]] = []
    silent: dict[str, str] = {}
    none: dict[str, str] = {}
    for done, kind in enumerate(kinds()):
        try:
            # Poses and amplitudes that a check tries and rejects may be unstable.
            with suppress_mujoco_warnings():
                found = check_of(kind).first(realization)
        except NothingToProposeError as reason:
            none[kind] = str(reason)
            continue
        except TwinError as error:
            silent[kind] = str(error)
            continue
        except Exception as error:  # the code of another package fails only its own kind
            silent[kind] = f"{type(error).__name__}: {error}"
            continue
        if not found:
            none[kind] = "the kind proposes nothing"
        specs += [{"kind": kind, **_round_numbers(spec)} for spec in found]
        progress((done + 1) / len(kinds()))
    return {"specs": specs, "silent": silent, "none": none}


def _last_frame(realization: Realization) -> str | None:
    """The frame with the name of a tool, or the last frame of the longest chain of joints."""
    structure = realization.structure
    moved = set(structure.joint_body.values())
    depth: dict[str, int] = {}

    def joints_above(body: str) -> int:
        chain = []
        while body in structure.body_parent and body not in depth:
            chain.append(body)
            body = structure.body_parent[body]
        count = depth.get(body, 0)
        for link in reversed(chain):
            count += link in moved
            depth[link] = count
        return count

    given = {*realization.names("body")[1:], *realization.names("site")}
    order = [frame for frame in structure.frame_body if frame in given]
    return max(
        order,
        key=lambda frame: (
            bool(_TOOL.search(frame)),
            joints_above(structure.frame_body[frame]),
            order.index(frame),
        ),
        default=None,
    )


def _round_numbers(value: Any) -> Any:
    """Plain mappings, lists and numbers with 9 digits, for readable YAML."""
    if isinstance(value, Mapping):
        return {str(key): _round_numbers(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_round_numbers(inner) for inner in value]
    if isinstance(value, float) and math.isfinite(value):
        return float(f"{value:.9g}")
    return value
