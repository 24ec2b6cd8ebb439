"""Normalize a URDF: the same robot in explicit and self-contained form, with a log of changes.

Normalization changes the form: meshes in metres next to the file, unit axes, explicit defaults,
names for shapes. It never invents physical values: an impossible inertia is kept and reported until
its repair is accepted by name.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree
from numpy.typing import NDArray

from pytest_twin.asset import obj
from pytest_twin.asset.changes import Change, Flag
from pytest_twin.asset.collada import stated_up_axis
from pytest_twin.errors import FormatError, PathError, SpecError, TwinError
from pytest_twin.formats import atomic, xml
from pytest_twin.formats.declared_inputs import expansion_of
from pytest_twin.formats.digest import bytes_sha256
from pytest_twin.formats.expansions import model_stem
from pytest_twin.formats.paths import read_bytes
from pytest_twin.formats.xml import digits
from pytest_twin.realization import gltf, inertia, mesh, urdf, urdf_orientation
from pytest_twin.realization.files.locate import ModelFolders, locate
from pytest_twin.realization.files.urdf import UrdfFiles
from pytest_twin.realization.limits import LIMITS

Vector = NDArray[np.float64]

MESH_FOLDER = "meshes"
INERTIA_REPAIR = "inertia-repair"
_MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
UNITS = "units: metre, kilogram, second, radian; newton, newton metre"
_UNIT_LENGTH = 1e-9
"""Largest deviation of an axis's length from 1; larger ones are normalized."""
_FLAT = 1e-9
"""Fraction of the largest principal moment below which a moment counts as zero, as in the audit."""
_SAFE = re.compile(r"[^A-Za-z0-9_-]+")
# One component of a path that is not hidden.
_FILE_NAME = re.compile(r"[^./\\\x00-\x1f\x7f][^/\\\x00-\x1f\x7f]{0,79}")
_IMAGES = (".png", ".jpg", ".jpeg", ".tga", ".bmp")


@dataclass(slots=True)
class Normalized:
    """A normalized asset.

    Attributes:
        files: every file that was written, the URDF first.
        source_files: every file that was read, the URDF first.
        flags: faults that were kept.
        repairs: link -> accepted repair: ixx iyy izz ixy ixz iyz in its inertial frame, kg*m^2.
        collision_points: collision mesh, as named in the source -> (n, 3) vertices, m.
    """

    urdf: Path
    files: list[Path]
    source_files: list[Path]
    changes: list[Change] = field(default_factory=list)
    flags: list[Flag] = field(default_factory=list)
    repairs: dict[str, tuple[float, ...]] = field(default_factory=dict)
    collision_points: dict[str, Vector] = field(default_factory=dict)


def normalize(
    source: Path,
    folder: Path,
    *,
    located: ModelFolders | None = None,
    accept: Collection[str] = (),
) -> Normalized:
    """Write the normalized asset of a URDF.

    Args:
        source: the URDF, which is not changed.
        folder: an existing folder for ``<name>.urdf`` and ``meshes/``.
        located: folders that may contain the URDF's files; by default those below the model's root.
        accept: accepted patches, ``inertia-repair:<link>``.

    Raises:
        FormatError: not well-formed, a limit is exceeded, or a collision mesh is damaged.
        ModelError: not a tree of links, or an impossible value.
        PathError: a collision mesh is missing or outside the roots.
        SpecError: an accepted patch is not applicable.
    """
    robot = urdf.read(source)
    return _Normalizer(source, robot, folder, located or locate(source), accept).run()


def file_stem(name: str, fallback: str) -> str:
    """Return a portable file name, without suffix."""
    return _SAFE.sub("_", name).strip("_-")[:80] or fallback


