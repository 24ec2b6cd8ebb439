"""Settings of the estimate of sensor noise: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class NoiseSettings:
    """Sizes of the local polynomials whose deviations from the samples are the sensor noise.

    They were chosen on simulated motions with known noise, sampled at 50 Hz to 1 kHz.

    Attributes:
        neighbours: samples to which a cubic is fitted.
        few_neighbours: samples to which a polynomial of degree seven is fitted, which follows fast
            motion at low sampling rates.
        apart: distance of the windows of degree seven, in samples.
        speed_groups: groups of windows with similar speed.
        quiet_share: share of the samples from which effort noise is estimated, those with the
            smallest discretization error.
        finest_effort: smallest resolution of an effort sensor, as a share of its largest reading: a
            13-bit converter.
    """

    neighbours: int = 15
    few_neighbours: int = 12
    apart: int = 4
    speed_groups: int = 12
    quiet_share: float = 0.3
    finest_effort: float = 1e-4


NOISE_ESTIMATE = NoiseSettings()
