"""Environment effects: forces from outside the robot."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from pytest_twin.effects.base import Effect, Parameter, Values, World
from pytest_twin.effects.fast_clip import fast_clip


class ExternalForce(Effect):
    """An external effort acts on the joint for some time."""

    id = "external_force"
    family = "environment"
    stage = "none"
    law = "effort for start <= t < start + duration, else 0"
    source = "Haddadin, De Luca, Albu-Schaeffer, IEEE T-RO 33 (2017): collision detection"
    parameters = (
        Parameter(
            "effort", "effort", 0.0, -20.0, 20.0, (0.3,), "effort", meaning="external effort"
        ),
        Parameter(
            "start",
            "time",
            None,
            0.0,
            12.0,
            tuple(0.5 * k for k in range(24)),
            "twelfth",
            reach=0.25,
            meaning="start of the effort",
        ),
        Parameter(
            "duration", "time", None, 0.02, 12.0, (0.6, 1.2, 2.4, 5.0, 12.0), "twelfth",
            reach=0.25, meaning="duration of the effort",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "thermal_friction": "record the same motion twice: an external force does not repeat",
    }

    def force(self, world: World, values: Values) -> None:
        since = world.time[:, None] - values["start"]
        # Overlap of the step with the interval: smooth in start and duration.
        inside = np.minimum(since + world.timestep, values["duration"]) - np.maximum(since, 0.0)
        world.applied += values["effort"] * fast_clip(inside / world.timestep, 0.0, 1.0)