class _Normalizer:
    def __init__(
        self,
        source: Path,
        robot: urdf.Robot,
        folder: Path,
        located: ModelFolders,
        accept: Collection[str],
    ) -> None:
        self.source = source
        self.robot = robot
        self.folder = folder
        self.files = UrdfFiles.of(robot.node, located.roots, located.packages)
        self.accept = set(accept)
        self.known_patches: set[str] = set()
        self.root, self.quaternions = urdf_orientation.parse(source)
        stem = file_stem(model_stem(source), "robot")
        self.out = Normalized(folder / f"{stem}.urdf", [folder / f"{stem}.urdf"], [source])
        expansion = expansion_of(source)
        if expansion is not None:
            self.out.source_files += expansion.read
        self.meshes: dict[tuple[Path, tuple[float, ...]], str] = {}
        self.read_meshes: dict[Path, mesh.Triangles | TwinError] = {}
        self.images: dict[Path, str] = {}
        self.taken: set[str] = set()
        self.bytes = self.faces = 0

    def run(self) -> Normalized:
        self._orientations()
        self._names()
        self._joints()
        self._inertias()
        self._shapes()
        self._textures()
        unknown = sorted(self.accept - self.known_patches)
        if unknown:
            raise SpecError(
                "this asset does not need that patch",
                path=self.source,
                where="--accept",
                value=unknown[0],
                expected=", ".join(sorted(self.known_patches)) or "no --accept",
            )
        self._mesh_folder()
        self._irregularities()
        etree.indent(self.root)
        head = f"<?xml version='1.0' encoding='utf-8'?>\n<!-- {UNITS} -->\n"
        body = self._with_prefixes(etree.tostring(self.root, encoding="unicode"))
        atomic.write_text(self.out.urdf, f"{head}{body}\n")
        return self.out

    def _irregularities(self) -> None:
        for found in xml.irregularities(self.source):
            self.out.changes.append(
                Change(
                    self._file(),
                    found.line,
                    "XML",
                    found.words,
                    "written as the standard asks",
                    "not well-formed XML: MuJoCo and Pinocchio accept the file, others refuse it",
                )
            )

    def _with_prefixes(self, text: str) -> str:
        """Declare every prefix in the text, because strict parsers refuse undeclared ones."""
        used = {
            str(name).partition(":")[0]
            for element in self.root.iter()
            for name in (element.tag, *element.attrib)
            if ":" in str(name) and not str(name).startswith(("{", "xml:", "xmlns:"))
        }
        declared = "".join(f' xmlns:{prefix}="urn:prefix:{prefix}"' for prefix in sorted(used))
        return text.replace("<robot", f"<robot{declared}", 1) if declared else text

    # -- the log

    def _file(self) -> str:
        return self.source.name

    def _change(
        self,
        element: Any,
        attribute: str,
        before: str | None,
        after: str | None,
        why: str,
        patch: str | None = None,
    ) -> None:
        line = element.sourceline or 1
        where = f"{_label(element)}.{attribute}" if attribute else _label(element)
        self.out.changes.append(Change(self._file(), line, where, before, after, why, patch))

    def _set(self, element: Any, attribute: str, value: str, why: str) -> None:
        before = element.get(attribute)
        if before != value:
            element.set(attribute, value)
            self._change(element, attribute, before, value, why)

    # -- form

    def _orientations(self) -> None:
        for stated in self.quaternions:
            self._change(
                stated.origin,
                urdf_orientation.QUATERNION,
                stated.quaternion,
                f"rpy {stated.rpy}",
                "the same rotation in rad, which every parser reads",
            )

    def _names(self) -> None:
        name = self.root.get("name") or ""
        if not name.strip():
            self._set(self.root, "name", self.out.urdf.stem, "the robot had no name")
        elif not _FILE_NAME.fullmatch(name):
            # Converters use the name in file names.
            self._set(self.root, "name", file_stem(name, "robot"), "the name cannot be a file name")
        for link in self.root.findall("link"):
            for kind in ("visual", "collision"):
                used: set[str] = set()
                for index, shape in enumerate(link.findall(kind)):
                    name = shape.get("name") or ""
                    if name and name not in used:
                        used.add(name)
                        continue
                    fresh = f"{link.get('name')}_{kind}_{index}"
                    why = "another shape has this name" if name else "the shape had no name"
                    self._set(shape, "name", fresh, why)
                    used.add(fresh)

    def _joints(self) -> None:
        for element in self.root.findall("joint"):
            joint = self.robot.joints[element.get("name", "")]
            self._lost_mimic(element)
            if joint.type in ("fixed", "floating"):
                continue
            if joint.type in ("revolute", "prismatic"):
                self._state_limit(element)
            axis = element.find("axis")
            if axis is None:
                axis = etree.SubElement(element, "axis")
                axis.set("xyz", "1 0 0")
                self._change(element, "axis", None, "1 0 0", "the default, stated explicitly")
                continue
            stated = xml_numbers(axis.get("xyz"), (1.0, 0.0, 0.0))
            if abs(float(np.linalg.norm(stated)) - 1.0) > _UNIT_LENGTH:
                self._set(axis, "xyz", digits(joint.axis), "the axis was not a unit vector")

    def _lost_mimic(self, element: Any) -> None:
        """Remove a mimic of a joint that does not exist, because converters refuse the robot."""
        lost = self.robot.lost_mimics.get(element.get("name", ""))
        if lost is None:
            return
        node = element.find("mimic")
        element.remove(node)
        why = "it follows a joint that does not exist"
        self._change(element, "mimic", lost.joint, None, why)
        where = f"joint '{element.get('name')}'.mimic"
        self.out.flags.append(
            Flag(self._file(), lost.node.line, where, lost.joint, why, critical=True)
        )

    def _state_limit(self, element: Any) -> None:
        """State effort and velocity limits, without which urdfdom refuses the robot."""
        limit = element.find("limit")
        why = "not stated, and urdfdom refuses the robot without it; 0 means unknown"
        if limit is None:
            limit = etree.SubElement(element, "limit")
        for key in ("effort", "velocity"):
            if key not in limit.attrib:
                limit.set(key, "0")
                self._change(element, f"limit.{key}", None, "0", why)

    # -- what is physical

    def _inertias(self) -> None:
        for element in self.root.findall("link"):
            link = self.robot.links[element.get("name", "")]
            if link.inertial is None:
                continue
            self._state_inertial(element.find("inertial"))
            if link.name in self.robot.corrected:
                self._state_correction(element.find("inertial"), link)
            share = inertia.violation(link.inertia)
            # A change of frame turns a zero into rounding errors, which are not an inertia.
            if share <= inertia.ROUNDING or np.abs(link.inertia).max() < inertia.MASS_FLOOR:
                self._flag_line(element, link)
                continue
            patch = f"{INERTIA_REPAIR}:{link.name}"
            self.known_patches.add(patch)
            node: Any = element.find("inertial/inertia")
            moments = urdf.principal_text(link.inertia)
            if patch not in self.accept:
                self.out.flags.append(
                    Flag(
                        self._file(),
                        node.sourceline or 1,
                        f"link '{link.name}'.inertia",
                        f"principal moments {moments} kg*m^2",
                        "no body can have it: a principal moment is negative or exceeds the sum "
                        "of the other two",
                        patch,
                        critical=True,
                    )
                )
                continue
            self._repair(node, link, patch)

    def _state_correction(self, element: Any, link: urdf.Link) -> None:
        """Apply the file's options for MuJoCo's compiler, for all simulators."""
        why = "as required by <mujoco><compiler> of the source"
        self._set(element.find("mass"), "value", digits([link.mass]), why)
        assert link.inertial is not None
        _, axes = urdf.origin(link.inertial)
        values = inertia.six_components(axes.T @ link.inertia @ axes)
        for key, value in zip(_MOMENTS, values, strict=True):
            self._set(element.find("inertia"), key, digits([value]), why)

    def _mesh_folder(self) -> None:
        """Point MuJoCo's mesh folder, if the file states one, to the meshes of this asset."""
        for compiler in self.root.findall("mujoco/compiler"):
            for key in ("assetdir", "texturedir"):
                if key in compiler.attrib:
                    before = str(compiler.attrib.pop(key))
                    self._change(compiler, key, before, None, "meshdir says where meshes are")
            self._set(compiler, "meshdir", MESH_FOLDER, "where the meshes of this asset are")
            self._set(compiler, "strippath", "true", "MuJoCo adds meshdir to the file's name")

    def _flag_line(self, element: Any, link: urdf.Link) -> None:
        """Report the inertia of a mass on a line: every format can state it, and no body has it."""
        moments = np.linalg.eigvalsh(link.inertia)
        if link.mass <= 0 or moments[2] < inertia.MASS_FLOOR or moments[0] > _FLAT * moments[2]:
            return
        self.out.flags.append(
            Flag(
                self._file(),
                element.find("inertial/inertia").sourceline or 1,
                f"link '{link.name}'.inertia",
                f"principal moments {urdf.principal_text(link.inertia)} kg*m^2",
                "a principal moment is 0, which only a line without thickness has; every "
                "realization keeps the value of the source",
            )
        )

    def _state_inertial(self, element: Any) -> None:
        """State omitted zeros, without which some parsers drop the element."""
        for tag, keys in (("mass", ("value",)), ("inertia", _MOMENTS)):
            node = element.find(tag)
            if node is None:
                node = etree.SubElement(element, tag)
                self._change(element, tag, None, "0", "not stated and read as 0: stated explicitly")
            lacking = [key for key in keys if key not in node.attrib]
            for key in lacking:
                node.set(key, "0")
            if lacking and node.sourceline:
                words = " ".join(lacking)
                self._change(node, words, None, "0", "not stated and read as 0: stated explicitly")

    def _repair(self, node: Any, link: urdf.Link, patch: str) -> None:
        repaired = inertia.nearest_consistent(link.inertia)
        # The moments refer to link axes; the inertial frame of the file may be rotated.
        _, axes = urdf.origin(link.inertial) if link.inertial else (None, np.eye(3))
        values = inertia.six_components(axes.T @ repaired @ axes)
        self.out.repairs[link.name] = values
        keys = _MOMENTS
        before = " ".join(f"{key}={node.get(key, '0')}" for key in keys)
        for key, value in zip(keys, values, strict=True):
            node.set(key, repr(value))
        after = " ".join(f"{key}={node.get(key)}" for key in keys)
        self._change(
            node,
            "",
            f"{before} kg*m^2",
            f"{after} kg*m^2",
            f"principal moments {urdf.principal_text(link.inertia)} became "
            f"{urdf.principal_text(repaired)} kg*m^2: the largest is kept, the other two grow "
            "until the triangle inequality holds",
            patch,
        )

    # -- files

    def _shapes(self) -> None:
        for link in self.root.findall("link"):
            for kind in ("collision", "visual"):
                for shape in link.findall(kind):
                    for element in shape.findall("geometry/mesh"):
                        self._mesh(link, shape, element, must=kind == "collision")

    def _mesh(self, link: Any, shape: Any, element: Any, *, must: bool) -> None:
        reference = element.get("filename") or ""
        try:
            path = self._resolve(element, reference)
            triangles = self._triangles(path, element)
        except TwinError as error:
            if must:
                raise
            link.remove(shape)
            problem = f"{error.problem}; the visual mesh is omitted"
            self._change(shape, "", f"mesh {reference}", None, problem)
            return
        if must:
            self.out.collision_points[reference] = triangles.vertices
        scale = xml_numbers(element.get("scale"), (1.0, 1.0, 1.0))
        if scale.shape != (3,) or not np.isfinite(scale).all() or (scale == 0).any():
            raise FormatError(
                "an invalid mesh scale",
                path=self.source,
                line=element.sourceline,
                where="mesh.scale",
                value=element.get("scale"),
                expected="three finite numbers other than 0",
            )
        name = self._written(path, scale, triangles)
        said = []
        if path.suffix.lower() != ".obj":
            said.append(f"{path.suffix.lower()} was converted to .obj, which every simulator loads")
        if path.suffix.lower() == ".dae":
            said.append("its unit is applied to its vertices; its materials are omitted")
            axis = stated_up_axis(path)
            if axis != "Z_UP":
                said.append(f"its up axis is {axis or 'not stated'}; its vertices are not turned")
        if path.suffix.lower() in gltf.SUFFIXES:
            said.append("its y axis is up, and its vertices are not turned; materials are omitted")
        if element.get("scale") is not None:
            said.append(f"scale {element.get('scale')} is applied to its vertices, in metres")
            del element.attrib["scale"]
        why = "; ".join(["a path inside the asset", *said])
        self._set(element, "filename", f"{MESH_FOLDER}/{name}", why)

    def _written(self, path: Path, scale: Vector, triangles: mesh.Triangles) -> str:
        key = (path, tuple(scale.tolist()))
        if key not in self.meshes:
            stem = file_stem(path.stem, "mesh")
            name, count = f"{stem}.obj", 2
            while name.lower() in self.taken:
                name, count = f"{stem}_{count}.obj", count + 1
            self.taken.add(name.lower())
            self.meshes[key] = name
            target = self.folder / MESH_FOLDER / name
            target.parent.mkdir(exist_ok=True)
            scaled = triangles if (scale == 1).all() else triangles.scaled(scale)
            atomic.write_text(target, obj.text(scaled))
            self.out.files.append(target)
        return self.meshes[key]

    def _triangles(self, path: Path, element: Any) -> mesh.Triangles:
        if path not in self.read_meshes:
            try:
                found: mesh.Triangles | TwinError = mesh.read(path)
            except TwinError as error:
                found = error
            self.read_meshes[path] = found
            self.out.source_files.append(path)
            if isinstance(found, mesh.Triangles):
                self.out.source_files += mesh.files_of(path)[1:]
                self.bytes += path.stat().st_size
                self.faces += len(found.faces)
            if self.bytes > LIMITS.total_asset_bytes or self.faces > LIMITS.total_mesh_faces:
                raise FormatError(
                    "the meshes together are too large",
                    path=self.source,
                    line=element.sourceline,
                    expected=f"at most {LIMITS.total_asset_bytes} bytes and "
                    f"{LIMITS.total_mesh_faces} triangles",
                )
        made = self.read_meshes[path]
        if isinstance(made, TwinError):
            raise made
        return made

    def _textures(self) -> None:
        for element in list(self.root.iter("texture")):
            reference = element.get("filename") or ""
            try:
                path = self._resolve(element, reference)
                if path.suffix.lower() not in _IMAGES:
                    raise PathError(
                        "not an image",
                        path=path,
                        value=path.suffix,
                        expected="one of " + ", ".join(_IMAGES),
                    )
                data = read_bytes(path, LIMITS.asset_bytes)
            except TwinError as error:
                parent: Any = element.getparent()
                parent.remove(element)
                self._change(element, "", f"texture {reference}", None, error.problem)
                continue
            if path not in self.images:
                name = (
                    f"{file_stem(path.stem, 'image')}-{bytes_sha256(data)[:8]}{path.suffix.lower()}"
                )
                target = self.folder / MESH_FOLDER / name
                target.parent.mkdir(exist_ok=True)
                atomic.write_bytes(target, data)
                self.images[path] = name
                self.out.files.append(target)
                self.out.source_files.append(path)
            place = f"{MESH_FOLDER}/{self.images[path]}"
            self._set(element, "filename", place, "a path inside the asset")

    def _resolve(self, element: Any, reference: str) -> Path:
        return self.files.find(
            reference,
            at=self.source,
            line=element.sourceline,
            where=f"{element.tag}.filename",
        )


def _label(element: Any) -> str:
    """Return an element's name, with the link or joint that contains it."""
    name = element.get("name")
    own = element.tag if name is None else f"{element.tag} '{name}'"
    for parent in element.iterancestors("link", "joint"):
        return f"{parent.tag} '{parent.get('name')}'/{own}"
    return own


def xml_numbers(text: str | None, default: tuple[float, ...]) -> Vector:
    """Return the numbers of an attribute (NaN for other words), or the default."""
    return np.array(default if text is None else [_number(word) for word in text.split()])


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return float("nan")
