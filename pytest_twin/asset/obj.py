"""Write meshes as Wavefront OBJ, which MuJoCo, USD converters and Pinocchio all load."""

from __future__ import annotations

import numpy as np

from pytest_twin.realization.mesh import Triangles


def text(triangles: Triangles) -> str:
    """Return vertices in metres and triangles as OBJ text, equal for equal meshes.

    Nine digits represent every single-precision number exactly; no simulator stores more.
    """
    vertices = np.asarray(triangles.vertices, dtype=np.float64) + 0.0
    faces = np.asarray(triangles.faces, dtype=np.int64) + 1
    parts = [
        "# unit: metre\n",
        "v %.9g %.9g %.9g\n" * len(vertices) % tuple(vertices.ravel().tolist()),
        "f %d %d %d\n" * len(faces) % tuple(faces.ravel().tolist()),
    ]
    return "".join(parts)
