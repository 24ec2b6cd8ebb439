"""Fourier series that begin and end at rest for arbitrary coefficients."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from pytest_twin.arrays import FloatArray
from pytest_twin.excitation.approved_limits import ApprovedLimits

MOST_HARMONICS = 5
"""Largest number of harmonics of a joint's series (Swevers et al. 1997 use five)."""
REST = 0.25
"""Time at rest before the first and after the last period, s."""
_LONGEST_PERIOD = 2.0
"""Periods of the task's lowest frequency in one period of the series."""


@dataclass(frozen=True, slots=True)
class Series:
    """Basis of one joint's position about its centre, ``basis @ z``, and its derivatives.

    The functions are sin(w t) and 1 - cos(w t) of some harmonics (Swevers and others, IEEE
    Transactions on Robotics and Automation 13, 1997), combined so that velocity and acceleration
    are 0 at both ends of a period. Any z then gives a motion from rest to rest at the centre.

    Attributes:
        time: (n,) times over one period without its end, s.
        period: period, s, a multiple of the command interval.
        frequencies: (k,) frequencies within the task's band, Hz.
        basis, velocity, acceleration: (n, m) functions and derivatives, 1, 1/s and 1/s^2.
    """

    time: FloatArray
    period: float
    frequencies: FloatArray
    basis: FloatArray
    velocity: FloatArray
    acceleration: FloatArray

    @property
    def width(self) -> int:
        """Return m, the number of coefficients of each joint."""
        return int(self.basis.shape[1])


def period_and_frequencies(approved: ApprovedLimits, travel: float) -> tuple[float, FloatArray]:
    """Return the period [s] and the harmonics [Hz] of a series within the task's band.

    Args:
        travel: time from the start to the centre and back, s.
    """
    low, high = approved.band
    free = free_time(approved, travel)
    for seconds in (min(free, _LONGEST_PERIOD / low), free):
        period = math.floor(seconds * approved.rate + 1e-9) / approved.rate
        numbers = np.arange(math.ceil(low * period - 1e-9), math.floor(high * period + 1e-9) + 1)
        if len(numbers) >= MOST_HARMONICS:
            break
    if len(numbers) > MOST_HARMONICS:
        # Low frequencies give the largest motion at a given speed, high ones the largest
        # acceleration.
        spread = np.geomspace(numbers[0], numbers[-1], MOST_HARMONICS)
        picked = numbers[np.abs(numbers[:, None] - spread).argmin(axis=0)]
        rest = [number for number in numbers if number not in picked]
        numbers = np.sort([*np.unique(picked), *rest][:MOST_HARMONICS])
    return period, numbers / period


def free_time(approved: ApprovedLimits, travel: float) -> float:
    """Return the part of the approved duration available for whole periods, s."""
    return approved.duration - 2.0 * REST - travel


def series(approved: ApprovedLimits, travel: float = 0.0, samples: int | None = None) -> Series:
    """Return the functions at ``samples`` instants of a period; by default at every command."""
    period, frequencies = period_and_frequencies(approved, travel)
    count = round(period * approved.rate) if samples is None else samples
    time = np.arange(count) * period / count
    omega = 2.0 * math.pi * frequencies
    phase = time[:, None] * omega
    # Dividing each function by its w gives velocities of equal size.
    sines, cosines = np.sin(phase), np.cos(phase)
    free_sines = scipy.linalg.null_space(np.ones((1, len(omega))))
    free_cosines = scipy.linalg.null_space(omega[None] / omega.max())
    return Series(
        time=time,
        period=period,
        frequencies=frequencies,
        basis=np.hstack([(sines / omega) @ free_sines, ((1.0 - cosines) / omega) @ free_cosines]),
        velocity=np.hstack([cosines @ free_sines, sines @ free_cosines]),
        acceleration=np.hstack([(-sines * omega) @ free_sines, (cosines * omega) @ free_cosines]),
    )
