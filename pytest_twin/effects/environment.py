"""Environment: pushes that come from outside."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from pytest_twin.effects.base import Effect, Parameter, Values, World
from pytest_twin.effects.within import within


class ExternalForce(Effect):
    """Something pushes the joint for a while."""

    id = "external_force"
    family = "environment"
    law = "effort from start for duration, zero elsewhere"
    source = "Haddadin, De Luca, Albu-Schaeffer, IEEE T-RO 33 (2017): collision detection"
    parameters = (
        Parameter("effort", "effort", 0.0, -20.0, 20.0, (0.3,), "effort"),
        Parameter(
            "start",
            "time",
            None,
            0.0,
            12.0,
            tuple(0.5 * k for k in range(24)),
            "twelfth",
            reach=0.25,
        ),
        Parameter(
            "duration", "time", None, 0.02, 12.0, (0.6, 1.2, 2.4, 5.0, 12.0), "twelfth", reach=0.25
        ),
    )
    confused_with: ClassVar = {"thermal_friction": "the same motion twice"}

    def force(self, world: World, values: Values) -> None:
        since = world.time[:, None] - values["start"]
        # Overlap of the step with the window, so that its edges move smoothly.
        inside = np.minimum(since + world.timestep, values["duration"]) - np.maximum(since, 0.0)
        world.applied += values["effort"] * within(inside / world.timestep, 0.0, 1.0)
