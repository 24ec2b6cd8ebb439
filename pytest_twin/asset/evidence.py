"""Sort the files supplied with a robot by kind, and list missing kinds."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from pathlib import Path, PurePosixPath

from pytest_twin.asset.own_files import own_files

WANTED = ("manual", "CAD", "calibration certificate", "naming table", "firmware", "SDK")
"""Kinds of evidence that every asset should have; the manifest lists the missing ones."""
OWN = "written by pytest-twin"
"""Kind of the files that a command wrote; they are not evidence of the supplier."""

_CERTIFICATE = re.compile(r"calib|certificat|kalibri|zertifikat", re.IGNORECASE)
_MANUAL = re.compile(r"manual|handbook|datasheet|guide|specification", re.IGNORECASE)
_NAMING = re.compile(
    r"naming|nomenclature|name[ _-]?(table|map|list)|mapping[ _-]?table|bezeichnung|benennung"
    r"|(joint|link|frame|axis|axes|signal)[ _-]?names?",
    re.IGNORECASE,
)
# Not inside a longer word: 'fw' in 'fw-3.10', 'api' in 'robot_api'.
_FIRMWARE = re.compile(r"firmware|bootloader|(?<![a-z])fw(?![a-z])", re.IGNORECASE)
_SDK = re.compile(r"(?<![a-z])(sdk|api)(?![a-z])|SDK", re.IGNORECASE)
_SDK_FOLDERS = frozenset({"api", "include", "driver", "drivers"})
_NOTE = re.compile(r"readme|change(log|s)|release[ _-]?notes|history|news", re.IGNORECASE)
_LICENCE = re.compile(r"licen[cs]e|copying", re.IGNORECASE)
_PAGES = frozenset({".html", ".htm"})
_PAPERS = frozenset({".pdf", ".doc", ".docx", ".odt", ".rtf"}) | _PAGES
_TEXTS = frozenset({".md", ".txt", ".rst"})
_TABLES = frozenset({".csv", ".tsv", ".xls", ".xlsx", ".ods", ".json", ".xml", ".yaml", ".yml"})
_BY_SUFFIX = {
    "CAD": "step stp iges igs sldprt sldasm x_t x_b ipt iam prt f3d fcstd brep dwg dxf 3dm",
    "firmware": "hex elf uf2 dfu fw s19 srec bin",
    "SDK": "so dll dylib lib a whl deb rpm jar h hpp proto",
    "model": "urdf xacro sdf mjcf usd usda usdc usdz srdf",
    "mesh": "stl obj dae ply glb gltf fbx 3mf msh",
    "image": "png jpg jpeg tga bmp tif tiff mtl",
    "configuration": "yaml yml json toml ini cfg launch",
}
_KIND_OF = {f".{s}": kind for kind, listed in _BY_SUFFIX.items() for s in listed.split()}
_SHAPES = ("CAD", "model", "mesh")
"""Kinds that a suffix alone decides: a mesh in the folder of an SDK is a mesh."""


def kind_of(name: str, names: Collection[str] = ()) -> str:
    """Return the kind of a file by its path, ``other`` if unknown.

    Args:
        name: path of the file, with ``/``.
        names: all files that were supplied with it.
    """
    path = PurePosixPath(name)
    suffix, stem = path.suffix.lower(), path.name
    folders = [part.lower() for part in path.parts[:-1]]
    by_suffix = _KIND_OF.get(suffix, "other")
    is_text = suffix in ("", *_TEXTS)
    if by_suffix in _SHAPES:
        return by_suffix
    if _is_gltf_buffer(path, names):
        return "mesh"
    if _CERTIFICATE.search(stem) and suffix in _PAPERS | _TEXTS | _TABLES:
        return "calibration certificate"
    if _NAMING.search(stem) and suffix in _PAPERS | _TEXTS | _TABLES:
        return "naming table"
    if is_text and _LICENCE.match(stem):
        return "licence"
    in_sdk = any(_SDK.search(part) for part in folders) or not _SDK_FOLDERS.isdisjoint(folders)
    if suffix in _PAPERS and not (suffix in _PAGES and in_sdk):
        return "manual"
    if suffix in _TEXTS and _MANUAL.search(stem):
        return "manual"
    if is_text and _NOTE.match(stem):
        return "note"
    if any(_FIRMWARE.search(part) for part in (*folders, stem)):
        return "firmware"
    if in_sdk or _SDK.search(stem):
        return "SDK"
    if stem == "package.xml" or stem == "CMakeLists.txt":
        return "configuration"
    return "model" if suffix == ".xml" else by_suffix


def _is_gltf_buffer(path: PurePosixPath, names: Collection[str]) -> bool:
    """Whether a ``.bin`` file lies beside a glTF file: it has the vertices, and is no firmware."""
    return path.suffix.lower() == ".bin" and any(
        other.lower().endswith(".gltf") and PurePosixPath(other).parent == path.parent
        for other in names
    )


def sort_folder(folder: str) -> dict[str, list[str]]:
    """Return kind -> files below a folder, relative to it; both sorted."""
    root = Path(folder)
    names = [path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()]
    return sort_files(names, own_files(root, names))


def sort_files(names: Iterable[str], own: Collection[str] = ()) -> dict[str, list[str]]:
    """Return kind -> its files, both sorted.

    Args:
        names: files that were supplied.
        own: those that commands of pytest-twin wrote.
    """
    listed = sorted(names)
    kinds: dict[str, list[str]] = {}
    for name in listed:
        kinds.setdefault(OWN if name in own else kind_of(name, listed), []).append(name)
    return dict(sorted(kinds.items()))


def missing(present: Iterable[str]) -> list[str]:
    """Return the kinds of evidence without a file."""
    kinds = set(present)
    return [kind for kind in WANTED if kind not in kinds]
