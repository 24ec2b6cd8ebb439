"""Strategy for perturbed assets: parameters vary as between robots of one series."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from hypothesis import strategies as st

from pytest_twin.strategies.configurations import load_any
from pytest_twin.twin import Fit, Patch, Twin

if TYPE_CHECKING:
    from pytest_twin.realization import Realization

Patches = Mapping[str, Mapping[str, Patch]]


@dataclass(frozen=True, slots=True)
class Spread:
    """Largest deviation of each parameter, as a fraction of its value or as a length.

    Attributes:
        mass: mass and inertia of a body, fraction.
        com: centre of mass of a body along each axis, m.
        position: position of a body in its parent along each axis, m.
        damping, friction, armature: of a joint, fraction.
    """

    mass: float = 0.05
    com: float = 2e-3
    position: float = 5e-4
    damping: float = 0.3
    friction: float = 0.3
    armature: float = 0.1


@dataclass(frozen=True)
class Perturbation:
    """A perturbed asset.

    Attributes:
        patches: changed values in the form of ``fit:`` in ``twin.yaml``: ``body`` and ``joint`` ->
            element -> attribute -> value in SI units.
        changes: the same as text, one line for each parameter.
    """

    patches: Patches
    changes: tuple[str, ...]
    source: Realization = field(repr=False)

    @cached_property
    def realization(self) -> Realization:
        """Realization with the changed values; they also apply to its Pinocchio reference."""
        return _with_patches(self.source, self.patches)


@dataclass(frozen=True, slots=True)
class _Number:
    """A scalar or vector parameter that is perturbed."""

    family: str
    element: str
    attribute: str
    value: tuple[float, ...]
    reach: float
    unit: str
    is_relative: bool


def perturbed_assets(
    robot: Realization | Path | str, spread: Spread | None = None
) -> st.SearchStrategy[Perturbation]:
    """Draw perturbed versions of a robot; examples shrink towards the nominal robot.

    The inertia of a body is scaled with its mass, so that it stays physically consistent.

    Args:
        robot: a realization, or the path of an MJCF, a URDF or a ``twin.yaml`` (its first
            realization).
        spread: largest deviation of each parameter.

    Raises:
        TwinError: a file that is not a robot.
    """
    realization = load_any(Path(robot)) if isinstance(robot, str | Path) else robot
    numbers = list(_numbers(realization, spread or Spread()))
    moves = st.tuples(
        *(
            st.tuples(*[st.floats(-1.0, 1.0)] * (1 if number.is_relative else 3))
            for number in numbers
        )
    )
    return moves.map(lambda drawn: _perturb(realization, numbers, drawn))


def _numbers(realization: Realization, spread: Spread) -> Iterator[_Number]:
    model = realization.model
    for name in realization.names("body"):
        body = model.body(name).id
        if body == 0:
            continue
        mass = float(model.body_mass[body])
        if mass > 0 and spread.mass:
            yield _Number("body", name, "mass", (mass,), spread.mass, "kg", True)
        if mass > 0 and spread.com:
            com = tuple(model.body_ipos[body].tolist())
            yield _Number("body", name, "com", com, spread.com, "m", False)
        if spread.position and realization.spec.body(name) is not None:
            stated = tuple(float(value) for value in realization.spec.body(name).pos)
            yield _Number("body", name, "pos", stated, spread.position, "m", False)
    for name in realization.joints:
        dof = realization.joint_dof_index(name)
        for attribute, values, reach in (
            ("damping", model.dof_damping, spread.damping),
            ("frictionloss", model.dof_frictionloss, spread.friction),
            ("armature", model.dof_armature, spread.armature),
        ):
            if values[dof] > 0 and reach:
                yield _Number("joint", name, attribute, (float(values[dof]),), reach, "", True)


def _perturb(
    realization: Realization, numbers: list[_Number], drawn: tuple[tuple[float, ...], ...]
) -> Perturbation:
    patches: dict[str, dict[str, dict[str, float | tuple[float, ...]]]] = {}
    changes = []
    for number, moves in zip(numbers, drawn, strict=True):
        if not any(moves):
            continue
        patch = patches.setdefault(number.family, {}).setdefault(number.element, {})
        where = f"{number.attribute} of {number.family} '{number.element}'"
        unit = f" {number.unit}" if number.unit else ""
        if number.is_relative:
            factor = 1.0 + number.reach * moves[0]
            patch[number.attribute] = number.value[0] * factor
            if number.attribute == "mass":
                patch["inertia"] = _scaled_inertia(realization, number.element, factor)
            before, after = number.value[0], number.value[0] * factor
            changes.append(f"{where}: {before:.6g} -> {after:.6g}{unit}")
        else:
            moved = tuple(
                value + number.reach * move for value, move in zip(number.value, moves, strict=True)
            )
            patch[number.attribute] = moved
            words = (" ".join(f"{value:.6g}" for value in row) for row in (number.value, moved))
            changes.append(f"{where}: {' -> '.join(words)}{unit}")
    return Perturbation(patches, tuple(changes), realization)


def _scaled_inertia(realization: Realization, body: str, factor: float) -> tuple[float, ...]:
    from pytest_twin.realization import inertia

    model = realization.model
    _, _, moments = inertia.compiled_inertia(model, model.body(body).id)
    return inertia.six_components(factor * moments)


def _with_patches(realization: Realization, patches: Patches) -> Realization:
    """The realization with ``patches`` applied after the fit of its twin."""
    from pytest_twin.errors import SpecError
    from pytest_twin.realization import mjcf, patch
    from pytest_twin.realization.model import Realization as Made

    twin = realization.twin or Twin(realization.path, realization.name, {})
    fit = twin.fit or Fit("perturbed", {}, {}, twin.path)
    merged: dict[str, dict[str, Patch]] = {
        family: dict(elements) for family, elements in fit.patches.items()
    }
    for family, elements in patches.items():
        known = merged.setdefault(family, {})
        for name, made in elements.items():
            known[name] = {**known.get(name, {}), **made}
    spec = realization.spec.copy()
    patch.apply_fit(
        spec,
        patches,
        {},
        refuse=lambda where, problem, **details: SpecError(problem, where=where, **details),
    )
    model, _ = mjcf.compile_spec(spec)
    return Made(
        name=realization.name,
        path=realization.path,
        spec=spec,
        model=model,
        source=realization.source,
        twin=replace(twin, fit=replace(fit, patches=merged)),
    )
