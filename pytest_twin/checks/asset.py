"""Audit of the model's file: critical findings block a release unless the twin accepts them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from pytest_twin.audit.finding import LAYER_GROUP
from pytest_twin.checks.base import (
    Check,
    Measure,
    NothingToProposeError,
    Observation,
    Progress,
    Trace,
)
from pytest_twin.checks.schemas import NO_FIELDS
from pytest_twin.dependency import Structure
from pytest_twin.golden import Golden
from pytest_twin.installed import entry_points_by_name
from pytest_twin.twin import MODEL_SUFFIXES, USD_SUFFIXES, Simulator, Twin
from pytest_twin.units import Quantity
from pytest_twin.words import counted

if TYPE_CHECKING:
    from pytest_twin.realization import Realization


class AssetAudit(Check):
    """Audit the file of a realization.

    ``values``: ``file``: name of the file; ``critical``: id -> finding, one sentence;
    ``accepted``: id -> who accepts it, and why. The notes state what the simulator assumes where
    the file is silent.
    """

    kind: ClassVar[str] = "asset"
    libraries: ClassVar[tuple[str, ...]] = ("numpy",)
    tolerances: ClassVar[Mapping[str, str]] = {}
    schema: ClassVar[Mapping[str, Any]] = {"target": NO_FIELDS, "stimulus": NO_FIELDS}
    simulators: ClassVar[tuple[Simulator, ...]] = ("mujoco", "newton")

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return the whole model, all elements of its file, what the twin accepts, and the
        packages that add layers to the audit."""
        layers = (point for found in entry_points_by_name(LAYER_GROUP).values() for point in found)
        packages = {f"library:{one.dist.name}" for one in layers if one.dist is not None}
        return structure.everything() | structure.elements() | packages | {"accepted:findings"}

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Audit the realization's file, without distances at poses, which are never critical."""
        from pytest_twin.audit.audit_file import findings_of
        from pytest_twin.checks.assumed_values import assumed_values

        findings = findings_of(realization.path, realization.source.located)
        twin = realization.twin
        accepted = {} if twin is None else twin.accepted_findings
        critical = {
            name: f"{name}: {one.title}" + ("" if one.place is None else f" ({one.place})")
            for name, one in findings.items()
            if one.severity == "critical"
        }
        progress(1.0)
        return Observation(
            {
                "file": realization.path.name,
                "critical": critical,
                "accepted": {
                    finding: f"accepted by {one.owner}: {one.reason}"
                    for finding, one in accepted.items()
                },
            },
            notes=assumed_values(realization),
        )

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Return one measure for each critical finding, and one for their number."""
        values = observation.values
        critical, accepted = values["critical"], values["accepted"]
        left = [finding for finding in critical if finding not in accepted]
        summary = f"{values['file']}: no critical finding"
        if left:
            summary = (
                f"{values['file']}: {counted(len(left), 'critical finding')} that nobody accepts, "
                f"such as {critical[left[0]]}"
            )
        elif critical:
            summary += f" besides {len(critical)} that the twin accepts"
        # The number of warnings is left to the command, which also uses poses and evidence beside
        # the file: two numbers would differ.
        summary += f"; warnings and values that nobody states: pytest-twin audit {values['file']}"
        return [
            _measure(summary, len(left)),
            *(
                _measure(text, 1) if name in left else _measure(f"{text}; {accepted[name]}", 0)
                for name, text in critical.items()
            ),
        ]

    def expect(
        self, golden: Golden, observation: Observation
    ) -> tuple[Mapping[str, Any], Trace | None]:
        """Return nothing: what a release accepts is in ``twin.yaml``, not in the golden."""
        return {}, None

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose the audit of every realization of the twin whose file it reads."""
        spec = None if realization.twin is None else audit_spec(realization.twin)
        if spec is None:
            raise NothingToProposeError(
                f"the audit reads URDF, MJCF and USD, and not {realization.path.name}"
            )
        return [spec]


def audit_spec(twin: Twin) -> dict[str, Any] | None:
    """Return the first spec of this kind; None where the audit reads no file of the twin."""
    suffixes = (*MODEL_SUFFIXES, *USD_SUFFIXES)
    names = [name for name, one in twin.realizations.items() if one.file.suffix.lower() in suffixes]
    if not names:
        return None
    default = names == [twin.first_realization.name]
    return {
        "name": "audit",
        "title": "Audit of the model: no critical finding that nobody accepts",
        **({} if default else {"realizations": names}),
    }


def _measure(sentence: str, count: int) -> Measure:
    none_allowed = Quantity(0.0, "1")
    return Measure.of_error("critical_findings", sentence, float(count), none_allowed, "audit")
