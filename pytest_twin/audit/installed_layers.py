"""Run audit layers from installed packages.

A layer is a class registered under the entry points ``pytest_twin.audit_layers``. The name of the
entry point is the name of the layer and the prefix of its finding codes: ``cell_speed.too_fast``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Protocol

from pytest_twin.audit.asset import Asset
from pytest_twin.audit.evidence import Evidence
from pytest_twin.audit.finding import LAYER_GROUP, LAYERS, PLANNING, SEVERITIES, SIMREADY, Finding
from pytest_twin.audit.geometry import Geometry
from pytest_twin.errors import SpecError, TwinError
from pytest_twin.installed import entry_points_by_name, load_plugin, package_of, single_entry_point


class Layer(Protocol):
    """One layer of the audit."""

    def check(self, asset: Asset, known: Evidence, geometry: Geometry) -> Iterable[Finding]:
        """Return the findings of this layer.

        Args:
            asset: the robot as stated in its file, faults included.
            known: values from data sheets and measurements (``--evidence``).
            geometry: solids of the shapes of each body.
        """
        ...


def names() -> tuple[str, ...]:
    """Return the names of layers of installed packages, sorted."""
    return tuple(sorted(entry_points_by_name(LAYER_GROUP)))


def check(asset: Asset, known: Evidence, geometry: Geometry) -> Iterator[Finding]:
    """Yield the findings of all installed layers.

    Raises:
        SpecError: a layer cannot be loaded, fails, has the name of another layer, or returns an
            invalid finding.
    """
    for name in names():
        yield from _findings(name, asset, known, geometry)


def _findings(name: str, asset: Asset, known: Evidence, geometry: Geometry) -> list[Finding]:
    point = single_entry_point(entry_points_by_name(LAYER_GROUP)[name], "audit layer")
    if name in (*LAYERS, SIMREADY, PLANNING):
        raise SpecError(
            f"{package_of(point)} provides an audit layer with the name of a built-in layer",
            where="audit layer",
            value=name,
            expected="another name of the entry point",
        )
    layer: Layer = load_plugin(point, "audit layer")
    try:
        found = list(layer.check(asset, known, geometry))
        wrong = [f for f in found if f.layer != name or f.severity not in SEVERITIES]
    except TwinError:
        raise
    except Exception as error:  # foreign code may raise anything
        raise SpecError(
            f"the audit layer of {package_of(point)} fails: {type(error).__name__}: {error}",
            path=asset.path,
            where="audit layer",
            value=name,
            expected=f"{point.value} to return findings; repair or uninstall the package",
        ) from error
    if wrong:
        raise SpecError(
            f"the audit layer of {package_of(point)} returns a finding that cannot be reported",
            path=asset.path,
            where="audit layer",
            value=f"{wrong[0].code}, {wrong[0].severity}",
            expected=f"a code {name}.WHAT and a severity of {', '.join(SEVERITIES)}",
        )
    return found
