"""Integration of an exported model: integrator and time step, and what depends on them."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import mujoco

from pytest_twin.effects.constraint import follow_timestep

_RK4 = int(mujoco.mjtIntegrator.mjINT_RK4)
_BRISTLE_STIFFNESS = 5
"""Index of the stiffness of bristles in ``dynprm`` of a ``dcmotor``."""
_SPARE_SAMPLES = 3
"""Samples of a delay line beyond the delay itself."""


@dataclass(frozen=True, slots=True)
class Integration:
    """How the exported model is stepped.

    Attributes:
        integrator: one of MuJoCo's.
        divisor: number of steps in one step of the diagnosed model.
        name: name of the integrator, where it is not MuJoCo's.
    """

    integrator: int
    divisor: int = 1
    name: str = ""

    def apply(self, spec: mujoco.MjSpec, bristles: Collection[str] = ()) -> None:
        """Set the options of a spec, and adapt dry friction, delays and filters to them.

        Args:
            spec: changed in place.
            bristles: actuators whose bristles are as stiff as the time step resolves.
        """
        spec.option.integrator = self.integrator
        before = float(spec.option.timestep)
        spec.option.timestep = step = before / self.divisor
        follow_timestep(spec, before)
        for actuator in spec.actuators:
            if self.integrator == _RK4:
                _adapt_to_fourth_order(actuator, step)
            if actuator.name in bristles:
                # Of inertia divided by the step squared.
                actuator.dynprm[_BRISTLE_STIFFNESS] *= self.divisor**2
            if actuator.delay > 0.0:
                actuator.nsample = math.ceil(actuator.delay / step) + _SPARE_SAMPLES
        for sensor in spec.sensors:
            if getattr(sensor, "delay", 0.0) > 0.0:
                sensor.nsample = math.ceil(sensor.delay / step) + _SPARE_SAMPLES

    @property
    def words(self) -> str:
        """The integrator, and the divisor where it is not 1."""
        name = self.name or mujoco.mjtIntegrator(self.integrator).name.removeprefix("mjINT_")
        return name if self.divisor == 1 else f"{name}, time step / {self.divisor}"


def integrations(model: mujoco.MjModel) -> tuple[Integration, ...]:
    """Candidates in the order of their cost: the model's own, fourth order, smaller steps."""
    own, fourth = int(model.opt.integrator), int(mujoco.mjtIntegrator.mjINT_RK4)
    if own == fourth:
        return (Integration(own), Integration(own, 2), Integration(own, 4))
    return (
        Integration(own), Integration(fourth), Integration(own, 4), Integration(fourth, 2),
        Integration(own, 8), Integration(own, 16), Integration(own, 32),
    )  # fmt: skip


def _adapt_to_fourth_order(actuator: mujoco.MjsActuator, step: float) -> None:
    """Correct what MuJoCo's RK4 integrates differently.

    - A delay line with linear interpolation reads a command that is held over a step half a step
      early, because stages within the step read it too.
    - The exact integration of a filter is applied to the mean slope of the stages, which has the
      decay within the step already. The current of a ``dcmotor``, which leads by a step besides,
      has no such substitute: it needs small steps of another integrator.
    """
    if actuator.delay > 0.0 and actuator.interp == 1:
        actuator.delay += step / 2.0
    if actuator.dyntype == mujoco.mjtDyn.mjDYN_FILTEREXACT and actuator.dynprm[0] > step:
        actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTER
