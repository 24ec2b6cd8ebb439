"""Load a model file (MJCF, URDF or an installed format) as a realization, after checking it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco

from pytest_twin.errors import ModelError, SpecError
from pytest_twin.formats import xml
from pytest_twin.formats.paths import Roots
from pytest_twin.realization import mjcf, patch, urdf, urdf_spec
from pytest_twin.realization.files.locate import ModelFolders, locate
from pytest_twin.realization.files.urdf import UrdfFiles
from pytest_twin.realization.fixed_base import fix_base
from pytest_twin.realization.model import Realization
from pytest_twin.realization.model_formats import as_mjcf
from pytest_twin.realization.source import Source
from pytest_twin.recording_options import Base
from pytest_twin.twin import USD_SUFFIXES, Fit, Simulator, Twin, effects_file_next_to


# Public: its keywords are independent of each other, and most callers give one or two. An object
# of options would break them and save nothing.
def load(  # noqa: PLR0913
    path: Path,
    *,
    twin: Twin | None = None,
    name: str = "mujoco",
    roots: Roots | None = None,
    located: ModelFolders | None = None,
    accept_invalid_inertia: bool = False,
    shapes: bool = True,
    simulator: Simulator = "mujoco",
    base: Base | None = None,
) -> Realization:
    """Load an MJCF or URDF file, or a file that an installed package converts to MJCF.

    Args:
        path: the file; its root element determines the format.
        twin: the twin that it belongs to. Its fit and base pose are applied, except to a model that
            a diagnosis wrote, which contains them.
        roots: folders that referenced files may be in; by default those of the twin, or the root
            of the model that :func:`pytest_twin.realization.files.locate` chooses.
        located: result of :func:`pytest_twin.realization.files.locate`, if it is known.
        accept_invalid_inertia: URDF: whether to repair inertias that are not physically consistent
            and add a note, instead of raising an error; ``source.inertia_repairs`` then has them.
        shapes: URDF: whether to load the collision shapes. Without them the mesh files are not
            needed, and motion without contact is the same.
        simulator: simulator that steps the model. ``newton`` needs a USD stage; fit, controllers
            and payloads then change an MJCF of the stage, and Newton gets its masses, joints and
            drives.
        base: what holds a floating base; overrides the twin.

    Raises:
        NewtonMissingError, UsdMissingError: an extra that a USD stage needs is not installed.
        FormatError: not well-formed XML, or larger than a limit.
        PathError: a referenced file does not exist or is outside the roots.
        ModelError: the model cannot be simulated.
        SpecError: the calibration or the fit names an element that the model lacks.
    """
    # Links are resolved in the folder, as in the roots; a link in place of the file is refused.
    path = path.parent.resolve() / path.name
    effects = effects_file_next_to(path)
    fit = None if twin is None or effects is not None else twin.fit
    text = _stage_as_mjcf(path) if simulator == "newton" else as_mjcf(path)
    if text is None and path.suffix.lower() in USD_SUFFIXES:
        raise ModelError(
            "MuJoCo does not step USD",
            path=path,
            expected="MJCF or URDF; goldens step a USD stage that twin.yaml declares with "
            "simulator: newton",
        )
    tag = xml.parse(path).tag if text is None else "mujoco"
    if tag not in ("mujoco", "robot"):
        raise ModelError("not a robot model", path=path, value=tag, expected="<mujoco> or <robot>")
    if text is not None and twin is None:
        # The root cannot be chosen from the referenced files: only the package can read them.
        roots = roots or Roots(path.parent)
    located = located or locate(path, twin=twin, roots=roots)
    if tag == "mujoco":
        document = mjcf.read(path, located.roots, text=text)
        source = Source(
            "mjcf", document.root, dict(document.asset_paths), read=frozenset(document.files)
        )
        spec, places = mjcf.build(document), document.places
    else:
        robot = urdf.read(path)
        converted = urdf_spec.convert(
            robot,
            UrdfFiles.of(robot.node, located.roots, located.packages),
            accept_invalid_inertia=accept_invalid_inertia,
            shapes=shapes,
            inertia_patches={} if fit is None else fit.patches.get("body", {}),
        )
        source = Source(
            "urdf",
            robot.node,
            converted.mesh_paths,
            robot,
            tuple(converted.notes),
            converted.inertia_repairs,
            converted.velocity_limit,
            frozenset(converted.beside),
        )
        spec, places = converted.spec, None
    if twin is not None and twin.calibration is not None:
        joints = [joint.name for joint in spec.joints]
        for joint in twin.calibration.joints:
            if joint not in joints:
                raise twin.error(
                    f"calibration.joints.{joint}",
                    "the model has no such joint",
                    expected=patch.suggest(joint, joints),
                )
    if fit is not None:
        patch.apply_fit(spec, fit.patches, fit.option, refuse=_fit_error(fit))
    pose = twin.calibration.transform_world_to_base if twin and twin.calibration else None
    if twin is not None and effects is None and pose is not None:
        patch.place_base(spec, pose, refuse=twin.error, where="calibration.base")
    held: list[str] = []
    try:
        if (base or (twin.recordings.base if twin is not None else None)) == "fixed":
            held = fix_base(spec)
        model, warned = mjcf.compile_spec(spec)
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise mjcf.translate(error, path, places) from None
    said = tuple(f"{path}: MuJoCo warns: {words}" for words in warned)
    chosen = () if twin is not None else located.words()
    source = replace(
        source, notes=(*chosen, *source.notes, *held, *said), effects=effects, located=located
    )
    loaded = Realization(
        name=name,
        path=path,
        spec=spec,
        model=model,
        source=source,
        twin=twin,
        simulator=simulator,
    )
    if simulator == "newton":
        from pytest_twin.realization import newton

        loaded.source = replace(source, notes=(*source.notes, *newton.omitted_forces(loaded)))
    return loaded


def _stage_as_mjcf(path: Path) -> bytes:
    from pytest_twin.realization import newton, usd_model

    newton.require(path)
    return usd_model.as_mjcf(path)


def _fit_error(fit: Fit) -> patch.Refuse:
    def refuse(where: str, problem: str, **details: Any) -> SpecError:
        inner = where.removeprefix("fit.")
        line = fit.lines.get(inner) or fit.lines.get(inner.rpartition(".")[0])
        return SpecError(problem, path=fit.path, line=line, where=where, **details)

    return refuse
