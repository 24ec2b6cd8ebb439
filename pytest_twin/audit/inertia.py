"""Mass and inertia: impossible, implausible and default values."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pytest_twin.audit.asset import Asset, Body, Vector
from pytest_twin.audit.finding import Finding, finding_of
from pytest_twin.audit.geometry import Geometry, Solid
from pytest_twin.realization.inertia import MASS_FLOOR, ROUNDING, point_inertia, violation

_DENSITY = (20.0, 12_000.0)
"""kg/m^3: plausible range of mass over hull volume, from a hollow cover to solid lead."""
_FACTOR = 30.0
"""Ratio of stated to geometric moments beyond which one of the two is reported as wrong."""
_SPREAD = 1.5
"""Ratio of a stated second moment to the largest possible one, beyond which it is reported. Of 68
public robots, those above it have placeholders or inertias of other parts."""
_OFF_CENTRE = 0.3
"""Fraction of a shape's size between its centroid and a centre of mass at the origin."""
_LIGHT = 1e-3
"""Fraction of the robot's mass below which a body's centre of mass does not matter."""


def principal(inertia: Vector) -> Vector:
    """Return the (3,) principal moments, ascending, kg*m^2."""
    return np.asarray(np.linalg.eigvalsh((inertia + inertia.T) / 2))


def check(asset: Asset, geometry: Geometry) -> Iterator[Finding]:
    """Yield faults of masses and inertias."""
    seen: dict[tuple[float, ...], Body] = {}
    total = sum(body.mass or 0.0 for body in asset.body.values())
    for body in asset.body.values():
        if not _is_finite(body):
            yield _not_finite(body)
            continue
        if not body.stated:
            continue
        yield from _possible(body)
        if body.mass and body.inertia is not None and body.mass > 0:
            solid = geometry.body(body.name)
            yield from _default(body)
            yield from _copied_inertia(body, seen, geometry)
            if solid is not None and solid.size > 0:
                points = _points(body, geometry)
                yield from _compare_with_hull(body, body.mass, body.inertia, solid, points)
                yield from _at_origin(body, body.mass, solid, total)
        elif body.mass is None and body.inertial is not None and body.inertia is not None:
            yield finding_of("inertia.no_mass", body.inertial, _element(body))
    yield from _massless_moving_bodies(asset, geometry)
    yield from _massless_robot(asset)


@dataclass(frozen=True, slots=True)
class Comparison:
    """A body compared with the convex hull of its shape at uniform density.

    Attributes:
        mass: mass, kg.
        moments: (3,) principal moments, kg*m^2.
        is_stated: False if a compiler computed mass and inertia from the geometry.
        density: mass over the hull's volume, kg/m^3.
        uniform: (3,) principal moments of the hull with the body's mass, kg*m^2.
        com_offset: distance from the hull's centroid to the centre of mass, m.
    """

    body: str
    mass: float
    moments: tuple[float, ...]
    is_stated: bool
    density: float | None
    uniform: tuple[float, ...] | None
    com_offset: float | None


def comparisons(asset: Asset, geometry: Geometry) -> list[Comparison]:
    """Compare every body that has mass with its shape; fields are None if it has no volume."""
    found = []
    for body in asset.body.values():
        if not body.mass or body.inertia is None or not _is_finite(body):
            continue
        solid = geometry.body(body.name)
        moments = tuple(float(value) for value in principal(body.inertia))
        if solid is None:
            found.append(Comparison(body.name, body.mass, moments, body.stated, None, None, None))
            continue
        found.append(
            Comparison(
                body.name,
                body.mass,
                moments,
                body.stated,
                body.mass / solid.volume,
                tuple(float(value) for value in body.mass * principal(solid.inertia)),
                float(np.linalg.norm(body.com - solid.centroid)),
            )
        )
    return found


def _element(body: Body) -> str:
    return f"link '{body.name}'"


def _is_finite(body: Body) -> bool:
    return bool(
        np.isfinite(body.mass or 0.0)
        and np.isfinite(0.0 if body.inertia is None else body.inertia).all()
    )


def _not_finite(body: Body) -> Finding:
    return finding_of(
        "inertia.not_finite",
        body.inertial or body.place,
        _element(body),
        None if body.mass is None else f"{body.mass:g}",
    )


