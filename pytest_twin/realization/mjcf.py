"""Read and check an MJCF file before MuJoCo parses it.

This module inserts the includes and reads all referenced files, inside the declared root folders.
MuJoCo gets one document and the content of the files, so that it never opens a path.
"""

from __future__ import annotations

import hashlib
import math
import re
import struct
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import mujoco

from pytest_twin.errors import LimitError, ModelError, TwinError
from pytest_twin.formats import xml
from pytest_twin.formats.paths import Roots
from pytest_twin.realization.engine import check_meaning, version_advice
from pytest_twin.realization.limits import LIMITS
from pytest_twin.realization.node import Node


@dataclass(slots=True)
class Document:
    """A complete model: the tree of elements, and the content of all referenced files.

    Attributes:
        root: the ``mujoco`` element with all includes inserted.
        assets: name in the document -> content of a mesh, texture or other asset.
        models: name in the document -> content of an attached model or of a flexcomp's file.
        asset_paths: name in the document -> a file with this content.
        files: all files that were read.
    """

    root: Node
    assets: dict[str, bytes] = field(default_factory=dict)
    models: dict[str, bytes] = field(default_factory=dict)
    asset_paths: dict[str, Path] = field(default_factory=dict)
    files: set[Path] = field(default_factory=set)
    places: list[tuple[Path, int]] = field(default_factory=list)
    """File and line from which each line of :meth:`text` was read."""

    def text(self) -> str:
        """The model as one document, with one element per line."""
        lines: list[str] = []
        self.places.clear()
        _write(self.root, lines, self.places)
        return "\n".join(lines)


def _write(node: Node, lines: list[str], places: list[tuple[Path, int]]) -> None:
    attributes = "".join(f" {key}={quoteattr(value)}" for key, value in node.attributes.items())
    lines.append(f"<{node.tag}{attributes}{'' if node.children else '/'}>")
    places.append((node.path, node.line))
    if node.children:
        for child in node.children:
            _write(child, lines, places)
        lines.append(f"</{node.tag}>")
        places.append((node.path, node.line))


def read(path: Path, roots: Roots, *, text: bytes | None = None) -> Document:
    """Read an MJCF file and all files that it refers to.

    Args:
        roots: folders that referenced files may be in.
        text: MJCF that replaces the content of a file of another format.

    Raises:
        FormatError: not well-formed, or larger than a limit.
        PathError: a referenced file does not exist or is outside the roots.
        ModelError: an invalid value, or two assets with one name.
    """
    return _Reader(roots).document(path, depth=0, text=text)


def read_tree(path: Path, roots: Roots) -> Node:
    """Read the ``mujoco`` element with all includes inserted; no other file is opened.

    Raises:
        FormatError: not well-formed, or larger than a limit.
        PathError: an included file does not exist or is outside the roots.
    """
    return _Reader(roots).tree(path)


def check_values(node: Node) -> None:
    """Refuse invalid values in an element and its descendants.

    Raises:
        ModelError: a value that is not finite or negative, or a plugin.
        LimitError: larger than a limit.
    """
    _Reader(Roots(node.path.parent)).check(node, 1.0)


def asset_name(node: Node) -> str:
    """Name of a mesh, texture or other asset; the name of its file where none is stated."""
    file = node.attributes.get("file", "").replace("\\", "/")
    return node.attributes.get("name") or Path(file).stem


def named_files(path: Path, roots: Roots) -> set[Path]:
    """Absolute paths of all files that a model refers to, without following links.

    Only XML files are read: the model, and files inside ``roots`` that it includes or attaches.
    Errors are ignored, because :func:`read` reports them.
    """
    named: set[Path] = set()
    waiting = [path]
    for _ in range(LIMITS.include_files):
        if not waiting:
            break
        file = waiting.pop()
        reader = _Reader(roots)
        with suppress(TwinError):
            tree = reader.tree(file)
            for node, _, reference in _references(tree):
                named.add(reference)
                if node.tag == "model":
                    waiting.append(roots.resolve(str(reference), at=node.path))
        named |= reader.included
    return named


def build(document: Document) -> mujoco.MjSpec:
    """Parse a checked document with MuJoCo.

    Raises:
        ModelError: MuJoCo's parser refuses it.
    """
    text = document.text()
    try:
        return mujoco.MjSpec.from_string(text, include=document.models, assets=document.assets)
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise translate(error, document.root.path, document.places) from None


