"""Convert a URDF to a normalized URDF, an MJCF and a USD stage, with a semantic-loss matrix.

This module runs in the child process, because it loads untrusted files.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.asset import manifest, simready
from pytest_twin.asset.changes import ChangeLog
from pytest_twin.asset.loss import compare, from_mujoco, from_pinocchio, from_urdf, from_usd, render
from pytest_twin.asset.loss.description import Description
from pytest_twin.asset.loss.matrix import Conversion, Matrix
from pytest_twin.asset.normalize import Normalized, normalize
from pytest_twin.errors import TwinError
from pytest_twin.formats import atomic
from pytest_twin.formats.declared_inputs import declared_inputs, expansion_of
from pytest_twin.formats.expansions import EXPANDED
from pytest_twin.formats.paths import Roots
from pytest_twin.realization import (
    inertia,
    mjcf_file,
    urdf,
    urdf_extras,
    urdf_sites,
    urdf_spec,
    urdf_visuals,
    usd,
)
from pytest_twin.realization.files.locate import locate
from pytest_twin.realization.files.packages import Packages
from pytest_twin.realization.files.urdf import UrdfFiles
from pytest_twin.realization.node import Node

CHANGES = "changes"
LOSS = "loss"


def realize(
    source: str,
    folder: str,
    accept: Sequence[str] = (),
    progress: Any = None,
) -> dict[str, Any]:
    """Write every form of a robot into an empty folder.

    Args:
        folder: an empty folder for the results.
        accept: accepted patches, ``inertia-repair:<link>``.
        progress: called with the fraction done.

    Returns:
        ``files`` of each state, ``critical`` failures, ``notes``, ``left_out`` forms, and
            ``counts`` of verdicts in the matrix.

    Raises:
        TwinError: the file contains no robot that can be read.
    """
    say = progress or (lambda fraction: None)
    path, out = Path(source), Path(folder)
    located = locate(path)
    made = normalize(path, out, located=located, accept=accept)
    say(0.3)
    told = _apply_patches(urdf.read(path), made)
    robot = urdf.read(made.urdf)
    extras = urdf_extras.read(told)
    before = from_urdf.describe(told, extras, made.collision_points)
    forms = [_mjcf(made, robot, told, before, extras)]
    say(0.6)
    forms.append(_usd(made, told, before))
    stage = forms[-1][1]
    # The reports of a robot of that name have the same names.
    if stage is not None and stage.stem not in (CHANGES, LOSS, Path(manifest.FILE_NAME).stem):
        simready.write(stage, path, located.roots)
    say(0.8)
    forms.append(_pinocchio(made, robot, before))
    matrix = Matrix(
        told.node.attributes.get("name", path.stem), path.name, tuple(c for c, _ in forms)
    )
    command: tuple[str, ...] = ("pytest-twin", "realize", path.name, "--out", "DIR")
    for name in sorted(declared_inputs().packages):
        command += ("--package", f"{name}=FOLDER")
    command += ("--root", "FOLDER") * len(declared_inputs().roots)
    for patch in sorted(accept):
        command += ("--accept", patch)
    expansion = expansion_of(path)
    if expansion is not None:
        for name, value in sorted(expansion.arguments.items()):
            command += ("--xacro", f"{name}:={value}")
        shutil.copyfile(expansion.urdf, out / f"{made.urdf.stem}{EXPANDED}")
    log = ChangeLog(command, tuple(made.changes), tuple(made.flags))
    _write(out, matrix, log)
    say(1.0)
    states = {
        "normalized": manifest.state_of(out, made.files),
        "realization": manifest.state_of(
            out,
            [file for _, file in forms if file is not None],
            {
                conversion.target.lower(): {
                    "engine": conversion.engine,
                    "file": None if file is None else file.relative_to(out).as_posix(),
                    **({"left_out": conversion.problem} if conversion.problem else {}),
                }
                for conversion, file in forms
            },
        ),
    }
    critical = [f"{flag.where}: {flag.why} ({flag.value})" for flag in made.flags if flag.critical]
    return {
        "asset": made.urdf.stem,
        "command": list(command),
        "source_files": [str(file) for file in dict.fromkeys(made.source_files)],
        "states": {
            name: {
                "files": dict(state.files),
                "facts": {
                    **state.facts,
                    "content": manifest.content_digests(out, state.files),
                },
            }
            for name, state in states.items()
        },
        "critical": critical + matrix.critical,
        "located": {**located.to_json(), "words": list(located.words())},
        "patches": [flag.patch for flag in made.flags if flag.patch],
        "left_out": [c.problem for c in matrix.conversions if c.problem and not c.critical],
        "changes": len(made.changes),
        "counts": {
            f"{c.source} -> {c.target}": {
                verdict: sum(row.verdict == verdict for row in c.rows)
                for verdict in ("kept", "changed", "lost")
            }
            for c in matrix.conversions
            if c.rows
        },
    }


def _apply_patches(robot: urdf.Robot, made: Normalized) -> urdf.Robot:
    """Return the source with accepted patches, which every form has to represent."""
    for name in robot.corrected:
        link = robot.links[name]
        assert link.inertial is not None
        _, axes = urdf.origin(link.inertial)
        _state(link.inertial, link.mass, inertia.six_components(axes.T @ link.inertia @ axes))
    for name, values in made.repairs.items():
        link = robot.links[name]
        assert link.inertial is not None
        _state(link.inertial, link.mass, values)
        _, axes = urdf.origin(link.inertial)
        link.inertia = axes @ inertia.tensor(values) @ axes.T
    return robot


def _state(inertial: Node, mass: float, values: Sequence[float]) -> None:
    """Replace the stated mass [kg] and ixx iyy izz ixy ixz iyz [kg*m^2]."""
    keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    stated = {"mass": {"value": mass}, "inertia": dict(zip(keys, values, strict=True))}
    for tag, numbers in stated.items():
        node = inertial.find(tag)
        if node is None:
            node = Node(tag, {}, inertial.path, inertial.line)
            inertial.children.append(node)
        node.attributes.update({key: repr(float(value)) for key, value in numbers.items()})


_Form = tuple[Conversion, Path | None]


def _mjcf(
    made: Normalized,
    robot: urdf.Robot,
    told: urdf.Robot,
    before: Description,
    extras: urdf_extras.Extras,
) -> _Form:
    path = made.urdf.with_suffix(".xml")
    try:
        converted = urdf_spec.convert(robot, UrdfFiles(Roots(path.parent), Packages()))
        urdf_sites.add(converted.spec, robot, extras)
        urdf_visuals.add(converted.spec, robot, converted.mesh_paths)
        model = mjcf_file.write(converted.spec, path, converted.mesh_paths)
        after = from_mujoco.describe(model, robot.root)
    except TwinError as error:
        path.unlink(missing_ok=True)
        return _failed_conversion("MJCF", error, path.parent), None
    return compare.compare(before, after, from_pinocchio.reference(told), "Pinocchio"), path


def _usd(made: Normalized, told: urdf.Robot, before: Description) -> _Form:
    path = made.urdf.with_suffix(".usdc")
    try:
        usd.convert(made.urdf, path)
        free = [joint.child for joint in told.joints.values() if joint.type == "floating"]
        after = from_usd.describe(path, free)
    except usd.UsdMissingError as error:
        return Conversion("URDF", "USD", "none", problem=str(error)), None
    except TwinError as error:
        path.unlink(missing_ok=True)
        return _failed_conversion("USD", error, path.parent), None
    return compare.compare(before, after, from_pinocchio.reference(told), "Pinocchio"), path


def _pinocchio(made: Normalized, robot: urdf.Robot, before: Description) -> _Form:
    try:
        after = from_pinocchio.describe(made.urdf, robot)
    except TwinError as error:
        return _failed_conversion("Pinocchio", error, made.urdf.parent), None
    return compare.compare(before, after, before.dynamics, "the URDF's own numbers"), None


def _failed_conversion(target: str, error: TwinError, folder: Path) -> Conversion:
    # Remove the temporary folder from paths, so that messages name files of the asset.
    problem = str(error).replace(f"{folder}/", "")
    return Conversion("URDF", target, "none", problem=problem, critical=True)


def _write(out: Path, matrix: Matrix, log: ChangeLog) -> None:
    for stem, data in ((LOSS, matrix.to_json()), (CHANGES, log.to_json())):
        text = json.dumps(_finite(data), indent=1, ensure_ascii=False, allow_nan=False)
        atomic.write_text(out / f"{stem}.json", text + "\n")
    atomic.write_text(out / f"{CHANGES}.md", log.to_markdown())
    atomic.write_text(out / f"{LOSS}.md", render.markdown(matrix))
    atomic.write_text(out / f"{LOSS}.html", render.html(matrix))


def _finite(value: Any) -> Any:
    """Replace non-finite numbers, which JSON cannot represent, by their names."""
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return value
