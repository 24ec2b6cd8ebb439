"""Visual and collision shapes: presence, size, closedness, convexity and cost."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pytest_twin.asset.collada import DEFAULT_UP_AXIS, stated_up_axis
from pytest_twin.audit.asset import Asset, Body, Shape
from pytest_twin.audit.finding import Finding, finding_of
from pytest_twin.audit.geometry import Geometry, Solid
from pytest_twin.realization import gltf
from pytest_twin.realization.mesh import Triangles
from pytest_twin.realization.shapes import polyhedron
from pytest_twin.words import counted, list_names

_MANY_FACES = 20_000
"""Triangles of one collision mesh, above which loading and contact become slow."""
_HOLLOW = 1.5
"""Hull volume over mesh volume above which the hull fills holes or notches that matter."""
_UNLIKE = 4.0
"""Ratio of the sizes of a link's two shapes beyond which contact is not where it seems; between
centimetres and metres or inches and centimetres, and coarse boxes."""
_REACH = "the robot's reach"
_OTHER = "the link's other shape"
_GYRATION = "the size that the link's inertia implies"
_BULK = "the size that the link's mass implies"
_DENSITY = 2000.0
"""kg/m^3: typical for links, between plastic and steel. An error by a factor of 10 changes a length
only by 2.2, the cube root."""
_TOO_LARGE, _TOO_SMALL = 100.0, 0.01
"""Ratio of two lengths of one link beyond which one of them is in another unit."""


@dataclass(frozen=True, slots=True)
class MeshFacts:
    """Properties of one mesh file at one scale.

    Attributes:
        extents: (3,) sides of the scaled bounding box, m.
        is_watertight: whether every edge has two faces.
        volume: volume, m^3; None if the mesh is not watertight.
        hull: volume of its convex hull, m^3.
    """

    file: Path
    faces: int
    extents: tuple[float, float, float]
    is_watertight: bool
    volume: float | None
    hull: float
    uses: tuple[str, ...]

    @property
    def convexity(self) -> float | None:
        """Return volume over hull volume, 1 for a convex mesh; None if the mesh is not closed."""
        return None if self.volume is None or self.hull <= 0 else self.volume / self.hull


def facts(asset: Asset, geometry: Geometry) -> list[MeshFacts]:
    """Return the properties of each mesh file at each of its scales."""
    found: dict[tuple[Path, tuple[float, ...]], list[Shape]] = {}
    for shape in asset.shapes:
        if shape.file is not None and shape.triangles is not None:
            found.setdefault((shape.file, tuple(shape.scale.tolist())), []).append(shape)
    result = []
    for (file, _), shapes in found.items():
        mesh = shapes[0].triangles
        assert mesh is not None
        closed = is_watertight(mesh)
        volume = polyhedron(mesh.vertices, mesh.faces) if closed else None
        extents = np.ptp(mesh.vertices, axis=0)
        result.append(
            MeshFacts(
                file,
                len(mesh.faces),
                (float(extents[0]), float(extents[1]), float(extents[2])),
                closed,
                None if volume is None else volume[0],
                geometry.hull_volume(shapes[0]),
                tuple(f"{shape.role} of {shape.body}" for shape in shapes),
            )
        )
    return result


def is_watertight(mesh: Triangles) -> bool:
    """Whether every edge has two faces with consistent orientation."""
    faces = mesh.faces.astype(np.int64)
    edges = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    count = len(mesh.vertices)
    forward = np.sort(edges[:, 0] * count + edges[:, 1])
    backward = np.sort(edges[:, 1] * count + edges[:, 0])
    return len(forward) > 0 and bool(np.array_equal(forward, backward))


def check(asset: Asset, geometry: Geometry) -> Iterator[Finding]:
    """Yield faults of shapes, and findings about their cost."""
    for shape in asset.shapes:
        yield from _size(shape)
    yield from _units(asset, geometry)
    yield from _roles(asset, geometry)
    yield from _masked(asset)
    first: dict[tuple[Path, tuple[float, ...]], Shape] = {}
    for shape in asset.shapes:
        if shape.file is not None and shape.triangles is not None:
            first.setdefault((shape.file, tuple(shape.scale.tolist())), shape)
    for path in dict.fromkeys(shape.file for shape in first.values() if shape.file is not None):
        shapes = [shape for shape in asset.shapes if shape.file == path]
        yield from _up_axis(path, shapes)
    for fact, shape in zip(facts(asset, geometry), first.values(), strict=True):
        yield from _quality(fact, shape, [s for s in asset.shapes if s.file == shape.file])


def _up_axis(path: Path, shapes: list[Shape]) -> Iterator[Finding]:
    """Yield a finding if tools interpret the axes of a COLLADA or glTF file differently."""
    collada = path.suffix.lower() == ".dae"
    if not (collada or path.suffix.lower() in gltf.SUFFIXES) or shapes[0].triangles is None:
        return
    stated = stated_up_axis(path) if collada else gltf.UP_AXIS
    if stated == "Z_UP":
        return
    collides = any(shape.role == "collision" for shape in shapes)
    yield finding_of(
        "meshes.up_axis",
        shapes[0].place,
        f"mesh '{path.name}'",
        stated,
        severity="warning" if collides else "info",
        title=f"it states {stated}"
        if stated
        else f"it states no up_axis: {DEFAULT_UP_AXIS} by default",
        expected="<up_axis>Z_UP</up_axis>" if collada else "a format with Z up, such as OBJ or STL",
    )


def _element(shape: Shape) -> str:
    return f"{shape.role} of link '{shape.body}'"


def _size(shape: Shape) -> Iterator[Finding]:
    if shape.size and min(shape.size) <= 0:
        critical = min(shape.size) < 0
        yield finding_of(
            "meshes.no_size",
            shape.place,
            _element(shape),
            " ".join(f"{value:g}" for value in shape.size),
            severity="critical" if critical else "warning",
            title=f"a {shape.kind} with a negative size"
            if critical
            else f"a {shape.kind} without size",
        )
    if (shape.scale < 0).any():
        yield finding_of(
            "meshes.mirrored",
            shape.place,
            _element(shape),
            " ".join(f"{value:g}" for value in shape.scale),
        )
    scale = np.abs(shape.scale)
    if scale.min() > 0 and scale.max() / scale.min() > 1.001:
        yield finding_of(
            "meshes.stretched",
            shape.place,
            _element(shape),
            " ".join(f"{value:g}" for value in shape.scale),
        )


def _units(asset: Asset, geometry: Geometry) -> Iterator[Finding]:
    """Yield findings of meshes in another unit, judged by mass, inertia, other shape and reach."""
    for name, body in asset.body.items():
        for role in ("collision", "visual"):
            shapes = [s for s in asset.shapes_of(name) if s.role == role and s.kind == "mesh"]
            for shape in shapes:
                solid = geometry.shape(shape)
                if solid is None or solid.size <= 0:
                    continue
                ratios = _inertial_ratios(body, solid)
                other = _other_size(shape, shapes, geometry, solid)
                if other is not None:
                    ratios[_OTHER] = other
                if asset.span > 0:
                    ratios[_REACH] = _span_ratio(solid, asset.span)
                yield from _verdict(shape, solid, ratios)


def _other_size(
    shape: Shape, meshes: list[Shape], geometry: Geometry, solid: Solid
) -> float | None:
    """Return the ratio of a mesh's size to that of the link's other shapes; None without others.

    A part may be far smaller than the link, if all meshes of its role together are not.
    """
    other = geometry.body(shape.body, "visual" if shape.role == "collision" else "collision")
    if other is not None:
        whole = geometry.body(shape.body, shape.role)
        small = whole is not None and solid.size < _TOO_SMALL * other.size
        return (whole.size if whole is not None and small else solid.size) / other.size
    solids = (geometry.shape(mesh) for mesh in meshes if mesh is not shape)
    largest = max((one.size for one in solids if one is not None), default=0.0)
    # The largest part is not too large because the others are small.
    return min(solid.size / largest, 1.0) if largest > 0.0 else None


def _inertial_ratios(body: Body, solid: Solid) -> dict[str, float]:
    """Return ratios of a solid's lengths to those that the body's mass and inertia imply."""
    if not body.stated or not body.mass or body.mass < 0:
        return {}
    found = {_BULK: float(np.cbrt(solid.volume * _DENSITY / body.mass))}
    if body.inertia is not None:
        gyration = float(np.sqrt(max(float(np.trace(body.inertia)) / 2 / body.mass, 0.0)))
        if gyration > 1e-6:
            found[_GYRATION] = solid.gyration / gyration
    return found


def _span_ratio(solid: Solid, span: float) -> float:
    """Return size over the robot's reach; a part may be far smaller, but not far larger."""
    ratio = solid.size / span
    return ratio * 5 if ratio > 20 else min(max(ratio, 1.0), 20.0)