def _possible(body: Body) -> Iterator[Finding]:
    if body.mass is not None and body.mass < 0:
        yield finding_of("inertia.negative_mass", body.inertial, _element(body), body.mass)
    if body.inertia is None or np.abs(body.inertia).max() < MASS_FLOOR:
        return
    moments = principal(body.inertia)
    text = ", ".join(f"{value:.6g}" for value in moments)
    scale = float(np.abs(moments).max())
    # Cancellation limits the accuracy of the eigenvalues to the digits of the sum.
    if moments[0] < -1e-12 * scale and moments[0] < -ROUNDING * scale:
        yield finding_of(
            "inertia.negative_moment",
            body.inertial,
            _element(body),
            float(moments[0]),
            expected=f"three positive moments (they are {text})",
        )
        return
    share = violation(body.inertia)
    if moments[0] <= 1e-9 * scale and (body.mass or 0.0) > 0:
        six = body.inertia[np.triu_indices(3)]
        equal = bool(np.ptp(six) < 1e-9 * np.abs(six).max())
        yield finding_of(
            "inertia.zero_moment",
            body.inertial,
            _element(body),
            text,
            title="a principal moment of its inertia is zero: it is not positive definite"
            + (", and breaks the triangle inequality" if share > ROUNDING else "")
            + (" (products of inertia equal to the moments)" if equal else ""),
            why="only a line without thickness has it; about that axis it has no inertia",
        )
    elif share > ROUNDING:
        # tr(I)/2 - I_max is the smallest eigenvalue of the pseudo-inertia's 3 x 3 block.
        lowest = float(moments.sum() / 2 - moments[2])
        yield finding_of(
            "inertia.triangle",
            body.inertial,
            _element(body),
            text,
            title="its principal moments break the triangle inequality "
            f"({moments[2]:.4g} > {moments[0]:.4g} + {moments[1]:.4g}): "
            f"the pseudo-inertia has the eigenvalue {lowest:.3g} kg*m^2",
        )
    elif share > 1e-9:
        yield finding_of("inertia.triangle_rounded", body.inertial, _element(body), text)


def _default(body: Body) -> Iterator[Finding]:
    assert body.inertia is not None
    diagonal = np.diag(body.inertia)
    off = np.abs(body.inertia - np.diag(diagonal)).max()
    mass = float(body.mass or 0.0)
    alike = float(np.ptp(diagonal)) < 1e-9 * float(diagonal.max()) and off < 1e-12
    round_value = alike and diagonal[0] > 0 and _has_one_digit(float(diagonal[0]))
    if round_value and (_has_one_digit(mass) or not body.com.any()):
        yield finding_of(
            "inertia.default",
            body.inertial,
            _element(body),
            float(diagonal[0]),
            title=f"three equal round moments with {mass:g} kg: a default value, "
            "not a measured one",
        )


def _has_one_digit(value: float) -> bool:
    """Whether a number has only one significant digit."""
    return value > 0 and float(f"{value:.0e}") == value


def _copied_inertia(
    body: Body, seen: dict[tuple[float, ...], Body], geometry: Geometry
) -> Iterator[Finding]:
    assert body.inertia is not None
    key = (float(body.mass or 0.0), *body.com.tolist(), *body.inertia.ravel().tolist())
    first = seen.setdefault(key, body)
    if first is body:
        return
    solids = geometry.body(first.name), geometry.body(body.name)
    volumes = [0.0 if solid is None else solid.volume for solid in solids]
    if np.isclose(volumes[0], volumes[1], rtol=0.02):
        return
    yield finding_of(
        "inertia.copied",
        body.inertial,
        _element(body),
        float(body.mass or 0.0),
        title=f"it has mass, centre of mass and inertia of link '{first.name}', and another shape",
    )


def _points(body: Body, geometry: Geometry) -> Vector:
    """Return the (n, 3) vertices of a body's visual and collision shapes, m."""
    solids = (geometry.body(body.name, role) for role in ("visual", "collision"))
    return np.vstack([solid.points for solid in solids if solid is not None])


