"""Sections of ``twin.yaml`` for adaptation: residual force, online update, criteria of promotion.

None of them edits the asset, the fit, or a calibration.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from pytest_twin.dependency import canonical
from pytest_twin.formats import typed
from pytest_twin.installed import entry_points_by_name, package_of

Span = tuple[float, float]
RESIDUALS = "pytest_twin.residuals"
"""Group of the entry points of residuals of the kind ``function``."""


@dataclass(frozen=True, slots=True)
class JointRegion:
    """Range of validity of a residual force at one joint.

    Attributes:
        bound: largest force, N*m or N.
        position, velocity: open intervals, rad and rad/s or m and m/s.
        jump: smallest change of velocity between two samples that counts as a contact, rad/s or
            m/s.
    """

    bound: float
    position: Span
    velocity: Span
    jump: float


@dataclass(frozen=True, slots=True)
class ResidualSpec:
    """A bounded joint force that is added to the base model.

    Attributes:
        kind: which implementation computes the force.
        file: file of the law, for the kinds ``unnamed_laws`` and ``onnx``.
        function: name of the entry point, for the kind ``function``.
        joints: joint -> range of validity, in the order of the inputs.
        period: time between two evaluations, s.
        max_age: s; the force is not computed from a sample that is older.
        hold_off: time without the residual after a start or a fault, s.
        uncertainty: largest standard deviation that it may state, N*m or N; None for no monitor.
    """

    id: str
    kind: Literal["unnamed_laws", "onnx", "function"]
    joints: Mapping[str, JointRegion]
    file: Path | None = None
    function: str | None = None
    period: float = 0.005
    max_age: float = 0.02
    hold_off: float = 0.2
    uncertainty: float | None = None

    @classmethod
    def from_json(cls, data: Mapping[str, Any], file: Path | None) -> ResidualSpec:
        """Build the spec from the validated table of ``twin.yaml`` and the resolved file."""
        return replace(typed.build({**data, "file": None}, cls), file=file)


@dataclass(frozen=True, slots=True)
class UpdateSpec:
    """An online update of named parameters within bounds.

    Attributes:
        parameters: ``JOINT.NAME`` -> (lower, upper) in SI units at the joint.
        window: duration of motion between two updates, s.
        forgetting: forgetting factor of the recursive estimate at each update, 0 to 1.
        noise: standard deviation of a measured position, rad or m.
    """

    id: str
    parameters: Mapping[str, Span]
    window: float = 1.0
    forgetting: float = 0.98
    noise: float = 0.005

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> UpdateSpec:
        """Build the spec from the validated table of ``twin.yaml``."""
        spans = {name: (one["lower"], one["upper"]) for name, one in data["parameters"].items()}
        return typed.build({**data, "parameters": spans}, cls)


@dataclass(frozen=True, slots=True)
class ShadowPolicy:
    """Criteria by which a shadow run accepts or rejects a candidate.

    Attributes:
        metrics: metric -> fraction by which a candidate must lower its mean over joints.
        safety: metric -> fraction by which a candidate may raise it at any joint.
    """

    metrics: Mapping[str, float] = field(default_factory=lambda: {"position_rms": 0.0})
    safety: Mapping[str, float] = field(
        default_factory=lambda: {"position_max": 0.05, "velocity_peak": 0.1, "effort_peak": 0.1}
    )

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> ShadowPolicy:
        """Build the policy from the validated table of ``twin.yaml``, with defaults."""
        return typed.build(data, cls)


def digest_of(spec: ResidualSpec | UpdateSpec, file_sha256: str | None) -> str:
    """SHA-256 of a residual or update, and of its file's digest or its package's version, hex."""
    content: dict[str, Any] = {"id": spec.id, "file": file_sha256}
    if isinstance(spec, UpdateSpec):
        content |= {
            "parameters": {name: list(span) for name, span in spec.parameters.items()},
            "numbers": [spec.window, spec.forgetting, spec.noise],
        }
    else:
        content |= {
            "kind": spec.kind,
            "function": spec.function,
            "numbers": [spec.period, spec.max_age, spec.hold_off, spec.uncertainty],
            "joints": {
                name: [one.bound, *one.position, *one.velocity, one.jump]
                for name, one in spec.joints.items()
            },
        }
        if spec.function is not None:
            # A newer version of the package may compute another force.
            points = entry_points_by_name(RESIDUALS).get(spec.function, ())
            content["packages"] = [package_of(point) for point in points]
    return hashlib.sha256(canonical(content)).hexdigest()
