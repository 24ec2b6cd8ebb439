"""Effects without a name: a force, or a level of dry friction, that is a table over one variable.

The search never proposes them. A diagnosis fits them where no effect with a name explains the
residual (:mod:`pytest_twin.diagnosis.unnamed_law`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import Effect, Parameter, Values, World

KNOTS = 64
"""Knots of a table. A tenth of a joint's range then has six, enough for a bump that narrow."""
_RANGES = ("low", "high", "valid_low", "valid_high")
_VALUES = tuple(f"value_{k:02d}" for k in range(KNOTS))
# Bounds of knots in SI units, and of values in multiples of the drive's RMS effort.
_MAX_KNOT, _MAX_VALUE = 1e6, 1e3
_SOURCE = "linear interpolation; de Boor, A Practical Guide to Splines (1978), ch. III"


@dataclass(frozen=True, slots=True)
class Variable:
    """What a table is a function of.

    Attributes:
        name: in ``diagnosis.json`` and ``effects.json``.
        units: on a hinge and on a slide.
    """

    name: str
    units: tuple[str, str]

    def unit(self, joint_type: str) -> str:
        """SI unit on a ``hinge`` or a ``slide``."""
        return self.units[joint_type == "slide"]


POSITION = Variable("position", ("rad", "m"))
VELOCITY = Variable("velocity", ("rad/s", "m/s"))
SPEED = Variable("speed", ("rad/s", "m/s"))
LOAD = Variable("load", ("N*m", "N"))
COMMAND = Variable("command", ("rad, rad/s or N*m", "m, m/s or N"))
SINCE_REVERSAL = Variable("time since reversal", ("s", "s"))
COLD_FRACTION = Variable("coldness", ("1", "1"))


def update_reversal_time(
    since: FloatArray,
    direction: FloatArray,
    velocity: FloatArray,
    still: FloatArray,
    timestep: float,
) -> tuple[FloatArray, FloatArray]:
    """Time since the last change of direction, and the direction, one step of ``timestep`` s later.

    Below the speed ``still`` a joint keeps its direction.
    """
    now = np.where(np.abs(velocity) > still, np.sign(velocity), direction)
    return np.where(now * direction < 0.0, 0.0, since + timestep), now


class _Table(Effect):
    """A table over one variable: linear between knots, zero beyond one interval from its ends.

    Class attributes:
        variables: possible arguments of the table; the parameter ``variable`` is an index.
        is_friction: whether the table is a level of dry friction instead of a force.
    """

    source = _SOURCE
    candidate = False
    variables: ClassVar[tuple[Variable, ...]]
    is_friction: ClassVar[bool]

    def variable(self, values: Mapping[str, float]) -> Variable:
        """Argument of the table."""
        return self.variables[int(values["variable"])]

    def parameters_of(
        self,
        variable: Variable,
        ends: tuple[float, float],
        valid: tuple[float, float],
        table: FloatArray,
        **others: float,
    ) -> dict[str, float]:
        """SI parameters of a (KNOTS,) table.

        Args:
            ends: first and last knot, in the unit of the variable.
            valid: range in which the table is known, in the same unit.
            table: (KNOTS,) values at the knots, N*m or N.
            others: further parameters of the law.
        """
        return {
            "variable": float(self.variables.index(variable)),
            **dict(zip(_RANGES, (*ends, *valid), strict=True)),
            **others,
            **dict(zip(_VALUES, map(float, table), strict=True)),
        }

    def table_of(self, values: Mapping[str, float]) -> dict[str, Any]:
        """The table as an object of ``effects.json``, SI units."""
        still = {"still": values["still"]} if "still" in values else {}
        return {
            "variable": self.variable(values).name,
            "knots": np.linspace(values["low"], values["high"], KNOTS).tolist(),
            "values": [values[n] for n in _VALUES],
            "range": [values["valid_low"], values["valid_high"]],
            "outside": "no force",
            **still,
        }

    def read_table(self, table: Mapping[str, Any]) -> dict[str, float]:
        """The parameters of :meth:`table_of`.

        Raises:
            ValueError: a field is missing or not a table; the message says what was expected.
        """
        names = [v.name for v in self.variables]
        if table.get("variable") not in names:
            raise ValueError(f"variable: {', '.join(names)}")
        knots, values = (_numbers(table, n, KNOTS) for n in ("knots", "values"))
        valid = _numbers(table, "range", 2)
        even = np.linspace(knots[0], knots[-1], KNOTS)
        if not (knots[0] < knots[-1] and np.allclose(knots, even, atol=1e-6 * np.ptp(knots))):
            raise ValueError("knots: ascending, at equal distances")
        variable = self.variables[names.index(table["variable"])]
        still = {}
        if any(p.name == "still" for p in self.parameters):
            (still["still"],) = _numbers({"still": [table.get("still")]}, "still", 1)
        return self.parameters_of(
            variable, (knots[0], knots[-1]), (valid[0], valid[1]), values, **still
        )

    def _interpolate(self, at: FloatArray, world: World, values: Values) -> FloatArray:
        """(rows, joints) values of the table in N*m or N, for values ``at`` of its variable."""
        memory = world.state.setdefault(self.id, {})
        if "table" not in memory:
            # Values are the same at every step of a simulation.
            table = np.stack([values[n] for n in _VALUES], axis=-1)
            memory["table"] = np.pad(table, [(0, 0), (0, 0), (1, 1)])
            interval = (values["high"] - values["low"]) / (KNOTS - 1)
            memory["per_unit"] = 1.0 / np.maximum(interval, 1e-12)
        place = np.clip((at - values["low"]) * memory["per_unit"] + 1.0, 0.0, KNOTS + 1.0)
        left = np.minimum(place.astype(np.int64), KNOTS)
        below, above = (
            np.take_along_axis(memory["table"], (left + d)[..., None], axis=-1)[..., 0]
            for d in (0, 1)
        )
        found: FloatArray = below + (place - left) * (above - below)
        return found


