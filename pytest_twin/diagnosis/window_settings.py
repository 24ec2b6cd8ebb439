"""Settings of windows and their initial states: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class WindowSettings:
    """Thresholds by which a motion is cut into windows, and their initial states are estimated.

    They were chosen on recordings of arms under effort commands, simulated and real.

    Attributes:
        start_samples: samples from which the initial state of a window is estimated.
        fewest_samples: samples that a window has at least.
        rough: a window does not begin where the mean squared deviation from a smooth motion exceeds
            this multiple of its typical value: a command jumps there.
        near: largest RMS error of a joint, as a share of its RMS travel in a window, for windows of
            the usual length.
        at_rest: travel in noise floors up to which a joint rests, so that its travel is no measure.
        shortest: shortest useful window, s. The initial state is estimated from samples around its
            start.
        beginning: duration in s of the beginning of a recording over which both initial velocities
            are compared.
        velocity_misfit: the estimated initial velocity is used if its misfit is below this share of
            the misfit from rest. Model errors are part of both.
        motor_misfit: a tried initial motor position is accepted below this share of a segment's
            misfit.
        stiction_distance: uncertain presliding distance, as a share of the smallest one in the
            catalogue.
        stiction_level: uncertainty of the friction level, as a share of it.
    """

    start_samples: int = 12
    fewest_samples: int = 8
    rough: float = 4.0
    near: float = 0.25
    at_rest: float = 10.0
    shortest: float = 0.1
    beginning: float = 0.25
    velocity_misfit: float = 0.2
    motor_misfit: float = 0.95
    stiction_distance: float = 0.05
    stiction_level: float = 0.05


WINDOWS = WindowSettings()