def _verdict(shape: Shape, solid: Solid, ratios: dict[str, float]) -> Iterator[Finding]:
    """Yield a finding if more than half of the ratios indicate another unit.

    If only a minority does, its reference is implausible instead. The layer ``inertia`` reports an
    inertia or mass that contradicts the shape; this function reports the other shape.
    """
    for words, beyond in (
        ("large", {what: ratio for what, ratio in ratios.items() if ratio > _TOO_LARGE}),
        ("small", {what: ratio for what, ratio in ratios.items() if ratio < _TOO_SMALL}),
    ):
        # A part may be far smaller than its robot, so the reach gives no lower limit.
        judges = [what for what in ratios if words == "large" or what != _REACH]
        agreed = len(beyond) > len(judges) / 2
        if _OTHER not in beyond and (not agreed or (words == "small" and _OTHER in ratios)):
            # Beside other shapes of its link, a part may be small for the link's mass.
            continue
        against = ", ".join(f"{ratio:.3g} times {what}" for what, ratio in beyond.items())
        yield finding_of(
            "meshes.units",
            shape.place,
            _element(shape),
            solid.size,
            severity="critical" if agreed and shape.role == "collision" else "warning",
            title=f"its mesh is far too {words}: {against}"
            + ("; millimetres taken for metres?" if words == "large" else "; scaled twice?"),
            expected=f"a size near {next(iter(beyond))}",
            why="it collides with everything" if words == "large" else "it collides with nothing",
        )


