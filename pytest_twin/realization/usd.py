"""Convert a URDF to a USD stage with ``urdf-usd-converter`` (extra ``usd``)."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pytest_twin.errors import ModelError, TwinError
from pytest_twin.formats.temporary import temporary_folder

if TYPE_CHECKING:
    from pytest_twin.realization.urdf import Joint

INSTALL = "pip install 'pytest-twin[usd]'"
_FIRST_WITHOUT = (3, 13)
"""First Python version without a release of usd-exchange; there the extra installs nothing."""


class UsdMissingError(TwinError):
    """The extra ``usd`` is not installed, or two packages of OpenUSD conflict."""


def missing(consequence: str, *, path: Path | None = None) -> UsdMissingError:
    """Error that says why USD is not available, and what to do with this version of Python.

    Args:
        consequence: what is not done without it, such as ``USD is left out``.
        path: the file that needs it.
    """
    running = sys.version_info[:2]
    if running >= _FIRST_WITHOUT:
        version = ".".join(str(part) for part in running)
        return UsdMissingError(
            f"{consequence}: its libraries (usd-exchange) have no release for Python {version}",
            path=path,
            expected=f"Python 3.11 or 3.12, with {INSTALL}",
        )
    return UsdMissingError(
        f"{consequence}: the extra 'usd' is not installed", path=path, expected=INSTALL
    )


def import_openusd() -> None:
    """Import OpenUSD with Newton's schemas, as far as they are installed.

    OpenUSD finds a schema only if it was registered before the first stage of the process, so every
    module that opens a stage begins here.

    Raises:
        ImportError: OpenUSD is not installed, or does not load.
    """
    if importlib.util.find_spec("newton_usd_schemas") is not None:
        import newton_usd_schemas  # noqa: F401 - registers the schemas
    from pxr import UsdPhysics  # noqa: F401 - whether OpenUSD loads


def require() -> None:
    """Import OpenUSD and the converter.

    Raises:
        UsdMissingError: the extra is not installed, or does not load.
    """
    for module in ("pxr", "urdf_usd_converter"):
        if importlib.util.find_spec(module) is None:
            raise missing("USD is left out")
    try:
        with _suppress_output():
            import_openusd()
            import urdf_usd_converter  # noqa: F401 - whether it loads
    except ImportError as error:
        # usd-core and usd-exchange (which the converter needs) both install the modules `pxr`, and
        # the later installation breaks the other.
        raise UsdMissingError(
            f"USD is left out: OpenUSD does not load ({' '.join(str(error).split())[:120]})",
            expected="usd-exchange without usd-core: `pip uninstall usd-core`, then "
            "`pip install --force-reinstall usd-exchange`",
        ) from None


def version() -> str:
    """Versions of OpenUSD and the converter, for a manifest."""
    from importlib.metadata import version as installed

    from pxr import Usd

    number = ".".join(str(part) for part in Usd.GetVersion())
    return f"OpenUSD {number}, urdf-usd-converter {installed('urdf-usd-converter')}"


def convert(urdf: Path, target: Path) -> None:
    """Write the stage of a normalized URDF as one file, ``.usda`` or ``.usdc``.

    The converter writes orientations of links in single precision. This function replaces them by
    double precision from the same URDF, and improves oblique joint axes as far as single precision
    allows.

    The converter merges some links of fixed joints into their parent; they are added again as
    frames.

    Raises:
        UsdMissingError: as :func:`require`.
        ModelError: the converter refuses the URDF.
    """
    require()
    import urdf_usd_converter
    from pxr import Sdf, Tf

    with temporary_folder(target.parent) as folder:
        try:
            with _suppress_output(), _temporary(str(folder)):
                made = urdf_usd_converter.Converter(layer_structure=False).convert(
                    str(urdf), str(folder)
                )
        except (ValueError, RuntimeError, TypeError, KeyError, Tf.ErrorException) as error:
            words = " ".join(str(error).split())[:300]
            raise ModelError(f"the USD converter refuses it: {words}", path=urdf) from None
        layer = Sdf.Layer.FindOrOpen(made.path)
        _correct(made.path, urdf)
        # Place and time of the conversion are removed, because they would change the digest.
        layer.documentation = ""
        layer.comment = ""
        layer.customLayerData = {}
        layer.Export(str(target))


def _correct(stage_path: str, urdf: Path) -> None:
    from pxr import Gf, Sdf, Usd
    from scipy.spatial.transform import Rotation

    from pytest_twin.realization import urdf as urdf_text
    from pytest_twin.realization import usd_axes, usd_simready
    from pytest_twin.realization.usd_names import link_prims

    robot = urdf_text.read(urdf)
    stage = Usd.Stage.Open(stage_path)
    prims = link_prims(stage)
    for joint in robot.in_order():
        prim = prims.get(joint.child)
        if prim is None and joint.parent in prims:
            prim = _frame(prims[joint.parent], joint)
            prims[joint.child] = prim
        if prim is None or not prim.HasAttribute("xformOp:orient"):
            continue
        prim.RemoveProperty("xformOp:orient")
        made = prim.CreateAttribute("xformOp:orient", Sdf.ValueTypeNames.Quatd, custom=False)
        x, y, z, w = Rotation.from_matrix(joint.rotation).as_quat()
        made.Set(Gf.Quatd(w, x, y, z))
    usd_axes.improve_axes(stage, robot)
    usd_simready.complete(stage, robot)
    stage.GetRootLayer().Save()


def _frame(parent: Any, joint: Joint) -> Any:
    """Add a prim for the child link of a fixed joint that lacks one."""
    from pxr import Gf, Tf, UsdGeom

    stem, count = Tf.MakeValidIdentifier(joint.child), 1
    name = stem
    while parent.GetChild(name):
        name, count = f"{stem}_{count}", count + 1
    made = UsdGeom.Xform.Define(parent.GetStage(), parent.GetPath().AppendChild(name))
    made.AddTranslateOp().Set(Gf.Vec3d(*joint.position.tolist()))
    made.AddOrientOp()
    made.AddScaleOp().Set(Gf.Vec3f(1.0))
    if name != joint.child:
        made.GetPrim().SetDisplayName(joint.child)
    return made.GetPrim()


@contextlib.contextmanager
def _temporary(folder: str) -> Iterator[None]:
    """Make the converter write its temporary files into ``folder``, which is deleted later."""
    before = tempfile.tempdir
    tempfile.tempdir = folder
    try:
        yield
    finally:
        tempfile.tempdir = before


@contextlib.contextmanager
def _suppress_output() -> Iterator[None]:
    """Suppress the output that OpenUSD writes directly to the descriptors 1 and 2."""
    saved: list[tuple[int, int]] = []
    with warnings.catch_warnings(), Path(os.devnull).open("w") as sink:
        warnings.simplefilter("ignore")
        for descriptor in (1, 2):
            saved.append((descriptor, os.dup(descriptor)))
        sys.stdout.flush()
        sys.stderr.flush()
        try:
            for descriptor, _ in saved:
                os.dup2(sink.fileno(), descriptor)
            yield
        finally:
            for descriptor, copy in saved:
                os.dup2(copy, descriptor)
                os.close(copy)
