"""Settings of the noise floor and of windows: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PrepareSettings:
    """Thresholds by which recordings become segments with a noise floor.

    Attributes:
        unsigned: share of the greatest effort below which a model's negative efforts do not show
            the sign.
        wild: sensor noises by which a finer step may change a window of the usual length. Beyond,
            windows are half as long. Chosen, like ``wild_share``, on recordings under efforts of
            arms that swing freely.
        wild_share: share of a joint's motion by which it may.
        fewest_samples: that a window of half the length must have.
        passes: alternating estimates of the noise floor and of the weights, which depend on it.
        far_lower: share of a joint's floor below which the floor was set far too high.
        step_left: share of the step's error that remains after its correction: at most this on
            simulated arms that move without contact.
        step_of_simulation: share of the step's error by which recordings are off that were
            simulated with that step: stamps fall between steps, and numbers end.
        step_with_impacts: share of the step's error that counts where impacts fall between steps,
            as measured on an arm whose tip taps on a table.
        step_with_jumps: share where jumps of a commanded effort do, as measured on arms whose
            drives are sent efforts.
    """

    unsigned: float = 0.05
    wild: float = 30.0
    wild_share: float = 0.002
    fewest_samples: int = 20
    passes: int = 3
    far_lower: float = 0.5
    step_left: float = 0.125
    step_of_simulation: float = 0.01
    step_with_impacts: float = 0.35
    step_with_jumps: float = 0.25


PREPARE = PrepareSettings()