def _roles(asset: Asset, geometry: Geometry) -> Iterator[Finding]:
    for name, body in asset.body.items():
        roles = {shape.role for shape in asset.shapes_of(name)}
        if roles == {"visual"} and (body.mass or 0) > 0:
            yield finding_of("meshes.no_collision", body.place, f"link '{name}'")
        seen, felt = geometry.body(name, "visual"), geometry.body(name, "collision")
        if seen is None or felt is None:
            continue
        off = float(np.linalg.norm(seen.centroid - felt.centroid))
        if off > max(seen.size, felt.size):
            yield finding_of("meshes.roles_apart", body.place, f"link '{name}'", off)
            continue
        ratio = felt.size / seen.size
        common = np.minimum(seen.upper, felt.upper) - np.maximum(seen.lower, felt.lower)
        if not 1 / _UNLIKE < ratio < _UNLIKE:
            yield finding_of(
                "meshes.roles_differ",
                body.place,
                f"link '{name}'",
                ratio,
                title=f"its collision shape is {ratio:.3g} times as large as its visual shape",
            )
        elif common.min() < 0.0:
            yield finding_of(
                "meshes.roles_differ",
                body.place,
                f"link '{name}'",
                0.0,
                title="its collision shape and its visual shape do not overlap",
            )


def _masked(asset: Asset) -> Iterator[Finding]:
    """Yield a finding of links whose collision shapes can touch no other link by their masks."""
    bodies: dict[str, list[Shape]] = {}
    for shape in asset.shapes:
        if shape.role == "collision" and shape.masks is not None:
            bodies.setdefault(shape.body, []).append(shape)
    owners: dict[tuple[int, int], set[str]] = {}
    for name, shapes in bodies.items():
        for shape in shapes:
            owners.setdefault(shape.masks or (0, 0), set()).add(name)

    def can_touch(shape: Shape) -> bool:
        contype, conaffinity = shape.masks or (0, 0)
        return shape.is_paired or any(
            (contype & other_conaffinity or other_contype & conaffinity) and names != {shape.body}
            for (other_contype, other_conaffinity), names in owners.items()
        )

    masked = [name for name, shapes in bodies.items() if not any(map(can_touch, shapes))]
    if len(bodies) < 2 or not masked:
        return
    everything = len(masked) == len(bodies)
    shape = bodies[masked[0]][0]
    yield finding_of(
        "meshes.masked",
        shape.place,
        f"robot '{asset.name}'" if everything else f"link '{masked[0]}'",
        f"contype {shape.masks[0]}, conaffinity {shape.masks[1]}" if shape.masks else None,
        title=f"no pair of its {sum(map(len, bodies.values()))} collision shapes can collide"
        if everything
        else f"the collision shapes of {counted(len(masked), 'link')} can collide with nothing: "
        + list_names(masked),
    )


def _quality(fact: MeshFacts, shape: Shape, uses: list[Shape]) -> Iterator[Finding]:
    collides = any(use.role == "collision" for use in uses)
    element = f"mesh '{fact.file.name}'"
    if not collides:
        return
    if fact.faces > _MANY_FACES:
        yield finding_of(
            "meshes.cost",
            shape.place,
            element,
            float(fact.faces),
            title=f"the collision mesh has {fact.faces} triangles",
            expected=f"at most {_MANY_FACES}",
        )
    if not fact.is_watertight:
        yield finding_of("meshes.open", shape.place, element)
    elif fact.convexity is not None and 0 < fact.convexity < 1 / _HOLLOW:
        yield finding_of(
            "meshes.not_convex",
            shape.place,
            element,
            fact.convexity,
            title="the collision mesh is not convex: its hull has "
            f"{1 / fact.convexity:.2g} times its volume",
        )
