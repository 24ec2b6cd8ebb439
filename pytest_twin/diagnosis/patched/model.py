"""Effects of a patched realization, and the file ``effects.json`` that lists them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.diagnosis.temperature import ColdFractions
from pytest_twin.effects import catalogue
from pytest_twin.effects.unnamed_law import TABLES
from pytest_twin.errors import SpecError
from pytest_twin.estimation.hypothesis import Hypothesis, Scales
from pytest_twin.realization import Realization

MODEL_FILE = "model.xml"
_MAX_EFFECTS = 256
"""Largest number of effects in the file."""
_MAX_BYTES = 1 << 20
"""Largest size of the file."""
_CREEP_KEY = "creeps"
_MAX_SUBSTEPS = 100
"""Largest number of simulation steps per time step of the recording's simulation."""


@dataclass(frozen=True, slots=True)
class AppliedEffect:
    """One effect of a patched realization.

    Attributes:
        effect, joint: id and joint name; joint None for an effect of the whole robot.
        values: parameter -> value in the effect's equation, SI units.
        is_in_mjcf: whether the MJCF contains it.
        written: the changed elements of the MJCF; empty if the MJCF does not contain it.
    """

    effect: str
    joint: str | None
    values: Mapping[str, float]
    is_in_mjcf: bool
    written: str = ""


@dataclass(frozen=True, slots=True)
class PatchedModel:
    """Content of ``effects.json``.

    Attributes:
        joints: names in the order of the columns of parameters.
        effects: all effects, including those in the MJCF.
        cold_fractions: temperature -> cold fraction, where an effect depends on it.
        has_friction_creep: whether dry friction creeps, as with MuJoCo's default constraint.
        substeps: substeps per step of the model in the simulation that made the recordings, whose
            integration error predictions keep; 0 for recordings of a robot.
    """

    joints: tuple[str, ...]
    effects: tuple[AppliedEffect, ...] = field(default=())
    cold_fractions: ColdFractions = field(default_factory=dict)
    has_friction_creep: bool = False
    substeps: int = 0

    @property
    def outside_mjcf(self) -> tuple[AppliedEffect, ...]:
        """Effects that are not in the MJCF."""
        return tuple(e for e in self.effects if not e.is_in_mjcf)


def applied_effects(
    hypothesis: Hypothesis, joints: Sequence[str], scales: Scales
) -> tuple[AppliedEffect, ...]:
    """The terms of a hypothesis as effects with joint names and SI values.

    Args:
        hypothesis: the terms with their parameters.
        joints: names of the joints, in the order of the problem's columns.
        scales: reference scales of the problem.
    """
    return tuple(
        AppliedEffect(
            term.effect,
            None if term.joint < 0 else joints[term.joint],
            {
                p.name: float(value * scales.value(p, term.joint))
                for p, value in zip(
                    term.parameters, hypothesis.theta[hypothesis.slice_of(term)], strict=True
                )
            },
            is_in_mjcf=False,
        )
        for term in hypothesis.terms
    )


def read_patched_model(realization: Realization) -> PatchedModel | None:
    """The effects of a realization that a diagnosis wrote, None for any other.

    Raises:
        SpecError: as :func:`read_effects`.
    """
    path = realization.source.effects
    return None if path is None else read_effects(path)


def effects_json(patched: PatchedModel) -> dict[str, Any]:
    """Content of ``effects.json``."""
    laws = catalogue()
    return {
        "schema": 1,
        "joints": list(patched.joints),
        **({"coldness": dict(patched.cold_fractions)} if patched.cold_fractions else {}),
        **({"dry_friction": _CREEP_KEY} if patched.has_friction_creep else {}),
        **({"simulated_in_substeps": patched.substeps} if patched.substeps else {}),
        "effects": [
            {
                "effect": e.effect,
                "joint": e.joint,
                **_parameters_json(e),
                "in_model": e.is_in_mjcf,
                **({"written": e.written} if e.written else {}),
                "law": laws[e.effect].law,
            }
            for e in patched.effects
        ],
    }