def _compare_with_hull(
    body: Body, mass: float, inertia: Vector, solid: Solid, points: Vector
) -> Iterator[Finding]:
    """Yield findings from the comparison with the convex hull of its shapes at uniform density.

    Args:
        points: (n, 3) vertices of all its shapes, m.
    """
    element = _element(body)
    outside = solid.outside(body.com)
    if outside > 0.1 * solid.size:
        yield finding_of(
            "inertia.com_outside",
            body.inertial,
            element,
            outside,
            severity="critical" if outside > 10 * solid.size else "warning",
            expected=f"a point inside its shape, {solid.size:.3g} m in size",
        )
    density = mass / solid.volume
    plausible = _DENSITY[0] <= density <= _DENSITY[1]
    if not plausible:
        yield finding_of(
            "inertia.density",
            body.inertial,
            element,
            density,
            title="its mass / hull volume is "
            + ("below that of foam" if density < _DENSITY[0] else "above that of lead"),
            expected=f"{_DENSITY[0]:g} .. {_DENSITY[1]:g} kg/m^3",
        )
    stated = float(np.trace(inertia)) / 2
    uniform = mass * float(np.trace(solid.inertia)) / 2
    if stated <= 0 or uniform <= 0:
        return
    reach = solid.reach(body.com)
    # Upper bound about the centre of mass: the whole mass at the farthest vertex of the hull.
    most = mass * reach**2
    shifted = point_inertia(mass, body.com)
    about_origin = inertia - shifted
    if _is_about_origin(inertia, about_origin, mass * solid.inertia, shifted):
        yield finding_of(
            "inertia.wrong_origin",
            body.inertial,
            element,
            stated,
            expected=f"half the trace near {uniform:.3g} kg*m^2, by its shape; reduced by "
            f"{float(np.trace(shifted)) / 2:.3g} kg*m^2 it fits",
        )
    elif stated > most * 1.05:
        ratio = stated / uniform
        yield finding_of(
            "inertia.too_large",
            body.inertial,
            element,
            stated,
            severity="critical" if ratio > 2e5 and plausible else "warning",
            title="its inertia is larger than any distribution of its mass within its shape allows"
            + _unit_guess(ratio),
            expected=f"half the trace near {uniform:.3g} and at most {most:.3g} kg*m^2",
        )
    elif stated < uniform / _FACTOR:
        ratio = stated / uniform
        yield finding_of(
            "inertia.too_small",
            body.inertial,
            element,
            stated,
            title="its inertia is far smaller than that of its shape" + _unit_guess(ratio),
            expected=f"half the trace near {uniform:.3g} kg*m^2",
        )

    elif (spread := _spread(mass, inertia, points)) > _SPREAD:
        yield finding_of(
            "inertia.spread",
            body.inertial,
            element,
            float(np.sqrt(spread)),
            title="along one direction its mass is spread "
            f"{np.sqrt(spread):.2g} times as wide as its shape allows",
        )


def _spread(mass: float, inertia: Vector, points: Vector) -> float:
    """Return the largest ratio of a second moment of mass to the largest within ``points`` (n, 3).

    Along a direction, the variance of anything between two planes at a distance d is at most
    d^2 / 4 (Popoviciu); the second moments are tr(I) / 2 - I_k, along the principal axes.
    """
    moments, axes = np.linalg.eigh((inertia + inertia.T) / 2)
    widths = np.ptp(points @ axes, axis=0)
    return float(np.max((moments.sum() / 2 - moments) / (mass * widths**2 / 4)))


def _at_origin(body: Body, mass: float, solid: Solid, total: float) -> Iterator[Finding]:
    away = float(np.linalg.norm(solid.centroid))
    if body.com.any() or mass < _LIGHT * total or away < _OFF_CENTRE * solid.size:
        return
    yield finding_of(
        "inertia.com_at_origin",
        body.inertial,
        _element(body),
        away,
        expected="a point near the middle of its shape, "
        + " ".join(f"{value:.3g}" for value in solid.centroid)
        + " m",
    )


def _is_about_origin(stated: Vector, shifted_back: Vector, uniform: Vector, shift: Vector) -> bool:
    """Whether the inertia fits its shape only after a shift to the centre of mass."""
    size = float(np.linalg.norm(uniform))
    # The square of a mass near the smallest double is 0.
    if size <= 0 or float(np.linalg.norm(shift)) < size or violation(shifted_back) > 0.05:
        return False
    before = float(np.linalg.norm(stated - uniform)) / size
    after = float(np.linalg.norm(shifted_back - uniform)) / size
    return after < 0.6 and before > 2 * after and principal(shifted_back)[0] > 0


