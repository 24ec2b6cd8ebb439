"""From a file to a realization: MJCF or URDF, checked before any loader sees it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco

from pytest_twin.errors import ModelError, SpecError
from pytest_twin.formats import xml
from pytest_twin.formats.paths import Roots
from pytest_twin.realization import mjcf, patch, urdf, urdf_spec
from pytest_twin.realization.files.locate import Located, locate
from pytest_twin.realization.files.search import SearchFolders
from pytest_twin.realization.files.urdf import UrdfFiles
from pytest_twin.realization.limits import LIMITS, ModelLimits
from pytest_twin.realization.model import Realization
from pytest_twin.realization.model_formats import as_mjcf
from pytest_twin.realization.source import Source
from pytest_twin.twin import USD_SUFFIXES, Fit, Simulator, Twin, effects_file_next_to


# A public function whose arguments are given by keyword.
def load(  # noqa: PLR0913
    path: Path,
    *,
    twin: Twin | None = None,
    name: str = "mujoco",
    roots: Roots | None = None,
    search: SearchFolders | None = None,
    located: Located | None = None,
    accept_invalid_inertia: bool = False,
    shapes: bool = True,
    limits: ModelLimits = LIMITS,
    simulator: Simulator = "mujoco",
) -> Realization:
    """Load an MJCF or URDF file, or one of a format that an installed package turns into MJCF.

    Args:
        path: the file; what it is, its root element says.
        twin: the twin that it belongs to: its fit is applied, its roots hold. A model that a
            diagnosis wrote has the fit and the base's pose in it.
        name: the realization's name.
        roots: folders that references may lead into; by default the twin's, else the root of the
            model, which :func:`pytest_twin.realization.files.locate` chooses.
        search: folders that the user names beside these.
        located: where the files may lie, where that is known already.
        accept_invalid_inertia: of a URDF, repair inertias that no body can have and note it,
            rather than raise; ``source.inertia_repairs`` then holds what a twin's fit can state.
        shapes: of a URDF, with the collision shapes. Without them its meshes need not be there;
            what moves in contact with nothing moves the same.
        limits: bounds on what may be loaded.
        simulator: what steps it. ``newton`` takes a USD stage; fit, controllers and payloads then
            change an MJCF of the stage, whose masses, joints and drives Newton gets.

    Raises:
        NewtonMissingError, UsdMissingError: an extra that a USD stage needs is not installed.
        FormatError: not well-formed XML, or beyond a bound.
        PathError: a reference that leaves the roots or leads nowhere.
        ModelError: no model that could be simulated.
        SpecError: the fit names what the model lacks.
    """
    # Its folder without links, as the roots have it; a link in place of the file is refused.
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
        # Its root cannot be chosen by the files that it names: only the package knows its syntax.
        roots = roots or Roots(path.parent)
    located = located or locate(path, search=search, twin=twin, roots=roots, limits=limits)
    if tag == "mujoco":
        document = mjcf.read(path, located.roots, text=text, limits=limits)
        source = Source(
            "mjcf", document.root, dict(document.asset_paths), read=frozenset(document.files)
        )
        spec, places = mjcf.build(document), document.places
    else:
        robot = urdf.read(path, limits=limits)
        converted = urdf_spec.convert(
            robot,
            UrdfFiles.of(robot.node, located.roots, located.packages),
            accept_invalid_inertia=accept_invalid_inertia,
            shapes=shapes,
            inertia_patches={} if fit is None else fit.patches.get("body", {}),
            limits=limits,
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
    if fit is not None:
        patch.apply_fit(spec, fit.patches, fit.option, refuse=_fit_error(fit))
    base = twin.calibration.transform_world_to_base if twin and twin.calibration else None
    if twin is not None and effects is None and base is not None:
        patch.place_base(spec, base, refuse=twin.error, where="calibration.base")
    try:
        model, warned = mjcf.compiled(spec)
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise mjcf.translate(error, path, places) from None
    said = tuple(f"{path}: MuJoCo warns: {words}" for words in warned)
    chosen = () if twin is not None else located.words()
    source = replace(source, notes=chosen + source.notes + said, effects=effects, located=located)
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

        loaded.source = replace(source, notes=(*source.notes, *newton.left_out(loaded)))
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
