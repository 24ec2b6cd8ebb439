"""List of all properties, and the tests of an asset."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pytest_twin.errors import SpecError
from pytest_twin.properties import agreement, dynamics, transformations
from pytest_twin.properties.asset import Asset, load_asset
from pytest_twin.properties.tolerances import Tolerances
from pytest_twin.properties.violation import Broken, PropertyError

EXAMPLES = 10
"""Default number of random configurations."""


@dataclass(frozen=True, slots=True)
class Property:
    """A property of realizations.

    Attributes:
        check: returns the violations of an asset, at a configuration if it ``needs_poses``.
        needs_poses: whether it is tested at random configurations, or once.
        compares: whether it needs two realizations.
    """

    name: str
    check: Callable[..., Iterable[Broken]]
    needs_poses: bool
    compares: bool

    @property
    def doc(self) -> str:
        """Description of the property, one line."""
        return (self.check.__doc__ or "").strip().splitlines()[0]

    def hold(self, asset: Asset, q: Mapping[str, float] | None = None) -> None:
        """Test the property on an asset.

        Args:
            q: joint -> rad or m; the generic configuration if None.

        Raises:
            PropertyError: the asset violates the property.
        """
        __tracebackhide__ = True
        if self.needs_poses:
            at = asset.generic if q is None else q
            broken = list(self.check(asset, at))
        else:
            at, broken = None, list(self.check(asset))
        if broken:
            raise PropertyError(self.name, asset.name, broken, at)


def _property(check: Callable[..., Iterable[Broken]], posed: bool, compares: bool) -> Property:
    return Property(check.__name__, check, posed, compares)


PROPERTIES: Mapping[str, Property] = {
    made.name: made
    for made in (
        _property(agreement.joints_and_frames, posed=False, compares=True),
        _property(agreement.forward_kinematics, posed=True, compares=True),
        _property(agreement.joint_direction, posed=True, compares=True),
        _property(agreement.center_of_mass, posed=True, compares=True),
        _property(agreement.link_inertias, posed=False, compares=True),
        _property(agreement.mass_matrix, posed=True, compares=True),
        _property(agreement.gravity_torque, posed=True, compares=True),
        _property(agreement.limits, posed=False, compares=True),
        _property(agreement.passive_terms, posed=False, compares=True),
        _property(agreement.couplings, posed=False, compares=True),
        _property(agreement.collision_shapes, posed=False, compares=True),
        _property(dynamics.possible_inertias, posed=False, compares=False),
        _property(dynamics.positive_definite_mass_matrix, posed=True, compares=False),
        _property(dynamics.kinetic_energy, posed=True, compares=False),
        _property(dynamics.gravity_is_gradient, posed=True, compares=False),
        _property(dynamics.coriolis_forces, posed=True, compares=False),
        _property(dynamics.energy_conservation, posed=True, compares=False),
        _property(transformations.written_and_read, posed=True, compares=False),
        _property(transformations.mirrored, posed=True, compares=False),
        _property(transformations.rerooted, posed=True, compares=False),
    )
}
"""Name -> property, in the order in which they are tested."""


def asset_properties(
    asset: Asset | Path | str,
    *,
    tolerances: Tolerances | None = None,
    leave_out: Collection[str] = (),
    examples: int = EXAMPLES,
    usd: bool | Path | str = True,
    packages: Mapping[str, Path] | None = None,
    accept: Iterable[str] = (),
) -> Callable[..., None]:
    """Create a parametrized test of all properties, ``test_asset = asset_properties("twin.yaml")``.

    The asset is loaded once, when the first test runs.

    Args:
        asset: ``twin.yaml``, a URDF or an MJCF, relative to the calling file; or an asset.
        tolerances: allowed differences between realizations.
        leave_out: names of properties that are not tested.
        examples: number of random configurations for each property, after a generic one.
        usd: for a URDF: an existing stage, relative to the calling file; or whether to create one,
            if the extra ``usd`` is installed.
        packages: ROS package -> its folder, for meshes of a URDF.
        accept: accepted repairs of a URDF, ``inertia-repair:<link>``.

    Raises:
        SpecError: a property that does not exist.
        ImportError: hypothesis is not installed.
    """
    import pytest

    from pytest_twin import strategies

    wanted = wanted_properties(leave_out)
    if isinstance(asset, str | Path):
        beside = Path(sys._getframe(1).f_globals.get("__file__", "")).parent
        ready = _LazyAsset(
            beside / asset,
            tolerances=tolerances,
            usd=usd if isinstance(usd, bool) else beside / usd,
            packages=packages,
            accept=tuple(accept),
        )
    else:
        ready = _LazyAsset(asset)

    @pytest.mark.parametrize("robot_property", list(wanted))
    def test_property(robot_property: str) -> None:
        __tracebackhide__ = True
        loaded = ready.asset
        made = wanted[robot_property]
        if made.compares and not loaded.others:
            pytest.skip("; ".join(loaded.left_out) or "one realization alone")
        if made.needs_poses:
            # A failure at the reference configuration is the simplest to understand.
            made.hold(loaded, loaded.rest)
        made.hold(loaded)
        if made.needs_poses and loaded.configurations.independent:
            _test_random_configurations(
                made, loaded, strategies.configurations(loaded.simulated[0]), examples
            )

    return test_property


def wanted_properties(leave_out: Collection[str]) -> dict[str, Property]:
    """All properties without those in ``leave_out``, by name.

    Raises:
        SpecError: a name that is not a property.
    """
    for name in leave_out:
        if name not in PROPERTIES:
            raise SpecError(
                "no such property",
                where="leave_out",
                value=name,
                expected=", ".join(PROPERTIES),
            )
    return {name: made for name, made in PROPERTIES.items() if name not in leave_out}


def _test_random_configurations(made: Property, asset: Asset, drawn: Any, examples: int) -> None:
    from hypothesis import HealthCheck, given, settings

    @settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
    )
    @given(q=drawn)
    def holds(q: dict[str, float]) -> None:
        made.hold(asset, q)

    holds()


class _LazyAsset:
    """An asset that is loaded once, when it is first used."""

    def __init__(self, source: Asset | Path, **options: Any) -> None:
        self._source = source
        self._options = options

    @property
    def asset(self) -> Asset:
        if not isinstance(self._source, Asset):
            self._source = load_asset(self._source, **self._options)
        return self._source
