"""A free law that was found, and its entry in ``diagnosis.json``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pytest_twin.diagnosis.locate import TimeAndRegime
from pytest_twin.diagnosis.unnamed_law.shape import Curve, describe_curve
from pytest_twin.effects.unnamed_law import UnnamedLaw
from pytest_twin.estimation.hypothesis import Term

_NEXT_TEST = (
    "repeat the motion at other times and through other values of {}: a force that depends on it "
    "comes back at the same values"
)


@dataclass(frozen=True, slots=True)
class AlternativeVariable:
    """Another variable over which a table explains a part of the residual.

    Attributes:
        is_friction: whether the table is a level of dry friction.
        confidence: share against all variables, 0 to 1.
    """

    variable: str
    is_friction: bool
    confidence: float


@dataclass(frozen=True, slots=True)
class FreeLaw:
    """A force, or a level of dry friction, that no effect of the catalogue explains.

    Attributes:
        term: effect and joint, in the numbering of the problem.
        curve: the table with its band.
        removed: share of the squared error of left-out recordings that the law removes, by
            cross-validation over whole recordings.
        confidence: share of this variable against the others, 0 to 1.
        alternatives: other variables, most likely first.
    """

    joint: str
    term: Term
    curve: Curve
    removed: float
    confidence: float
    alternatives: tuple[AlternativeVariable, ...]
    where: TimeAndRegime

    @property
    def words(self) -> str:
        """Description of the curve in one phrase, with units."""
        return describe_curve(self.curve)


def law_json(law: FreeLaw, held_out_gain: float) -> dict[str, Any]:
    """The finding as an object of ``diagnosis.json``.

    Args:
        held_out_gain: share of the squared held-out error that it removes.
    """
    curve = law.curve
    unit, force_unit = curve.units
    k = curve.peak
    value, half = float(curve.values[k]), float(curve.half_width[k])
    return {
        "effect": UnnamedLaw.id,
        "joint": law.joint,
        "path": law.term.law.path,
        "confidence": round(law.confidence, 4),
        "parameters": {
            "peak_friction" if curve.is_friction else "peak_force": {
                "value": value, "unit": force_unit, "ci95": [value - half, value + half],
            },
        },
        "where": {"summary": law.words, "windows": dict(law.where.windows)},
        "held_out_gain": round(held_out_gain, 5),
        "alternatives": [
            {
                "effect": UnnamedLaw.id, "joint": law.joint, "confidence": round(r.confidence, 4),
                "variable": r.variable, "acts": _describe_action(r.is_friction),
            }
            for r in law.alternatives
        ],
        "next_test": _NEXT_TEST.format(curve.variable.name),
        "law": {
            "words": law.words,
            "acts": _describe_action(curve.is_friction),
            "variable": curve.variable.name,
            "unit": unit,
            "force_unit": force_unit,
            "knots": curve.knots.tolist(),
            "values": curve.values.tolist(),
            "band": [
                [float(v - h), float(v + h)]
                for v, h in zip(curve.values, curve.half_width, strict=True)
            ],
            "range": list(curve.valid),
            "outside": "no force",
            "samples": curve.occupancy.tolist(),
            "cross_validated_gain": round(law.removed, 5),
        },
    }  # fmt: skip


def _describe_action(is_friction: bool) -> str:
    return "against motion" if is_friction else "as a force"


__all__ = ["AlternativeVariable", "FreeLaw", "law_json"]
