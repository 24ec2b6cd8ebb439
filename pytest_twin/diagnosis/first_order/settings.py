"""Settings of the linearized evaluation: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FirstOrderSettings:
    """Resolution of the measured motion and of the residuals, and thresholds on them.

    They were chosen so that linearized and simulated residuals of simulated cases agree.

    Attributes:
        grid: largest interval in s between samples of the motion.
        smooth: width in s of the window in which the residual is smoothed.
        at_rest: share of the typical velocity below which a joint is at rest.
        slip: share of the typical velocity over which dry friction changes its sign.
        bin: smallest width of a bin of residuals, s.
        widest_bin: largest width of a bin, s.
        most_binned: number of values (bins times signals) above which bins are made wider.
        rigid_interval: interval in s between samples of rigid-body terms, which vary as slowly as
            the motion.
        least_travel: smallest travel in rad or m that determines the spacing of wavenumbers.
        limits_from: residual in noise floors above which the limits of a joint are fitted.
    """

    grid: float = 0.005
    smooth: float = 0.1
    at_rest: float = 0.02
    slip: float = 0.005
    bin: float = 0.02
    widest_bin: float = 0.05
    most_binned: int = 12_000
    rigid_interval: float = 0.02
    least_travel: float = 0.05
    limits_from: float = 10.0


FIRST_ORDER = FirstOrderSettings()
