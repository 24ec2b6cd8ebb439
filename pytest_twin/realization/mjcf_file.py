"""Write a MuJoCo spec as an MJCF file with full precision and with references to mesh files."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import mujoco
from lxml import etree

from pytest_twin.errors import ModelError
from pytest_twin.formats import atomic
from pytest_twin.formats.xml import digits
from pytest_twin.realization import mjcf

_Element = Any


def write(spec: mujoco.MjSpec, path: Path, meshes: Mapping[str, Path]) -> mujoco.MjModel:
    """Write ``spec`` as MJCF, and return the model that MuJoCo loads from the file.

    MuJoCo's own writer rounds to six digits; this function writes the full numbers of the spec.

    Args:
        meshes: mesh of the spec -> its file, next to ``path`` or below its folder. The vertices in
            the file are those of the spec, in m, so that no scale is written.

    Raises:
        ModelError: MuJoCo refuses the spec.
    """
    for mesh in spec.meshes:
        mesh.file = meshes[mesh.name].relative_to(path.parent).as_posix()
        mesh.uservert, mesh.userface = [], []
        spec.assets[mesh.file] = meshes[mesh.name].read_bytes()
    try:
        mjcf.compile_spec(spec)
        written = text(spec)
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise mjcf.translate(error, path, None) from None
    atomic.write_text(path, written)
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise ModelError(
            f"MuJoCo does not load the written file: {' '.join(str(error).split())}", path=path
        ) from None


def text(spec: mujoco.MjSpec) -> str:
    """The MJCF of a compiled ``spec``, with full precision."""
    root = etree.fromstring(spec.to_xml().encode())
    for element in root.iter("mesh"):
        element.attrib.pop("content_type", "")
    for element in root.iter("body"):
        body = spec.body(element.get("name"))
        _set_numbers(element, pos=body.pos, quat=body.quat)
        inertial = element.find("inertial")
        if inertial is not None:
            _set_numbers(inertial, quat=body.iquat, diaginertia=body.inertia)
            inertial.set("pos", digits(body.ipos))
            inertial.set("mass", digits([body.mass]))
    _for_each(root, "joint", "worldbody", spec.joint, _joint)
    _for_each(root, "geom", "worldbody", spec.geom, _geom)
    _for_each(root, "site", "worldbody", spec.site, _pose)
    _for_each(root, "joint", "equality", spec.equality, _equality)
    for kind in ("general", "motor"):
        _for_each(root, kind, "actuator", spec.actuator, _actuator)
    etree.indent(root)
    return etree.tostring(root, encoding="unicode") + "\n"


def with_exact_inertia(spec: mujoco.MjSpec, model: mujoco.MjModel) -> str:
    """The MJCF of a ``spec`` from MuJoCo's writer, with the full inertia of each named body.

    Rounding to six digits may violate the triangle inequality of a thin body, and MuJoCo then
    refuses the file.

    Args:
        spec: a compiled spec.
    """
    root = etree.fromstring(spec.to_xml().encode())
    for element in root.iter("body"):
        inertial = element.find("inertial")
        if inertial is None or "diaginertia" not in inertial.attrib or not element.get("name"):
            continue
        body = model.body(element.get("name"))
        _set_numbers(inertial, quat=body.iquat, diaginertia=body.inertia)
    etree.indent(root)
    return etree.tostring(root, encoding="unicode") + "\n"


def _for_each(root: _Element, tag: str, section: str, find: Any, write_out: Any) -> None:
    for place in root.findall(section):
        for element in place.iter(tag):
            write_out(element, find(element.get("name")))


def _pose(element: _Element, made: Any) -> None:
    _set_numbers(element, pos=made.pos, quat=made.quat)


def _geom(element: _Element, made: mujoco.MjsGeom) -> None:
    _pose(element, made)
    used = {
        mujoco.mjtGeom.mjGEOM_SPHERE: 1,
        mujoco.mjtGeom.mjGEOM_CAPSULE: 2,
        mujoco.mjtGeom.mjGEOM_CYLINDER: 2,
        mujoco.mjtGeom.mjGEOM_BOX: 3,
    }.get(made.type, 0)
    if used:
        _set_numbers(element, size=made.size[:used])


def _joint(element: _Element, made: mujoco.MjsJoint) -> None:
    if made.type == mujoco.mjtJoint.mjJNT_FREE:
        return
    _set_numbers(element, axis=made.axis, range=made.range, actuatorfrcrange=made.actfrcrange)
    if "damping" in element.attrib:
        element.set("damping", digits([made.damping[0]]))
    if "frictionloss" in element.attrib:
        element.set("frictionloss", digits([made.frictionloss]))


def _equality(element: _Element, made: mujoco.MjsEquality) -> None:
    element.set("polycoef", digits(made.data[:5]))


def _actuator(element: _Element, made: mujoco.MjsActuator) -> None:
    _set_numbers(element, ctrlrange=made.ctrlrange, forcerange=made.forcerange)
    if "gear" in element.attrib:
        element.set("gear", digits(made.gear))


def _set_numbers(element: _Element, **values: Iterable[float]) -> None:
    """Set attributes with full precision.

    Absent attributes are added only for a pose or axis that differs from the default.
    """
    defaults = {"pos": (0, 0, 0), "quat": (1, 0, 0, 0), "axis": (0, 0, 1)}
    for name, value in values.items():
        numbers = [float(number) for number in value]
        if not all(math.isfinite(number) for number in numbers):
            continue
        if name in defaults:
            if tuple(numbers) == defaults[name]:
                element.attrib.pop(name, "")
            else:
                element.set(name, digits(numbers))
        elif name in element.attrib:
            element.set(name, digits(numbers))
