"""Parts and structure of a realization."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import mujoco

from pytest_twin.dependency import Part, Structure
from pytest_twin.formats.digest import file_sha256
from pytest_twin.realization.features.canonical import value_of
from pytest_twin.realization.features.layers import layers
from pytest_twin.realization.features.structure import structure_of
from pytest_twin.realization.named_model import NamedModel


def parts(realization: NamedModel) -> dict[str, Part]:
    """Part id -> part of a realization; each id begins with the name of the realization."""
    found = model_parts(realization.model, realization.name, realization.velocity_limit)
    more = {"additions": additions(realization.spec)}
    if realization.simulator != "mujoco":
        more["stage"] = {"sha256": file_sha256(realization.path)}
    if realization.source.effects is not None:
        more["effects"] = {"sha256": file_sha256(realization.source.effects)}
    idents = ((f"{realization.name}/{key}", content) for key, content in more.items())
    return {**found, **{ident: Part(ident, content) for ident, content in idents}}


def model_parts(
    model: mujoco.MjModel, name: str, velocity_limit: Mapping[str, float] | None = None
) -> dict[str, Part]:
    """Part id -> part of a compiled model.

    Args:
        name: name of the realization, the prefix of all ids.
        velocity_limit: joint -> rad/s or m/s, where the source states it.
    """
    content = layers(model, velocity_limit or {})
    return {f"{name}/{key}": Part(f"{name}/{key}", value) for key, value in content.items()}


def model_structure(model: mujoco.MjModel, name: str, part_ids: Iterable[str]) -> Structure:
    """Structure of a compiled model; ``part_ids`` are the keys of :func:`model_parts`."""
    return structure_of(model, name, frozenset(part_ids))


def additions(spec: mujoco.MjSpec) -> dict[str, Any]:
    """Defaults of the model for bodies and payloads that are added to it.

    The main default class and the compiler's limits are not visible in the compiled model.
    """
    probe = spec.copy()
    geom = probe.worldbody.add_body().add_geom()
    content = {
        f"geom {name}": value_of(getattr(geom, name))
        for name in (
            "contype",
            "conaffinity",
            "condim",
            "priority",
            "friction",
            "solmix",
            "solref",
            "solimp",
            "margin",
            "gap",
            "adhesion",
            "surfacevel",
            "density",
            "mass",
            "typeinertia",
            "fluid_ellipsoid",
            "fluid_coefs",
            "size",
            "pos",
            "quat",
        )
    }
    bounds = ("boundmass", "boundinertia", "balanceinertia", "settotalmass", "inertiafromgeom")
    layout = ("inertiagrouprange", "fusestatic", "alignfree", "autolimits", "discardvisual")
    return content | {name: value_of(getattr(spec.compiler, name)) for name in (*bounds, *layout)}
