"""Bounds on models: what is larger is no robot but a mistake or an attack."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ModelLimits:
    """Bounds that hold before a simulator sees anything of a model.

    Attributes:
        elements: elements after includes and repetitions are counted out.
        link_depth: links of a URDF one below the other. An MJCF nests its bodies, and XML readers
            stop at 256 levels; MuJoCo's compiler refuses 1024 and crashes on some thousands.
        audited_link_depth: the same for an audit, which needs no compiled model.
        include_files: files spliced into one model.
        include_depth: files that include files that include.
        nested_models: depth of models that attach models.
        asset_bytes: size of one mesh, texture, height field or skin file.
        total_asset_bytes: size of all of them.
        mesh_faces: triangles of one mesh.
        total_mesh_faces: triangles of all meshes.
        image_pixels: pixels of one image, or cells of one height field.
        samples: length of one delay buffer, user array or numeric.
        memory_bytes: arena that a model may ask for.
    """

    elements: int = 100_000
    link_depth: int = 250
    audited_link_depth: int = 10_000
    include_files: int = 200
    include_depth: int = 8
    nested_models: int = 4
    asset_bytes: int = 128 * 2**20
    total_asset_bytes: int = 512 * 2**20
    mesh_faces: int = 1_000_000
    total_mesh_faces: int = 5_000_000
    image_pixels: int = 64 * 2**20
    samples: int = 1_000_000
    memory_bytes: int = 4 * 2**30


LIMITS = ModelLimits()
