"""From a file to a realization: MJCF or URDF, checked before any loader sees it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco

from pytest_twin.errors import ModelError, SpecError
from pytest_twin.formats import xml
from pytest_twin.formats.paths import Roots
from pytest_twin.realization import mjcf, patch
from pytest_twin.realization.limits import LIMITS, ModelLimits
from pytest_twin.realization.model import Realization
from pytest_twin.twin import Fit, Twin


@dataclass(frozen=True, slots=True)
class Source:
    """What a realization was built from.

    Attributes:
        kind: ``mjcf`` or ``urdf``.
        document: the checked text and the files that it refers to.
        notes: what the conversion changed or left out, with file and line.
        velocity_limit: joint -> rad/s or m/s.
    """

    kind: str
    document: mjcf.Document
    notes: tuple[str, ...] = ()
    velocity_limit: Mapping[str, float] = field(default_factory=dict)

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that was read, sorted."""
        read = {node.path for node in self.document.root.walk()}
        return tuple(sorted(read | set(self.document.asset_paths.values())))


def load(
    path: Path,
    *,
    twin: Twin | None = None,
    name: str = "mujoco",
    roots: Roots | None = None,
    limits: ModelLimits = LIMITS,
) -> Realization:
    """Load an MJCF or URDF file.

    Args:
        path: the file; what it is, its root element says.
        twin: the twin that it belongs to: its fit is applied, its roots hold.
        name: the realization's name.
        roots: folders that references may lead into; the twin's, or the file's own, by default.
        limits: bounds on what may be loaded.

    Raises:
        FormatError: not well-formed XML, or beyond a bound.
        PathError: a reference that leaves the roots or leads nowhere.
        ModelError: no model that could be simulated.
        SpecError: the fit names what the model lacks.
    """
    path = path.absolute()
    if roots is None:
        roots = Roots(path.parent) if twin is None else twin.path_roots
    tag = xml.parse(path).tag
    if tag != "mujoco":
        raise ModelError("not a robot model", path=path, value=tag, expected="<mujoco> or <robot>")
    document = mjcf.read(path, roots, limits=limits)
    source = Source("mjcf", document)
    spec = mjcf.build(document)
    if twin is not None and twin.fit is not None:
        patch.apply_fit(spec, twin.fit.patches, twin.fit.option, refuse=_fit_error(twin.fit))
    try:
        model = spec.compile()
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise mjcf.translate(error, document) from None
    return Realization(name=name, path=path, spec=spec, model=model, source=source, twin=twin)


def _fit_error(fit: Fit) -> patch.Refuse:
    def refuse(where: str, problem: str, **details: Any) -> SpecError:
        inner = where.removeprefix("fit.")
        line = fit.lines.get(inner) or fit.lines.get(inner.rpartition(".")[0])
        return SpecError(problem, path=fit.path, line=line, where=where, **details)

    return refuse
