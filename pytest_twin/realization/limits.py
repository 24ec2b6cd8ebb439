"""Size limits of models; a larger model is an error or an attack."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ModelLimits:
    """Size limits that are checked before a simulator loads a model.

    Attributes:
        elements: number of elements, with includes and repetitions expanded.
        link_depth: depth of the kinematic tree of a URDF. XML readers stop at 256 levels, MuJoCo's
            compiler refuses 1024 levels and crashes at some thousands.
        audited_link_depth: the same for an audit, which does not compile the model.
        include_files: number of files included by one model.
        nested_models: depth of nested attached models.
        asset_bytes: size of one mesh, texture, height field or skin file, bytes.
        total_asset_bytes: total size of these files, bytes.
        mesh_faces: number of triangles of one mesh.
        total_mesh_faces: number of triangles of all meshes.
        image_pixels: number of pixels of one image, or of cells of one height field.
        samples: length of one delay buffer, user array or numeric.
        memory_bytes: size of the memory arena that a model requests, bytes.
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
