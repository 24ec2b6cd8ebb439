"""Left and right links: if one has the mirrored shape, it has the mirrored inertia."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pytest_twin.audit.asset import Asset, Body, Vector
from pytest_twin.audit.finding import Finding, finding_of
from pytest_twin.audit.geometry import Geometry, Solid
from pytest_twin.realization.inertia import MASS_FLOOR

_ALIKE = 0.02
"""Fraction of a shape's size within which two shapes are the same."""
_APART = 0.05
"""Fraction of a shape's size beyond which a centre of mass contradicts its twin's."""
_DIFFERENT = 0.2
"""Relative difference of two inertias beyond which one contradicts the other; cables and screws of
real left and right arms make up to 0.15."""
_EQUAL = 1e-3
"""Relative difference of masses below which two links are images of one part."""
_SIGNS = [signs for signs in itertools.product((1.0, -1.0), repeat=3) if sum(signs) > -3.0]
"""Translation, the three mirror planes and the three half turns, along the base's axes."""


@dataclass(frozen=True, slots=True)
class _Link:
    """A link's shape and inertia relative to its own origin, along the base's axes.

    Attributes:
        shape: (3,) centroid, m; ``form``: (3, 3) inertia per unit mass, m^2; ``size``: m.
        com: (3,) centre of mass, m; ``inertia``: (3, 3) about it, kg*m^2.
    """

    body: Body
    shape: Vector
    form: Vector
    size: float
    com: Vector
    inertia: Vector

    def has_shape_of(self, other: _Link, image: Vector) -> bool:
        """Whether an image of ``other`` has this link's shape, in the same place."""
        turned = image @ other.form @ image.T
        return bool(
            np.linalg.norm(image @ other.shape - self.shape) < _ALIKE * self.size
            and np.linalg.norm(turned - self.form) < _ALIKE * np.linalg.norm(self.form)
        )

    def com_from(self, other: _Link, image: Vector) -> float:
        """Return the distance between this centre of mass and that of ``other``'s image, m."""
        return float(np.linalg.norm(image @ other.com - self.com))

    def inertia_from(self, other: _Link, image: Vector) -> float:
        """Return the relative difference between this inertia and that of ``other``'s image."""
        turned = image @ other.inertia @ image.T
        return float(np.linalg.norm(turned - self.inertia) / np.linalg.norm(self.inertia))


def check(asset: Asset, geometry: Geometry) -> Iterator[Finding]:
    """Yield links with the mass and the image of the shape of another link, but not of its inertia.

    An image is a copy, a mirror image or a half turn, in the base's axes at the reference pose.
    """
    links: dict[int, list[_Link]] = {}
    for name in asset.drawn:
        body, solid = asset.body[name], geometry.body(name)
        if solid is None or not body.stated or not body.mass or body.inertia is None:
            continue
        if not np.isfinite(body.inertia).all() or np.abs(body.inertia).max() < MASS_FLOOR:
            continue
        # Rounding on a logarithmic scale: equal masses have the same key.
        key = round(float(np.log(max(body.mass, MASS_FLOOR))) / _EQUAL)
        links.setdefault(key, []).append(_link(body, solid, asset.drawn[name][1]))
    for alike in links.values():
        for second in alike[1:]:
            yield from _compare(alike[0], second, asset)


def _link(body: Body, solid: Solid, axes: Vector) -> _Link:
    assert body.inertia is not None
    return _Link(
        body,
        axes @ solid.centroid,
        axes @ solid.inertia @ axes.T,
        solid.size,
        axes @ body.com,
        axes @ body.inertia @ axes.T,
    )


def _compare(first: _Link, second: _Link, asset: Asset) -> Iterator[Finding]:
    local = asset.drawn[second.body.name][1] @ asset.drawn[first.body.name][1].T
    images = [local, *(np.diag(signs) for signs in _SIGNS)]
    alike = [image for image in images if second.has_shape_of(first, image)]
    if not alike:
        return
    differences = [
        (second.com_from(first, image), second.inertia_from(first, image)) for image in alike
    ]
    if any(off < _APART * second.size and by < _DIFFERENT for off, by in differences):
        return
    off = min(off for off, _ in differences)
    turned = min(by for _, by in differences)
    com_differs = off > _APART * second.size
    element = f"link '{second.body.name}'"
    yield finding_of(
        "inertia.not_mirrored",
        second.body.inertial,
        element,
        off if com_differs else turned,
        title="it has the mass and the shape, or its mirror image, of link "
        f"'{first.body.name}', and not its " + ("centre of mass" if com_differs else "inertia"),
        unit="m" if com_differs else "1",
    )