def compile_spec(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, tuple[str, ...]]:
    """Compile a spec; the model, and the compiler's warnings, one line each."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = spec.compile()
    check_meaning(model)
    return model, tuple(" ".join(str(warning.message).split()) for warning in caught)


def translate(error: Exception, path: Path, places: Sequence[tuple[Path, int]] | None) -> TwinError:
    """Convert an error of MuJoCo to one with the file and line of the model.

    Args:
        places: file and line of each line of the document that MuJoCo got; None where its line
            numbers are those of ``path``.
    """
    words = " ".join(str(error).split())
    line = None
    match = re.search(r",? line (\d+)", words)
    if match is not None:
        line = int(match[1])
        if places is not None and 1 <= line <= len(places):
            path, line = places[line - 1]
        words = words.replace(match[0], "")
    words = re.sub(r"^(XML )?Error: ", "", words)
    kind = LimitError if "could not allocate" in words.lower() else ModelError
    words += version_advice(words)
    return kind(f"MuJoCo refuses the model: {words}", path=path, line=line)


# Elements whose files are in the compiler's mesh folder, and attributes in the texture folder.
_MESH_FILES = frozenset({"mesh", "hfield", "skin", "flexcomp"})
_TEXTURE_FILES = ("file", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
_SUFFIXES = {
    "mesh": (".stl", ".obj", ".msh"),
    "hfield": (".png", ".bin", ".hf", ""),
    "skin": (".skn",),
    "flexcomp": (".stl", ".obj", ".msh", ".gmsh"),
    "texture": (".png", ".ktx", ".bin", ""),
}
# Attributes with names or words, in which 'nan' is not a number.
_NAMES = frozenset(
    [
        "name",
        "class",
        "childclass",
        "joint",
        "joint1",
        "joint2",
        "body",
        "body1",
        "body2",
        "geom",
        "geom1",
        "geom2",
        "site",
        "site1",
        "site2",
        "tendon",
        "tendon1",
        "tendon2",
        "material",
        "mesh",
        "hfield",
        "texture",
        "model",
        "prefix",
        "suffix",
        "target",
        "objname",
        "refname",
        "actuator",
        "file",
        "content_type",
        "data",
        "key",
        "value",
        "plugin",
        "instance",
        "cranksite",
        "slidersite",
        "refsite",
        "sidesite",
        "basebody",
        "user",
    ]
)
_NOT_NEGATIVE = ("mass", "density", "armature", "frictionloss", "damping", "diaginertia")
_POSITIVE = ("timestep",)
_BOUNDED = ("nsample", "size", "nconmax", "njmax", "nkey", "nuserdata", "nstack", "maxhullvert")


def _references(root: Node) -> Iterator[tuple[Node, str, Path]]:
    """Yield each element that refers to a file, the attribute, and the file's absolute path.

    The folders in ``<compiler>`` are removed from the element, because the paths contain them.
    """
    mesh_folder, texture_folder, strip = "", "", False
    for compiler in root.all("compiler"):
        for key in ("assetdir", "meshdir", "texturedir"):
            folder = compiler.attributes.pop(key, None)
            if folder is not None and key != "texturedir":
                mesh_folder = folder
            if folder is not None and key != "meshdir":
                texture_folder = folder
        strip = compiler.attributes.pop("strippath", str(strip).lower()) == "true"
    base = root.path.parent
    for node in root.walk():
        for key in _TEXTURE_FILES if node.tag == "texture" else ("file",):
            reference = node.attributes.get(key)
            if reference is None:
                continue
            if not reference:
                raise node.error("empty file name", key, expected="a path to a file")
            if strip:
                reference = reference.replace("\\", "/").rsplit("/", 1)[-1]
            if node.tag == "model":
                yield node, key, base / reference
            elif node.tag == "texture":
                yield node, key, base / texture_folder / reference
            elif node.tag in _MESH_FILES:
                yield node, key, base / mesh_folder / reference
            else:
                raise node.error(
                    "no file is allowed here",
                    key,
                    value=reference,
                    expected="no such attribute; remove it",
                )


class _Reader:
    def __init__(self, roots: Roots) -> None:
        self.roots = roots
        self.files = 0
        self.read: set[Path] = set()
        self.included: set[Path] = set()
        """Paths of included files as written, without following links."""
        self.elements = 0.0
        self.bytes = 0
        self.faces = 0

    def tree(self, path: Path, text: bytes | None = None) -> Node:
        """The elements of a file, with includes inserted."""
        root = self._tree(path, path.parent, (path,), text)
        if root.tag != "mujoco":
            raise root.error("not an MJCF model", value=root.tag, expected="the root <mujoco>")
        return root

    def document(self, path: Path, depth: int, text: bytes | None = None) -> Document:
        root = self.tree(path, text)
        document = Document(root)
        self.check(root, 1.0)
        self._check_asset_names(root)
        self._read_files(document, depth)
        document.files = self.read
        return document

    # -- includes

    def _tree(
        self, path: Path, main: Path, chain: tuple[Path, ...], text: bytes | None = None
    ) -> Node:
        self.files += 1
        if self.files > LIMITS.include_files or len(chain) > LIMITS.include_depth:
            raise LimitError(
                "too many included files",
                path=path,
                expected=f"at most {LIMITS.include_files}, {LIMITS.include_depth} deep",
            )
        self.read.add(path)
        element = xml.parse(path) if text is None else xml.parse_bytes(text, path)
        return self._with_includes(element, path, main, chain)

    def _with_includes(self, element: Any, path: Path, main: Path, chain: tuple[Path, ...]) -> Node:
        node = Node(element.tag, dict(element.attrib), path, element.sourceline or 1)
        for child in element:
            if not isinstance(child.tag, str):
                continue
            if child.tag != "include":
                node.children.append(self._with_includes(child, path, main, chain))
                continue
            line = child.sourceline or 1
            reference = child.get("file")
            if not reference:
                raise ModelError(
                    "include without a file",
                    path=path,
                    line=line,
                    where="include",
                    expected="a path, such as <include file='hand.xml'/>",
                )
            included = self._resolve(reference, (main, path.parent), path, line)
            if included in chain:
                raise ModelError(
                    "a file that includes itself",
                    path=path,
                    line=line,
                    where="include.file",
                    value=reference,
                    expected="another file; remove this include",
                )
            node.children.extend(self._tree(included, main, (*chain, included)).children)
        return node

    def _resolve(self, reference: str, folders: tuple[Path, ...], path: Path, line: int) -> Path:
        """Path of the file in the first folder that contains it."""
        candidate = folders[-1] / reference
        for folder in folders[:-1]:
            # Only the existence is tested here; the chosen path is checked below.
            if (folder / reference).is_symlink() or (folder / reference).exists():
                candidate = folder / reference
                break
        self.included.add(candidate)
        return self.roots.resolve(str(candidate), at=path, line=line)

    # -- referenced files

    def _read_files(self, document: Document, depth: int) -> None:
        for node, key, path in _references(document.root):
            if node.tag == "model":
                self._read_attached_model(document, node, path, depth)
            else:
                self._read_asset(document, node, key, path)

    def _read_attached_model(self, document: Document, node: Node, file: Path, depth: int) -> None:
        if depth >= LIMITS.nested_models:
            raise node.limit(
                "models nested too deep",
                expected=f"at most {LIMITS.nested_models} levels",
            )
        path = self.roots.resolve(str(file), at=node.path, line=node.line)
        nested = self.document(path, depth + 1)
        document.assets.update(nested.assets)
        document.models.update(nested.models)
        document.asset_paths.update(nested.asset_paths)
        content = nested.text().encode()
        name = hashlib.sha256(content).hexdigest()[:24] + ".xml"
        document.models[name] = content
        document.asset_paths[name] = path
        node.attributes["file"] = name
        node.attributes.pop("content_type", None)

    def _read_asset(self, document: Document, node: Node, key: str, file: Path) -> None:
        path = self.roots.resolve(str(file), at=node.path, line=node.line)
        suffix = path.suffix
        if suffix.lower() not in _SUFFIXES[node.tag]:
            raise node.error(
                "not a file type that MuJoCo reads here",
                key,
                value=path.name,
                expected=" or ".join(s for s in _SUFFIXES[node.tag] if s),
            )
        size = path.stat().st_size
        self.bytes += size
        if size > LIMITS.asset_bytes or self.bytes > LIMITS.total_asset_bytes:
            raise node.limit(
                "referenced files too large",
                key,
                value=size,
                unit="bytes",
                expected=f"at most {LIMITS.asset_bytes} bytes each, "
                f"{LIMITS.total_asset_bytes} in all",
            )
        content = path.read_bytes()
        self._check_content(node, key, suffix.lower(), content)
        # The name is a digest of the content, so that MuJoCo's cache cannot confuse two files.
        name = hashlib.sha256(content).hexdigest()[:24] + suffix
        document.assets[name] = content
        if node.tag == "flexcomp":
            # MuJoCo's parser expands a flexcomp and finds its file only among the included ones.
            document.models[name] = content
        document.asset_paths[name] = path
        self.read.add(path)
        if node.tag in ("mesh", "hfield", "skin", "texture"):
            node.attributes.setdefault("name", path.stem)
        node.attributes[key] = name

    def _check_content(self, node: Node, key: str, suffix: str, content: bytes) -> None:
        if suffix == ".stl" and len(content) >= 84:
            faces = int(struct.unpack_from("<I", content, 80)[0])
            if 84 + 50 * faces != len(content):
                raise node.error(
                    "not a whole binary STL",
                    key,
                    value=f"{len(content)} bytes, {faces} faces",
                    expected=f"{84 + 50 * faces} bytes; export the mesh again",
                )
            self.faces += faces
            if faces > LIMITS.mesh_faces or self.faces > LIMITS.total_mesh_faces:
                raise node.limit(
                    "too many triangles",
                    key,
                    value=faces,
                    expected=f"at most {LIMITS.mesh_faces} each, {LIMITS.total_mesh_faces} in all",
                )
        if suffix == ".png" and len(content) >= 24:
            width, height = struct.unpack_from(">II", content, 16)
            if width * height > LIMITS.image_pixels:
                raise node.limit(
                    "image too large",
                    key,
                    value=f"{width} x {height}",
                    unit="pixels",
                    expected=f"at most {LIMITS.image_pixels} pixels",
                )

    # -- values

    @staticmethod
    def _check_asset_names(root: Node) -> None:
        """Refuse two assets with one name, before their files are read."""
        first: dict[tuple[str, str], Node] = {}
        for section in root.all("asset"):
            for node in section.children:
                name = asset_name(node)
                before = first.setdefault((node.tag, name), node)
                if name and before is not node:
                    raise node.error(
                        f"a second {node.tag} named '{name}'",
                        expected=f"a name that differs from that of {before.place}",
                    )

    def check(self, node: Node, repeated: float) -> None:
        """Refuse invalid values and too many elements; ``repeated`` is the number of copies."""
        if node.tag == "plugin" or node.tag == "extension":
            raise node.error(
                "plugins are native code and are not loaded",
                expected="a model without plugins; remove this element",
            )
        numbers = {
            key: _numbers(text) for key, text in node.attributes.items() if key not in _NAMES
        }
        for key, values in numbers.items():
            if any(not math.isfinite(value) for value in values):
                raise node.error(
                    "not a finite number",
                    key,
                    value=node.attributes[key],
                    expected="finite numbers",
                )
        for key in _NOT_NEGATIVE:
            # Damping may be a polynomial; only its first, linear, term must not be negative.
            values = numbers.get(key, ())[: 1 if key == "damping" else None]
            if any(value < 0 for value in values):
                raise node.error("negative", key, value=node.attributes[key], expected="0 or more")
        for key in _POSITIVE:
            if any(value <= 0 for value in numbers.get(key, ())):
                raise node.error(
                    "not positive",
                    key,
                    value=node.attributes[key],
                    unit="s",
                    expected="more than 0",
                )
        self._check_size(node, numbers)
        copies = repeated * _copies(node, numbers)
        self.elements += copies
        if self.elements > LIMITS.elements:
            raise node.limit(
                "too many elements",
                expected=f"at most {LIMITS.elements}, repetitions counted out",
            )
        for child in node.children:
            self.check(child, copies)

    def _check_size(self, node: Node, numbers: dict[str, tuple[float, ...]]) -> None:
        bounded = [key for key in numbers if key in _BOUNDED or key.startswith("nuser_")]
        for key in bounded:
            if key == "size" and node.tag != "numeric":
                continue
            if any(abs(value) > LIMITS.samples for value in numbers[key]):
                raise node.limit(
                    "too large",
                    key,
                    value=node.attributes[key],
                    expected=f"at most {LIMITS.samples}",
                )
        for keys in (("nrow", "ncol"), ("width", "height"), ("gridsize",), ("resolution",)):
            cells = math.prod(v for key in keys for v in numbers.get(key, (1.0,)))
            if abs(cells) > LIMITS.image_pixels:
                raise node.limit(
                    "too large",
                    keys[0],
                    value=cells,
                    expected=f"at most {LIMITS.image_pixels} cells",
                )
        memory = node.attributes.get("memory") if node.tag == "size" else None
        if memory is not None:
            match = re.fullmatch(r"\s*(\d+)\s*([KMGTPE]?)\s*", memory, re.IGNORECASE)
            factor = 0 if match is None else 1024 ** " KMGTPE".index(match[2].upper() or " ")
            if match is None and memory.strip() != "-1":
                raise node.error("no size", "memory", value=memory, expected="such as '64M'")
            if match is not None and int(match[1]) * factor > LIMITS.memory_bytes:
                raise node.limit(
                    "asks for too much memory",
                    "memory",
                    value=memory,
                    expected=f"at most {LIMITS.memory_bytes} bytes",
                )


def _numbers(text: str) -> tuple[float, ...]:
    """The numbers of an attribute; empty if it is not a list of numbers."""
    try:
        return tuple(float(token) for token in text.split())
    except ValueError:
        return ()


def _copies(node: Node, numbers: dict[str, tuple[float, ...]]) -> float:
    if node.tag in ("replicate", "composite", "flexcomp"):
        return max(1.0, math.prod(abs(value) for value in numbers.get("count", (1.0,))))
    return 1.0
