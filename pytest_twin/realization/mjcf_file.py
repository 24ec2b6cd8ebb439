"""A spec as a file that MuJoCo loads on its own: every digit of it, meshes beside it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from lxml import etree

from pytest_twin.errors import ModelError
from pytest_twin.formats import atomic
from pytest_twin.realization import mjcf

_Element = Any


def write(spec: mujoco.MjSpec, path: Path, meshes: Mapping[str, Path]) -> mujoco.MjModel:
    """Write ``spec`` as MJCF and return the model as MuJoCo loads it from that file.

    MuJoCo's own writer keeps six digits; the numbers here are those of the spec.

    Args:
        meshes: mesh of the spec -> its file, beside or below ``path``. Its vertices are those of
            the spec, in metres, as in a normalized asset: the file's own scale is not written.

    Raises:
        ModelError: MuJoCo refuses the spec.
    """
    for mesh in spec.meshes:
        mesh.file = meshes[mesh.name].relative_to(path.parent).as_posix()
        mesh.uservert, mesh.userface = [], []
        spec.assets[mesh.file] = meshes[mesh.name].read_bytes()
    try:
        mjcf.compiled(spec)
        written = text(spec)
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise mjcf.translate(error, path, None) from None
    atomic.write_text(path, written)
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise ModelError(
            f"MuJoCo does not load what was written: {' '.join(str(error).split())}", path=path
        ) from None


def text(spec: mujoco.MjSpec) -> str:
    """The MJCF of a compiled ``spec``, every number in full."""
    root = etree.fromstring(spec.to_xml().encode())
    for element in root.iter("mesh"):
        element.attrib.pop("content_type", "")
    for element in root.iter("body"):
        body = spec.body(element.get("name"))
        _put(element, pos=body.pos, quat=body.quat)
        inertial = element.find("inertial")
        if inertial is not None:
            _put(inertial, quat=body.iquat, diaginertia=body.inertia)
            inertial.set("pos", _digits(body.ipos))
            inertial.set("mass", _digits([body.mass]))
    _each(root, "joint", "worldbody", spec.joint, _joint)
    _each(root, "geom", "worldbody", spec.geom, _geom)
    _each(root, "site", "worldbody", spec.site, _place)
    _each(root, "joint", "equality", spec.equality, _equality)
    for kind in ("general", "motor"):
        _each(root, kind, "actuator", spec.actuator, _actuator)
    etree.indent(root)
    return etree.tostring(root, encoding="unicode") + "\n"


def with_exact_inertia(spec: mujoco.MjSpec, model: mujoco.MjModel) -> str:
    """MuJoCo's text of a ``spec``, with the inertia of every named body in full.

    Six digits may break the triangle inequality of a thin body, and MuJoCo then refuses the file.

    Args:
        spec: compiled.
        model: what it was compiled to.
    """
    root = etree.fromstring(spec.to_xml().encode())
    for element in root.iter("body"):
        inertial = element.find("inertial")
        if inertial is None or "diaginertia" not in inertial.attrib or not element.get("name"):
            continue
        body = model.body(element.get("name"))
        _put(inertial, quat=body.iquat, diaginertia=body.inertia)
    etree.indent(root)
    return etree.tostring(root, encoding="unicode") + "\n"


def _each(root: _Element, tag: str, section: str, find: Any, write_out: Any) -> None:
    for place in root.findall(section):
        for element in place.iter(tag):
            write_out(element, find(element.get("name")))


def _place(element: _Element, made: Any) -> None:
    _put(element, pos=made.pos, quat=made.quat)


def _geom(element: _Element, made: mujoco.MjsGeom) -> None:
    _place(element, made)
    used = {
        mujoco.mjtGeom.mjGEOM_SPHERE: 1,
        mujoco.mjtGeom.mjGEOM_CAPSULE: 2,
        mujoco.mjtGeom.mjGEOM_CYLINDER: 2,
        mujoco.mjtGeom.mjGEOM_BOX: 3,
    }.get(made.type, 0)
    if used:
        _put(element, size=made.size[:used])


def _joint(element: _Element, made: mujoco.MjsJoint) -> None:
    if made.type == mujoco.mjtJoint.mjJNT_FREE:
        return
    _put(element, axis=made.axis, range=made.range, actuatorfrcrange=made.actfrcrange)
    if "damping" in element.attrib:
        element.set("damping", _digits([made.damping[0]]))
    if "frictionloss" in element.attrib:
        element.set("frictionloss", _digits([made.frictionloss]))


def _equality(element: _Element, made: mujoco.MjsEquality) -> None:
    element.set("polycoef", _digits(made.data[:5]))


def _actuator(element: _Element, made: mujoco.MjsActuator) -> None:
    _put(element, ctrlrange=made.ctrlrange, forcerange=made.forcerange)
    if "gear" in element.attrib:
        element.set("gear", _digits(made.gear))


def _put(element: _Element, **values: Iterable[float]) -> None:
    """State numbers in full; where MuJoCo left an attribute out, it is put where it says more."""
    defaults = {"pos": (0, 0, 0), "quat": (1, 0, 0, 0), "axis": (0, 0, 1)}
    for name, value in values.items():
        numbers = [float(number) for number in value]
        if not all(math.isfinite(number) for number in numbers):
            continue
        if name in defaults:
            if tuple(numbers) == defaults[name]:
                element.attrib.pop(name, "")
            else:
                element.set(name, _digits(numbers))
        elif name in element.attrib:
            element.set(name, _digits(numbers))


def _digits(values: Iterable[float]) -> str:
    """The shortest decimals that read back as the same numbers."""
    return " ".join(repr(float(value)).removesuffix(".0") for value in np.asarray(values))