def _numbers(table: Mapping[str, Any], name: str, count: int) -> FloatArray:
    """(count,) finite numbers of a field of a table."""
    given = table.get(name)
    good = isinstance(given, list) and len(given) == count
    if not good or not all(type(x) in (int, float) and np.isfinite(x) for x in given or ()):
        raise ValueError(f"{name}: {count} finite numbers")
    return np.array(given, dtype=float)


_MEANINGS = {
    "low": "first knot, in the unit of the variable",
    "high": "last knot",
    "valid_low": "lower end of the range in which the table is known",
    "valid_high": "upper end of that range",
}


def _parameters(variables: Sequence[Variable], meaning: str) -> tuple[Parameter, ...]:
    choices = tuple(v.name for v in variables)
    return (
        Parameter(
            "variable", "one", None, 0.0, max(len(variables) - 1.0, 1.0),
            tuple(map(float, range(len(variables)))), choice=True, meaning="variable",
            choices=choices,
        ),
        *(
            Parameter(name, "one", None, -_MAX_KNOT, _MAX_KNOT, (0.0,), meaning=words)
            for name, words in _MEANINGS.items()
        ),
        *(
            Parameter(n, "effort", 0.0, -_MAX_VALUE, _MAX_VALUE, (0.1,), "effort", meaning=meaning)
            for n in _VALUES
        ),
    )  # fmt: skip


class UnnamedLaw(_Table):
    """A force that no effect with a name explains, as a table over position, velocity or command.

    The search never proposes it. A diagnosis fits it to the residual that all named effects leave.
    """

    id = "unnamed_law"
    family = "transmission"
    law = "effort = table(variable), linear between knots; zero outside the range of the table"
    variables: ClassVar = (POSITION, VELOCITY, COMMAND)
    is_friction: ClassVar = False
    parameters = _parameters(variables, "force at a knot")
    confused_with: ClassVar = {
        "external_force": "repeat the motion at another time: a function of the state comes back",
    }

    def force(self, world: World, values: Values) -> None:
        which = values["variable"]
        at = np.where(which == 1.0, world.velocity, world.position)
        at = np.where(which == 2.0, world.setpoint, at)
        world.applied = world.applied + self._interpolate(at, world, values)


class UnnamedFriction(_Table):
    """Dry friction that no effect with a name explains: its level is a table over position, speed,
    load, or time since the last reversal.

    The search never proposes it. A diagnosis fits it to the residual that all named effects leave.
    """

    id = "unnamed_friction"
    family = "friction"
    law = (
        "level = table(variable), linear between knots; zero outside the range of the table; "
        "with the model's own level at least zero"
    )
    variables: ClassVar = (POSITION, SPEED, LOAD, SINCE_REVERSAL)
    is_friction: ClassVar = True
    parameters = (
        *_parameters(variables, "level at a knot"),
        Parameter(
            "still", "velocity", None, 0.0, 1.0, (0.02,), "velocity",
            meaning="speed below which the direction does not change",
        ),
    )  # fmt: skip
    remembers = True
    confused_with: ClassVar = {
        "external_force": "repeat the motion at another time: a function of the state comes back",
        "position_dependent_friction": "turn the joint further: periodic friction comes back",
    }

    def friction(self, world: World, values: Values) -> None:
        which = values["variable"]
        at = world.position
        if (which == 1.0).any():
            at = np.where(which == 1.0, np.abs(world.velocity), at)
        if (which == 2.0).any():
            at = np.where(which == 2.0, np.abs(world.load), at)
        if (which == 3.0).any():
            at = np.where(which == 3.0, self._time_since_reversal(world, values["still"]), at)
        world.friction_level = world.friction_level + self._interpolate(at, world, values)

    def _time_since_reversal(self, world: World, still: FloatArray) -> FloatArray:
        memory = world.state.setdefault(self.id, {})
        if "since" not in memory:
            memory["since"], memory["direction"] = np.zeros((2, *world.velocity.shape))
        memory["since"], memory["direction"] = update_reversal_time(
            memory["since"], memory["direction"], world.velocity, still, world.timestep
        )
        since: FloatArray = memory["since"]
        return since


class UnnamedThermalFriction(_Table):
    """Dry friction that no effect with a name explains: its level is a table over the cold
    fraction of the recording, 1 in the coldest and 0 in the warmest.

    The search never proposes it. A diagnosis fits it to the residual that all named effects leave.
    """

    id = "unnamed_thermal_friction"
    family = "friction"
    law = UnnamedFriction.law
    variables: ClassVar = (COLD_FRACTION,)
    is_friction: ClassVar = True
    parameters = _parameters(variables, "level at a knot")
    needs_temperature = True
    confused_with: ClassVar = {"thermal_friction": "record at more temperatures"}

    def friction(self, world: World, values: Values) -> None:
        at = np.broadcast_to(world.cold_fraction[:, None], world.position.shape)
        world.friction_level = world.friction_level + self._interpolate(at, world, values)


TABLES: Mapping[str, UnnamedLaw | UnnamedFriction | UnnamedThermalFriction] = {
    table.id: table for table in (UnnamedLaw(), UnnamedFriction(), UnnamedThermalFriction())
}
"""Effects that are tables, by id."""