def _parameters_json(effect: AppliedEffect) -> dict[str, Any]:
    table = TABLES.get(effect.effect)
    if table is not None:
        return {"table": table.table_of(effect.values)}
    return {"values": dict(effect.values)}


def read_effects(path: Path) -> PatchedModel:
    """Read ``effects.json``.

    Raises:
        SpecError: a field is missing or has a wrong value.
    """
    if path.stat().st_size > _MAX_BYTES:
        raise SpecError("too large", path=path, expected=f"at most {_MAX_BYTES} bytes")
    try:
        data = json.loads(path.read_text("utf-8"))
    except (ValueError, RecursionError) as error:
        raise SpecError(f"not JSON: {error}", path=path) from None

    def require(good: bool, where: str, expected: str, value: object = None) -> None:
        if not good:
            raise SpecError(
                "wrong field of effects.json",
                path=path,
                where=where,
                value=value,
                expected=expected,
            )

    require(isinstance(data, dict) and data.get("schema") == 1, "schema", "1")
    joints = data.get("joints")
    require(
        isinstance(joints, list) and bool(joints) and all(isinstance(j, str) for j in joints),
        "joints",
        "names of joints",
    )
    cold_fractions = data.get("coldness", {})
    require(
        isinstance(cold_fractions, dict) and len(cold_fractions) <= _MAX_EFFECTS,
        "coldness",
        "a table",
    )
    for temperature, value in cold_fractions.items():
        require(_is_finite(value), f"coldness.{temperature}", "a finite number", value)
    require(
        not cold_fractions or len(set(cold_fractions.values())) > 1,
        "coldness",
        "temperatures that differ",
    )
    dry = data.get("dry_friction")
    require(dry in (None, _CREEP_KEY), "dry_friction", _CREEP_KEY, dry)
    substeps = data.get("simulated_in_substeps", 0)
    whole = isinstance(substeps, int) and not isinstance(substeps, bool)
    require(
        whole and 0 <= substeps <= _MAX_SUBSTEPS, "simulated_in_substeps",
        f"an integer from 0 to {_MAX_SUBSTEPS}", substeps,
    )  # fmt: skip
    listed = data.get("effects")
    require(isinstance(listed, list) and len(listed) <= _MAX_EFFECTS, "effects", "a list")
    found = []
    for i, item in enumerate(listed):
        here = f"effects.{i}"
        require(isinstance(item, dict), here, "a table")
        name, joint, values = item.get("effect"), item.get("joint"), item.get("values")
        if name in TABLES:
            require(isinstance(item.get("table"), dict), f"{here}.table", "a table")
            try:
                values = TABLES[name].read_table(item["table"])
            except ValueError as error:
                require(False, f"{here}.table", str(error))
        require(
            name in catalogue(), f"{here}.effect", "an installed effect (pytest-twin effects)", name
        )
        require(joint is None or joint in joints, f"{here}.joint", "one of joints, or null", joint)
        robot = catalogue()[name].scope == "robot"
        require(
            robot == (joint is None),
            f"{here}.joint",
            "null for an effect of the whole robot, else a joint",
        )
        require(isinstance(item.get("in_model"), bool), f"{here}.in_model", "true or false")
        known = {p.name for p in catalogue()[name].parameters}
        require(isinstance(values, dict) and set(values) <= known, f"{here}.values", str(known))
        for key, value in values.items():
            require(_is_finite(value), f"{here}.values.{key}", "a finite number", value)
        if not item["in_model"]:
            require(set(values) == known, f"{here}.values", str(known))
        found.append(
            AppliedEffect(name, joint, {k: float(v) for k, v in values.items()}, item["in_model"])
        )
    return PatchedModel(
        tuple(joints),
        tuple(found),
        {k: float(v) for k, v in cold_fractions.items()},
        dry is not None,
        substeps,
    )


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
