"""An effect: a magnet at one pose that attracts the joint."""

import numpy as np

from pytest_twin.effects import Effect, Parameter, Values, World


class Magnet(Effect):
    """A magnet at one pose that attracts the joint."""

    id = "magnet"
    family = "environment"
    law = "effort = -strength u exp((1 - u^2) / 2); u = (q - pose) / width"
    source = "gradient of a Gaussian well"
    parameters = (
        Parameter("strength", "effort", 0.0, 0.0, 10.0, (0.3,), "effort"),
        Parameter("pose", "position", None, -3.2, 3.2, (-0.6, -0.4, -0.2, 0.0, 0.2, 0.4, 0.6)),
        Parameter("width", "position", None, 0.01, 0.5, (0.05, 0.15)),
    )
    confused_with = {"cogging": "move through half a turn: cogging repeats, a magnet does not"}

    def force(self, world: World, values: Values) -> None:
        away = (world.position - values["pose"]) / np.maximum(values["width"], 1e-9)
        world.applied -= values["strength"] * away * np.exp((1.0 - away**2) / 2.0)