def _unit_guess(ratio: float) -> str:
    for factor, unit in ((1e6, "kg*mm^2"), (1e9, "g*mm^2"), (1e4, "kg*cm^2"), (1e7, "g*cm^2")):
        if factor / 5 < ratio < factor * 5:
            return f", by a factor near {ratio:.0e}: {unit} taken for kg*m^2?"
    return ""


def _massless_moving_bodies(asset: Asset, geometry: Geometry) -> Iterator[Finding]:
    """Yield findings of moving bodies without mass or inertia."""
    members: dict[str, list[Body]] = {}
    for name, top in asset.group.items():
        if name not in asset.drawn:
            continue
        members.setdefault(top, []).append(asset.body[name])
    unreadable = {fault.element for fault in asset.faults if fault.layer == "inertia"}
    for top in sorted(asset.moving & members.keys()):
        bodies = members[top]
        if any(_element(body) in unreadable for body in bodies) or not all(
            body.stated for body in bodies
        ):
            continue
        mass, inertia = _combine_bodies(bodies, asset)
        body = asset.body[top]
        place = body.inertial or body.place
        joint = asset.joints_of[top][0]
        if mass > MASS_FLOOR and not body.mass and geometry.body(top) is not None:
            yield finding_of("inertia.shape_without_mass", place, _element(body), 0.0)
        if mass > MASS_FLOOR and principal(inertia)[0] > 1e-9 * float(np.trace(inertia)):
            continue
        shaped = any(asset.shapes_of(b.name) for b in bodies)
        carried = asset.subtrees[top][0]
        if mass <= MASS_FLOOR:
            virtual = not shaped and carried > MASS_FLOOR
            yield finding_of(
                "inertia.moving_without",
                place,
                _element(body),
                mass,
                severity="warning" if virtual else "critical",
                title=f"joint '{joint.name}' moves it, and it has no mass"
                + ("; it may be one axis of a joint with several" if virtual else ""),
            )
        elif not any(_is_flat(b) for b in bodies):
            moments = principal(inertia)
            yield finding_of(
                "inertia.zero_moment",
                place,
                _element(body),
                ", ".join(f"{value:.6g}" for value in moments),
                title=f"joint '{joint.name}' moves it, and a principal moment of its inertia is "
                "zero: it is not positive definite",
                why="about that axis its acceleration is undefined",
            )


def _massless_robot(asset: Asset) -> Iterator[Finding]:
    """Yield the finding of a robot without any mass; moving bodies are reported one by one."""
    bodies = asset.body.values()
    unreadable = "inertia" in asset.unseen or any(f.layer == "inertia" for f in asset.faults)
    if unreadable or asset.moving or not bodies or any(body.mass for body in bodies):
        return
    yield finding_of("inertia.no_mass_at_all", asset.place, f"robot '{asset.name}'", 0.0)


def _is_flat(body: Body) -> bool:
    """Whether a finding already reports its own inertia as not positive definite."""
    if body.inertia is None or np.abs(body.inertia).max() < MASS_FLOOR:
        return False
    moments = principal(body.inertia)
    return bool(moments[0] <= 1e-9 * np.abs(moments).max())


def _combine_bodies(bodies: list[Body], asset: Asset) -> tuple[float, Vector]:
    """Return mass and inertia about the common centre of mass of bodies fixed to each other."""
    parts = []
    for body in bodies:
        if not body.mass or body.mass < 0:
            if body.inertia is not None and body.name in asset.drawn:
                axes = asset.drawn[body.name][1]
                parts.append((0.0, np.zeros(3), axes @ body.inertia @ axes.T))
            continue
        position, axes = asset.drawn[body.name]
        tensor = np.zeros((3, 3)) if body.inertia is None else axes @ body.inertia @ axes.T
        parts.append((body.mass, position + axes @ body.com, tensor))
    mass = sum(part[0] for part in parts)
    if not parts:
        return 0.0, np.zeros((3, 3))
    if mass <= 0:
        return 0.0, np.asarray(sum((part[2] for part in parts), np.zeros((3, 3))))
    com = sum((part[0] * part[1] for part in parts), np.zeros(3)) / mass
    inertia = sum(
        (part[2] + point_inertia(part[0], part[1] - com) for part in parts), np.zeros((3, 3))
    )
    return mass, np.asarray(inertia)
