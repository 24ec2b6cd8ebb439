"""Sort the files supplied with a robot by kind, and list missing kinds."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import PurePosixPath

WANTED = ("manual", "CAD", "calibration certificate", "firmware", "SDK")
"""Kinds of evidence that every asset should have; the manifest lists the missing ones."""

_CERTIFICATE = re.compile(r"calib|certificat|kalibri|zertifikat", re.IGNORECASE)
_MANUAL = re.compile(r"manual|handbook|datasheet|guide|specification", re.IGNORECASE)
_PAPERS = frozenset({".pdf", ".doc", ".docx", ".odt", ".rtf", ".html", ".htm"})
_TEXTS = frozenset({".md", ".txt", ".rst"})
_RECORDS = frozenset({".csv", ".json", ".xml", ".xlsx", ".yaml", ".yml"})
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


def kind_of(name: str) -> str:
    """Return the kind of a file by its path, ``other`` if unknown."""
    path = PurePosixPath(name)
    suffix, stem = path.suffix.lower(), path.name
    folders = {part.lower() for part in path.parts[:-1]}
    if _CERTIFICATE.search(stem) and suffix in _PAPERS | _TEXTS | _RECORDS:
        return "calibration certificate"
    if suffix in _PAPERS or (suffix in _TEXTS and _MANUAL.search(stem)):
        return "manual"
    if folders & {"firmware", "fw"} and suffix not in _TEXTS:
        return "firmware"
    if folders & {"sdk"}:
        return "SDK"
    if stem.upper().startswith(("README", "CHANGELOG")):
        return "note"
    if suffix in ("", *_TEXTS) and stem.upper().startswith(("LICENSE", "LICENCE", "COPYING")):
        return "licence"
    if stem == "package.xml" or stem == "CMakeLists.txt":
        return "configuration"
    if suffix == ".xml":
        return "model"
    return _KIND_OF.get(suffix, "other")


def sort_files(names: Iterable[str]) -> dict[str, list[str]]:
    """Return kind -> its files, both sorted."""
    found: dict[str, list[str]] = {}
    for name in sorted(names):
        found.setdefault(kind_of(name), []).append(name)
    return dict(sorted(found.items()))


def missing(found: Iterable[str]) -> list[str]:
    """Return the kinds of evidence without a file."""
    present = set(found)
    return [kind for kind in WANTED if kind not in present]
