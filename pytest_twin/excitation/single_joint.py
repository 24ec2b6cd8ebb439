"""Motions of one joint: steps, chirps, and slow reversals under several loads."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.excitation.approved_limits import ApprovedLimits
from pytest_twin.excitation.motion import JointStates, Path, Role

STEP_SHARE = 0.05
"""Amplitude of steps and chirps as a share of the approved range, so small that gravity and
inertia are almost constant."""
SPEEDS = (0.02, 0.05, 0.1, 0.25, 0.6)
"""Speeds of slow reversals as shares of the approved speed: the lowest determines Stribeck
friction, the highest viscous friction."""
_CYCLES = 2
"""Smallest number of reversals at each speed and direction; the second tests repeatability."""

Make = Callable[[float, int], JointStates]


def steps(approved: ApprovedLimits, joint: int) -> Make:
    """Return steps of random height and length about the start, as fast as the limits allow."""

    def make(scale: float, seed: int) -> JointStates:
        random = np.random.default_rng(seed)
        height = scale * _amplitude(approved, joint)
        path = _path(approved, scale)
        low, high = approved.band
        path.dwell(0.5 / high)
        start = approved.start
        sign = 1.0
        while True:
            target = start.copy()
            target[joint] += sign * height * random.uniform(0.5, 1.0)
            back = 2.0 * path.time_to(target) + path.time_to(start)
            # Long enough to settle, short enough that many steps fit.
            rest = random.uniform(1.0, 2.0) * min(1.0 / high + 0.3, 0.5 / low)
            if path.seconds + back + 2.0 * rest > approved.duration:
                break
            path.move(target)
            path.dwell(rest)
            sign = -sign
        path.move(start)
        path.dwell(0.5 / high)
        return path.states().described(height=height)

    return make


def chirp(approved: ApprovedLimits, joint: int, role: Role) -> Make:
    """Return a sine sweep over the task's band, upwards for fit and downwards for held-out."""

    def make(scale: float, seed: int) -> JointStates:
        random = np.random.default_rng(seed)
        low, high = approved.band
        seconds = math.floor(approved.duration * approved.rate) / approved.rate
        time = np.arange(round(seconds * approved.rate) + 1) / approved.rate
        share = random.uniform(0.8, 1.0)
        ratio = math.log(high / low)
        along = time if role == "fit" else seconds - time
        phase = 2.0 * math.pi * low * seconds / ratio * np.expm1(ratio * along / seconds)
        omega = 2.0 * math.pi * low * np.exp(ratio * along / seconds)
        speed, acceleration = approved.speed[joint], approved.acceleration[joint]
        amplitude = np.minimum(
            scale * share * _amplitude(approved, joint),
            scale * np.minimum(0.9 * speed / omega, 0.9 * acceleration / omega**2),
        )
        # Fade in and out over one period at each end, or a tenth of the time.
        ramp = min(1.0 / low, 0.1 * seconds)
        amplitude = amplitude * _smooth(time / ramp) * _smooth((seconds - time) / ramp)
        wave = amplitude * np.sin(phase)
        wave *= _within_limits(wave, approved, joint)
        return _of_one(approved, joint, time, wave).described(
            frequency=[low, high], amplitude=float(np.abs(wave).max())
        )

    return make


def reversals(approved: ApprovedLimits, joint: int, pose: FloatArray, role: Role) -> Make:
    """Return slow symmetric reversals at several speeds; other joints hold ``pose`` (j,)."""

    low, high = approved.band

    def make(scale: float, seed: int) -> JointStates:
        centre = approved.start + scale * (pose - approved.start)
        # Use fewer speeds, then shorter periods, until the motion fits in the duration.
        for count in range(len(SPEEDS), 0, -1):
            for period in np.geomspace(1.0 / low, 1.0 / high, 8):
                random = np.random.default_rng(seed)
                path, used = attempt(centre, scale, SPEEDS[-count:], float(period), random)
                if path.seconds <= approved.duration and used:
                    return path.states().described(speeds=used, pose=centre.tolist())
        return path.states().described(speeds=used, pose=centre.tolist())

    def attempt(
        centre: FloatArray,
        scale: float,
        shares: Sequence[float],
        period: float,
        random: np.random.Generator,
    ) -> tuple[Path, list[float]]:
        lower, upper = approved.room
        room = 2.0 * scale * min(upper[joint] - centre[joint], centre[joint] - lower[joint])
        path = _path(approved, scale)
        path.dwell(0.5 / high)
        path.move(centre)
        used = []
        for share in shares:
            jitter = 1.0 if role == "fit" else float(random.uniform(0.7, 1.0))
            speed = scale * share * jitter * approved.speed[joint]
            # Half a period in each direction, within the position and speed limits.
            blend = math.pi * speed / (scale * approved.acceleration[joint])
            half = min(0.5 * period, 0.95 * room / speed)
            if half <= 1.2 * blend:
                # The range or the period is too short for this speed: use the largest possible one.
                half = 0.5 * period
                speed = min(
                    half * scale * approved.acceleration[joint] / (1.2 * math.pi),
                    0.95 * room / half,
                )
            if speed <= 0.0:
                continue
            sweeps = [(speed, 0.5 * half)]
            for _ in range(_CYCLES):
                sweeps += [(-speed, half), (speed, half)]
            sweeps[-1] = (speed, 0.5 * half)
            path.sweep(joint, sweeps)
            # Blends at the ends are shorter than in between, so move back to the exact centre.
            path.move(centre)
            used.append(float(speed))
        path.move(approved.start)
        path.dwell(0.5 / high)
        return path, used

    return make


def _path(approved: ApprovedLimits, scale: float) -> Path:
    """Return a path whose speed is scaled as well, because servos overshoot."""
    speed, acceleration = scale * approved.speed, scale * approved.acceleration
    return Path(approved.start, speed, acceleration, approved.rate)


def _amplitude(approved: ApprovedLimits, joint: int) -> float:
    """Return the amplitude of a small motion about the start, within the margin."""
    lower, upper = approved.room
    start = approved.start[joint]
    whole = approved.joints[joint].upper - approved.joints[joint].lower
    return float(min(STEP_SHARE * whole, upper[joint] - start, start - lower[joint]))


def _of_one(
    approved: ApprovedLimits, joint: int, time: FloatArray, wave: FloatArray
) -> JointStates:
    position, velocity, acceleration = np.zeros((3, len(time), len(approved.joints)))
    position[:] = approved.start
    position[:, joint] += wave
    velocity[:, joint] = np.gradient(wave, time, edge_order=2)
    acceleration[1:-1, joint] = np.diff(wave, 2) * approved.rate**2
    return JointStates(time, position, velocity, acceleration)


def _within_limits(wave: FloatArray, approved: ApprovedLimits, joint: int) -> float:
    """Return the factor (at most 1) at which a wave satisfies speed and acceleration limits."""
    speed = np.abs(np.diff(wave)).max() * approved.rate
    acceleration = np.abs(np.diff(wave, 2)).max() * approved.rate**2
    return float(
        min(
            1.0,
            approved.speed[joint] / max(speed, 1e-12),
            approved.acceleration[joint] / max(acceleration, 1e-12),
        )
    )


def _smooth(share: FloatArray) -> FloatArray:
    s = np.clip(share, 0.0, 1.0)
    smooth: FloatArray = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    return smooth
